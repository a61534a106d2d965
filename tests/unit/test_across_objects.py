"""Several objects as one data set, and a model evaluated on those it never saw."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_generation import small_config

from scenes import RandomisationSpec, load_object
from training.data.dataset import join_datasets, split_rows, with_common_labels
from training.errors import TrainingError
from training.runs.run import fold_rows
from training.studies.objects import MIXED, ObjectsPlan, rows_in_range, verdicts
from twin.errors import FrameError
from twin.pins import make_reference
from twin.types import Form

STATES = 9  # of each of the drawn data set's ten contacts


def named(found, folder, first=0, count=90):
    """Part of a data set as if it had been read from a folder of its own, its contacts numbered from 0."""
    part = found.rows(np.arange(first, first + count))
    return replace(part, folders=(Path(folder),), group=np.arange(count) // STATES)


def places(found, rows):
    """What frames are, whatever row they lie in."""
    return {name: found.targets.corrected[row].tolist() for row, name in zip(rows, found.pins.image_name[rows].tolist(), strict=True)}


def test_contacts_of_different_sets_stay_apart_and_whole(data):
    parts = [named(data, "sim/plane", 0, 45), named(data, "sim/ball", 45, 45)]
    both = join_datasets(parts)
    assert len(both) == 90 and len(np.unique(both.group)) == 10, "the sets number their contacts alike, and mean different ones"
    for rows in (split_rows(len(both), 3, both.group)[1], fold_rows(np.arange(90), 0, 0, both.group)[0]):
        assert 0 < len(rows) < 90 and len(rows) == STATES * len(np.unique(both.group[rows]))
        left = np.setdiff1d(np.arange(90), rows)
        assert not set(both.group[rows]) & set(both.group[left])
    assert both.pins.image_name[0].startswith("ball/f_") and np.array_equal(both.pins.nodes_px[:45], parts[1].pins.nodes_px)


def test_the_order_in_which_sets_are_given_changes_nothing(data):
    parts = [named(data, f"sim/{name}", 30 * k, 27) for k, name in enumerate(("plane", "ball", "edge"))]
    one, other = join_datasets(parts), join_datasets(parts[::-1])
    for seed in range(3):
        for mine, theirs in zip(split_rows(len(one), seed, one.group), split_rows(len(other), seed, other.group), strict=True):
            assert places(one, mine) == places(other, theirs)
    assert np.array_equal(one.pins.nodes_px, other.pins.nodes_px) and one.folders == other.folders


def test_frames_that_belong_to_no_contact_form_groups_of_one(data):
    real = replace(named(data, "real/tap", 0, 40), group=None)
    both = join_datasets([real, named(data, "sim/plane", 40, 45)])
    assert len(np.unique(both.group)) == 40 + 5


def test_pins_are_counted_from_one_layout(data):
    moved = make_reference(data.pins.reference.pins_px + [3.0, -2.0], data.pins.sensor.pins)
    other = named(data, "sim/b", 45, 45)
    both = join_datasets([named(data, "sim/a", 0, 45), replace(other, pins=other.pins.relative_to(moved))])
    assert np.allclose(both.pins.nodes_px[45:], other.pins.nodes_px)


def test_contacts_of_several_objects_keep_the_labels_that_vary_with_all(data):
    first, second = named(data, "sim/a", 0, 45), named(data, "sim/b", 45, 45)
    less = replace(second, targets=second.targets.only(("pose_6",)))
    both = join_datasets(with_common_labels([first, less]))
    assert both.targets.names == ("pose_6",)
    np.testing.assert_array_equal(both.targets.raw[:, 0], data.targets.raw[:90, 1])
    with pytest.raises(FrameError, match="no label varies in all of them"):
        with_common_labels([less, replace(first, targets=first.targets.only(("pose_2",)))])


def test_what_can_not_be_joined_is_named(data):
    part = named(data, "sim/a")
    with pytest.raises(FrameError, match="given twice"):
        join_datasets([part, part])
    with pytest.raises(FrameError, match=r"form \(raw\) differs"):
        join_datasets([part, replace(named(data, "sim/b"), pins=replace(data.pins, form=Form.RAW))])
    with pytest.raises(FrameError, match="one recording at a time"):
        _ = join_datasets([part, named(data, "sim/b")]).folder


def plan_of(tmp_path, train=("plane", "sphere"), unseen=("edge",)):
    config = small_config(tmp_path)
    things = [tuple(load_object(name) for name in names) for names in (train, unseen)]
    randomisation = RandomisationSpec(name="none", description="nothing")
    return ObjectsPlan(config.sensor, config.experiment, randomisation, *things, count=2, tests=1, seed=4, across=config.across)


def test_both_models_learn_from_equally_many_contacts_and_are_judged_on_others(data, tmp_path):
    plan = plan_of(tmp_path)
    made = {folder: (config, count) for folder, config, count in plan.sets()}
    assert {folder: count for folder, (_, count) in made.items()} == {
        **{"sim/plane": 4, "sim/sphere": 2},
        **{"tests/plane": 1, "tests/sphere": 1, "tests/edge": 1},
    }
    assert {config.object.name for config, _ in made.values()} == {"plane", "sphere", "edge"}
    assert not {made["sim/plane"][0].seed} & {config.seed for folder, (config, _) in made.items() if folder.startswith("tests")}
    sets = {"sim/plane": named(data, "sim/plane", 0, 4 * STATES), "sim/sphere": named(data, "sim/sphere", 0, 2 * STATES)}
    learnt = plan.trained_on(sets)
    assert list(learnt) == [MIXED, "plane"] and [len(np.unique(part.group)) for part in learnt.values()] == [4, 4]


def test_an_object_can_not_be_both_trained_on_and_unseen(tmp_path):
    with pytest.raises(TrainingError, match="sphere: given twice"):
        plan_of(tmp_path, unseen=("edge", "sphere"))
    with pytest.raises(TrainingError, match="at least two objects"):
        plan_of(tmp_path, train=("plane",))


def test_only_labels_within_the_ranges_are_judged(data, tmp_path):
    experiment = plan_of(tmp_path).experiment
    rows = rows_in_range(data, experiment)
    depth, angle = data.targets.corrected.T
    inside = (depth >= -4.4) & (depth <= -3.8) & (np.abs(angle) <= 8)
    assert 0 < inside.sum() < len(data) and np.array_equal(rows, np.flatnonzero(inside))


def test_the_verdict_needs_every_label_of_an_unseen_object(tmp_path):
    row = {"model": MIXED, "object": "edge", "pose_2_times": 1.2, "pose_6_times": 1.4}
    rows = [row, {**row, "model": "plane", "pose_2_times": 9.0}, {**row, "object": "sphere", "pose_2_times": 9.0}]
    (line,) = verdicts(plan_of(tmp_path), rows, ("pose_2", "pose_6"))
    assert "depth 1.20, angle 1.40 times" in line and "(within 1.5)" in line
    assert "not within" in verdicts(plan_of(tmp_path), [row | {"pose_6_times": 1.6}], ("pose_2", "pose_6"))[0]
