"""A network that is trained on real frames without labels: model inversion estimates their labels (pseudo-labels).

The twin is read in seconds for hundreds of frames, but not by a live loop. The network has nearly its errors, and is a run as any other. It
needs no label of these frames, only more of them.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from training.data.dataset import Dataset
from training.data.targets import Targets
from training.estimate.estimator import PoseEstimator
from training.runs.assemble import intervals
from training.studies.sim_to_real.inverse_estimates import TwinRead, named_labels
from training.studies.sim_to_real.steps import train_on_real, widen_intervals
from twin.progress import Step
from twin.rig.labels import ArmLabel


def teach(
    twin: TwinRead,
    real: Dataset,
    labels: Sequence[ArmLabel],
    few: np.ndarray,
    unlabelled: np.ndarray,
    out: Path,
    *,
    seed: int,
    epochs: int | None,
    progress: Step | None = None,
) -> None:
    """Train a run on labelled frames and on frames whose labels that model inversion estimates, or continue it.

    The intervals are at least as wide as the twin's errors on labelled frames that are estimated from other ones.

    Parameters
    ----------
    real : Dataset
        A recording.
    labels : sequence of ArmLabel
        Of all its frames. Those of the frames ``unlabelled`` are not used.
    few, unlabelled : (n,) and (u,) int
        Rows of the labelled frames, and of the others to learn from.
    out : Path
        Folder of the run.
    epochs : int or None
        None: the recipe's own.
    """
    moved, known = real.pins.nodes_px - real.pins.reference.pins_px, [labels[row] for row in few]
    told = named_labels(twin.estimate(moved[few], known, moved[unlabelled], moved[unlabelled]), real.targets.names)
    rows = np.sort(np.concatenate([few, unlabelled]))
    train_on_real(
        replace(real, targets=_with_estimated(real.targets, few, unlabelled, told)).rows(rows),
        out,
        seed=seed,
        epochs=epochs,
        progress=progress,
    )
    judged, found = twin.left_out(moved[few], known)
    part = real.rows(few[judged])
    if not len(part):
        return
    estimator = PoseEstimator.load(out)
    inputs, index = estimator.inputs_of(part.pins, together=not part.pins.measured)
    mean, scale, executed = estimator.ensemble.outputs(inputs, index)
    _, scale = estimator.ensemble.destandardise(mean, scale)
    made = named_labels(found, part.targets.names)
    said = intervals(made, scale, part.targets.corrected, part.targets.raw, executed, part.targets.units)
    widen_intervals(out, {key: np.maximum(getattr(estimator.ensemble, key), width) for key, width in said.items()})


def _with_estimated(targets: Targets, few: np.ndarray, unlabelled: np.ndarray, told: np.ndarray) -> Targets:
    """Targets with the labels (u, K) that are estimated for frames without; nothing is known of their moves."""
    corrected, nothing = targets.corrected.copy(), np.full(len(targets.executed), np.nan)
    corrected[unlabelled] = told
    raw = corrected.copy()
    raw[few] = targets.raw[few]
    return replace(targets, raw=raw, corrected=corrected, executed=nothing, move=np.full_like(targets.move, np.nan))
