"""One contract for every arm: simulated, MG400 over TCP, Magician over a pseudo-terminal, UR through its client, any over ROS 2."""

import time
from contextlib import contextmanager

import numpy as np
import pytest
from arms import ARMS, bench

from hardware.arms.open_arm import open_arm
from hardware.errors import DeviceError, DeviceNotConnectedError
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm
from twin.contracts import ArmContract

SETTLED_MM = 0.1  # repeatability of the arms is half of it
SLOW_MM_S, FAST_MM_S = 20.0, 200.0


class OfBench(ArmContract):
    """The contract on an arm of the bench."""

    kind: str

    def open(self, stack):
        self.at = stack.enter_context(bench(self.kind))
        self.home = self.at.home
        return self.at.arm

    def read(self):
        return self.at.reads()


class TestSimulatedArmOfSixAxes(OfBench):
    kind = "simulated-6"


class TestSimulatedArmOfFourAxes(OfBench):
    kind = "simulated-4"


class TestMg400(OfBench):
    kind = "mg400"


class TestMg400WithOldFirmware(OfBench):
    kind = "mg400-old"


class TestMagician(OfBench):
    kind = "magician"


class TestRos2ArmOfTwists(OfBench):
    kind = "ros2-twist"


class TestRos2ArmOfPoses(OfBench):
    kind = "ros2-pose"


class TestUr(OfBench):
    kind = "ur"


@contextmanager
def at_home(kind):
    with bench(kind) as at:
        at.arm.connect()
        at.arm.enable()
        at.arm.set_speed(FAST_MM_S, FAST_MM_S)
        at.arm.move_linear(at.home)
        yield at


@pytest.fixture(params=ARMS)
def ready(request):
    with at_home(request.param) as at:
        yield at


@pytest.fixture(scope="module", params=ARMS)
def resting(request):
    """An arm for tests in which nothing moves."""
    with at_home(request.param) as at:
        yield at


def test_a_move_to_where_it_is_returns_soon(ready):
    begun = time.monotonic()
    ready.arm.move_linear(ready.home)
    assert time.monotonic() - begun < 2.0  # the arm never says that it runs


def test_joints_move_too(ready):
    joints = ready.arm.state().joints_deg + 2.0
    if ready.arm.name.startswith("ROS 2"):
        with pytest.raises(DeviceError, match="use move_linear"):
            ready.arm.move_joints(joints)
        return
    assert np.allclose(ready.arm.move_joints(joints), joints)
    assert np.allclose(ready.arm.state().joints_deg, joints, atol=0.01)


BAD = [
    np.zeros(3),
    "home",
    "123456",
    None,
    [np.nan] * 6,
    [[0.0] * 6],
    [10**400] * 6,
    np.ones(6) * 1j,
    np.ma.masked_all(6),
    ["1"] * 6,
    [[1], [1, 2]],
]


@pytest.mark.parametrize("given", BAD, ids=lambda given: repr(given)[:12])
def test_a_target_that_is_not_numbers_is_told_and_nothing_moves(resting, given):
    joints = f"the joint angles must be {resting.arm.axes} finite numbers"
    for move, told in ((resting.arm.move_joints, joints), (resting.arm.move_linear, "the pose must be 6 finite numbers")):
        with pytest.raises(DeviceError, match=told):
            move(given)
    assert np.allclose(resting.arm.state().pose, resting.home, atol=0.01) and not resting.arm.state().moving


@pytest.mark.parametrize("far", [2e4, 1e12, 1e300])
def test_a_target_farther_than_any_arm_reaches_is_told_at_once(resting, far):
    begun = time.monotonic()
    safe = SafeArm(resting.arm, load_limits("simulated").model_copy(update={"joints_deg": None}))
    for arm in (resting.arm, safe):
        for move, count in ((arm.move_joints, arm.axes), (arm.move_linear, 6)):
            if arm is safe and arm.kinematics is None and move == arm.move_joints:
                continue  # SafeArm refuses it for that reason
            with pytest.raises(DeviceError, match="farther than any arm reaches; give mm and deg"):
                move([*[0.0] * (count - 1), far], wait=False)
    assert time.monotonic() - begun < 2.0


def test_four_axes_keep_level_and_turn_as_suits_the_wrist(ready):
    sent = ready.arm.move_linear(ready.home + [0, 0, 0, 5, 5, 360])
    if ready.arm.axes == 4:
        assert np.allclose(sent, ready.home)
    else:
        assert np.allclose(sent[3:5], 5)


def test_without_wait_it_returns_at_once_and_settles_later(ready):
    ready.arm.set_speed(SLOW_MM_S, SLOW_MM_S)
    target = ready.home + [0, 60, 0, 0, 0, 0]
    ready.arm.move_linear(target, wait=False)
    assert np.linalg.norm(ready.arm.state().pose[:3] - target[:3]) > SETTLED_MM  # the way takes most of a second
    state = ready.arm.wait_settled(target)
    assert np.linalg.norm(state.pose[:3] - target[:3]) < SETTLED_MM and not state.moving


def test_what_can_not_be_is_refused_before_anything_moves(ready):
    before = ready.reads()
    targets = [np.full(6, np.nan)]
    if ready.arm.axes == 4:
        targets += [[900.0, 0, 0, 0, 0, 0], [20.0, 0, 0, 0, 0, 0]]
    for target in targets:
        with pytest.raises(DeviceError):
            ready.arm.move_linear(np.array(target))
    for speeds in ((0, 10), (10, np.nan), (-1, 1), (np.inf, 1)):
        with pytest.raises(DeviceError, match="positive"):
            ready.arm.set_speed(*speeds)
    assert np.array_equal(ready.reads(), before)
    ready.arm.move_linear(ready.home + [5, 0, 0, 0, 0, 0])  # no alarm was raised


def test_where_it_was_can_be_asked_later(ready):
    """A camera that is emulated from the arm's pose needs it at the time of exposure."""
    where = ready.device.track.pose if hasattr(ready.device, "track") else ready.device.pose
    ready.arm.set_speed(SLOW_MM_S, SLOW_MM_S)
    ready.arm.move_linear(ready.home + [0, 20, 0, 0, 0, 0], wait=False)
    times, end = [time.monotonic()], time.monotonic() + 10
    while np.ptp([where(t)[1] for t in times]) < 0.5:
        assert time.monotonic() < end, "it does not move"
        time.sleep(0.01)
        times.append(time.monotonic())
    asked = [where(t) for t in times]
    ready.arm.stop()
    ready.arm.move_linear(ready.home)
    assert np.allclose([where(t) for t in times], asked)


def test_speed_is_at_most_what_was_asked(ready):
    ready.arm.set_speed(40.0, 40.0)
    begun = time.monotonic()
    ready.arm.move_linear(ready.home + [0, 40, 0, 0, 0, 0])
    assert time.monotonic() - begun > 40 / 40.0 / 4.0  # benches run four times as fast


@pytest.mark.parametrize(
    ("spec", "remedy"),
    [
        ("mg400:127.0.0.1:1", "twin emulate mg400"),
        ("magician:/dev/no-such-port", "twin emulate magician"),
        ("ros2:twist,namespace=no/one", "twin emulate ros2"),
    ],
)
def test_what_is_not_there_is_one_clear_error(spec, remedy):
    arm = open_arm(spec)  # opens nothing yet
    with pytest.raises(DeviceNotConnectedError, match=remedy):
        arm.connect()
    assert not arm.is_connected


@pytest.mark.parametrize(
    "spec", ["", "ur5", "simulated:5", "mg400:host:port", "mg400:127.0.0.1:65535", "mg400:127.0.0.1:0", "ros2", "ros2:twist,topic=/a"]
)
def test_what_is_no_arm_names_those_that_are(spec):
    with pytest.raises(DeviceError, match="mg400|ros2:twist"):
        open_arm(spec)


def test_names_of_arms():
    assert open_arm("simulated").axes == 6 and open_arm("simulated:4").axes == 4
    assert open_arm("mg400").name == "MG400 at 192.168.1.6" and open_arm("mg400:10.0.0.1:29999").axes == 4
    assert open_arm("magician:/dev/ttyUSB0").axes == 4
