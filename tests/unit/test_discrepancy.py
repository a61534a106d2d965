"""What a twin misses, learnt from a few frames: it is found where it is smooth, distrusted where it isn't, and nothing at rest."""

import numpy as np
import pytest

from training.runs.gaussian_process import Points
from training.studies.sim_to_real.discrepancy import FEWEST, FRICTIONS, Discrepancy, Residuals, _likeliest, label_axes
from twin.rig.labels import ArmLabel

PINS = 30
RECOVERED = 0.25  # of what was missing may be left, on labels between those that were learnt from


def labels_of(rng, count):
    poses, moves = np.zeros((count, 6)), np.zeros((count, 6))
    poses[:, 1], poses[:, 5] = rng.uniform(-4, 0, count), rng.uniform(-20, 20, count)
    moves[:, 0] = rng.uniform(-5, 5, count)
    return [ArmLabel(pose, move, bool(done)) for pose, move, done in zip(poses, moves, rng.random(count) < 0.7, strict=True)]


def moved_of(labels):
    """Displacements of a made-up sensor: outwards with depth, sideways with the move."""
    place = np.linspace(-1, 1, 2 * PINS).reshape(PINS, 2)
    return np.stack([(label.pose[1] + 5) * place + 0.4 * label.executed * label.move[0] for label in labels])


def missed_by(labels, moved, scatter=0.0, seed=9):
    """2 % and a bend with the angle; with ``scatter``, something that no label tells."""
    rng = np.random.default_rng(seed)
    rms = np.sqrt((moved**2).sum(-1).mean(-1))[:, None, None]
    bend = np.array([np.sin(label.pose[5] / 12) for label in labels])[:, None, None] * np.cos(np.arange(2 * PINS)).reshape(PINS, 2)
    return 0.02 * moved + rms * (0.03 * bend + scatter * rng.normal(size=(len(labels), 1, 1)))


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def learnt(rng, scatter=0.0, count=40):
    labels = labels_of(rng, count)
    moved = moved_of(labels)
    return Discrepancy(
        Residuals(label_axes(labels), moved, missed_by(labels, moved, scatter), np.full(len(labels), np.nan), np.ones(len(labels)))
    )


def mean_px(found, labels, moved):
    """(S, N, 2) expected discrepancy of S simulated displacements, px."""
    points = Points.of(found._scale_axes(label_axes(labels)))
    return found._fields(np.stack([process.mean(points) for process in found.processes], axis=1), moved, np.zeros(2 * PINS))


def test_a_smooth_discrepancy_is_recovered_on_other_labels(rng):
    found, labels = learnt(rng), labels_of(rng, 50)
    moved = moved_of(labels)
    missed = missed_by(labels, moved)
    left = missed - mean_px(found, labels, moved)
    assert np.abs(left).mean() < RECOVERED * np.abs(missed).mean()


def test_a_residual_that_no_label_explains_is_drawn_with_its_observed_spread(rng):
    found, labels = learnt(rng, scatter=0.05), labels_of(rng, 200)
    moved = moved_of(labels)
    missed = missed_by(labels, moved, scatter=0.05, seed=10)
    drawn = found.draw_px(labels, moved, np.arange(len(labels)), seed=0)
    ratio = np.std((drawn - mean_px(found, labels, moved)).mean(axis=(1, 2))) / np.std(
        (missed - mean_px(found, labels, moved)).mean(axis=(1, 2))
    )
    assert 0.6 < ratio < 1.6
    assert found.summary()[0]["told"] < 0.9


def test_states_of_one_contact_share_one_function_and_the_draw_repeats(rng):
    found, label = learnt(rng, scatter=0.05), labels_of(rng, 1)[0]
    twice = [label, ArmLabel(label.pose + [0, 1e-3, 0, 0, 0, 0], label.move, label.executed)]
    moved = moved_of([label, label])
    together = found.draw_px(twice, moved, np.array([4, 4]), seed=2)
    apart = found.draw_px(twice, moved, np.array([4, 5]), seed=2)
    assert np.abs(together[0] - together[1]).max() < 0.1 * np.abs(apart[0] - apart[1]).max()
    assert np.array_equal(together, found.draw_px(twice, moved, np.array([4, 4]), seed=2))


def test_the_discrepancy_is_proportional_to_the_displacement(rng):
    """A contact that moves the pins half as far misses half as much."""
    found, labels = learnt(rng), labels_of(rng, 5)
    moved = 2 * moved_of(labels)
    assert mean_px(found, labels, moved / 2) == pytest.approx(mean_px(found, labels, moved) / 2)


def test_a_frames_friction_is_found_between_those_that_were_tried():
    rng = np.random.default_rng(3)
    at = np.log(FRICTIONS)
    fields = np.cumsum(rng.normal(size=(len(at), 1, 2, 30, 2)), axis=0) * np.ones((1, 9, 1, 1, 1))
    true = rng.uniform(at[0], at[-1], 9)
    real = np.stack([[np.interp(t, at, fields[:, 0, 1, n, c]) for n in range(30) for c in range(2)] for t in true]).reshape(9, 30, 2)
    real[0, :4] = np.nan  # lost
    fields[3, 1] = np.nan  # this friction's contact failed
    moved, friction, told_px = _likeliest(fields, real, FRICTIONS)
    sound = np.arange(9) != 1
    assert (told_px[sound, 1] > 0).all()
    assert np.allclose(np.log(friction[sound, 1]), true[sound]) and np.allclose(moved[2:, 1], real[2:])
    assert np.isfinite(moved[1]).all(), "the frictions beside it stand for it"
    fields[:, 5, 0] = np.nan
    assert np.isnan(_likeliest(fields, real, FRICTIONS)[0][5, 0]).all()


def test_friction_is_drawn_in_the_range_of_the_frames():
    nothing = np.zeros((20, 5, 2))
    frictions = np.exp(np.linspace(np.log(0.3), np.log(0.6), 20))
    spread = Residuals(np.zeros((20, 12)), nothing, nothing, frictions, np.ones(20)).friction_spread()
    assert 0.2 < spread.low < 0.3 and 0.6 < spread.high < 0.8 and spread.free_share == spread.stick_share == 0
    few = np.where(np.arange(20) < FEWEST - 1, frictions, np.nan)
    assert Residuals(np.zeros((20, 12)), nothing, nothing, few, np.ones(20)).friction_spread() is None
    assert Residuals(np.zeros((20, 12)), nothing, nothing, frictions, np.zeros(20)).friction_spread() is None
    sliding = np.append(frictions, [0.1] * 3), np.append(np.full(20, 5.0), [0.6] * 3)
    assert Residuals(np.zeros((23, 12)), nothing[:1], nothing[:1], *sliding).friction_spread().low == pytest.approx(0.1 / 1.25, rel=0.1)
    sticking = np.append(frictions, [3.0, 3.0]), np.append(np.ones(20), [0.0, 0.01])
    assert Residuals(np.zeros((22, 12)), nothing[:1], nothing[:1], *sticking).friction_spread().high == pytest.approx(spread.high, rel=0.05)


def test_a_direction_has_no_beginning():
    """What is missed at 179 deg is missed at -179 deg."""
    rng = np.random.default_rng(3)
    pose, still = np.zeros((60, 6)), np.zeros(6)
    pose[:, 2], pose[:, 5] = rng.uniform(3, 5, 60), np.linspace(-175, 175, 60)
    place = np.linspace(-1, 1, 2 * PINS).reshape(PINS, 2)
    moved = pose[:, 2, None, None] * place
    missed = 0.1 * moved * np.sin(np.radians(pose[:, 5]))[:, None, None] + 0.1 * moved
    known = label_axes([ArmLabel(each, still) for each in pose])
    learnt = Discrepancy(Residuals(known, moved, missed, np.full(60, np.nan), np.ones(60)))
    ends = [ArmLabel(np.array([0, 0, 4.0, 0, 0, turn]), still) for turn in (179.0, -179.0)]
    one, other = mean_px(learnt, ends, np.stack([4 * place] * 2))
    assert np.abs(one - other).max() < 0.05 * np.abs(one).max()
