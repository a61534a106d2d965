"""Slip over time: what simulated drags tell, that it is learnt from them, and that memory begins again with every contact."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from scenes import load_sensor
from training.data.dataset import load_dataset
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.models import recipe_of
from training.models.part import OneFrame, Unseen
from training.runs.config import RunConfig
from training.runs.run_files import SLIP, pack
from training.studies.evaluation import evaluate_run
from training.studies.train import add_slip
from training.surrogate.symmetry import symmetries
from training.touch import slip
from training.touch.slip import (
    NAMES,
    Drag,
    SlipTracker,
    compare_slip,
    drags_of,
    learn_slip,
    random_places,
    read_slip,
    resample_path,
    write_slip,
)
from twin.geometry.pins import rest_pins
from twin.types import Form, Frame

ALMOST = 1e-9  # rounding
STEP_MM = 0.4  # a load step of a drag
DRAGS = 54


def plain_drag(rng):
    """A press of six states and a drag of fourteen; the pins show the way until the contact slides, which the depth and friction set."""
    limit, turn = rng.uniform(0.8, 3.0), rng.uniform(0, 2 * np.pi)
    pressed = np.concatenate([np.linspace(0, 1, 6), np.ones(14)])
    drag_mm = np.concatenate([np.zeros(6), STEP_MM * np.arange(1, 15)])
    way = np.array([np.cos(turn), np.sin(turn)])
    shown = np.minimum(drag_mm, limit)[:, None] * way
    share = np.where(drag_mm > 0, np.minimum(drag_mm / limit, 1.0), 0.0)
    seen = np.column_stack([limit * pressed, shown, share * (drag_mm > 0)])
    caps = np.tile(seen[:, :, None], (1, 1, 3))
    return Drag(caps, np.zeros((20, 4), bool), share, drag_mm, way)


def plain_eyes(caps_mm, lost, rng):
    return caps_mm[:, :, 0] + 0.02 * rng.normal(size=lost.shape)


@pytest.fixture(scope="module")
def learnt():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slip, "WAYS", 90)
        patch.setattr(slip, "EPOCHS", 14)
        rng = np.random.default_rng(0)
        return learn_slip([plain_drag(rng) for _ in range(DRAGS)], plain_eyes, load_sensor("pad-rectangular"))


def unseen_ways(count=20):
    rng = np.random.default_rng(7)
    return [resample_path(plain_drag(rng), random_places(20, rng), plain_eyes, rng) for _ in range(count)]


def test_slip_is_told_before_the_whole_contact_slides(learnt):
    found = compare_slip(learnt, unseen_ways())
    assert found["contacts"] == 20 and found["whole_accuracy"] > 0.95
    assert found["lead_mm"] > 0.5 and found["late"] < 0.1 and found["false_alarms"] < 0.05
    assert found["share"] < 0.08 and 0.75 < found["share_covered"] <= 1.0
    assert found["left_mm"] < 0.3 and 0.75 < found["left_covered"] <= 1.0 and found["direction_deg"] < 5


def test_a_press_or_a_stop_alone_is_no_slip_and_every_contact_is_a_new_one(learnt):
    way = unseen_ways(1)[0]
    tracker = SlipTracker(learnt)
    first = [tracker(modes).begins for modes in way.modes]
    pressed = way.drag_mm == 0
    assert max(np.array(first)[pressed]) < 0.5 < first[-1]
    tracker.forget()
    assert [tracker(modes).begins for modes in way.modes] == pytest.approx(first)
    assert SlipTracker(learnt)(way.modes[-1]).begins != pytest.approx(first[-1])  # the past counts


def test_a_drag_that_is_turned_or_mirrored_is_seen_by_the_pins_that_stand_there():
    sensor = load_sensor("mg400-331")
    rest = rest_pins(sensor.geometry).caps_mm
    lost = np.zeros((1, len(rest)), bool)
    lost[0, 17] = True
    drag = Drag(rest[None], lost, np.zeros(1), np.zeros(1), np.array([1.0, 0.0]))
    for symmetry in symmetries(sensor.pins.phase_deg):
        found = drag.turn(symmetry, sensor.pins.rings)
        np.testing.assert_allclose(found.caps_mm, drag.caps_mm, atol=ALMOST)
        assert np.flatnonzero(found.lost[0]).tolist() == [symmetry.places(sensor.pins.rings)[17]]
        assert np.linalg.norm(found.direction) == pytest.approx(1.0)


def test_the_way_to_slip_is_between_the_states_around_it():
    drag = Drag(np.zeros((4, 1, 3)), np.zeros((4, 1), bool), np.array([0.0, 0.2, 0.7, 1.0]), np.array([0.0, 0.4, 0.8, 1.2]), np.ones(2))
    assert drag.whole_mm == pytest.approx(0.8 + 0.4 * 0.25 / 0.3)
    assert np.isnan(replace(drag, share=np.array([0.0, 0.2, 0.7, 0.9])).whole_mm)


def test_drags_of_a_data_set_are_as_long_as_their_moves(contacts):
    folder, _, sensor = contacts
    data = load_dataset(folder, sensor, ("move_1", "move_2"))
    drags = drags_of(data)
    assert len(drags) == 10
    for rows, drag in drags:
        move = data.targets.raw[rows[-1]]
        assert drag.drag_mm[-1] == pytest.approx(np.linalg.norm(move), rel=0.05)
        still = drag.drag_mm == 0
        assert still.any() and not drag.share[still].any() and (drag.share[~still] > 0).any()
        assert np.linalg.norm(drag.direction) == pytest.approx(1.0)


def test_a_model_that_remembers_tells_slip_besides_and_forgets_a_contact_that_ends(contacts):
    folder, run, sensor = contacts
    estimator = PoseEstimator.load(run)
    assert estimator.with_history().names == estimator.names  # too few drags to learn slip from
    data = load_dataset(folder, sensor, estimator.names)
    modes = estimator.modes_of(data.pins)
    network = slip.SlipNetwork(2 * modes.shape[1]).eval()
    estimator.slip = slip.SlipModel(network, 1.0, np.abs(modes).max(axis=0), 0.5, 1.0, 1.0)
    remembering = estimator.with_history()
    assert remembering.names == (*estimator.names, *NAMES) and remembering.with_history().names == remembering.names
    frames = iter([data.pins.rows(np.array([k])) for k in (0, 1)] + [None] + [data.pins.rows(np.array([0]))])

    def pins_in(model, trained, frame):
        pins = next(frames)
        return Unseen("nothing") if pins is None else OneFrame(pins)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(remembering.part), "pins_in", pins_in)
        made = [remembering(Frame(np.zeros((8, 8), np.uint8), Form.PROCESSED)) for _ in range(4)]
    assert [each.valid for each in made] == [True, True, False, True]
    assert len(made[0].value) == len(made[0].names) == len(made[2].value)
    np.testing.assert_allclose(made[3].value, made[0].value)
    assert not np.allclose(made[1].value[-4:], made[0].value[-4:])


def test_a_network_for_slip_is_kept_and_a_damaged_one_refused(learnt, tmp_path):
    write_slip(tmp_path / "slip.safetensors", learnt)
    way = unseen_ways(1)[0]
    kept, own = SlipTracker(read_slip(tmp_path / "slip.safetensors")), SlipTracker(learnt)
    for modes in way.modes[:5]:
        one, other = kept(modes), own(modes)
        assert one.begins == pytest.approx(other.begins, abs=1e-5) and one.left_high_mm == pytest.approx(other.left_high_mm, rel=1e-4)
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "slip.safetensors").read_bytes()[:-100])
    with pytest.raises(TrainingError, match="cut.safetensors"):
        read_slip(tmp_path / "cut.safetensors")


def test_a_run_that_learnt_from_drags_remembers_them_and_its_small_copy_does(contacts, tmp_path, monkeypatch):
    folder, run, sensor = contacts
    shutil.copytree(run, tmp_path / "run")
    estimator = PoseEstimator.load(run)
    parts = [load_dataset(folder, sensor, estimator.names)]
    config = RunConfig("touch", recipe_of("touch", members=1, kernel=False, epochs=20), split=None)
    assert "30 are needed" in add_slip(tmp_path / "run", config, parts)[0]
    for name, small in (("WAYS", 20), ("EPOCHS", 2)):
        monkeypatch.setattr(slip, name, small)
    monkeypatch.setattr("training.studies.train.FEWEST_DRAGS", 0)
    assert add_slip(tmp_path / "run", config, parts) == []
    pack(tmp_path / "run", tmp_path / "small")
    for place in ("run", "small"):
        made = PoseEstimator.load(tmp_path / place).with_history().estimate_one(OneFrame(parts[0].pins.rows(np.array([5]))), 0.0, "")
        told = dict(zip(made.names, made.value, strict=True))
        assert 0 <= told["slip_begins"] <= 1 and told["slip_left"] >= 0 and -180 <= told["slip_direction"] <= 180


@pytest.mark.usefixtures("undrawn_charts")
def test_slip_of_simulated_drags_is_judged_and_said(contacts, tmp_path):
    folder, run, sensor = contacts
    estimator = PoseEstimator.load(run)
    data = load_dataset(folder, sensor, estimator.names)
    network = slip.SlipNetwork(2 * estimator.modes_of(data.pins).shape[1]).eval()
    shutil.copytree(run, tmp_path / "run")
    write_slip(tmp_path / "run" / SLIP, slip.SlipModel(network, 1.0, np.ones(network.enter.in_features // 2), 0.5, 1.0, 1.0))
    found = evaluate_run(tmp_path / "run", [folder], tmp_path / "out", rows="all")
    assert found.metrics["slip"]["contacts"] == 10 and found.metrics["maps"]["states"] > 20
    assert sum("slip (contacts: 10)" in line or "contact maps (states: " in line for line in found.lines()) == 2
