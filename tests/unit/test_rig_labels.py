"""A recording's table as the arm's labels."""

import cv2
import numpy as np
import pytest

from scenes import load_experiment
from twin.errors import FrameError
from twin.frames import open_recording
from twin.rig.labels import as_executed, read_arm_labels


def recording(folder, table, names=("a.png", "b.png")):
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((16, 16), np.uint8))
    if table:
        (folder / "targets.csv").write_text(table)
    return open_recording(folder)


def test_labels_know_whether_the_move_was_executed(tmp_path):
    table = "image_name,pose_2,pose_6,move_1,move_6\nb.png,-0.5,-5,-2,1\na.png,-3.5,10,1,2\n"
    first, second = read_arm_labels(recording(tmp_path, table))
    assert first.executed and first.pose.tolist() == [0, -0.5, 0, 0, 0, -5] and first.move.tolist() == [-2, 0, 0, 0, 0, 1]
    assert second.executed and second.pose.tolist() == [0, -3.5, 0, 0, 0, 10]
    (tmp_path / "move_executed.csv").write_text("image_name,executed_estimate\nb.png,0\na.png,1\n")
    assert [label.executed for label in read_arm_labels(open_recording(tmp_path))] == [False, True]


def test_a_move_that_is_not_known_spoils_no_pose_that_is():
    pose, move, unknown = np.full((1, 6), 3.0), np.full((1, 6), 2.0), np.full((1, 6), np.nan)
    for executed, given, stood, moved in ((1.0, unknown, 3, np.nan), (0.0, unknown, np.nan, 0), (0.0, move, 1, 0), (0.25, move, 1.5, 0.5)):
        for found, expected in zip(as_executed(pose, given, np.array([executed])), (stood, moved), strict=True):
            assert np.array_equal(found, np.full((1, 6), expected), equal_nan=True), (executed, given)


def test_what_is_missing_is_said(tmp_path):
    with pytest.raises(FrameError, match=r"no labels pose_1\.\.6 \(found no table\)"):
        read_arm_labels(recording(tmp_path, ""))
    with pytest.raises(FrameError, match=r"rows without a number in a pose or move \(b.png\)"):
        read_arm_labels(recording(tmp_path, "image_name,pose_2\na.png,1\nb.png,nan\n"))
    with pytest.raises(FrameError, match=r"rows without a number in a pose or move \(b.png\)"):  # not all rows, where one cell is text
        read_arm_labels(recording(tmp_path, "image_name,pose_2\na.png,1\nb.png,1 mm\n"))


def test_a_label_that_the_experiment_varies_must_not_be_missing(tmp_path):
    """Without the edge's direction every contact would be simulated along the same edge."""
    found = recording(tmp_path, "image_name,pose_2,pose_3\na.png,1,4\nb.png,2,4\n")
    with pytest.raises(FrameError, match=r"no label pose_6, which the experiment edge-circle varies \(found .*pose_3\).*`experiment`"):
        read_arm_labels(found, load_experiment("edge-circle"))
    assert len(read_arm_labels(found)) == 2


def test_a_label_that_varies_though_the_experiment_holds_it_is_said(tmp_path):
    """A twist that no experiment has looks like noise of the pins, and no model that learns from simulated contacts knows it."""
    table = "image_name,pose_3,pose_4,pose_5,move_1,move_6\na.png,3,1,2,0.02,-8\nb.png,4,2,3,0.01,7\n"
    found = recording(tmp_path, table)
    read_arm_labels(found, load_experiment("surface-3d"))
    (said,) = found.problems
    assert said.startswith("move_6 varies in the table, and not in the experiment surface-3d"), said
