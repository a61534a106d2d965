"""The model of a direction on the whole circle: a field that is turned exactly, and answers that turn with it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from drawn_recording import config_of

from scenes import load_sensor
from training.estimator import PoseEstimator
from training.label_code import LabelCode, label_error
from training.models.steered.field import waves_of
from training.models.steered.network import Steered, SteeredSize
from training.packed import pack
from training.recipes import TrainingError
from training.run import train_run
from twin.pins import nominal_reference
from twin.types import Form

ROUNDING = 1e-6


@pytest.fixture(scope="module")
def rest():
    """A layout with six equal sectors."""
    places = nominal_reference(load_sensor("mg400-127"), Form.RECORDING).pins_px
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


def test_an_edges_direction_is_learnt_from_few_frames_and_kept_in_a_small_copy(data, tmp_path):
    edges = edges_instead(data)
    config = replace(config_of("steered", epochs=60, batch=16, members=1), size={"modes": 20, "width": 32})
    train_run(config, edges, tmp_path / "run")
    estimator = PoseEstimator.load(tmp_path / "run")
    judged = np.array([name in estimator.config["rows"]["kept_out"] for name in edges.pins.image_name])
    made = estimator.predict_rows(edges, np.flatnonzero(judged))
    error = np.abs(label_error(made.mean, edges.targets.corrected[judged], edges.targets.units))
    assert error[:, 1].mean() < 6 and error[:, 0].mean() < 0.05, error.mean(axis=0)
    pack(tmp_path / "run", tmp_path / "small")
    small = PoseEstimator.load(tmp_path / "small").predict_rows(edges, np.flatnonzero(judged))
    np.testing.assert_allclose(small.mean, made.mean, atol=0.5)  # half precision


def test_labels_without_a_direction_are_refused(data, tmp_path):
    with pytest.raises(TrainingError, match="steered is for labels of which one is a direction"):
        train_run(config_of("steered", epochs=1), data, tmp_path)
