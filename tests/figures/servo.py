"""Following the paper's five objects in the twin with the shipped weights."""

import csv
from pathlib import Path

from figures.jobs import DRAWN, Measured, Value, job, run_twin

COLUMNS = {
    "path_error_mm": "mm",
    "depth_error_mm": "mm",
    "angle_error_deg": "deg",
    "hold_depth_mm": "mm",
    "hold_angle_deg": "deg",
    "smoothness": "",
    "completed": "",
    "lost_contacts": "",
}


@job(
    "servo.mg400-331",
    "twin study servo --model mg400-331 --out OUT",
    sensors=("mg400-331",),
    code=("hardware.servo.following", "training.estimate.estimator"),
    shipped=("training/weights/mg400-331",),
    minutes=15,
    beside=DRAWN,
)
def servo(work: Path) -> Measured:
    """One round of each object."""
    run_twin(work, "study", "servo", "--model", "mg400-331", "--out", work / "study")
    with (work / "study" / "study.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {f"{row['object']}.{name}": Value(float(row[name]), unit) for row in rows for name, unit in COLUMNS.items()}
