"""On six recordings: the effect of the twin by the number of labelled frames, and whether shipped intervals hold what they say."""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from figures.jobs import NO_PICTURES, ROOT, Measured, Value, job, real_folder
from scenes import load_experiment, load_sensor
from training.data.dataset import load_dataset
from training.data.targets import unit_of
from training.estimate.estimator import PoseEstimator
from training.studies.evaluation import models_of_kinds
from training.studies.judging import measure_errors
from training.studies.sim_to_real import SimToRealPlan
from training.studies.sim_to_real.study import errors_figure, label_efficiency
from twin.frames import open_recording
from twin.report.charts import write_chart
from twin.store import write_json

RECORDINGS = {  # by recording: sensor, experiment, contacts, elements across, minutes on two idle cores
    "tac-vgnn-331": ("mg400-331", "surface-2d", 300, 20, 20.0),
    "tac-vgnn-127": ("mg400-127", "surface-2d", 300, 20, 15.0),
    "ur5-331-surface-3d-tap": ("ur5-331", "surface-3d", 300, 12, 12.0),
    "ur5-331-surface-3d-shear": ("ur5-331", "surface-3d-sheared", 300, 12, 25.0),
    "ur5-331-edge-2d-tap": ("ur5-331", "edge-circle", 800, 12, 40.0),
    "ur5-331-edge-2d-shear": ("ur5-331", "edge-circle-sheared", 500, 12, 60.0),
}
SEEDS = (0, 1, 2, 3, 4)
CHARTS = ROOT / "docs" / "pictures"
"""Where the charts are written, one for each recording."""
CHART_DPI = 90


def draw(work: Path, plan: SimToRealPlan, seed: int) -> list[dict[str, Any]]:
    """Rows of one draw of frames. A draw that was measured before the work was interrupted is read."""
    kept = work / f"draw-{seed}.json"
    if not kept.is_file():
        write_json(kept, label_efficiency(plan, work / "worth", (seed,)))
    rows: list[dict[str, Any]] = json.loads(kept.read_text())
    return rows


def over_draws(draws: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """One row for each model and number of labels: the mean of its errors, and of ``KEY_most`` the largest."""
    by_row: dict[tuple[object, ...], list[dict[str, Any]]] = {}
    for row in (row for rows in draws for row in rows):
        by_row.setdefault((row["trained_on"], row["model"], row["labelled_frames"]), []).append(row)
    found = []
    for rows in by_row.values():
        errors = {key: [row[key] for row in rows] for key, value in rows[0].items() if isinstance(value, float)}
        found.append(rows[0] | {key: max(each) if key.endswith("_most") else float(np.mean(each)) for key, each in errors.items()})
    return found


def by_labels(work: Path, *, recording: str) -> Measured:
    """Mean errors over the draws of frames, the largest for ``Plan.labels`` labels, and their chart."""
    sensor, experiment, count, across, _ = RECORDINGS[recording]
    plan = SimToRealPlan(load_sensor(sensor), real_folder(recording), load_experiment(experiment), count=count, across=across, workers=2)
    rows = over_draws([draw(work, plan, seed) for seed in SEEDS])
    CHARTS.mkdir(parents=True, exist_ok=True)
    write_chart(CHARTS / f"labels-{recording}.png", lambda: errors_figure(rows, plan.experiment.targets), dpi=CHART_DPI)
    found = {}
    for row in rows:
        about = "_".join((row["trained_on"], str(row["labelled_frames"]), row["model"]))
        name = "".join(letter if letter.isalnum() else "_" for letter in about)
        errors = {column: row[f"{column}_corrected"] for column in plan.experiment.targets}
        if row["labelled_frames"] == plan.labels:
            errors |= {f"{column}_most": row[f"{column}_corrected_most"] for column in plan.experiment.targets}
        found |= {f"{name}.{column}": Value(error, unit_of(column.removesuffix("_most"))) for column, error in errors.items()}
    return found


def inside(work: Path, *, recording: str) -> Measured:
    """Share of the frames that the shipped weights did not learn from whose labels lie inside their intervals of 90 %."""
    sensor, folder = RECORDINGS[recording][0], real_folder(recording)
    several = models_of_kinds(sensor, folder)
    kinds = several.for_labels(open_recording(folder, several.sensor)) if several else []
    estimator = several.parts[kinds[0]] if several else PoseEstimator.load(sensor)
    data = load_dataset(folder, estimator.recorded_sensor, estimator.names, form=estimator.form)
    kept_out, names = estimator.config["rows"]["kept_out"], data.pins.image_name
    rows = np.flatnonzero(np.isin(names, kept_out) | np.isin([f"{recording}/{name}" for name in names], kept_out))
    made = several.predict_rows(data, rows, kinds) if several else estimator.predict_rows(data, rows)
    judged = measure_errors(made, data, rows)["corrected"]
    shares = {f"{name}.inside": Value(judged[name]["coverage_90"]) for name in estimator.names}
    return shares | {f"{name}.error": Value(judged[name]["mae"], unit_of(name)) for name in estimator.names} | {"frames": Value(len(rows))}


def register() -> None:
    """Two jobs for each recording."""
    for recording, (sensor, experiment, count, across, minutes) in RECORDINGS.items():
        command = f"worth(Plan({sensor}, {recording}, {experiment}, count={count}, across={across}), out, {SEEDS})"
        job(
            f"labels.{recording}",
            command,
            sensors=(sensor,),
            code=("training.studies.sim_to_real.study",),
            recordings=(recording,),
            minutes=minutes,
            beside=NO_PICTURES,
        )(partial(by_labels, recording=recording))
        job(
            f"intervals.{recording}",
            f"shipped weights of {sensor} on frames of {recording} that they did not learn from",
            sensors=(sensor,),
            code=("training.studies.evaluation",),
            shipped=(f"training/weights/{sensor}",),
            recordings=(recording,),
            minutes=2.0,
            beside=NO_PICTURES,
        )(partial(inside, recording=recording))


register()
