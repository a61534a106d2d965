"""Forces against a load cell: two public tables of poses and forces, to 20 rows of each of which the twin is fitted."""

import csv
from pathlib import Path
from typing import Any

import numpy as np

from figures.jobs import NO_PICTURES, Measured, Value, job, real_folder
from scenes import load_experiment, load_object, load_sensor
from scenes.rig import ForceSensorSpec, RigSpec
from scenes.sensor import SensorSpec
from training.studies.validation import validate_contacts
from twin.calibration.contact.calibrate import calibrate_to_file
from twin.calibration.contact.forces import ForceComparison, ForceSetup, read_forces
from twin.calibration.size import of_radius
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.report.page import force_interval
from twin.rig.contact import RigContact
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel
from twin.types import FINE

TABLE, SENSOR, EXPERIMENT = "force-127", "mg400-127", "surface-3d-sheared"
SMALL_MM = 10.2  # radius of the miniature tip that a published generator makes, as tip-miniature has it
ROWS, ACROSS, SEED = 20, 8, 0
CURVES, MINI, ZERO_MM = "force-minitip", "mg400-331", -2.0
"""The table of the miniature tip with 331 pins, the specification that it starts from, and its zero of depth at the start: contacts of
2.5 mm hardly touch."""
REFERENCE_MM = 2.0
"""Depth of the flat press whose force compares the stiffness of units, mm."""
PRESSED_S, HELD_S, DRAGGED_S = 0.206, (0.228, 0.252), 0.255
"""When the curves' presses end, when the arm stands still before the drag, and when the drag begins: equal in all of them, s."""


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
    found = _fit_figures(fitted) | {"fitted": Value(fitted["parts"]["fitted"]["rows"])}
    found |= {f"small_{axis}": Value(value, "N") for axis, value in zip("xyz", plain["error_n"], strict=True)}
    for key in ("correlation", "scale"):
        found |= {f"small_{key}_{axis}": Value(value) for axis, value in zip("xyz", plain[key], strict=True)}
    for name, each in zip(("sliding", "sticking"), fitted["slip"], strict=True):
        found |= {f"{name}.rows": Value(each["rows"]), f"{name}.ratio": Value(each["ratio"])}
    return found


@job(
    "load_cell.second-split",
    f"twin calibrate contact --sensor {SENSOR} --frames {TABLE}/targets.csv --experiment {EXPERIMENT} --num-labelled {ROWS} "
    f"--elements {ACROSS} --seed {SEED + 1} --out FITTED.toml",
    sensors=(SENSOR,),
    code=("training.studies.validation", "twin.calibration.contact.forces"),
    beside=NO_PICTURES,
    recordings=(TABLE,),
    minutes=10,
)
def second_split(work: Path) -> Measured:
    """The fit to 20 other rows of the first table."""
    sensor, table = load_sensor(SENSOR), real_folder(TABLE) / "targets.csv"
    options = {"labels": ROWS, "seed": SEED + 1, "workers": 2, "across": ACROSS}
    return _of_fit(calibrate_to_file(table, sensor, load_experiment(EXPERIMENT), work / "fitted.toml", **options))


@job(
    "load_cell.miniature-plain",
    "make figures ONLY=load_cell.miniature-plain",
    sensors=(MINI,),
    code=("twin.calibration.contact.forces",),
    beside=NO_PICTURES,
    recordings=(CURVES,),
    minutes=2,
)
def miniature_plain(work: Path) -> Measured:
    """A tip of 10.2 mm, of which nothing is fitted, against the second table, and its presses and drags against the whole curves."""
    table, small = real_folder(CURVES) / "targets.csv", _small_tip()
    setup = ForceSetup(small, load_experiment(EXPERIMENT), load_object("plane"), ACROSS)
    labels, measured, _ = read_forces(table, setup, {})
    simulated = setup.readings(setup.forces([setup.start], labels)[0], setup.start)
    rows = _rows(table)
    single = np.array([[float(row[f"label_F{axis}"]) for axis in "xyz"] for row in rows])
    found = {"rows": Value(len(rows))}
    for k, axis in enumerate("xyz"):
        of, real = simulated[:, k], measured[:, k]
        found[f"error_{axis}"] = Value(float(abs(of - real).mean()), "N")
        found[f"correlation_{axis}"] = Value(float(np.corrcoef(of, real)[0, 1]))
        found[f"scale_{axis}"] = Value(float(np.polyfit(of, real, 1)[0]))
        found[f"label_error_{axis}"] = Value(float(np.sqrt(((single - measured)[:, k] ** 2).mean())), "N")
    by_number = {int(row["row"]): label for row, label in zip(rows, labels, strict=True)}
    curves: dict[int, list[list[float]]] = {}
    for row in _rows(table.with_name("curves.csv")):
        curves.setdefault(int(row["row"]), []).append([float(row[key]) for key in ("Time", "Fx", "Fy", "Fz")])
    levels = [(*_measured_levels(np.array(curve)), *_simulated_levels(small, by_number[each])) for each, curve in curves.items()]
    peak, held, side, ratio, pressed, dragged, slides = np.array(levels).T
    shares = {
        "held_to_peak": held / peak,
        "peak_to_twin": peak / pressed,
        "held_to_twin": held / pressed,
        "side_to_twin": side / dragged,
        "peak_ratio": ratio,
        "twin_ratio": slides,
    }
    for key, share in shares.items():
        found |= {f"{key}.{name}": Value(float(each)) for name, each in zip(("median", "least", "most"), _range(share), strict=True)}
    return found | {"curves": Value(len(levels))}


@job(
    "load_cell.miniature-331",
    f"twin calibrate contact --sensor SMALL.toml --frames {CURVES}/targets.csv --experiment {EXPERIMENT} --num-labelled {ROWS} "
    f"--elements {ACROSS} --out FITTED.toml",
    sensors=(MINI,),
    code=("training.studies.validation", "twin.calibration.contact.forces"),
    beside=NO_PICTURES,
    recordings=(CURVES,),
    minutes=15,
)
def miniature(work: Path) -> Measured:
    """The same fit to the second table, for a tip of 10.2 mm."""
    table, experiment = real_folder(CURVES) / "targets.csv", load_experiment(EXPERIMENT)
    return _of_fit(
        calibrate_to_file(table, _small_tip(), experiment, work / "fitted.toml", labels=ROWS, seed=SEED, workers=2, across=ACROSS)
    )


@job(
    "load_cell.elements",
    "make figures ONLY=load_cell.elements",
    sensors=(SENSOR,),
    code=("twin.mechanics.solver", "twin.calibration.size"),
    beside=NO_PICTURES,
    minutes=1,
)
def elements(work: Path) -> Measured:
    """By how much forces on the coarse grid of these fits exceed those on the usual one, for three depths."""
    small, plane = of_radius(load_sensor(SENSOR), SMALL_MM), load_object("plane")
    found = {}
    for depth_mm in (1, 2, 3):
        pose = ContactPose(indent_mm=float(depth_mm))
        coarse, fine = (SkinSolver(small, resolution=Resolution(across)).press(plane, pose).force_n[2] for across in (ACROSS, FINE))
        found[f"more_{depth_mm}mm"] = Value(float(coarse / fine - 1))
    return found


def _small_tip() -> SensorSpec:
    """The specification with a dome of 10.2 mm, the tool point at its end, and the axes of the second table's load cell."""
    shipped = load_sensor(MINI)
    zero_mm = ZERO_MM * shipped.skin.outer_radius_mm / SMALL_MM
    rig = RigSpec(tcp_to_dome_mm=-shipped.skin.apex_mm, contact_offset_mm=zero_mm, force_sensor=ForceSensorSpec(gain=(-1.0, 1.0, -1.0)))
    return of_radius(shipped.model_copy(update={"rig": rig}), SMALL_MM)


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def _range(values: np.ndarray) -> tuple[float, float, float]:
    return float(np.median(values)), float(values.min()), float(values.max())


def _measured_levels(curve: np.ndarray) -> tuple[float, float, float, float]:
    """Of a curve (K, 4): largest normal force of the press, that before the drag, largest side force, and its ratio to the normal."""
    time, side, normal = curve[:, 0], np.hypot(curve[:, 1], curve[:, 2]), np.abs(curve[:, 3])
    held = normal[(time > HELD_S[0]) & (time < HELD_S[1])].mean()
    top = np.argmax(np.where(time > DRAGGED_S, side, 0.0))
    return normal[time < PRESSED_S].max(), held, side[top], side[top] / normal[top]


def _simulated_levels(sensor: SensorSpec, label: ArmLabel) -> tuple[float, float, float]:
    """Normal force after the twin's press, and the largest side force of its drag with its ratio to the normal force."""
    experiment = load_experiment(EXPERIMENT)
    arm = RigContact(SkinSolver(sensor, resolution=Resolution(ACROSS)), experiment, load_object(experiment.object), rig=rig_of(sensor))
    states = [arm.end(ArmLabel(label.pose, np.zeros(6))), *(state for _, state in arm.along(arm.commanded_path(label)))]
    work = np.array([state.T_sensor_object[:3, :3].T @ state.force_n for state in states])
    side, normal = np.hypot(work[:, 0], work[:, 1]), np.abs(work[:, 2])
    top = 1 + int(np.argmax(side[1:]))
    return normal[0], side[top], side[top] / max(normal[top], 1e-9)


def _fit_figures(summary: dict[str, Any]) -> Measured:
    """Errors on rows kept out, and fitted parameters with their intervals."""
    held = summary["parts"]["evaluated"]
    units: dict[str, tuple[str, Any]] = {"before": ("N", held["before_n"]), "error": ("N", held["error_n"])}
    units |= {"correlation": ("", held["correlation"]), "scale": ("", held["scale"])}
    found = {f"{key}_{axis}": Value(value, unit) for key, (unit, of) in units.items() for axis, value in zip("xyz", of, strict=True)}
    found |= {"inside": Value(held["inside"]), "evaluated": Value(held["rows"])}
    for each in summary["parameters"]:
        name = each["name"].replace(".", "_")
        if "force_sensor" not in each["name"]:
            found |= {f"{name}.{key}": Value(each[key]) for key in ("start", "value", "low", "high")}
    return found


def _of_fit(fitted: ForceComparison) -> Measured:
    """The figures of a fit, and the force of a flat press with its interval."""
    sensor = fitted.sensor
    found = _fit_figures(fitted.summary) | {"factor": Value(sensor.skin.stiffness_factor)}
    press = SkinSolver(sensor, resolution=Resolution(ACROSS)).press(load_object("plane"), ContactPose(indent_mm=REFERENCE_MM))
    low, high = force_interval(press.force_n.tolist(), sensor.skin.stiffness_factor)
    return found | {"reference": Value(float(press.force_n[2]), "N"), "reference.low": Value(low, "N"), "reference.high": Value(high, "N")}
