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

With --robustness it also writes robustness.csv: errors of single frames whose image is changed (1 % scale, 2 px shift, 1 deg
turn, 5 pins erased, each in a random direction), and how much larger they are than those of the same frames unchanged.
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
    from training.studies.evaluation import evaluate_run
    from twin.cli.output import tell
    from twin.cli.progress import shown

    with shown() as progress:
        found = evaluate_run(run, data, writable_folder(out), rows=rows, labels=labels, robustness=robustness, progress=progress)
    tell(found)
