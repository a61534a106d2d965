"""Decisions of safety: laws that hold for every target, and one example of every code."""

import time

import numpy as np
import pytest
from faulty_arm import ArmFault, FaultyArm
from hypothesis import given
from hypothesis import strategies as st

from hardware.arms.arm import ArmState, SimulatedArm
from hardware.arms.motion import MG400
from hardware.errors import DeviceError
from hardware.safety.decide import SHIPPED_LIMITS, Action, DecisionCode, SafetyLimits, Sensed, clip, decide, decide_joints, load_limits
from hardware.safety.safe_arm import RefusedMoveError, SafeArm

NOW_S = 1000.0
HOME = np.array([300.0, 0, 0, 0, 0, 0])
LIMITS = load_limits("mg400").model_copy(update={"step_mm": 5.0, "step_deg": 3.0})
FREE = LIMITS.model_copy(update={"step_mm": None, "step_deg": None})
FELT = FREE.model_copy(update={"force_n": 10.0, "torque_nmm": 300.0, "slip_share": 0.5})
WIDE = SafetyLimits(box_mm=((-500, 500),) * 3)
RING = SafetyLimits(box_mm=((-500, 500),) * 3, annulus_mm=(200, 440))


def state(pose=HOME, *, age_s=0.0, enabled=True, error=""):
    pose = np.asarray(pose, float)
    return ArmState(pose, MG400.inverse(pose), NOW_S - age_s, enabled, False, error)


def lost_state():
    return ArmState(HOME * np.nan, np.full(4, np.nan), NOW_S, True, False)


def decided(target, limits=FREE, *, at=HOME, sensed=None, **told):
    return decide(target, state(at, **told), limits, now_s=NOW_S, kinematics=MG400, sensed=sensed)


@pytest.mark.parametrize(
    ("decision", "action", "code"),
    [
        (decided(HOME + 1), Action.MOVE, DecisionCode.OK),
        (decided(HOME + [50, 0, 0, 0, 0, 0], LIMITS), Action.MOVE, DecisionCode.STEP_SHORTENED),
        (decided(HOME * np.nan), Action.REFUSE, DecisionCode.NOT_A_NUMBER),
        (decided("home"), Action.REFUSE, DecisionCode.NOT_A_NUMBER),
        (decided(None), Action.REFUSE, DecisionCode.NOT_A_NUMBER),
        (decided(HOME[:3]), Action.REFUSE, DecisionCode.NOT_A_NUMBER),
        (decided(HOME, enabled=False), Action.REFUSE, DecisionCode.NOT_ENABLED),
        (decided(HOME, error="alarm 17"), Action.HOLD, DecisionCode.ARM_ERROR),
        (decided(HOME, age_s=1.1), Action.HOLD, DecisionCode.STALE_FEEDBACK),
        (decide(HOME, lost_state(), FREE, now_s=NOW_S, kinematics=MG400), Action.HOLD, DecisionCode.NOT_A_NUMBER),
        (decided(HOME, sensed=Sensed(1.0, NOW_S - 0.6)), Action.HOLD, DecisionCode.STALE_FRAME),
        (decided(HOME, sensed=Sensed(1.0, np.nan)), Action.HOLD, DecisionCode.STALE_FRAME),
        (decided(HOME, sensed=Sensed(6.1, NOW_S)), Action.RETRACT, DecisionCode.TOO_DEEP),
        (decided(HOME, sensed=Sensed(np.nan, NOW_S)), Action.MOVE, DecisionCode.OK),
        (decided(HOME, FELT, sensed=Sensed(1.0, NOW_S, force_n=9.9)), Action.MOVE, DecisionCode.OK),
        (decided(HOME, FELT, sensed=Sensed(1.0, NOW_S, force_n=10.1)), Action.RETRACT, DecisionCode.TOO_STRONG),
        (decided(HOME, FELT, sensed=Sensed(1.0, NOW_S, torque_nmm=-301.0)), Action.RETRACT, DecisionCode.TOO_TWISTED),
        (decided(HOME, FELT, sensed=Sensed(1.0, NOW_S, slip_share=0.6)), Action.HOLD, DecisionCode.SLIPPING),
        (decided(HOME + [0, 0, 160, 0, 0, 0]), Action.REFUSE, DecisionCode.OUTSIDE_BOX),
        (decided([400, 290, 0, 0, 0, 0]), Action.REFUSE, DecisionCode.OUTSIDE_ANNULUS),
        (decided([30, 300, 0, 0, 0, 90], RING, at=[0, -300, 0, 0, 0, -90]), Action.REFUSE, DecisionCode.OUTSIDE_ANNULUS),
        (decided([480.0, 0, 0, 0, 0, 0], WIDE), Action.REFUSE, DecisionCode.OUT_OF_REACH),
        (decided([120.0, 0, 60, 0, 0, 0], WIDE), Action.REFUSE, DecisionCode.JOINT_LIMIT),
        (decided(MG400.forward(np.array([0.0, 0, 61, 0])), WIDE), Action.REFUSE, DecisionCode.LINKAGE_LIMIT),
        (decided([0, 250, 0, 0, 0, 90], WIDE, at=[-120, -220, 0, 0, 0, -110]), Action.REFUSE, DecisionCode.LINE_BLOCKED),
    ],
)
def test_every_code(decision, action, code):
    assert (decision.action, decision.code) == (action, code), decision
    assert (decision.pose is not None) == (action is Action.MOVE)
    assert decision.reason or code is DecisionCode.OK


@given(st.tuples(*[st.floats(-500, 500)] * 3, *[st.floats(-180, 180)] * 3))
def test_what_may_be_sent_keeps_every_limit(target):
    decision = decided(np.array(target), LIMITS)
    if decision.action is Action.MOVE:
        sent = decision.pose
        assert all(low <= value <= high for value, (low, high) in zip(sent[:3], LIMITS.box_mm, strict=True))
        assert LIMITS.annulus_mm[0] <= np.hypot(*sent[:2]) <= LIMITS.annulus_mm[1]
        assert np.linalg.norm(sent[:3] - HOME[:3]) <= LIMITS.step_mm + 1e-9
        joints = MG400.inverse(MG400.nearest_pose(sent))
        assert MG400.violation(joints) is None and joints[2] - joints[1] <= LIMITS.linkage_deg + 1e-6


@given(st.lists(st.floats(-600, 600), min_size=6, max_size=6), st.sampled_from([LIMITS, FREE, WIDE, RING]))
def test_what_a_target_is_clipped_to_may_be_sent(target, limits):
    clipped = clip(np.array(target), HOME, limits, MG400)
    assert decided(clipped, limits).action is Action.MOVE
    if decided(target, limits).code is DecisionCode.OK:
        np.testing.assert_allclose(clipped, decided(target, limits).pose)


@given(st.floats(0.01, 200.0), st.floats(0, 2 * np.pi))
def test_a_shortened_step_keeps_its_direction(length, angle):
    target = HOME + [0, length * np.cos(angle), length * np.sin(angle), 0, 0, 0]
    decision = decide(target, state(), LIMITS, now_s=NOW_S)
    if decision.pose is not None:
        went, wanted = decision.pose - HOME, target - HOME
        assert np.linalg.norm(went) == pytest.approx(min(length, LIMITS.step_mm))
        assert went @ wanted == pytest.approx(np.linalg.norm(went) * length)


def test_a_long_turn_is_shortened_the_short_way_round():
    decision = decide(HOME + [0, 0, 0, 0, 0, 350.0], state(), LIMITS, now_s=NOW_S)
    assert decision.pose[5] == pytest.approx(-3.0)


def test_the_turn_of_four_axes_is_not_wrapped():
    at = np.array([265.0, 299.0, 9.0, 0, 0, 10.0])  # J1 at 48 deg: R = 208 is within J4's range, R = -152 is not
    assert decided(at + [0, 0, 0, 0, 0, 198.0], LIMITS, at=at).pose[5] == pytest.approx(13.0)


def test_joint_moves_are_checked_on_their_way():
    def decided(joints, limits=FREE):
        return decide_joints(np.asarray(joints, float), state(), limits, now_s=NOW_S, kinematics=MG400).code

    here = MG400.inverse(HOME)
    assert decided(here + [1, 0, 0, 0]) == DecisionCode.OK
    assert decided(here + [0, 0, 0, 500]) == DecisionCode.JOINT_LIMIT
    assert decided(here + [80, 0, 0, 0]) == DecisionCode.OUTSIDE_BOX
    assert decided(here + [5, 0, 0, 0], LIMITS) == DecisionCode.STEP_TOO_LONG
    assert decided([np.nan] * 4) == decided([0.0, 0.0]) == DecisionCode.NOT_A_NUMBER
    outside_between = [*(-here[:1] + 100), *here[1:]]  # both ends may be allowed: the way between is looked at too
    assert decided(outside_between) == DecisionCode.OUTSIDE_BOX


def test_limits_are_checked_data(tmp_path):
    for name in ("mg400", "magician", "simulated"):
        assert load_limits(name).contact_mm > 0
    path = tmp_path / "mine.toml"
    for text in ("box_mm = [[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]", "boxmm = 1", "box_mm = 3", "no toml"):
        path.write_text(text)
        with pytest.raises(DeviceError, match=f"{path}: .*like .*mg400.toml"):
            load_limits(path)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("mg40", "no limits are called 'mg40'; give one of"),
        ("mine.toml", "mine.toml: no such file; give one of"),
        ("mine.png", "mine.png: no such file"),
    ],
)
def test_limits_that_are_not_there_are_told_with_one_remedy(tmp_path, monkeypatch, given, told):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DeviceError, match=f"^{told}.* magician, mg400, ros2, simulated, ur, or the path of a TOML file like") as caught:
        load_limits(given)
    assert str(caught.value).count("give ") == 1


def test_a_file_is_read_as_limits_whatever_its_name_and_a_name_comes_before_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mg400").mkdir()
    assert load_limits("mg400") == load_limits(SHIPPED_LIMITS / "mg400.toml")
    for name in ("mine", "mine.txt"):
        (tmp_path / name).write_text((SHIPPED_LIMITS / "mg400.toml").read_text())
        assert load_limits(name) == load_limits("mg400")
    (tmp_path / "fake.png").write_text("a picture")
    with pytest.raises(DeviceError, match="^fake.png: not readable as TOML"):
        load_limits("fake.png")


@pytest.fixture
def arm():
    arm = FaultyArm(axes=4, time_scale=20.0)
    arm.connect()
    arm.enable()
    yield arm
    if arm.is_connected:
        arm.disconnect()


def test_a_safe_arm_sends_what_is_allowed_and_logs_it(arm):
    told = []
    safe = SafeArm(arm, LIMITS, log=told.append)
    assert np.allclose(safe.move_linear(HOME + [20, 0, 0, 0, 0, 0]), HOME + [5, 0, 0, 0, 0, 0])
    with pytest.raises(RefusedMoveError, match="outside-box") as refused:
        SafeArm(arm, FREE).move_linear(HOME + [0, 0, 500, 0, 0, 0])
    assert refused.value.decision.code is DecisionCode.OUTSIDE_BOX
    safe.set_speed(1e4, 1e4)
    assert arm._speeds.linear_mm_s == LIMITS.linear_mm_s
    assert (
        [entry.decision.code for entry in told]
        == [DecisionCode.STEP_SHORTENED, DecisionCode.SPEED_CAPPED]
        == [e.decision.code for e in safe.decisions]
    )


def test_too_deep_a_contact_makes_it_retreat_along_the_normal(arm):
    safe = SafeArm(arm, FREE, normal=(0, 1, 0))
    safe.sense(Sensed(7.0, time.monotonic()))
    with pytest.raises(RefusedMoveError, match="too-deep"):
        safe.move_linear(HOME)
    assert np.allclose(arm.state().pose, HOME + [0, FREE.retreat_mm, 0, 0, 0, 0])


def test_a_frame_that_grows_old_stops_it(arm):
    safe = SafeArm(arm, FREE.model_copy(update={"frame_age_s": 0.05}))
    safe.sense(Sensed(1.0, time.monotonic()))
    safe.set_speed(1.0, 1.0)
    safe.move_linear(HOME + [0, 100, 0, 0, 0, 0], wait=False)
    time.sleep(0.06)
    assert arm.state().moving
    with pytest.raises(RefusedMoveError, match="stale-frame"):
        safe.move_linear(HOME)
    assert not arm.state().moving


def test_silent_feedback_stops_it(arm):
    safe = SafeArm(arm, FREE.model_copy(update={"feedback_age_s": 0.05}))
    safe.set_speed(1.0, 1.0)
    arm.move_linear(HOME + [0, 100, 0, 0, 0, 0], wait=False)
    arm.faults.add(ArmFault.SILENT)
    assert arm.state().moving  # the last it tells
    time.sleep(0.06)
    with pytest.raises(RefusedMoveError, match="stale-feedback"):
        safe.move_linear(HOME)
    arm.faults.clear()
    assert not arm.state().moving


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_any_exception_stops_retreats_and_disables(error):
    arm = SimulatedArm(axes=4, time_scale=20.0)
    with pytest.raises(error), SafeArm(arm, LIMITS, normal=(0, 0, 1)) as safe:
        safe.enable()
        raise error
    assert np.allclose(arm.track.pose(np.inf), HOME + [0, 0, LIMITS.retreat_mm, 0, 0, 0])
    assert not arm.is_connected
    assert [entry.call for entry in safe.decisions][-3:] == ["shutdown", "retreat", "disconnect"]


def test_a_retreat_stays_within_the_box():
    arm = SimulatedArm(axes=4, time_scale=20.0, pose=HOME + [0, 0, 120, 0, 0, 0])
    with pytest.raises(RuntimeError), SafeArm(arm, LIMITS) as safe:
        safe.enable()
        raise RuntimeError
    assert 120 < arm.track.pose(np.inf)[2] <= LIMITS.box_mm[2][1]


def test_stop_and_its_like_are_never_refused(arm):
    safe = SafeArm(arm, FREE)
    safe.sense(Sensed(99.0, -np.inf))
    for call in (safe.stop, safe.emergency_stop, safe.clear_error, safe.disable, safe.disconnect):
        call()
    assert {entry.decision.code for entry in safe.decisions} == {DecisionCode.UNGATED} and not arm.is_connected


def test_a_failed_stop_does_not_keep_it_from_disabling(arm, monkeypatch):
    def broken():
        raise DeviceError("stuck")

    monkeypatch.setattr(arm, "stop", broken)
    SafeArm(arm, FREE).shutdown("test")
    assert not arm.state().enabled


def test_limits_of_another_arm_are_refused():
    with pytest.raises(DeviceError, match="6 joints"):
        SafeArm(SimulatedArm(axes=6), LIMITS)


def test_what_a_model_tells_of_force_torque_and_slip_is_sensed_and_what_it_does_not_tell_limits_nothing():
    ours = Sensed.of(1.0, NOW_S, ("pose_2", "force_x", "force_y", "force_z", "torque_z", "slip_share"), np.array([0, 3, 0, 4, -7, 0.2]))
    assert (ours.force_n, ours.torque_nmm, ours.slip_share) == (5.0, -7.0, 0.2)
    assert Sensed.of(1.0, NOW_S, ("Fx", "Fy", "Fz"), np.array([0, 6.0, 8.0])).force_n == 10.0
    nothing = Sensed.of(1.0, NOW_S, ("pose_2",), np.zeros(1))
    tight = FREE.model_copy(update={"force_n": 1e-9, "torque_nmm": 1e-9, "slip_share": 0.0})
    assert decided(HOME, tight, sensed=nothing).code is DecisionCode.OK
    for name in ("mg400", "magician", "simulated"):
        assert load_limits(name).force_n is not None  # on by default
