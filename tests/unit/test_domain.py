"""The domain of a model, on made-up contacts whose displacements follow from three numbers."""

from copy import copy
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from scenes import load_sensor
from training.errors import TrainingError
from training.estimate.domain import FEWEST, DomainVerdict, learn_domain, read_domain, write_domain
from training.estimate.estimator import PoseEstimator
from twin.pins import nominal_reference
from twin.types import Form

UNITS = ("mm", "deg")
REFERENCE = nominal_reference(load_sensor("mg400-127"), Form.PROCESSED)
SPACING_PX = float(REFERENCE.spacing_px.mean())
PLACES = (REFERENCE.pins_px - REFERENCE.pins_px.mean(axis=0)) / SPACING_PX
NONE_LOST = np.zeros(len(PLACES), bool)


def contacts(count, seed, depth=(1.0, 3.0)):
    """Displacements (M, N, 2), spacings, of contacts of a depth, a tilt and a shear, with the pins' noise, and the labels depth, tilt."""
    rng = np.random.default_rng(seed)
    deep, tilt, shear = rng.uniform(*depth, count), rng.uniform(-15, 15, count), rng.uniform(-1, 1, count)
    off = PLACES[None] - np.stack([0.15 * tilt, np.zeros(count)], axis=-1)[:, None]
    bump = np.exp(-0.06 * (off**2).sum(axis=2))[..., None]
    moved = deep[:, None, None] * bump * (0.05 * off + np.stack([0.1 * shear, 0 * shear], axis=-1)[:, None])
    return moved + rng.normal(0, 0.005, moved.shape), np.column_stack([deep, tilt])


@lru_cache(maxsize=1)
def domain():
    moved, labels = contacts(600, 0)
    return learn_domain(moved, labels, REFERENCE, UNITS, least=np.array([0.05, 0.5]))


def judged(moved, lost=NONE_LOST, **options):
    return domain().assess(moved, lost, REFERENCE, **options)


def test_contacts_like_those_of_the_training_are_usual():
    verdicts = [judged(each) for each in contacts(200, 1)[0]]
    assert np.mean([not each.reason for each in verdicts]) >= 0.99
    assert np.mean([not each.notes for each in verdicts]) >= 0.9


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda u: u + np.where(PLACES[:, 1:] > 0.5, [0.5, 0.0], 0.0), "torn frame: below y"),
        (lambda u: u + np.where(PLACES[:, :1] > 0.5, [0.0, 0.5], 0.0), "torn frame: right of x"),
        (lambda u: u + [1.2, 0.0], "displaced camera: the view is shifted by"),
        (lambda u: u + 0.08 * PLACES * [1, 0], "displaced camera: the view is stretched by"),
        (lambda u: u + 0.3 * np.random.default_rng(2).normal(size=u.shape), "not a contact that the model knows"),
        (lambda u: PLACES @ [[0.8, 0.6], [-0.6, 0.8]] - PLACES + u @ [[0.8, 0.6], [-0.6, 0.8]], "turned by 36.9 deg"),
    ],
)
def test_a_strange_frame_gets_no_estimate_and_its_cause_is_named(change, words):
    for each in contacts(5, 3)[0]:
        assert words in judged(change(each)).reason


def test_a_small_displacement_of_the_camera_is_removed_as_far_as_models_can():
    straight = contacts(1, 4)[0][0]
    verdict = judged(straight + [0.2, -0.1])
    assert not verdict.reason and verdict.camera[:2] == pytest.approx([0.2, -0.1], abs=0.02) and verdict.factor > 1
    nodes_px, area_px2 = domain().without_camera(
        REFERENCE.pins_px + SPACING_PX * (straight + [0.2, -0.1]), REFERENCE.area_px2, verdict.camera, SPACING_PX
    )
    assert np.abs((nodes_px - REFERENCE.pins_px) / SPACING_PX - straight).max() < 0.03
    assert area_px2 == pytest.approx(REFERENCE.area_px2, rel=0.02)
    assert judged(straight + [0.2, -0.1], corrects=False).reason.startswith("displaced camera")


@pytest.mark.parametrize("axis, share", [(1, 0.5), (1, 0.25), (1, 0.8), (0, 0.5), (0, 0.3)])
def test_a_part_of_one_contact_and_the_rest_of_another_are_no_contact(axis, share):
    one, other = contacts(80, 12)[0], contacts(80, 13)[0]
    beyond = PLACES[:, axis : axis + 1] > np.quantile(PLACES[:, axis], share)
    apart = np.sqrt(((one - other) ** 2).mean(axis=(1, 2)))
    mixed = [judged(np.where(beyond, a, b)).reason for a, b, far in zip(one, other, apart > 0.08, strict=True) if far]
    assert len(mixed) > 20 and np.mean([bool(reason) for reason in mixed]) > 0.9


def test_the_cameras_place_follows_from_contacts_of_which_most_are_known():
    moved = contacts(40, 14)[0]
    shift = np.array([0.4, -0.3, 0.0, 0.0])
    motions, usual = domain().common_camera(moved + (shift @ domain().motions).reshape(-1, 2))
    assert motions == pytest.approx(shift, abs=0.02) and usual > 0.9
    assert not domain().common_camera(moved)[0].any()
    assert domain().common_camera(moved + np.random.default_rng(0).normal(0, 0.2, moved.shape))[1] < 0.2


def test_intervals_grow_with_the_distance_and_never_shrink_until_there_is_no_estimate():
    straight, strange = contacts(1, 5)[0][0], np.random.default_rng(6).normal(size=(len(PLACES), 2))
    loose = replace(domain(), limits=domain().limits * [1, 1, 1, 9, 9, 9, 9, 1, 1, 1, 1])  # the parts alone would refuse before
    verdicts = [loose.assess(straight + size * strange, NONE_LOST, REFERENCE) for size in np.linspace(0, 0.2, 41)]
    first = next(k for k, each in enumerate(verdicts) if each.reason)
    factors = [each.factor for each in verdicts[:first]]
    assert factors == sorted(factors) and factors[-1] > 1.2 and all(each.reason for each in verdicts[first:])


def test_intervals_grow_from_where_the_frames_end_that_determined_them():
    """A domain of two kinds of contact has the limits of the wider kind. The intervals may come from the other one."""
    (narrow, labels), (wide, more) = contacts(600, 20), contacts(600, 21)
    ridge = np.random.default_rng(22).uniform(-1, 1, (600, 1, 1)) * np.sin(2 * PLACES[:, ::-1])
    pool = np.concatenate([narrow, wide + 0.06 * ridge + np.random.default_rng(23).normal(0, 0.02, wide.shape)])
    both = learn_domain(pool, np.concatenate([labels, more]), REFERENCE, UNITS, least=np.array([0.05, 0.5]))
    left_out, new = contacts(600, 24)[0], contacts(400, 25)[0]
    dent = np.exp(-0.5 * ((PLACES - [2.0, 1.0]) ** 2).sum(axis=1))[:, None] * [0.12, 0.0]

    def judge(domain, moved):
        return [domain.assess(each, NONE_LOST, REFERENCE) for each in moved]

    pooled, started = judge(both, new + dent), judge(both.starting_at(left_out, np.zeros(left_out.shape[:2], bool)), new + dent)
    assert np.mean([not each.reason and not each.notes for each in pooled]) > 0.5  # the domain alone takes the dent for a contact
    assert np.mean([each.reason != "" or each.factor > 1.5 for each in started]) > 0.9
    assert [each.reason for each in started] == [each.reason for each in pooled]
    usual = judge(both.starting_at(left_out, np.zeros(left_out.shape[:2], bool)), new)
    assert np.mean([bool(each.notes) for each in usual]) <= np.mean([bool(each.notes) for each in judge(both, new)]) + 0.01


def test_lighter_contacts_are_no_strangers_and_their_intervals_reach_no_contact():
    deep, labels = contacts(600, 7, depth=(1.0, 3.0))
    light = contacts(50, 8, depth=(0.0, 0.9))[0]
    assert not any(judged(each).reason for each in [*light, np.zeros_like(light[0])])
    added = judged(np.zeros_like(light[0])).added
    assert added[0] > 0 and added[0] >= judged(0.5 * deep[0]).added[0]


def test_lost_pins_are_filled_in_and_what_is_not_known_of_them_widens():
    moved = contacts(1, 9)[0][0]
    few, half = NONE_LOST.copy(), np.hypot(*(PLACES - [0.5, 0.0]).T) < 3.0
    few[::25] = True
    filled, unsure = domain().fill_lost(np.where(few[:, None], 9.0, moved), few)
    assert np.abs(filled - moved)[few].max() < 0.05 and np.array_equal(filled[~few], moved[~few])
    assert domain().fill_lost(moved, half)[1] > unsure > 0 and not judged(np.where(few[:, None], 9.0, moved), few).reason


def test_an_estimate_far_outside_the_trained_range_is_named():
    reason, _ = domain().outside_range(np.array([16.2, 0.0]), ("pose_2", "pose_6"), UNITS)
    assert "depth 16.2 mm, trained from 1.0" in reason
    reason, excess = domain().outside_range(np.array([3.2, 0.0]), ("pose_2", "pose_6"), UNITS)
    assert not reason and 0.15 < excess[0] < 0.25 and excess[1] == 0


def test_a_written_domain_judges_alike_and_one_of_other_pins_is_refused(tmp_path):
    write_domain(tmp_path / "domain.safetensors", domain())
    again = read_domain(tmp_path / "domain.safetensors", len(PLACES), 2)
    assert np.array_equal(again.starts, np.ones(5))
    for each in contacts(20, 10)[0]:
        assert again(each).parts == pytest.approx(domain()(each).parts, abs=0.05)
    with pytest.raises(TrainingError, match="domain"):
        read_domain(tmp_path / "domain.safetensors", 331, 2)


def test_too_few_frames_make_no_domain():
    moved, labels = contacts(FEWEST - 1, 11)
    assert learn_domain(moved, labels, REFERENCE, UNITS, least=np.ones(2)) is None


def test_a_model_of_a_sensor_that_was_never_calibrated_says_what_is_assumed():
    calibrated = PoseEstimator.load("mg400-127")
    assumed = copy(calibrated)
    assumed.sensor, assumed.domain = calibrated.sensor.model_copy(update={"rig": None}), replace(calibrated.domain, simulated=True)
    low, high, _ = assumed._widening(np.array([-3.0, 20.0]), np.array([0.1, 2.0]), 0.0, DomainVerdict(""), np.zeros(2))
    assert high - low == pytest.approx([2 * (0.1 + 0.015 * 20 + 0.1 * 3), 2 * (2.0 + 1.0)])
    assert any("never calibrated" in line for line in assumed.caveats) and not any("never" in line for line in calibrated.caveats)
