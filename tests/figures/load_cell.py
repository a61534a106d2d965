"""Forces against a load cell: a public table of poses and forces, of which 20 rows are fitted and the others judge."""

from pathlib import Path

import numpy as np

from figures.jobs import NO_PICTURES, Measured, Value, job, real_folder
from scenes import load_experiment, load_sensor
from scenes.rig import RigSpec
from twin.calibration.contact.calibrate import calibrate_to_file
from twin.calibration.size import of_radius

TABLE = "force-127"
RADIUS_MM = 13.5  # of the tip at the start, whose tool point is at its end; the fit moves both
ROWS, ACROSS, SEED = 20, 8, 0


@job(
    "load_cell.mg400-127",
    f"twin calibrate contact --sensor SMALLER.toml --frames {TABLE}/targets.csv --experiment surface-3d-sheared --num-labelled {ROWS} "
    f"--elements {ACROSS} --out FITTED.toml",
    sensors=("mg400-127",),
    code=("twin.calibration.contact.forces",),
    beside=NO_PICTURES,
    recordings=(TABLE,),
    minutes=15,
)
def load_cell(work: Path) -> Measured:
    """Mean absolute errors before and after the fit, the share inside the intervals, and the fitted parameters with their intervals."""
    sensor = load_sensor("mg400-127")
    tip = of_radius(sensor.model_copy(update={"rig": RigSpec(tcp_to_dome_mm=-sensor.skin.apex_mm)}), RADIUS_MM)
    table, experiment = real_folder(TABLE) / "targets.csv", load_experiment("surface-3d-sheared")
    summary = calibrate_to_file(table, tip, experiment, work / "fitted.toml", labels=ROWS, seed=SEED, workers=2, across=ACROSS).summary
    judged, found = summary["parts"]["judged"], {}
    for key in ("before", "error"):
        found |= {f"{key}_{axis}": Value(value, "N") for axis, value in zip("xyz", judged[f"{key}_n"], strict=True)}
    found |= {"inside": Value(judged["inside"]), "judged": Value(judged["rows"]), "fitted": Value(summary["parts"]["fitted"]["rows"])}
    for each in summary["parameters"]:
        name = each["name"].replace("[", "").replace("]", "")
        found |= {f"{name}.{key}": Value(each[key] if each["known"] or key == "value" else np.nan) for key in ("value", "low", "high")}
    return found
