"""The value of the twin: errors by the number of labelled frames, with and without the twin, of models that need no training.

With the twin: it is read (``read``). Without: quadratic regression. Both with frames sampled at random and with frames nearest to an even
sequence. With the twin also: frames without labels beside labelled ones. All models together take minutes for a plate, and half an hour
for an edge with five thousand frames.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from training.data.dataset import load_dataset
from training.data.label_code import goes_round
from training.studies.sim_to_real import steps
from training.studies.sim_to_real.model_inversion import read_row, read_twin
from training.studies.sim_to_real.steps import BOTH, EVENLY, REAL, WITHOUT, SimToRealPlan
from twin.progress import Progress, silent, stage

UNLABELLED = (300, 3000)
"""Numbers of frames without labels that the twin is given beside the ``Plan.labels`` labelled ones, where a label is a direction."""


def label_efficiency(plan: SimToRealPlan, out: Path, seeds: Sequence[int], *, progress: Progress = silent) -> list[dict[str, Any]]:
    """Rows as those of the study's table: the mean over the draws of frames by these seeds, and the largest. Contacts have the rig's one
    friction.

    Parameters
    ----------
    plan : Plan
        ``draws``, ``calibrate``, ``ablate`` and ``epochs`` do not matter; ``seed`` is that of the contacts.
    out : Path
        Folder of the simulated contacts; those that it holds are used again.

    Raises
    ------
    TrainingError
        There are too few frames, or the labels of the simulated contacts differ from theirs.
    """
    with stage(progress, "frames") as step:
        real = load_dataset(plan.frames, plan.sensor, plan.experiment.targets, progress=step).in_order()
    labels = steps.arm_labels(real)
    sets = steps.full_twin(plan, plan.sensor, labels, None).simulated_sets(plan, out, plan.sensor, real.pins.form, plan.simulated, progress)
    twin = read_twin(sets, plan.target_object, plan.experiment, seed=plan.seed)
    unlabelled = UNLABELLED if any(goes_round(real.targets.units, real.targets.corrected)) else ()
    found: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for seed in seeds:
        chosen = steps.choose_frames(len(real), plan.labels, seed)
        every = [np.zeros(0, int), *chosen.nested, chosen.trained["all"]]
        made = []
        for designed, among in (("", every), (EVENLY, steps.designed_frames(real, chosen, seed))):
            for rows in among:
                made.append(read_row(f"{BOTH}{designed}", twin, real, labels, rows, chosen.test))
                if len(rows):
                    made.append(steps.quadratic_row(f"{REAL}{designed}", real, rows, chosen.test))
        pool = np.random.default_rng(seed).permutation(np.setdiff1d(chosen.trained["all"], chosen.few))
        for count in unlabelled:
            if count <= len(pool):
                name, more = BOTH + WITHOUT.format(count=count), np.sort(pool[:count])
                made.append(read_row(name, twin, real, labels, chosen.few, chosen.test, unlabelled=more))
        for row in made:
            found.setdefault((row["trained_on"], row["model"], row["labelled_frames"]), []).append(row)
    return [_summary(rows) for rows in found.values()]


def _summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One row with the mean of each error, and its largest value as ``KEY_most``."""
    errors = {key: [row[key] for row in rows] for key in rows[0] if key.endswith(("_corrected", "_raw"))}
    named = {key: rows[0][key] for key in ("trained_on", "labelled_frames", "model")}
    most = {f"{key}_most": float(max(each)) for key, each in errors.items()}
    return named | {key: float(np.mean(each)) for key, each in errors.items()} | most
