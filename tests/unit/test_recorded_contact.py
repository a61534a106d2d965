"""The plate's way in a recording, against what the arm does by definition."""

import numpy as np
import pytest

from training.recorded_contact import RECORDED_TAPS, TAP_MM, SurfaceRow, SurfaceTap, indentation_mm, read_surface_rows, recorded_path
from twin.errors import FrameError

EXACT_MM = 1e-9
PLAIN = SurfaceTap(0.0, 0.0, 0.0, 0.0, 0.0, 90.0)
FITTED = SurfaceTap(0.4, -17.3, 0.7, -1.3, -0.7, 89.8)


def carried(path, start, stop, points):
    """Where material points of the plate go (k, 3) between two poses."""
    T = path.poses[stop] @ np.linalg.inv(path.poses[start])
    return points @ T[:3, :3].T + T[:3, 3]


def test_an_unturned_sensor_indents_by_pose_and_tap_straight_down():
    path = recorded_path(PLAIN, SurfaceRow(-1.5, 0.0, 0.0, 0.0, False))
    assert np.allclose(path.poses[:, :3, :3], np.eye(3) @ path.poses[0, :3, :3]) and np.allclose(path.poses[:, 2, 2], 1)
    assert np.allclose(path.poses[:, 2, 3], [20.0, 20.0 - (TAP_MM - 1.5)], atol=EXACT_MM)


def test_no_contact_is_no_path():
    assert recorded_path(PLAIN, SurfaceRow(-TAP_MM - 0.1, 0.0, 0.0, 0.0, True)) is None


def test_robot_x_is_where_the_image_turn_says():
    """The arm moves by +x: the plate goes the other way, seen from the sensor."""
    for turn_deg in (90.0, 30.0):
        path = recorded_path(SurfaceTap(0, 0, 0, 0, 0, turn_deg), SurfaceRow(-1.0, 0.0, 2.0, 0.0, True))
        moved = path.poses[2, :3, 3] - path.poses[1, :3, 3]
        assert np.allclose(moved, [-2 * np.cos(np.radians(turn_deg)), -2 * np.sin(np.radians(turn_deg)), 0], atol=EXACT_MM)


def test_the_arm_turns_about_the_tcp():
    row = SurfaceRow(-1.0, 6.0, 0.0, 5.0, True)
    tcp = np.array([[0, 0, -FITTED.tcp_to_dome_mm]]) - FITTED.tcp_lateral_mm * np.array(
        [[np.cos(np.radians(FITTED.image_turn_deg)), np.sin(np.radians(FITTED.image_turn_deg)), 0]]
    )
    path = recorded_path(FITTED, row)
    assert np.allclose(carried(path, 1, 2, tcp), tcp, atol=EXACT_MM)
    turn = path.poses[2, :3, :3] @ path.poses[1, :3, :3].T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(5.0)


def test_the_tap_goes_along_robot_y_and_starts_at_first_touch():
    path = recorded_path(FITTED, SurfaceRow(-1.0, 15.0, 3.0, -2.0, True))
    for T, gap in zip(path.poses[:2], (True, False), strict=True):
        height = 20.0 - T[:3, 2] @ T[:3, 3]
        assert abs(height) < EXACT_MM if gap else height > 1
    move = path.poses[1, :3, 3] - path.poses[0, :3, 3]
    off_normal = np.degrees(np.arccos(-move @ path.poses[0, :3, 2] / np.linalg.norm(move)))
    assert off_normal == pytest.approx(abs(FITTED.plate_tilt_deg), abs=1e-6)


def test_a_move_that_was_not_executed_leaves_the_state_before_it():
    done, undone = (recorded_path(FITTED, SurfaceRow(-1.0, 10.0, 3.0, -4.0, executed)) for executed in (True, False))
    assert len(done.poses) == 3 and np.array_equal(done.poses[:2], undone.poses)
    same = recorded_path(FITTED, SurfaceRow(-1.0, 14.0, 3.0, 0.0, False))
    assert np.allclose(same.poses, undone.poses)


def test_the_plate_is_one_plane_in_the_world():
    """Indentation differs along the plate by its tilt, and by nothing else."""
    per_mm = np.diff([indentation_mm(FITTED, -1.0, -FITTED.angle_offset_deg, x) for x in (-5.0, 0.0, 5.0)]) / 5
    assert np.allclose(per_mm, -np.sin(np.radians(FITTED.plate_tilt_deg)), atol=1e-12)
    tilted = SurfaceTap(0, 0, 0, 0, 3.0, 0.0)  # sensor's x is robot +x: the plate's normal leans towards -x
    assert recorded_path(tilted, SurfaceRow(-1.0, 0.0, 0.0, 0.0, False)).poses[0, 0, 2] == pytest.approx(-np.sin(np.radians(3)))


def test_rows_know_whether_the_move_was_executed(tmp_path):
    (tmp_path / "targets.csv").write_text("image_name,pose_2,pose_6,move_1,move_6\na.png,-3.5,10,1,2\nb.png,-0.5,-5,-2,1\n")
    assert [row.executed for row in read_surface_rows(tmp_path)] == [True, True]
    (tmp_path / "move_executed.csv").write_text("image_name,executed_estimate\nb.png,0\na.png,1\n")
    assert read_surface_rows(tmp_path) == [SurfaceRow(-3.5, 10, 1, 2, True), SurfaceRow(-0.5, -5, -2, 1, False)]
    with pytest.raises(FrameError, match="no such file"):
        read_surface_rows(tmp_path / "missing")


@pytest.mark.parametrize("name", ["mg400-331", "mg400-127"])
def test_every_label_of_the_recordings_leads_somewhere(name):
    generator = np.random.default_rng(0)
    for depth, angle, move, turn in generator.uniform([-4, -20, -5, -5], [0, 20, 5, 5], (50, 4)):
        path = recorded_path(RECORDED_TAPS[name], SurfaceRow(depth, angle, move, turn, True))
        assert path is not None and 0.5 < 20 - path.poses[1, :3, 2] @ path.poses[1, :3, 3] < 7.5
