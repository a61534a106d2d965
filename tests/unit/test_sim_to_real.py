"""From simulated pins to a real sensor: other rest pins, a few labelled frames, small copies."""

import json
from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest
import torch
from drawn_recording import config_of

from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.models.vgnn import model as vgnn
from training.runs.gaussian_process import Points, fit_two_fidelities
from training.runs.run import train_run, write_tensors
from training.runs.run_files import pack, shipped_names
from training.studies.sim_to_real import model_inversion
from training.studies.sim_to_real.field import Left, Missed
from training.studies.sim_to_real.model_inversion import ModelInversion, TwinForwards, TwinRead, _share
from training.studies.sim_to_real.steps import choose_frames, combine_co_kriging, quadratic_row, states_like, widen_intervals
from twin.pins import make_reference
from twin.rig.labels import ArmLabel

LIKE_A_UNIT = 1e-3  # mm or deg: the tolerances of a unit's pins turn and scale its layout by some 0.01 deg and 0.01 %
HALF = 0.02  # of a label's spread: what half precision may change


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    train_run(config_of("vgnn", epochs=30, members=1, batch=16, kernel=False), data, out)
    return out


def other_camera(pins):
    """The same frames by a camera that sits otherwise, with its own no-contact layout."""
    moved = pins.reference.pins_px + [3.0, -2.0] + 0.3 * np.random.default_rng(5).normal(size=(127, 2))
    return replace(pins, measured=True).relative_to(make_reference(moved, pins.sensor.pins))


def test_pins_are_counted_from_the_no_contact_frame_in_hand(data, run):
    estimator, pins = PoseEstimator.load(run), replace(data.pins, measured=True)
    here, there = estimator.predict_table(pins), estimator.predict_table(other_camera(pins))
    assert np.abs(here.mean - there.mean).max() < LIKE_A_UNIT
    unknown = estimator.predict_table(replace(other_camera(pins), measured=False))
    assert np.abs(here.mean - unknown.mean).max() > 2 * LIKE_A_UNIT


def test_the_discrepancy_is_learnt_from_few_frames_and_its_uncertainty_is_right():
    rng = np.random.default_rng(1)
    simulated, real = rng.normal(size=(400, 6)), rng.normal(size=(240, 6))

    def in_twin(x):
        return np.column_stack([np.sin(x[:, 0]) + 0.5 * x[:, 1], x[:, 2] * x[:, 3]])

    truth = in_twin(real) + np.column_stack([0.5 + 0.3 * real[:, 0], 0.4 * real[:, 4]])
    few, rest = slice(0, 40), slice(40, None)
    told, left_out = fit_two_fidelities(simulated, in_twin(simulated), real[few], truth[few], seed=0)
    error = np.abs(told(Points.of(real[rest], second=True)) - truth[rest]).mean(axis=0)
    assert (error < 0.3 * np.abs(in_twin(real[rest]) - truth[rest]).mean(axis=0)).all()
    said = np.abs(left_out - truth[few]).mean(axis=0)
    assert (said < 2 * error).all() and (said > 0.5 * error).all()


FEW, REST, SIMULATED = np.arange(24), np.arange(24, 44), np.arange(44, 90)


@pytest.fixture(scope="module")
def corrected(data, run, tmp_path_factory):
    """The run beside a process that knows some frames of a sensor whose labels are off; its targets; and the process's own error.

    A copy of the run, ``sim_only`` in the same folder's parent, is too sure of itself.
    """
    off = mislabelled(data)
    out = tmp_path_factory.mktemp("study") / "sim_plus_real"
    alone = copytree(run, out.with_name("sim_only"))
    content = torch.load(alone / "weights.pt", weights_only=True)
    write_tensors(alone / "weights.pt", content | {"quantile": 1e-3 * content["quantile"]})
    before = files_of(alone)
    made = combine_co_kriging(alone, out, data.rows(SIMULATED), off.rows(FEW), seed=0)
    assert files_of(alone) == before, "the run that frames are put beside stays as it is"
    widen_intervals(alone, made.intervals)
    return out, off.targets, made.left_out


def files_of(folder):
    """What a run's files hold, byte by byte."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def mislabelled(found):
    """The same frames of a sensor whose labels are off."""
    return replace(found, targets=replace(found.targets, corrected=found.targets.corrected + [1.0, -3.0]))


def test_a_study_that_is_gone_on_with_finds_the_same_again(data, corrected, tmp_path):  # noqa: F811
    """The run beside which frames are put has its intervals widened by then."""
    out, alone = corrected[0], corrected[0].with_name("sim_only")
    kept = {folder: torch.load(folder / "weights.pt", weights_only=True) for folder in (out, alone)}
    again = combine_co_kriging(alone, tmp_path / "again", data.rows(SIMULATED), mislabelled(data).rows(FEW), seed=0)
    assert all(np.array_equal(kept[alone][key].numpy(), wider) for key, wider in again.intervals.items())
    assert np.array_equal(again.left_out, corrected[2])
    made = torch.load(tmp_path / "again" / "weights.pt", weights_only=True)
    assert all(torch.equal(kept[out][key], made[key]) for key in again.intervals)


def test_a_run_is_not_written_over_itself(data, run):  # noqa: F811
    before = files_of(run)
    with pytest.raises(TrainingError, match="over itself"):
        combine_co_kriging(run, run.parent / "." / run.name, data.rows(SIMULATED), data.rows(FEW), seed=0)
    assert files_of(run) == before


def test_a_corrected_run_is_a_run_and_better_where_the_model_was_off(data, run, corrected):
    out, off, left_out = corrected
    assert (left_out < [0.5, 3.0]).all()
    plain, plus = (PoseEstimator.load(path).predict_table(data.pins.rows(REST)) for path in (run, out))
    before, after = (np.abs(made.mean - off.corrected[REST]).mean(axis=0) for made in (plain, plus))
    assert (after < 0.6 * before).all()
    assert json.loads((out / "config.json").read_text())["beside"]["frames"] == data.pins.image_name[FEW].tolist()


def test_intervals_are_widened_to_what_labelled_frames_say(data, corrected):
    out, off, _ = corrected
    for run in (out, out.with_name("sim_only")):
        told = PoseEstimator.load(run).predict_table(data.pins.rows(REST))
        inside = np.abs(told.mean - off.corrected[REST]) <= told.half_width
        assert (inside.mean(axis=0) > 0.7).all()


def test_contacts_of_another_experiment_are_refused(data):
    far = replace(data, targets=replace(data.targets, corrected=data.targets.corrected + [50.0, 0.0]))
    with pytest.raises(TrainingError, match="^0 simulated states .*`contacts`"):
        states_like(far, data.rows(FEW))
    assert len(states_like(data, data.rows(FEW))) >= len(FEW)


def test_a_displaced_camera_is_left_to_the_network(data, run, corrected):
    plain, plus = (PoseEstimator.load(path) for path in (run, corrected[0]))
    inputs, rows = plus.inputs_of(data.pins, together=False)
    assert np.abs(plus.ensemble(inputs, rows).mean - plain.ensemble(inputs, rows).mean).max() > 0.5
    inputs.displaced[:] = 1
    assert np.array_equal(plus.ensemble(inputs, rows).mean, plain.ensemble(inputs, rows).mean)


def test_a_small_copy_of_a_corrected_run_says_the_same(data, corrected, tmp_path):
    pack(corrected[0], tmp_path)
    whole, small = (PoseEstimator.load(path).predict_table(data.pins) for path in (corrected[0], tmp_path))
    assert (np.abs(whole.mean - small.mean).max(axis=0) < HALF * data.targets.corrected.std(axis=0)).all()


def test_a_small_copy_says_the_same_on_any_machine(data, run, tmp_path, monkeypatch):
    """Waves of equal frequency may be any basis: another linear algebra finds another one."""
    size = pack(run, tmp_path)
    assert size < 0.5 * (run / "weights.pt").stat().st_size
    whole = PoseEstimator.load(run).predict_table(data.pins)
    found_here = vgnn.laplacian_waves
    monkeypatch.setattr(vgnn, "laplacian_waves", lambda adjacency, count: -found_here(adjacency, count))
    small = PoseEstimator.load(tmp_path).predict_table(data.pins)
    assert (np.abs(whole.mean - small.mean).max(axis=0) < HALF * data.targets.corrected.std(axis=0)).all()
    assert "data" not in json.loads((tmp_path / "config.json").read_text())
    cut = (tmp_path / "weights.safetensors").read_bytes()[:-100]
    (tmp_path / "weights.safetensors").write_bytes(cut)
    with pytest.raises(TrainingError, match="damaged"):
        PoseEstimator.load(tmp_path)


def test_shipped_weights_load_by_name():
    assert shipped_names()
    for name in shipped_names():
        assert PoseEstimator.load(name).sensor.name == name
    with pytest.raises(TrainingError, match=shipped_names()[0]):
        PoseEstimator.load("no-such-run")


def test_frames_that_are_judged_on_are_never_learnt():
    frames = choose_frames(1000, 40, 3)
    assert len(frames.test) == 200 and len(frames.few) == 40 and len(frames.trained["500"]) == 500
    for rows in frames.trained.values():
        assert not set(rows) & set(frames.test) and set(frames.few) <= set(rows)
    assert not np.array_equal(frames.few, choose_frames(1000, 40, 4).few)
    with pytest.raises(TrainingError, match="80 frames"):
        choose_frames(100, 90, 0)


def test_the_quadratic_regression_learns(data):
    row = quadratic_row("real", data, np.arange(60), np.arange(60, 90))
    assert row["pose_2_corrected"] < 0.4 * np.abs(data.targets.corrected[:, 0] - data.targets.corrected[:, 0].mean()).mean()


def edge_pins(labels, rest):
    """Displacements by an edge at a distance, a depth and a direction, after a move across it."""
    pose, move = np.stack([label.pose for label in labels]), np.stack([label.move for label in labels])
    turn = np.radians(pose[:, 5])[:, None]
    place = (rest @ [1, 1j]) * np.exp(-1j * turn) / 60
    away = place.imag - pose[:, [1]] / 12
    field = pose[:, [2]] * np.exp(-4 * away**2) * (0.3 + 1j * away) + 0.3 * move[:, [1]] * np.exp(-2 * away**2)
    field = field * np.exp(1j * turn)
    return np.stack([field.real, field.imag], axis=-1)


@pytest.mark.parametrize("sense", [-1, pytest.param(1, marks=pytest.mark.slow)])
def test_the_twin_read_backwards_finds_labels_and_learns_what_the_twin_misses(sense):
    """An edge around the circle, after moves that are found, too; the real pins are displaced, and move by a tenth more."""
    rng = np.random.default_rng(0)
    rest = rng.uniform(-60, 60, (60, 2))
    ranges = np.zeros((12, 2))
    ranges[[1, 2, 5, 7]] = [[-6, 6], [3, 5], [-180, 180], [-2, 2]]

    def contacts(count):
        drawn = rng.uniform(*ranges.T, (count, 12))
        return [ArmLabel(each[:6], each[6:]) for each in drawn]

    def pins(labels):
        moved = edge_pins(labels, rest * [sense, 1])  # seen from behind, the edge turns the other way as its label grows
        return moved * [sense, 1]

    simulated, few, asked = contacts(200), contacts(30), contacts(30)
    twin = ModelInversion(pins(simulated), simulated, rest, ranges)
    shifted = rng.normal(0, 0.2, (60, 2))
    real = [1.1 * pins(each) + shifted + rng.normal(0, 0.02, (len(each), 60, 2)) for each in (few, asked)]
    truth = np.stack([np.concatenate([label.pose, label.move]) for label in asked])

    def errors(count):
        found = twin.estimate(real[0][:count], few[:count], real[1])
        assert (found[:, [0, 3, 4, 6]] == 0).all()
        missed = np.abs(found - truth)
        missed[:, 5] = np.abs((found[:, 5] - truth[:, 5] + 180) % 360 - 180)
        return np.median(missed[:, [1, 2, 5]], axis=0)

    assert (errors(30) < [0.15, 0.25, 1.5]).all()
    assert (errors(30) < 0.85 * errors(0)).all(), "labelled frames tell what the twin misses"


def test_a_twin_without_unknown_labels_or_without_noise_is_read_as_well():
    rng = np.random.default_rng(2)
    rest = rng.uniform(-60, 60, (60, 2))
    ranges = np.zeros((12, 2))
    ranges[[1, 2, 5]] = [[1, 1], [4, 4], [-180, 180]]
    only = [ArmLabel(each[:6], each[6:]) for each in rng.uniform(*ranges.T, (100, 12))]
    truth = np.array([label.pose[5] for label in only])
    found = ModelInversion(edge_pins(only, rest), only, rest, ranges).estimate(np.zeros((0, 60, 2)), [], edge_pins(only[:20], rest))
    assert np.abs((found[:, 5] - truth[:20] + 180) % 360 - 180).max() < 1.0, "the direction alone is unknown, the pins have no noise"
    known = ranges.copy()
    known[1:3], known[5] = [[-6, 6], [3, 5]], 30.0
    ranges[1:3] = known[1:3]
    around = [ArmLabel(each[:6], each[6:]) for each in rng.uniform(*ranges.T, (150, 12))]
    asked = [ArmLabel(each[:6], each[6:]) for each in rng.uniform(*known.T, (20, 12))]
    twin = ModelInversion(edge_pins(around, rest), around, rest, known)
    found = twin.estimate(np.zeros((0, 60, 2)), [], edge_pins(asked, rest) + rng.normal(0, 0.01, (20, 60, 2)))
    assert (found[:, 5] == 30.0).all(), "the direction is known"
    assert np.median(np.abs(found[:, 1] - [label.pose[1] for label in asked])) < 0.2
    assert twin.estimate(np.zeros((0, 60, 2)), [], np.zeros((0, 60, 2))).shape == (0, 12)


def test_the_covariance_of_what_is_left_is_that_of_the_frames_and_grows_with_their_amplitude():
    rng = np.random.default_rng(0)
    noise = np.diag(np.linspace(0.5, 2.0, 12))
    axes, _ = np.linalg.qr(rng.normal(size=(12, 12)))
    grown = (axes * np.array([40.0, 15.0, *[0.0] * 10])) @ axes.T
    size = rng.uniform(1, 10, 4000)
    seen = np.zeros((4000, 6), complex)
    seen[:, 0] = size
    drawn = rng.multivariate_normal(np.zeros(12), noise, 4000) + np.sqrt(size / np.median(size))[:, None] * rng.multivariate_normal(
        np.zeros(12), grown, 4000
    )
    left = Left(drawn[:, :6] + 1j * drawn[:, 6:], seen, noise)
    for least, most in ((1, 2), (9, 10)):
        rows = (size > least) & (size < most)
        white = drawn[rows] @ left.axes * left.weights(seen[rows])
        assert np.abs(np.cov(white.T) - np.eye(12)).max() < 0.35
    assert (left.weights(seen[:1] * 0 + 10) < left.weights(seen[:1] * 0 + 1)).all()


@pytest.mark.slow
def test_frames_without_labels_teach_what_the_twin_misses_where_few_have_labels(monkeypatch):
    rng = np.random.default_rng(1)
    rest = rng.uniform(-60, 60, (60, 2))
    ranges = np.zeros((12, 2))
    ranges[[1, 2, 5]] = [[-6, 6], [3, 5], [-180, 180]]
    simulated, few, more, asked = ([ArmLabel(each[:6], each[6:]) for each in rng.uniform(*ranges.T, (n, 12))] for n in (300, 4, 150, 60))
    shifted = rng.normal(0, 0.4, (60, 2))
    seen = [1.1 * edge_pins(each, rest) + shifted + rng.normal(0, 0.02, (len(each), 60, 2)) for each in (few, more, asked)]
    twin = ModelInversion(edge_pins(simulated, rest), simulated, rest, ranges)
    truth = np.array([label.pose[5] for label in asked])

    def error(*unlabelled):
        found = twin.estimate(seen[0], few, seen[2], *unlabelled)
        return np.abs((found[:, 5] - truth + 180) % 360 - 180).mean()

    assert error(seen[1]) < 0.95 * error()
    empty = rng.normal(0, 0.02, (60, 60, 2)) + shifted
    taught = []

    class Counted(Missed):
        def __init__(self, field, known, seen, noisier):
            taught.append(len(known) - len(few))
            super().__init__(field, known, seen, noisier)

    monkeypatch.setattr(model_inversion, "Missed", Counted)
    error(np.concatenate([seen[1][:60], empty]))
    assert 40 < taught[-1] < 66, "frames that show no direction teach nothing"


def plate_pins(labels, rest):
    """Displacements (B, N, 2) by a plate's depth and tilt: a stretch that grows with the depth, and a shift with the tilt."""
    depth, tilt = (np.array([label.pose[k] for label in labels])[:, None, None] for k in (2, 3))
    far = np.exp(-np.sum(rest**2, axis=1) / 50**2)[:, None]
    return 0.05 * depth * rest * far + 0.02 * (tilt + 0.02 * tilt**2) * far * [1.0, 0.4] + 0.004 * depth * tilt * rest[:, ::-1] * far


@pytest.mark.slow
def test_a_twin_read_both_ways_is_as_good_as_the_better_reading_and_better_than_the_other():
    """The real pins move by a tenth more than the twin's, are displaced, and bend with the tilt in a way that the twin does not know."""
    rng = np.random.default_rng(3)
    rest = rng.uniform(-60, 60, (60, 2))
    ranges = np.zeros((12, 2))
    ranges[[2, 3]] = [[1, 5], [-20, 20]]
    simulated, few, asked = ([ArmLabel(each[:6], each[6:]) for each in rng.uniform(*ranges.T, (n, 12))] for n in (300, 20, 200))
    odd = rng.normal(0, 0.02, (60, 2))

    def seen(labels):
        tilt = np.array([label.pose[3] for label in labels])[:, None, None]
        return 1.1 * plate_pins(labels, rest) + odd * np.abs(tilt) + rng.normal(0, 0.1, (len(labels), 60, 2))

    real, judged = seen(few), seen(asked)
    truth, told = (np.array([label.pose[[2, 3]] for label in labels]) for labels in (asked, few))
    twin = TwinRead(plate_pins(simulated, rest), simulated, rest, ranges)
    back = ModelInversion(plate_pins(simulated, rest), simulated, rest, ranges).estimate(real, few, judged)[:, [2, 3]]
    states = np.array([label.pose[[2, 3]] for label in simulated])
    forwards = TwinForwards(plate_pins(simulated, rest), states)
    forth = forwards.estimate(real, told, judged)
    both, alone, without = (np.abs(made - truth).mean(axis=0) for made in (twin.estimate(real, few, judged)[:, [2, 3]], back, forth))
    assert (both < 1.1 * np.minimum(alone, without)).all() and (both < 0.97 * np.maximum(alone, without)).all()
    assert (without < 0.7 * np.abs(forwards.estimate(real[:0], told[:0], judged) - truth).mean(axis=0)).all(), "labelled frames teach it"


def test_two_readings_are_weighted_by_their_errors_and_equally_without_any():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 400))
    assert _share(np.stack([first, second])) == pytest.approx(0.5, abs=0.05)
    assert _share(np.stack([first, 5 * second])) > 0.9 and _share(np.stack([5 * first, second])) < 0.1
    assert _share(np.stack([first, 3 * first])) == 1.0, "a reading with the same errors, but larger, has no weight"
    assert _share(np.zeros((2, 0))) == _share(np.zeros((2, 5))) == 0.5
    assert 0.5 < _share(np.stack([first, 5 * second])[:, :5]) < 0.95, "a few frames tell less"
