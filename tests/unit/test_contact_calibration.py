"""Calibration of contacts on frames of the twin itself, whose numbers are known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_generation import EXPERIMENT, small_config

from scenes import load_experiment
from scenes.body import ASSUMED_FACTOR
from scenes.rig import ForceSensorSpec
from training.generation.config import draw_label
from twin.calibration.contact import PARAMETERS, fit_contact
from twin.calibration.contact.fit import CalibrationSetup, FittedContacts, expect, held_out_px
from twin.calibration.contact.forces import ForceSetup
from twin.calibration.contact.newtons import assume_stiffness, compare_forces, pressed_n
from twin.errors import FrameError
from twin.evaluation.labelled.model import ContactModel, MeasuredFrames
from twin.types import Form

FITTED = tuple(p for p in PARAMETERS if p.name in ("rig.contact_offset_mm", "rig.tcp_lateral_mm", "rig.image_turn_deg"))
TRUTH = {"contact_offset_mm": 0.45, "tcp_lateral_mm": 1.1, "image_turn_deg": 84.0, "turn_sign": -1}
NOISE_PX, FRAMES = 0.05, 7
ACROSS = 6  # coarse, for both sides
SAME_FORCE = 1e-3  # relative: what the solver leaves
SAME_PX = 0.02


def telling(home):
    """The small experiment with moves that show."""
    file = home / "moved.toml"
    file.write_text(EXPERIMENT.replace("move_1 = [-0.5, 0.5]", "move_1 = [-1.5, 1.5]").replace("-4.4, -3.8", "-4, -3.2"))
    return file


def frames(config, sensor, seeds, *, bad=()):
    """Frames of a rig; every third move was not executed, of ``bad`` ones the pins are nonsense."""
    model = ContactModel(sensor, config.experiment, config.object, Form.PROCESSED, across=ACROSS)
    labels, pins, done = [], [], []
    for k, seed in enumerate(seeds):
        label = draw_label(config.experiment, np.random.default_rng(seed))
        moved = model.displacements_px(label)[int(k % 3 != 2)]
        noise = np.random.default_rng([seed, 1]).normal(scale=NOISE_PX, size=moved.shape)
        pins.append(model.rest_px + moved + noise + (3.0 if k in bad else 0.0))
        labels.append(label)
        done.append(k % 3 != 2)
    pins = np.stack(pins)
    pins[0, :3] = np.nan  # lost ones
    return MeasuredFrames(Form.PROCESSED, [f"f_{k}" for k in range(len(pins))], labels, pins, model.rest_px, []), np.array(done)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """What a calibration starts from, which moves were made, and frames that it does not see."""
    home = tmp_path_factory.mktemp("calibration")
    config = small_config(home, experiment=load_experiment(telling(home)))
    true = config.sensor.model_copy(update={"rig": config.sensor.rig.model_copy(update=TRUTH)})
    measured, done = frames(config, true, range(FRAMES), bad=(4,))
    setup = CalibrationSetup(config.sensor, config.experiment, config.object, ACROSS, Form.PROCESSED, home / "contacts", parameters=FITTED)
    held, _ = frames(config, true, range(100, 103))
    return setup, measured, done, held


@pytest.fixture(scope="module")
def calibrated(prepared):
    setup, measured, done, held = prepared
    return setup, measured, done, fit_contact(setup, measured), held


@pytest.mark.slow
def test_numbers_and_sign_are_found_again_within_their_uncertainty(calibrated):
    _, _, _, fit, _ = calibrated
    truth = np.array([TRUTH[p.name.split(".")[1]] for p in FITTED])
    assert fit.sensor.rig.turn_sign == TRUTH["turn_sign"]
    assert (np.abs(fit.value - truth) < 3 * fit.sd).all() and (np.abs(fit.value - truth) < 0.2 * np.abs(fit.start - truth)).all()
    assert fit.sensor.rig.contact_offset_mm == fit.value[0] and (fit.determined > 0.9).all()


@pytest.mark.slow
def test_moves_that_were_not_executed_and_odd_frames_are_found(calibrated):
    _, _, done, fit, _ = calibrated
    good = np.arange(FRAMES) != 4
    assert np.array_equal(fit.executed[good] > 0.5, done[good])
    assert fit.trust[4] < 0.5 and (fit.trust[good] > 0.9).all()
    assert np.nanmean(fit.after_px[good]) < 0.2 < np.nanmean(fit.before_px[good])


@pytest.mark.slow
def test_frames_that_were_not_fitted_are_met_as_well(calibrated):
    setup, _, _, fit, held = calibrated
    before, after = held_out_px(setup, fit, held)
    assert after < 0.25 * before


@pytest.mark.slow
def test_a_continued_calibration_computes_nothing_twice(calibrated, monkeypatch):
    setup, measured, _, fit, _ = calibrated
    monkeypatch.setattr("twin.calibration.contact.fit._contact", None)  # not callable: a new contact would fail
    again = fit_contact(setup, measured)
    assert np.array_equal(again.value, fit.value) and np.array_equal(again.executed, fit.executed)


def test_parameters_that_frames_do_not_determine_stay_at_their_start():
    """Frames of which neither story is likelier: the probability is the share, and nobody is sure."""
    made = expect(np.array([[1.0, 1.0]] * 6))
    assert np.allclose(made.executed, made.executed[0]) and made.share == pytest.approx(0.5, abs=0.05)
    sure = expect(np.array([[0.1, 9.0], [9.0, 0.1], [9.0, 0.1], [np.nan, np.nan]]))
    assert sure.executed[0] < 0.01 and (sure.executed[1:3] > 0.99).all() and sure.trust[3] == 0


def test_values_go_into_the_specification_and_come_back(tmp_path):
    config = small_config(tmp_path)
    setup = FittedContacts(config.sensor, config.experiment, config.object, ACROSS)
    values = setup.quantities
    moved = values + [0.1 * p.step for p in PARAMETERS]
    there = setup.sensor_with(moved, 1)
    assert np.allclose(replace(setup, sensor=there).quantities, moved)
    assert there.rig.turn_offset_deg[:2] == (0, 0) and there.rig.turn_offset_deg[2] == pytest.approx(moved[3])


def test_too_few_frames_are_refused(prepared):
    setup, measured, _, _ = prepared
    few = MeasuredFrames(measured.form, measured.names[:2], measured.labels[:2], measured.pins_px[:2], measured.no_contact_px, [])
    with pytest.raises(FrameError, match="too few frames with pins .2.;"):
        fit_contact(setup, few)


def test_weighed_presses_fix_the_scale_of_forces_and_leave_the_pins_where_they_are(tmp_path):
    config = small_config(tmp_path, experiment=load_experiment(telling(tmp_path)))
    sensor = config.sensor.model_copy(update={"rig": config.sensor.rig.model_copy(update={"compliance_mm_per_n": 0.1})})
    labels = [replace(draw_label(config.experiment, np.random.default_rng(seed)), executed=False) for seed in range(3)]

    def simulate_n(sensor, labels):
        setup = ForceSetup(sensor, config.experiment, config.object, ACROSS, parameters=())
        return setup.forces([setup.start], labels)[0, :, 2]

    simulated = simulate_n(sensor, labels)
    weighed = 1.4 * simulated * np.exp([0.02, -0.02, 0.0])
    found = compare_forces(weighed, simulated, sensor)
    assert found.presses == 3 and found.scale == pytest.approx(1.4, rel=0.02) and 1.0 < found.factor < 1.1
    stiffer = found.of(sensor)
    assert stiffer.skin.stiffness_factor == found.factor
    np.testing.assert_allclose(simulate_n(stiffer, labels[:1]), found.scale * simulated[:1], rtol=SAME_FORCE)
    models = [ContactModel(each, config.experiment, config.object, Form.PROCESSED, across=ACROSS) for each in (sensor, stiffer)]
    before, after = (model.displacement_px(labels[0]) for model in models)
    np.testing.assert_allclose(after, before, atol=SAME_PX)


def test_without_enough_weighed_presses_it_says_which_stiffness_is_assumed(tmp_path):
    sensor = small_config(tmp_path).sensor
    for found in (assume_stiffness(sensor, "none was measured"), compare_forces([1.0, 2.0, 0.01], [1.0, 2.0, 0.01], sensor)):
        assert (found.presses, found.scale, found.factor) == (0, 1.0, ASSUMED_FACTOR)
        assert f"skin {sensor.skin.young_modulus_mpa:.3g} MPa" in found.explanation and "the force of 3 presses" in found.explanation
    wide, narrow = (compare_forces(np.exp(spread * np.linspace(-1, 1, 5)), np.ones(5), sensor).factor for spread in (0.3, 0.03))
    assert wide > 1.2 > narrow > 1.0


def test_forces_are_read_along_the_approach_as_the_rigs_sensor_reads_them(tmp_path):
    config = small_config(tmp_path)
    labels = {"Fz": np.array(["1.5", "", "2"]), "Fy": np.array(["3", "7", "-1"])}
    recording = SimpleNamespace(labels=labels, __len__=lambda: 3)
    np.testing.assert_array_equal(pressed_n(recording, config.sensor, config.experiment), [1.5, np.nan, 2.0])
    reads = ForceSensorSpec(gain=(1.0, 2.0, 1.0), offset_n=(0.0, 1.0, 0.0))
    sensor = config.sensor.model_copy(update={"rig": config.sensor.rig.model_copy(update={"force_sensor": reads})})
    np.testing.assert_array_equal(pressed_n(recording, sensor, config.experiment), [1.0, 3.0, -1.0])  # the approach is y


@pytest.mark.slow
def test_pins_at_rest_that_no_frame_shows_are_fitted_with_the_contact(calibrated):
    """Every pin of the unit stands a little beside where the specification has it."""
    setup, measured, _, _, held = calibrated
    off_px = np.random.default_rng(3).normal(scale=1.0, size=measured.no_contact_px.shape)
    seen = replace(measured, pins_px=measured.pins_px + off_px, at_rest_seen=False)
    fit = fit_contact(setup, seen)
    away_px = np.linalg.norm(fit.rest_px - measured.no_contact_px - off_px, axis=1)
    assert np.median(away_px) < 0.1 * np.median(np.linalg.norm(off_px, axis=1))
    assert np.allclose(fit.sensor.pipeline.processed.rest_px, fit.rest_px, atol=1e-3)
    before, after = held_out_px(setup, fit, replace(held, pins_px=held.pins_px + off_px, at_rest_seen=False))
    assert after < 0.25 * before
