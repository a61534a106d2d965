"""Forces against a load cell: a public table of poses and forces, to 20 rows of which the twin is fitted."""

from pathlib import Path

from figures.jobs import NO_PICTURES, Measured, Value, job, real_folder
from scenes import load_experiment, load_sensor
from scenes.rig import RigSpec
from training.studies.validation import validate_contacts
from twin.calibration.contact.calibrate import calibrate_to_file
from twin.calibration.size import of_radius

TABLE, SENSOR, EXPERIMENT = "force-127", "mg400-127", "surface-3d-sheared"
SMALL_MM = 10.2  # radius of the miniature tip that a published generator makes, as tip-miniature has it
ROWS, ACROSS, SEED = 20, 8, 0


@job(
    f"load_cell.{SENSOR}",
    f"twin calibrate contact --sensor {SENSOR} --frames {TABLE}/targets.csv --experiment {EXPERIMENT} --num-labelled {ROWS} "
    f"--elements {ACROSS} --out FITTED.toml",
    sensors=(SENSOR,),
    code=("training.studies.validation", "twin.calibration.contact.forces"),
    beside=NO_PICTURES,
    recordings=(TABLE,),
    minutes=15,
)
def load_cell(work: Path) -> Measured:
    """Mean absolute errors before and after the fit, and of a small tip with nothing fitted; intervals; fitted parameters with theirs."""
    sensor, table, experiment = load_sensor(SENSOR), real_folder(TABLE) / "targets.csv", load_experiment(EXPERIMENT)
    small = of_radius(sensor.model_copy(update={"rig": RigSpec(tcp_to_dome_mm=-sensor.skin.apex_mm)}), SMALL_MM)
    plain = validate_contacts(small, table, experiment, work / "small", across=ACROSS).summary["parts"]["evaluated"]
    fitted = calibrate_to_file(table, sensor, experiment, work / "fitted.toml", labels=ROWS, seed=SEED, workers=2, across=ACROSS).summary
    held = fitted["parts"]["evaluated"]
    errors = {"before": held["before_n"], "error": held["error_n"], "small": plain["error_n"]}
    shapes = {
        "correlation": held["correlation"],
        "scale": held["scale"],
        "small_correlation": plain["correlation"],
        "small_scale": plain["scale"],
    }
    found = {f"{key}_{axis}": Value(value, "N") for key, of in errors.items() for axis, value in zip("xyz", of, strict=True)}
    found |= {f"{key}_{axis}": Value(value) for key, of in shapes.items() for axis, value in zip("xyz", of, strict=True)}
    found |= {"inside": Value(held["inside"]), "evaluated": Value(held["rows"]), "fitted": Value(fitted["parts"]["fitted"]["rows"])}
    for name, each in zip(("sliding", "sticking"), fitted["slip"], strict=True):
        found |= {f"{name}.rows": Value(each["rows"]), f"{name}.ratio": Value(each["ratio"])}
    for each in fitted["parameters"]:
        name = each["name"].replace(".", "_")
        found |= (
            {f"{name}.{key}": Value(each[key]) for key in ("start", "value", "low", "high")} if "force_sensor" not in each["name"] else {}
        )
    return found
