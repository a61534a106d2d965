"""How well forces, slip and contact maps are told of objects that a model never saw, in the twin; and forces of a real sensor."""

import csv
import json
from functools import partial
from pathlib import Path

import numpy as np

from figures.jobs import NO_PICTURES, Measured, Value, job, real_folder, run_twin
from scenes import load_sensor
from twin.calibration.sensor_file import write_sensor

CODE = ("training.generation", "training.studies.train", "training.studies.evaluation")
TAUGHT = {"plane": 300, "ball-40": 300, "cylinder": 300, "edge": 300}  # contacts of the objects that are learnt from
UNSEEN = {"can": 15, "ball-80": 15, "square": 15}
DRAGS, UNSEEN_DRAGS = 60, 8  # of each object
ACROSS = 16
EXPERIMENTS = {"mg400-331": "objects-2d", "mg400-127": "objects-2d", "ur5-331": "surface-3d-sheared"}
EDGES = {"ur5-331": "edge-circle-sheared"}  # where an edge has an experiment of its own
FORCES = ("force_x", "force_y", "force_z")
SEED, UNSEEN_SEED = 5, 77
TACPAD, TACPAD_SET = "ur5-tacpad", "tacpad-force"
TACPAD_LABELS = {"pose_z": "mm", "pose_Rx": "deg", "pose_Ry": "deg", "shear_x": "mm", "shear_y": "mm", "Fx": "N", "Fy": "N", "Fz": "N"}
WIDE_SPOTS_PX = 4.5  # instead of the sensor's 3.7: they average over the caps' pattern, which halves the pins' noise
TACPAD_SPLITS = (0, 1, 2)


def contacts(
    work: Path, name: str, sensor: str, thing: str, count: int, *, experiment: str, randomise: str, seed: int, wide: bool = True
) -> Path:
    """Simulated contacts of an object in a folder below ``work``; those that are there already are kept."""
    options = (
        "--sensor",
        sensor,
        "--object",
        thing,
        "--experiment",
        experiment,
        "--count",
        count,
        "--randomise",
        randomise,
        *(("--wide",) if wide else ()),
    )
    run_twin(work, "dataset", *options, "--images", "none", "--states", "all", "--elements", ACROSS, "--seed", seed, "--out", work / name)
    return work / name


def judged(work: Path, run: Path, data: list[Path], *options: object) -> tuple[dict, dict[str, np.ndarray]]:
    """Metrics of a run, and its table of predictions by column."""
    run_twin(
        work, "evaluate", run, *(part for folder in data for part in ("--data", folder)), *options, "--force", "--out", work / "judged"
    )
    with (work / "judged" / "predictions.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    table = {key: np.array([float(row[key]) for row in rows]) for key in rows[0] if key != "image_name"}
    return json.loads((work / "judged" / "metrics.json").read_text()), table


def told(metrics: dict, table: dict[str, np.ndarray], where: str) -> Measured:
    """Errors of forces, torque, area and slip; forces also as shares of their range, areas as shares of the mean."""
    labels = metrics["corrected"]
    found = {f"{where}.states": Value(metrics["frames"])}
    for name in FORCES:
        found[f"{where}.{name}"] = Value(labels[name]["mae"], "N")
        found[f"{where}.{name}_share"] = Value(labels[name]["mae"] / float(np.ptp(table[f"{name}_true"])))
    found[f"{where}.torque"] = Value(labels["torque_z"]["mae"], "N mm")
    found[f"{where}.area_share"] = Value(labels["contact_area"]["mae"] / float(table["contact_area_true"].mean()))
    found[f"{where}.slip_share"] = Value(labels["slip_share"]["mae"])
    inside = [labels[name]["coverage_90"] for name in (*FORCES, "torque_z", "contact_area", "slip_share")]
    found |= {f"{where}.inside_least": Value(min(inside)), f"{where}.inside_most": Value(max(inside))}
    units = {"patch_iou": "", "pressure_correlation": "", "shear_correlation": "", "resultant": "", "skin_mm": "mm"}
    return found | {f"{where}.{key}": Value(metrics["maps"][key], unit) for key, unit in units.items()}


def forces(work: Path, *, sensor: str) -> Measured:
    """A model taught by four objects, on contacts of them that it never saw, and on three objects that it never saw."""
    made = {}
    for seed, things in ((SEED, TAUGHT), (UNSEEN_SEED, UNSEEN)):
        for thing, count in things.items():
            experiment = EDGES.get(sensor, EXPERIMENTS[sensor]) if thing == "edge" else EXPERIMENTS[sensor]
            made[thing] = contacts(work, thing, sensor, thing, count, experiment=experiment, randomise="moves", seed=seed)
    taught = [made[thing] for thing in TAUGHT]
    run = trained(work, sensor, taught)
    same = told(*judged(work, run, taught), "same")
    return same | told(*judged(work, run, [made[thing] for thing in UNSEEN], "--rows", "all"), "unseen")


def trained(work: Path, sensor: str, folders: list[Path]) -> Path:
    """The run of a model that is trained on simulated contacts in folders."""
    run, data = work / "run", tuple(part for folder in folders for part in ("--data", folder))
    run_twin(
        work, "train", "--model", "touch", "--sensor", sensor, *data, "--target", "contact", "--members", 2, "--no-kernel", "--out", run
    )
    return run


def slip(work: Path, *, sensor: str) -> Measured:
    """Slip over time, learnt from drags over four objects, on drags over three objects that the model never saw."""
    made = {}
    for seed, things, count in ((SEED, TAUGHT, DRAGS), (UNSEEN_SEED, UNSEEN, UNSEEN_DRAGS)):
        for thing in things:
            made[thing] = contacts(work, thing, sensor, thing, count, experiment="drag", randomise="drag", seed=seed, wide=False)
    run = trained(work, sensor, [made[thing] for thing in TAUGHT])
    metrics, _ = judged(work, run, [made[thing] for thing in UNSEEN], "--rows", "all")
    units = {"lead_mm": "mm", "left_mm": "mm", "direction_deg": "deg"}
    return {key: Value(value, units.get(key, "")) for key, value in metrics["slip"].items()}


def real_forces(work: Path, *, split: int) -> Measured:
    """Pose, shear and forces of the TacPad, learnt from four fifths of a recording with a force sensor, on the last one."""
    spec, run = load_sensor(TACPAD), work / "run"
    wider = spec.pipeline.raw.model_copy(update={"spot_sigma_px": WIDE_SPOTS_PX})
    sensor = write_sensor(work / f"{TACPAD}.toml", spec.model_copy(update={"pipeline": spec.pipeline.model_copy(update={"raw": wider})}))
    data, options = real_folder(TACPAD_SET), ("--target", ",".join(TACPAD_LABELS), "--members", 4, "--split", split)
    if not (run / "weights.pt").is_file():
        run_twin(work, "train", "--model", "touch", "--sensor", sensor, "--data", data, *options, "--out", run)
    metrics, _ = judged(work, run, [data])
    found = {"frames": Value(metrics["frames"])}
    for name, unit in TACPAD_LABELS.items():
        label = metrics["corrected"][name]
        found |= {name: Value(label["mae"], unit), f"{name}_inside": Value(label["coverage_90"])}
    return found


for name in EXPERIMENTS:
    job(
        f"forces.{name}",
        f"twin train --model touch --sensor {name} --data SIMULATED ... --target contact --members 2 --no-kernel --out RUN",
        sensors=(name,),
        code=CODE,
        beside=NO_PICTURES,
        minutes=25,
    )(partial(forces, sensor=name))
job(
    "slip.mg400-331",
    "twin train --model touch --sensor mg400-331 --data DRAGS ... --target contact --members 2 --no-kernel --out RUN",
    sensors=("mg400-331",),
    code=CODE,
    beside=NO_PICTURES,
    minutes=20,
)(partial(slip, sensor="mg400-331"))
for number in TACPAD_SPLITS:
    job(
        f"forces.{TACPAD}.split{number}",
        f"twin train --model touch --sensor ur5-tacpad.toml --data {TACPAD_SET} --target {','.join(TACPAD_LABELS)} --members 4 "
        f"--split {number} --out RUN",
        sensors=(TACPAD,),
        code=CODE,
        beside=NO_PICTURES,
        recordings=(TACPAD_SET,),
        minutes=12,
    )(partial(real_forces, split=number))
