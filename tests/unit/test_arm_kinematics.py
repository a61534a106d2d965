"""Kinematics of the arms against poses that a real arm told, and against themselves."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.arms.motion import (
    LINE_LEAVES_WORKSPACE,
    LINKAGE_ABOVE,
    MAGICIAN,
    MG400,
    TARGET_LIMIT,
    MotionTrack,
    OutOfReachError,
    Speeds,
    StageKinematics,
    check_line,
)

# J1 J2 J3 J4 (deg) and x y z R (mm, deg) that a real MG400 told of itself
TOLD = np.array(
    [
        [-0.007, -0.021, 59.903, 2.681, 197.229, -0.023, -30.260, 2.674],
        [-0.015, -0.020, 59.903, -70.019, 197.230, -0.051, -30.260, -70.033],
        [-0.070, 6.499, 12.529, 159.755, 300.120, -0.365, 82.109, 159.685],
        [-0.011, -15.363, 40.637, 159.752, 196.198, -0.038, 0.965, 159.741],
        [48.427, 46.154, 19.430, 159.752, 265.586, 299.425, 9.440, 208.180],
        [-54.113, 56.777, 16.554, 159.749, 247.985, -342.741, -7.433, 105.637],
        [-54.538, -27.940, 27.310, 159.752, 106.421, -149.406, 20.579, 105.214],
        [-2.304, 12.932, 65.225, 159.752, 221.673, -8.920, -42.168, 157.448],
        [87.310, -1.396, 38.689, 159.760, 11.352, 241.641, 11.721, 247.071],
        [-85.001, 3.588, 41.160, 159.758, 21.975, -251.250, 5.641, 74.756],
    ]
)
JOINTS, POSES = TOLD[:, :4], np.c_[TOLD[:, 4:7], np.zeros((10, 2)), TOLD[:, 7]]
NOMINAL = replace(MG400, l1_mm=175.0, l2_mm=175.0, z0_mm=-53.8)  # lengths and reach of the vendor's document
REACH_MM = 440.0
FITTED_MM, NOMINAL_RMS_MM, TURN_DEG = 0.01, 0.4, 0.002  # R is told to a thousandth


def off_mm(arm):
    return np.linalg.norm([arm.forward(q)[:3] - p[:3] for q, p in zip(JOINTS, POSES, strict=True)], axis=1)


def test_the_fitted_lengths_tell_where_a_real_arm_was():
    assert off_mm(MG400).max() < FITTED_MM
    turns = [arm[5] for arm in map(MG400.forward, JOINTS)]
    assert np.abs(turns - POSES[:, 5]).max() < TURN_DEG  # not wrapped: 208 and 247 deg are among them


def test_the_nominal_lengths_are_off_by_little():
    rms = np.sqrt(np.mean(off_mm(NOMINAL) ** 2))
    assert 0.1 < rms < NOMINAL_RMS_MM


def test_the_lengths_are_those_that_fit_the_pairs_best():
    _, j2, j3, _ = np.radians(JOINTS).T
    one, none = np.ones(len(JOINTS)), np.zeros(len(JOINTS))
    rows = np.vstack([np.c_[np.sin(j2), np.cos(j3), one, none], np.c_[np.cos(j2), -np.sin(j3), none, one]])
    found, _, rank, _ = np.linalg.lstsq(rows, np.r_[np.hypot(POSES[:, 0], POSES[:, 1]), POSES[:, 2]], rcond=None)
    assert rank == 4
    assert np.allclose(found, [MG400.l1_mm, MG400.l2_mm, MG400.r0_mm, MG400.z0_mm], atol=0.01)


@pytest.mark.parametrize("arm", [MG400, MAGICIAN])
@given(st.tuples(*[st.floats(0.01, 0.99)] * 4))
def test_inverse_undoes_forward(arm, shares):
    low, high = np.array(arm.limits_deg).T
    joints = low + np.array(shares) * (high - low)
    pose = arm.forward(joints)
    if np.hypot(*pose[:2]) > 1.0 and np.cos(np.radians(pose[5] - joints[3] - joints[0])) > 0 and _in_front(arm, joints):
        assert np.allclose(arm.forward(arm.inverse(pose)), pose, atol=1e-6)
        assert np.allclose(arm.inverse(pose), joints, atol=1e-5)


def _in_front(arm, joints):
    """The wrist before the base's axis, and the elbow above: one solution."""
    _, j2, j3, _ = np.radians(joints)
    rho = arm.r0_mm + arm.l1_mm * np.sin(j2) + arm.l2_mm * np.cos(j3)
    return rho > 1.0 and -85.0 < joints[2] - joints[1] < 85.0


def test_magician_against_hand_calculation():
    # J2 = 0: the upper arm upright (135 up); J3 = 0: the forearm level (147 out)
    assert np.allclose(MAGICIAN.forward(np.array([0.0, 0, 0, 30])), [147, 0, 135, 0, 0, 30])
    assert np.allclose(MAGICIAN.forward(np.array([90.0, 90, 0, 30])), [0, 282, 0, 0, 0, 120])


def test_limits_and_their_alarms():
    assert MG400.violation(np.array([0.0, 0, 60, 0])) is None  # at the linkage's limit, not beyond
    assert MG400.violation(np.array([0.0, 0, 60.01, 0])).code == LINKAGE_ABOVE
    for joint, (low, high) in enumerate(MG400.limits_deg):
        for end, code in ((high + 0.1, 64 + 2 * joint), (low - 0.1, 65 + 2 * joint)):
            joints = np.array([0.0, 40, 60, 0])
            joints[joint] = end
            assert MG400.violation(joints).code == code


def test_reach_is_the_vendors():
    farthest = max(MG400.forward(np.array([0, j2, -25.0 + 0 * j2, 0]))[0] for j2 in np.linspace(0, 85, 200))
    assert farthest == pytest.approx(REACH_MM, abs=4.0)
    with pytest.raises(OutOfReachError):
        MG400.inverse(np.array([600.0, 0, 0, 0, 0, 0]))


def test_turns_are_chosen_to_suit_j4():
    wrapped = MG400.nearest_pose(np.array([265.586, 299.425, 9.44, 5, 5, 208.18 - 360]))
    assert wrapped[5] == pytest.approx(208.18) and not wrapped[3:5].any()


def test_a_line_may_leave_the_workspace_between_good_ends():
    left, right = MG400.forward(np.array([-150.0, 20, 40, 0])), MG400.forward(np.array([150.0, 20, 40, 0]))
    assert check_line(MG400, left, left) is None and check_line(MG400, right, right) is None
    assert check_line(MG400, left, right).code == LINE_LEAVES_WORKSPACE
    assert check_line(MG400, left, MG400.forward(np.array([0.0, 0, 70, 0]))).code == TARGET_LIMIT


def test_a_line_to_a_place_far_away_is_refused_at_its_end_at_once():
    """Its steps would fill the memory."""
    start = MG400.forward(np.array([0.0, 20.0, 20.0, 0.0]))
    far = start + (1e15, 0, 0, 0, 0, 0)
    assert check_line(MG400, start, far) is not None


@pytest.mark.parametrize("acceleration", [np.inf, 200.0, 20.0])
def test_a_move_keeps_speed_and_acceleration(acceleration):
    track = MotionTrack(MG400, np.array([0.0, 20, 40, 0]))
    start = track.pose(0.0)
    piece = track.move(start + [20, 30, 10, 0, 0, 0], Speeds(50.0, 90.0, acceleration, 1e3), linear=True, now_s=100.0)
    times = np.linspace(100.0, piece.end_s, 2001)
    step_s = times[1] - times[0]
    way = np.array([np.linalg.norm(track.pose(t)[:3] - start[:3]) for t in times])
    speed = np.diff(way) / step_s
    assert way[-1] == pytest.approx(np.sqrt(1400.0)) and speed.max() < 50.0 * 1.001 and speed.min() > -1e-9
    if np.isfinite(acceleration):
        assert np.abs(np.diff(speed) / step_s).max() < acceleration * 1.01
    assert track.pose(99.0) == pytest.approx(start)  # the past stays


def test_a_stop_keeps_the_arm_where_it_is():
    track = MotionTrack(MG400, np.array([0.0, 20, 40, 0]))
    for n in (1, 2):
        track.move(track.target().pose(np.inf) + [0, 10.0 * n, 0, 0, 0, 0], Speeds(10.0, 90.0), linear=True, now_s=0.0)
    at = track.pose(0.5)
    track.stop(0.5)
    assert np.allclose(track.pose(99.0), at) and not track.moving(0.6)


@pytest.mark.parametrize(("arm", "turned"), [(StageKinematics(), 20.0), (MG400, 340.0)])
def test_six_axes_turn_the_shortest_way_and_four_as_told(arm, turned):
    start = np.array([300.0, 0, 0, 0, 0, 170.0])
    track = MotionTrack(arm, arm.inverse(start))
    piece = track.move(start - [0, 0, 0, 0, 0, 340.0], Speeds(10.0, 10.0), linear=True, now_s=0.0)
    assert piece.duration_s == pytest.approx(turned / 10.0)
    assert np.cos(np.radians(track.pose(piece.end_s / 2)[5])) == pytest.approx(-1.0 if turned == 20.0 else 1.0)
