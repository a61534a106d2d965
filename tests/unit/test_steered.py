"""The model of a direction on the whole circle: a field that is turned exactly, and answers that turn with it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from drawn_recording import config_of

from scenes import load_sensor
from training.data.label_code import LabelCode, label_error
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.models.steered.model import Steered, SteeredSize, waves_of
from training.runs.run import train_run
from training.runs.run_files import pack
from training.studies.sim_to_real.steps import combine_co_kriging, model_for
from twin.pins import nominal_reference
from twin.types import Form

ROUNDING = 1e-6


@pytest.fixture(scope="module")
def rest():
    """A layout with six equal sectors."""
    places = nominal_reference(load_sensor("mg400-127"), Form.PROCESSED).pins_px
    corner = (places - places[0]) @ [1, 1j]
    ring = np.concatenate([r * np.exp(2j * np.pi * np.arange(6 * r) / (6 * r)) for r in range(1, 7)])
    assert len(ring) == len(corner) - 1
    whole = np.concatenate([[0], ring])
    return np.stack([whole.real, whole.imag], axis=1)


def edge_field(rest, turn, distance):
    """The complex displacement of pins pressed by an edge that lies at the angle ``turn`` and at a distance from the middle."""
    place = (rest @ [1, 1j]) * np.exp(-1j * turn) / 6
    away = place.imag - distance
    return np.exp(1j * turn) * (np.exp(-4 * away**2) * (0.3 + 1j * away) + 0.1 * place)


def as_pairs(field):
    return torch.from_numpy(np.stack([field.real, field.imag], axis=-1).astype(np.float32))


def test_a_turned_contact_has_turned_coefficients(rest):
    """A sixth of the circle carries pins onto pins: then the turn is exact for any displacement, however rough."""
    waves, sixth = waves_of(rest), np.pi / 3
    rough = np.random.default_rng(0).normal(size=(len(rest), 2)) @ [1, 1j]
    place = rest @ [1, 1j]
    goes_to = np.abs(place[:, None] * np.exp(1j * sixth) - place[None]).argmin(axis=1)
    turned = np.empty_like(rough)
    turned[goes_to] = np.exp(1j * sixth) * rough
    np.testing.assert_allclose(waves.fit @ turned, np.exp(1j * sixth * waves.order) * (waves.fit @ rough), atol=ROUNDING)


def test_smooth_fields_are_turned_by_any_angle(rest):
    waves = waves_of(rest)
    smooth = [edge_field(rest, turn, 0.1) for turn in (0.0, 0.7)]
    turned, wanted = np.exp(0.7j * waves.order) * (waves.fit @ smooth[0]), waves.fit @ smooth[1]
    assert np.linalg.norm(turned - wanted) < 0.05 * np.linalg.norm(wanted)


@pytest.mark.parametrize("sense", [1, -1])
def test_the_sense_of_the_label_is_found(rest, sense):
    torch.manual_seed(0)
    turns = np.random.default_rng(1).uniform(-np.pi, np.pi, 60)
    moved = torch.stack([as_pairs(edge_field(rest, sense * turn, 0.2)) for turn in turns])
    code = LabelCode((False, True))
    numbers = torch.from_numpy(2**0.5 * code.encode(np.column_stack([turns, np.degrees(turns)]))).float()
    network = Steered(waves_of(rest), 3, SteeredSize(modes=10, width=8))
    network.prepare(moved, numbers, code)
    assert int(network.sine) == 1 and float(network.sense) == sense
    out = network.eval()(moved)["mean"]
    assert out.shape == (60, 3) and torch.allclose(out[:, 1] ** 2 + out[:, 2] ** 2, torch.tensor(2.0), atol=1e-4)


def edges_instead(data):
    """The drawn data set, its pins pressed by edges of every direction."""
    rng = np.random.default_rng(3)
    labels = np.column_stack([rng.uniform(-0.3, 0.3, len(data)), rng.uniform(-180, 180, len(data))])
    rest = data.pins.reference.pins_px
    middle, radius = rest.mean(axis=0), np.abs((rest - rest.mean(axis=0)) @ [1, 1j]).max()
    fields = np.stack([edge_field(6 * (rest - middle) / radius, np.radians(turn), distance) for distance, turn in labels])
    nodes = rest + 5 * np.stack([fields.real, fields.imag], axis=-1)
    return replace(data, pins=replace(data.pins, nodes_px=nodes), targets=replace(data.targets, raw=labels, corrected=labels))


@pytest.fixture(scope="module")
def learnt(data, tmp_path_factory):
    """A run, the folder of it, the edges that it learnt from, and the rows that it did not."""
    edges, out = edges_instead(data), tmp_path_factory.mktemp("steered") / "run"
    config = replace(config_of("steered", epochs=60, batch=16, members=1), size={"modes": 20, "width": 32})
    train_run(config, edges, out)
    kept_out = PoseEstimator.load(out).config["rows"]["kept_out"]
    return out, edges, np.flatnonzero(np.isin(edges.pins.image_name, kept_out))


def errors(run, edges, rows):
    made = PoseEstimator.load(run).predict_rows(edges, rows)
    return np.abs(label_error(made.mean, edges.targets.corrected[rows], edges.targets.units)).mean(axis=0)


def test_an_edges_direction_is_learnt_from_few_frames_and_kept_in_a_small_copy(learnt, tmp_path):
    run, edges, judged = learnt
    missed = errors(run, edges, judged)
    assert missed[1] < 6 and missed[0] < 0.05, missed
    made = PoseEstimator.load(run).predict_rows(edges, judged)
    pack(run, tmp_path)
    small = PoseEstimator.load(tmp_path).predict_rows(edges, judged)
    np.testing.assert_allclose(small.mean, made.mean, atol=0.5)  # half precision


def test_labelled_frames_are_put_beside_it(learnt, tmp_path):
    """Of a sensor whose labels are off by as much everywhere: the process learns it, the average has half of it."""
    run, edges, judged = learnt
    off = replace(edges, targets=replace(edges.targets, corrected=edges.targets.corrected + [0.2, 0.0]))
    others = np.setdiff1d(np.arange(len(edges)), judged)
    combine_co_kriging(run, tmp_path / "beside", edges.rows(others), off.rows(others[:30]), seed=0)
    assert errors(tmp_path / "beside", off, judged)[0] < 0.7 * errors(run, off, judged)[0]
    assert errors(tmp_path / "beside", off, judged)[1] < 2 * errors(run, off, judged)[1]


def test_a_study_trains_it_where_there_is_a_direction(data):
    assert (model_for(edges_instead(data)), model_for(data)) == ("steered", "vgnn")


def test_labels_without_a_direction_are_refused(data, tmp_path):
    with pytest.raises(TrainingError, match="steered is for labels of which one is a direction"):
        train_run(config_of("steered", epochs=1), data, tmp_path)
