"""Errors of pose models: trained on recordings, taught by the twin, and on unseen objects."""

import csv
import json
import shutil
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import torch
from bench_training import drawn_table, inputs_of

from figures.jobs import NO_PICTURES, FiguresError, Measured, Value, job, read, real_folder, run_twin
from training.data.dataset import load_dataset
from training.estimate.estimator import PoseEstimator
from training.studies.evaluation import at_own_rest
from training.studies.judging import measure_errors
from training.studies.tac_vgnn.models import measure_training

SETS = {"mg400-331": "tac-vgnn-331", "mg400-127": "tac-vgnn-127"}
TRAINED = ("training.studies.train", "training.studies.evaluation")
SHIPPED = "training/weights"
UNITS = {"pose_2": "mm", "pose_6": "deg"}
SPLITS = (0, 1, 2)
SIMULATED_SEEDS = (0, 1, 2, 3, 4)
MODELS = {"vgnn": 4.0, "tac-vgnn-release": 25.0, "gnn": 10.0, "cnn-v2": 35.0, "cnn-v1": 50.0}  # minutes of a training on two cores
EPOCHS = {"cnn-v1": 12}  # of the 100 of its recipe: one takes four minutes
PARTS = ("vgnn", "vgnn-without-graph", "vgnn-without-modes", "vgnn-without-kernel")
LABELS = 40
WITHHELD_ON = 400  # frames on which the no-contact frame is withheld


def rows_of(path: Path) -> list[dict[str, str]]:
    """Of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def trained(work: Path, *, model: str, sensor: str, split: int) -> Measured:
    """Train on four fifths of a recording (the paper's models on raw labels) and evaluate on the last one, also on changed images."""
    labels = "corrected" if model == "vgnn" else "raw"
    data, run = real_folder(SETS[sensor]), work / "run"
    fewer = ("--epochs", EPOCHS[model]) if model in EPOCHS else ()
    options = ("--target", "surface-2d-shear", "--label-kind", labels, "--seed", split, "--split", split, *fewer)
    if not (run / "weights.pt").is_file():
        run_twin(work, "train", "--model", model, "--sensor", sensor, "--data", data, *options, "--out", run)
    changed = ("--robustness",) if model == "vgnn" else ()
    run_twin(work, "evaluate", run, "--data", data, "--out", work / "judged", *changed)
    metrics = json.loads((work / "judged" / "metrics.json").read_text())
    found = {"frames": Value(metrics["frames"]), "leak_slope": Value(metrics["leak_slope"])}
    for kind, (name, unit) in product(("corrected", "raw"), UNITS.items()):
        part = metrics[kind][name]
        found |= {f"{kind}_{unit}": Value(part["mae"], unit), f"{kind}_{unit}_inside": Value(part["coverage_90"])}
    for row in rows_of(work / "judged" / "robustness.csv") if changed else ():
        name = row["change"].replace(" ", "_")
        found |= {f"{name}_{unit}_more": Value(float(row[f"{column}_more"])) for column, unit in UNITS.items()}
    return found


def over_splits(work: Path, *, model: str, sensor: str) -> Measured:
    """Mean, least and largest error over seeds and splits, from the kept figures of the single jobs."""
    found = {}
    jobs = [f"training.{model}.{sensor}.split{split}" for split in SPLITS]
    kept = read()
    if missing := [name for name in jobs if name not in kept]:
        raise FiguresError(f"{', '.join(missing)} must be measured first: make figures ONLY={','.join(missing)}")
    if len({kept[name]["commit"] for name in jobs}) > 1:
        raise FiguresError(f"{', '.join(jobs)} were measured at different commits: make figures ONLY={','.join(jobs)}")
    for kind, unit in product(("corrected", "raw"), UNITS.values()):
        errors = [kept[name]["figures"][f"{kind}_{unit}"]["value"] for name in jobs]
        parts = (("mean", np.mean(errors)), ("least", min(errors)), ("most", max(errors)))
        found |= {f"{kind}_{unit}_{key}": Value(float(value), unit) for key, value in parts}
    return found


def parts_of_vgnn(work: Path) -> Measured:
    """What each part of `vgnn` earns on the 331's split 0."""
    options = ("--label-kind", "corrected", "--models", ",".join(PARTS), "--batches", "", "--no-contacts")
    run_twin(
        work, "study", "tac-vgnn", "--data", real_folder(SETS["mg400-331"]), "--sensor", "mg400-331", "--out", work / "study", *options
    )
    found = {}
    for row in rows_of(work / "study" / "models.csv"):
        found |= {f"{row['model']}_{unit}": Value(float(row[f"{column}_corrected"]), unit) for column, unit in UNITS.items()}
    return found


def taught_by_the_twin(work: Path, *, sensor: str, seed: int, extra: tuple = ()) -> Measured:
    """Rows of a study from the twin to real frames, against corrected and raw labels."""
    options = ("--label-kind", LABELS, "--seed", seed, "--count", 300, *extra)
    run_twin(work, "study", "sim-to-real", "--sensor", sensor, "--frames", real_folder(SETS[sensor]), *options, "--out", work / "study")
    found = {}
    for row in rows_of(work / "study" / "study.csv"):
        about = f"{row['trained_on']}_{row['labelled_frames']}_{row['model']}"
        name = "".join(letter if letter.isalnum() else "_" for letter in about)
        for kind, (column, unit) in product(("corrected", "raw"), UNITS.items()):
            found[f"{name}.{kind}_{unit}"] = Value(float(row[f"{column}_{kind}"]), unit)
    return found


def never_touched(work: Path) -> Measured:
    """A model taught by nine objects and one by the plane alone, on objects seen and unseen."""
    options = ("--count", 60, "--tests", 25, "--elements", 12, "--seed", 1)
    run_twin(work, "study", "objects", "--sensor", "mg400-331", *options, "--out", work / "study")
    found = {}
    for row in rows_of(work / "study" / "objects.csv"):
        for column, unit in UNITS.items():
            name = f"{row['model']}.{row['object']}"
            found |= {
                f"{name}.{unit}": Value(float(row[f"{column}_error"]), unit),
                f"{name}.{unit}_times": Value(float(row[f"{column}_times"])),
            }
    return found


def shipped_on_frames(work: Path) -> Measured:
    """The shipped weights of ``ur5-331`` on the 30 published raw frames: of the twin, and what it misses of 40 labelled frames."""
    run_twin(work, "evaluate", "ur5-331", "--data", real_folder("ur5-331-raw"), "--rows", "all", "--out", work / "judged")
    metrics = json.loads((work / "judged" / "metrics.json").read_text())
    return {name: Value(metrics["corrected"][name]["mae"], "mm" if name == "pose_3" else "deg") for name in ("pose_3", "pose_4", "pose_5")}


def without_no_contact(work: Path, *, sensor: str) -> Measured:
    """Shipped weights on some frames of their recording: with its no-contact frame, with the rest places that were measured on this unit
    before, with the specification's alone, as of a unit that was never measured, and with those that its contacts tell; and the ratios."""
    source, estimator = real_folder(SETS[sensor]), PoseEstimator.load(sensor)
    frames = sorted((source / "frames_bw").glob("*.png"))
    chosen = np.random.default_rng(5).choice(len(frames), WITHHELD_ON, replace=False)
    errors = {}
    for case, known in (
        ("given", estimator.recorded_sensor),
        ("withheld", estimator.recorded_sensor),
        ("never_measured", estimator.sensor),
    ):
        folder = work / case
        (folder / "frames_bw").mkdir(parents=True, exist_ok=True)
        for k in chosen:
            shutil.copy2(frames[k], folder / "frames_bw")
        beside = ["targets.csv", "move_executed.csv", *(["init_0.png"] if case == "given" else [])]
        for name in beside:
            shutil.copy2(source / name, folder)
        data = load_dataset(folder, known, estimator.names, form=estimator.form)
        cases = {case: data}
        if case == "never_measured":
            cases["told_by_contacts"] = at_own_rest(estimator, data)
        for which, counted in cases.items():
            rows = np.flatnonzero(counted.pins.valid)
            judged = measure_errors(estimator.predict_rows(counted, rows), counted, rows)["corrected"]
            errors[which] = {unit: judged[name]["mae"] for name, unit in UNITS.items()}
    found = {f"{case}_{unit}": Value(error, unit) for case, by in errors.items() for unit, error in by.items()}
    times = {f"{case}_{unit}_times": Value(errors[case][unit] / errors["given"][unit]) for case in errors for unit in UNITS.values()}
    return found | times


def seconds_an_epoch(work: Path) -> Measured:
    """Of models on 3763 drawn graphs, batches of 128, two threads."""
    torch.set_num_threads(2)
    found = {}
    for sensor, model in (("mg400-127", "tac-vgnn"), ("mg400-331", "tac-vgnn"), ("mg400-331", "vgnn")):
        pins = drawn_table(sensor, 3763)
        seconds = measure_training(model, pins, inputs_of(model, pins), 128)["s_per_epoch"]
        found[f"{model}.{sensor}"] = Value(seconds, "s")
    return found


def register() -> None:
    """All jobs of this file."""
    for (model, minutes), sensor in product(MODELS.items(), SETS):
        splits = SPLITS if model == "vgnn" else SPLITS[:1]
        common = {"sensors": (sensor,), "code": TRAINED, "recordings": (SETS[sensor],), "beside": NO_PICTURES}
        for split in splits:
            command = f"twin train --model {model} --sensor {sensor} --data DIR --target surface-2d-shear --split {split} --out RUN"
            job(f"training.{model}.{sensor}.split{split}", command, minutes=minutes, **common)(
                partial(trained, model=model, sensor=sensor, split=split)
            )
        if len(splits) > 1:
            job(f"training.{model}.{sensor}.splits", f"mean of the runs of {model}", minutes=minutes + 0.1, **common)(
                partial(over_splits, model=model, sensor=sensor)
            )
    real = {"code": ("training.studies.tac_vgnn",), "recordings": (SETS["mg400-331"],), "sensors": ("mg400-331",), "beside": NO_PICTURES}
    job("training.parts.mg400-331", f"twin study tac-vgnn --label-kind corrected --models {','.join(PARTS)}", minutes=20, **real)(
        parts_of_vgnn
    )
    for sensor in SETS:
        common = {"sensors": (sensor,), "code": ("training.studies.sim_to_real",), "recordings": (SETS[sensor],), "beside": NO_PICTURES}
        command = f"twin study sim-to-real --sensor {sensor} --frames DIR --num-labelled {LABELS} --count 300 --seed"
        for seed in SIMULATED_SEEDS:
            job(f"sim_to_real.{sensor}.seed{seed}", f"{command} {seed}", minutes=8, **common)(
                partial(taught_by_the_twin, sensor=sensor, seed=seed)
            )
        job(f"sim_to_real.{sensor}.calibrated", f"{command} 0 --calibrate", minutes=40, **common)(
            partial(taught_by_the_twin, sensor=sensor, seed=0, extra=("--calibrate",))
        )
    command = "twin study objects --sensor mg400-331 --count 60 --tests 25 --elements 12 --seed 1"
    job("objects.mg400-331", command, sensors=("mg400-331",), code=("training.studies.objects",), minutes=30, beside=NO_PICTURES)(
        never_touched
    )
    command = "tests/bench/bench_training.py --models tac-vgnn vgnn --batches 128 --threads 2"
    job(
        "training.epoch",
        command,
        sensors=tuple(SETS),
        code=("bench_training", "training.studies.tac_vgnn.models"),
        minutes=2,
        beside=NO_PICTURES,
    )(seconds_an_epoch)
    job(
        "training.shipped.ur5-331",
        "twin evaluate ur5-331 --data DIR --rows all",
        sensors=("ur5-331",),
        code=("training.studies.evaluation",),
        shipped=(f"{SHIPPED}/ur5-331",),
        recordings=("ur5-331-raw",),
        minutes=1,
        beside=NO_PICTURES,
    )(shipped_on_frames)
    for sensor in SETS:
        command = f"twin evaluate {sensor} --data DIR --rows all, DIR with init_0.png and without it"
        job(
            f"training.withheld.{sensor}",
            command,
            sensors=(sensor,),
            code=("training.studies.evaluation",),
            shipped=(f"{SHIPPED}/{sensor}",),
            recordings=(SETS[sensor],),
            minutes=2,
            beside=NO_PICTURES,
        )(partial(without_no_contact, sensor=sensor))


register()
