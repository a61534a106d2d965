"""``twin evaluate``: how good a trained model is."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import Out, writable_folder

HELP = """Judge a trained model on a labelled recording.

\b
--rows validation  the fifth of the run's own recording that was kept out of its training
--rows all         every row: for a recording that the model has not seen

\b
Writes predictions.csv (image_name, and for every label <label>_true, _pred, _lo90, _hi90; executed_probability, valid),
metrics.json (mean absolute errors against raw and corrected labels, overall and by depth, angle and shear; coverage of the
90 % intervals; slope of the angle's error on move_6 over frames whose move was not executed; ms per frame), errors.png.

With --robustness also robustness.csv: errors of single frames when the image itself is changed (1 % scale, 2 px shift, 1 deg
turn, 5 pins erased, each in a random direction), and by which part they are larger than those of the same frames unchanged.
"""


@app.command("evaluate", help=HELP)
def evaluate(
    run: Annotated[Path, typer.Argument(help="folder of a training run, or a sensor whose weights go with the package")],
    data: Annotated[list[Path], typer.Option("--data", metavar="DIR", help="labelled recording; all that the run was trained on")],
    out: Out,
    rows: Annotated[str, typer.Option("--rows", help="validation or all")] = "validation",
    labels: Annotated[str, typer.Option("--labels", help="truth in predictions.csv and errors.png: corrected or raw")] = "corrected",
    robustness: Annotated[bool, typer.Option("--robustness", help="also judge changed images (five times the frames)")] = False,
) -> None:
    from training.dataset import joined, load_dataset
    from training.estimator import PoseEstimator
    from training.evaluate import judge, predict_rows_of, rows_to_judge, time_frames, write_evaluation
    from training.recipes import TrainingError
    from training.robustness import judge_changes
    from twin.cli.progress import count_bar
    from twin.report.table import write_table

    for value, allowed, option in ((rows, ("validation", "all"), "--rows"), (labels, ("corrected", "raw"), "--labels")):
        if value not in allowed:
            raise TrainingError(f"{option} must be {' or '.join(allowed)}, got {value!r}")
    estimator = PoseEstimator.load(run)
    with count_bar("frames") as progress:
        parts = [load_dataset(folder, estimator.sensor, estimator.names, form=estimator.form, progress=progress) for folder in data]
    found = joined(parts)
    for problem in found.problems:
        print(f"note: {problem}")
    chosen = rows_to_judge(estimator, found, rows)
    made = predict_rows_of(estimator, found, chosen)
    metrics = {"model": estimator.model, "rows": rows, **judge(made, found, chosen), "ms_per_frame": time_frames(estimator, found)}
    writable_folder(out)
    for name, unit in zip(estimator.names, estimator.units, strict=True):
        raw, corrected = metrics["raw"][name], metrics["corrected"][name]
        print(
            f"{name}: mean error {corrected['mae']:.4g} {unit} against corrected labels, {raw['mae']:.4g} against raw; "
            f"{100 * corrected['coverage_90']:.1f} % and {100 * raw['coverage_90']:.1f} % inside the 90 % intervals for them"
        )
    if metrics["leak_slope"] is not None:
        print(f"slope of the angle's error on move_6 where it was not executed: {metrics['leak_slope']:+.3f}")
    else:
        print(f"leak check not made: {metrics['leak_not_checked']}")
    ms = metrics["ms_per_frame"]
    print(f"{len(chosen)} frames" + ("" if ms is None else f", {ms:.1f} ms per frame (median, one thread)"))
    written = write_evaluation(out, made, found, chosen, metrics, labels)
    if robustness:
        with count_bar("changed frames") as progress:
            changes = judge_changes(estimator, found, chosen, progress=progress)
        for row in changes:
            said = (f"{name} {row[f'{name}_mae']:.4g} ({100 * row[f'{name}_more']:+.1f} %)" for name in estimator.names)
            print(f"{row['change']}: {', '.join(said)}; {row['not_valid']} frames not valid")
        written.append(write_table(out / "robustness.csv", changes))
    for path in written:
        print(f"wrote {path}")
