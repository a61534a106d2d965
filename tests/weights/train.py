"""``python tests/weights/train.py FOLDER [NAME...]``: train the shipped weights of the MG400's sensors again: mg400-331, mg400-127.

They learn from four fifths of the published recording (``TACTIP_REAL``) and from simulated contacts with eleven objects, each with the pins
that the twin computes, and with the discrepancy of 40 labelled frames added. Networks know their rows too well to expect the errors of
others. So the last layer's expected errors are fitted to every second frame of the other fifth, and to half of the simulated contacts that
no network learnt from; the rest evaluates them. Contacts are generated into FOLDER, or taken up from it (an hour on two cores for each
sensor); training takes ten minutes. The small copy keeps the shipped places of the pins at rest and displacements. The domains are learnt
again afterwards by ``domains.py``.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from contacts import intervals_on
from domains import LEARNT, REAL, simulate

from scenes import load_experiment, load_object, load_sensor
from scenes.object import CylinderShape, ObjectSpec
from training.data.dataset import Dataset, join_datasets, load_dataset, split_rows
from training.data.label_code import label_error
from training.data.pins import voronoi_areas
from training.estimate.estimator import PoseEstimator
from training.models import recipe_of
from training.runs.assemble import conformal_quantile
from training.runs.config import RunConfig
from training.runs.loop import predict_rows
from training.runs.run import train_run
from training.runs.run_files import CONFIG, DISPLACEMENTS, SHIPPED, TENSORS, pack, read_config, read_tensors, write_tensors
from training.studies.judging import measure_errors
from training.studies.sim_to_real.discrepancy import Discrepancy, measure_residuals
from training.studies.sim_to_real.steps import arm_labels, choose_frames, measured_of, widen_intervals, with_missing
from twin.calibration.contact.fit import CalibrationSetup
from twin.store import output, overwriting, write_json

RECORDINGS = {"mg400-331": "tac-vgnn-331", "mg400-127": "tac-vgnn-127"}
BARS_MM = (40, 100)
"""Diameters of the cylinders beside the shipped objects."""
CONTACTS, ACROSS, SEED, EPOCHS, LABELLED = 100, 16, 171, 40, 40
UNITS = 40
"""Contacts with units of other skin and gel."""
DRAWS, REAL_COPIES, NOISE_PX = 4, 4, 0.1
"""Draws of the discrepancy for each simulated contact, copies of each real frame, and noise of the pins of every copy but the first, px:
the networks learn no row by heart."""
TARGETS = ("pose_2", "pose_6")
RIDGE = 0.01
"""Penalty of a change of the weights of the expected errors, in standard deviations of their inputs."""
SHARES = (0.5, 0.2, 0.3)
"""Weights in this fit of real frames, simulated ones, and those with the discrepancy."""
REST_PX = 0.01
"""Largest difference between the places from which old and new weights count displacements."""
Part = tuple[Dataset, np.ndarray]
"""A data set, and rows of it."""


def objects() -> list[ObjectSpec]:
    """The objects to press against; none is one of the servo's outlines."""
    bars = [
        ObjectSpec(name=f"bar-{mm}", description=f"Rod of {mm} mm diameter along y", shape=CylinderShape(kind="cylinder", radius_mm=mm / 2))
        for mm in BARS_MM
    ]
    return [*(load_object(name) for name in LEARNT), *bars]


def contacts_in(out: Path, sensor, obj: ObjectSpec, experiment: str, randomisation: str, count: int = CONTACTS) -> Dataset:
    """Simulated contacts with an object, made if they are missing."""
    plan = load_experiment(experiment, wide=randomisation == "moves")
    return load_dataset(simulate(out, sensor, obj, plan, randomisation, count=count, seed=SEED, across=ACROSS), sensor, TARGETS)


def with_noise(data: Dataset, seed: int) -> Dataset:
    """The data set with noise of its pins."""
    nodes_px = data.pins.nodes_px + NOISE_PX * np.random.default_rng(seed).standard_normal(data.pins.nodes_px.shape)
    return replace(data, pins=replace(data.pins, nodes_px=nodes_px, area_px2=voronoi_areas(nodes_px, data.pins.reference)))


def with_discrepancy(sensor, folder: Path, sets: list[Dataset], real: Dataset) -> list[list[Dataset]]:
    """The simulated contacts with draws of the discrepancy that 40 labelled frames show, a list for each set."""
    experiment = load_experiment("surface-2d")
    few = real.rows(choose_frames(len(real), LABELLED, 0).few)
    setup = CalibrationSetup(sensor, experiment, load_object(experiment.object), ACROSS, few.pins.form, folder / f"{sensor.name}-labelled")
    setup.folder.mkdir(parents=True, exist_ok=True)
    missing = Discrepancy(measure_residuals(setup, measured_of(few)))
    return [[with_missing(with_noise(each, k), arm_labels(each), missing, SEED + k) for k in range(DRAWS)] for each in sets]


def fit_scales(run: Path, parts: list[Part]) -> None:
    """Fit the expected errors of a finished run to parts of frames that it did not learn from: real, simulated, with discrepancy.

    Their estimates do not change. The intervals get the largest quantile of all parts.
    """
    estimator = PoseEstimator.load(run)
    (network,) = estimator.ensemble.networks
    first, last = network.outputs, 2 * network.outputs
    weight, bias = (of.detach()[first:last].clone() for of in (network.head.weight, network.head.bias))
    known = []
    for data, rows in parts:
        inputs, chosen = estimator.inputs_of(data.pins.rows(rows), together=False)
        out = predict_rows(network, inputs, chosen)
        known.append((out["embedding"], out["mean"] - torch.tensor(estimator.ensemble.standardise(data.targets.corrected[rows]))))
    usual, spread = weight.clone(), torch.cat([embedding for embedding, _ in known]).std(dim=0)
    weight.requires_grad_(), bias.requires_grad_()
    optimiser = torch.optim.LBFGS([weight, bias], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        total = RIDGE * (((weight - usual) * spread) ** 2).sum()
        for (embedding, error), share in zip(known, SHARES, strict=True):
            scale = embedding @ weight.T + bias
            total = total + share * (error.abs() * torch.exp(-scale) + scale).mean()
        total.backward()
        return total

    optimiser.step(loss)
    content = read_tensors(run / TENSORS)
    with torch.no_grad():
        content["networks"][0]["head.weight"][first:last], content["networks"][0]["head.bias"][first:last] = weight, bias
    with overwriting(), output(run, TENSORS):
        write_tensors(run / TENSORS, content)
    quantiles = [intervals_on(run, data, rows) for data, rows in parts]
    widen_intervals(run, quantiles[0] | {"quantile": np.max([each["quantile"] for each in quantiles], axis=0)})


def ship(name: str, run: Path, kept_out: list[str], units: Dataset) -> None:
    """Replace the shipped weights by the small copy of a run. It keeps the places of the pins at rest, and the names of frames kept out.

    It also has the factors with which the intervals contain 90 % of the labels of simulated ``units`` with other skin and gel.
    """
    estimator = PoseEstimator.load(run)
    made, truth = estimator.predict_rows(units, np.arange(len(units))), units.targets
    widens = conformal_quantile(np.abs(label_error(made.mean, truth.corrected, truth.units)) / made.half_width)
    out, old = SHIPPED / name, read_config(SHIPPED / name)
    rest = read_tensors(run / TENSORS)["reference_px"].numpy()
    assert np.abs(rest - PoseEstimator.load(name).trained_reference.pins_px).max() < REST_PX, "displacements are counted from other places"
    kept = (out / DISPLACEMENTS).read_bytes()
    with overwriting():
        size = pack(run, out)
    (out / DISPLACEMENTS).write_bytes(kept)
    config = read_config(out)
    factors, rows = np.maximum(widens, 1.0).round(2).tolist(), config["rows"] | {"kept_out": kept_out}
    about = {"other_unit_widens": factors, "known_rest_px": old["known_rest_px"], "split": 0, "rows": rows}
    write_json(out / CONFIG, config | about)
    print(f"{name}: {size} bytes", flush=True)


def make(name: str, folder: Path) -> None:
    """Train weights, calibrate their intervals, and write the small copy."""
    sensor, run = load_sensor(name), folder / f"{name}-run"
    real = load_dataset(REAL / RECORDINGS[name], sensor, TARGETS).in_order()
    train, test = split_rows(len(real), 0)
    sets = [contacts_in(folder / f"{name}-{each.name}", sensor, each, "objects-2d", "moves") for each in objects()]
    drawn = with_discrepancy(sensor, folder, sets, real)
    splits = [split_rows(len(each), 0, each.group) for each in sets]
    copies = [a.rows(mine).with_copies([each.rows(mine).pins for each in b]) for a, b, (mine, _) in zip(sets, drawn, splits, strict=True)]
    seen = real.rows(train)
    data = join_datasets([seen.with_copies([with_noise(seen, k).pins for k in range(1, REAL_COPIES)]), *copies])
    firsts = [each[0] for each in drawn]
    clean, drawn = (join_datasets([each.rows(out) for each, (_, out) in zip(of, splits, strict=True)]) for of in (sets, firsts))
    contacts = np.unique(clean.group)  # a quasi-random sequence: every second one would be another half of the poses
    half = np.isin(clean.group, np.random.default_rng(SEED).permutation(contacts)[::2])
    recipe = recipe_of("vgnn", members=1, kernel=False, epochs=EPOCHS)
    config = RunConfig("vgnn", recipe, seed=0, split=None)
    if not (run / TENSORS).is_file():
        train_run(config, data, run)
    fit_scales(run, [(real, test[::2]), (clean, np.flatnonzero(half)), (drawn, np.flatnonzero(half))])
    others = np.flatnonzero(~half)
    report(name, run, {"real": (real, test[1::2]), "simulated": (clean, others), "with discrepancy": (drawn, others)})
    units = contacts_in(folder / f"{name}-units", sensor, load_object("plane"), "surface-2d", "contact", UNITS)
    ship(name, run, real.pins.image_name[test].tolist(), units)


def report(name: str, run: Path, parts: dict[str, Part]) -> None:
    """Print the errors on rows that the run did not learn from."""
    estimator = PoseEstimator.load(run)
    for part, (data, rows) in parts.items():
        found = measure_errors(estimator.predict_rows(data, rows), data, rows)["corrected"]
        labels = [(key, of) for key, of in found.items() if key != "bins"]
        errors = [f"{key} {of['mae']:.4f} ({of['coverage_90']:.1%} inside +- {of['half_width_90']:.3f})" for key, of in labels]
        print(f"{name}, {part}, {len(rows)} rows: {', '.join(errors)}", flush=True)


if __name__ == "__main__":
    for chosen in sys.argv[2:] or RECORDINGS:
        make(chosen, Path(sys.argv[1]))
