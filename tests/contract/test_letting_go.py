"""Whatever ends the work with an arm, a second Ctrl-C and a lost connection too, it is stopped and disabled, or that is said."""

import os
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest
from arms import mg400_of
from faulty_arm import ArmFault, FaultyArm
from free_ports import free_offset
from noisy_camera import NoisyCamera
from pins_camera import AT_REST, StudioModel, shows
from true_estimator import TrueEstimator

from hardware.arms.arm import SimulatedArm
from hardware.collect.collect import Collection, collect
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError, DeviceNotConnectedError
from hardware.live.lerobot import LeRobotArm
from hardware.live.studio_mode import CameraFeed
from hardware.rig.geometry import PlacedObject
from hardware.safety.decide import SafetyLimits
from hardware.safety.safe_arm import SafeArm
from hardware.servo.loop import LoopHooks, LoopSettings, ServoLoop
from hardware.workcell.build import Rig
from scenes import PlacementSpec, load_experiment, load_object, load_sensor, load_servo
from twin.rig.kinematics import Mounting
from twin.signals import signals_as_ctrl_c
from twin.types import Form

AWAY = np.array([300.0, 60, -10, 0, 0, 30])
BOX = SafetyLimits(box_mm=((-2000, 2000),) * 3)


@pytest.fixture
def placed():
    return PlacedObject(load_object("can"), PlacementSpec(), Mounting.of(load_sensor("mg400-331"), load_experiment("surface-2d")))


@pytest.fixture
def arm(placed):
    with FaultyArm(pose=placed.start_pose(-60.0), time_scale=20.0) as arm:
        yield arm


def interrupted_retreat(arm):
    """The arm, whose move is interrupted after ``arm.retreats`` is set."""
    move = arm.move_linear
    arm.retreats = False

    def moved(*arguments, **options):
        if arm.retreats:
            raise KeyboardInterrupt
        return move(*arguments, **options)

    arm.move_linear = moved
    return arm


def test_ctrl_c_during_the_retreat_still_disables(arm, placed):
    interrupted_retreat(arm)

    def now(record, frame, estimate):
        arm.retreats = True
        raise KeyboardInterrupt

    with NoisyCamera() as source:
        loop = ServoLoop(
            Rig(source, arm, placed, False), load_servo("surface"), TrueEstimator(arm, placed), LoopSettings(100), LoopHooks(on_step=now)
        )
        with pytest.raises(KeyboardInterrupt):
            loop.run(placed.start_pose(2.0))
    assert not arm.state().enabled


def test_ctrl_c_during_a_retreat_after_the_last_step_disables_and_ends(arm, placed):
    interrupted_retreat(arm)
    with NoisyCamera() as source:
        loop = ServoLoop(Rig(source, arm, placed, False), load_servo("surface"), TrueEstimator(arm, placed), LoopSettings(1))
        loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: setattr(arm, "retreats", True))
        with pytest.raises(KeyboardInterrupt):
            loop.run(placed.start_pose(2.0))
    assert not arm.state().enabled


def test_a_retreat_that_breaks_in_any_way_still_disables(arm, placed):
    with NoisyCamera() as source:
        loop = ServoLoop(Rig(source, arm, placed, False), load_servo("surface"), TrueEstimator(arm, placed), LoopSettings(1))
        loop.mover._retreat = lambda pose: 1 / 0
        loop.run(placed.start_pose(2.0))
    assert not arm.state().enabled
    assert any("retreat" in note and "division" in note for note in loop.notes)


def test_a_safe_arm_is_disabled_though_its_retreat_is_interrupted(arm):
    arm.disconnect()
    with pytest.raises(KeyboardInterrupt), SafeArm(interrupted_retreat(arm), BOX) as safe:
        safe.enable()
        disabled = []
        arm.disable = lambda: disabled.append(True)
        arm.retreats = True
        raise KeyboardInterrupt
    assert disabled


def collected(arm, placed, folder, source):
    about = Collection(folder, {"seed": 1}, Form.RAW)
    return collect(Rig(source, arm, placed, False), load_experiment("surface-2d"), about, 3, seed=1, speed=(100.0, 100.0))


def test_collecting_disables_though_its_retreat_is_interrupted(arm, placed, tmp_path):
    interrupted_retreat(arm)
    with NoisyCamera() as source:
        arm.retreats = True
        with pytest.raises(KeyboardInterrupt):
            collected(arm, placed, tmp_path, source)
    assert not arm.state().enabled


def test_an_arm_that_could_not_be_let_go_is_told_with_the_error(arm, placed, tmp_path):
    arm.faults.add(ArmFault.IGNORE)

    def dead():
        raise DeviceError("press its emergency stop")

    arm.disable = dead
    with NoisyCamera() as source, pytest.raises(DeviceError, match="not executed") as raised:
        collected(arm, placed, tmp_path, source)
    assert any("disable" in note and "emergency stop" in note for note in raised.value.__notes__)


def test_nothing_is_collected_from_a_recording(arm, placed, tmp_path):
    """Its frames show no pose of this arm."""
    source = NoisyCamera()
    source.is_live = False
    with source, pytest.raises(DeviceError, match="live"):
        collected(arm, placed, tmp_path, source)
    assert not arm.state().enabled


def test_a_rig_lets_go_of_the_arm_though_its_camera_breaks(placed):
    class Breaking(NoisyCamera):
        def _close(self):
            raise RuntimeError("broken")

    arm = SimulatedArm()
    with pytest.raises(RuntimeError), Rig(Breaking(), arm, placed, True):
        arm.enable()
    assert not arm.is_connected


def test_a_retreat_that_the_limits_forbid_is_noted(placed):
    arm = SimulatedArm(pose=placed.start_pose(-60.0), time_scale=20.0)
    safe = SafeArm(arm, BOX)
    with NoisyCamera() as source, safe:
        loop = ServoLoop(Rig(source, safe, placed, True), load_servo("surface"), TrueEstimator(arm, placed), LoopSettings(1))
        loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: setattr(safe, "limits", SafetyLimits(box_mm=((5000, 6000),) * 3)))
        loop.run(placed.start_pose(2.0))
    assert any("retreat" in note for note in loop.notes)


def test_a_connection_that_fails_on_enabling_is_let_go():
    arm = SimulatedArm()
    arm.enable = lambda: (_ for _ in ()).throw(DeviceError("alarm"))
    robot = LeRobotArm(arm)
    with pytest.raises(DeviceError, match="alarm"):
        robot.connect()
    assert not robot.is_connected


@pytest.mark.parametrize("ended", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_end_ends_as_ctrl_c_does(ended):
    outside = signal.signal(ended, signal.SIG_DFL)  # under nohup a hang-up is ignored
    try:
        with pytest.raises(KeyboardInterrupt), signals_as_ctrl_c():
            os.kill(os.getpid(), ended)
            time.sleep(5.0)
        assert signal.getsignal(ended) is signal.SIG_DFL
    finally:
        signal.signal(ended, outside)


class TestMg400:
    """Its connections are several, and each may be lost alone."""

    @pytest.fixture
    def moving(self):
        with Mg400Emulator(port_offset=None) as emulator:
            arm = mg400_of(emulator)
            arm.connect()
            arm.enable()
            arm.set_speed_percent(linear=1)
            arm.move_linear(AWAY, wait=False)
            yield SimpleNamespace(arm=arm, emulator=emulator)
            arm.disconnect()

    def test_disable_needs_the_dashboard_only(self, moving):
        moving.arm._motion.close()
        moving.arm.disable()
        assert not moving.emulator.arm.enabled

    @pytest.mark.parametrize("lost", ["_dashboard", "_motion"])
    def test_disconnect_stops_an_arm_whose_connection_was_lost(self, moving, lost):
        getattr(moving.arm, lost).close()
        moving.arm.disconnect()
        assert not moving.emulator.arm.enabled and not moving.emulator.arm.busy()

    def test_an_arm_that_does_not_answer_a_stop_is_said_loudly(self, moving, monkeypatch):
        def silent(text, **_):
            raise DeviceError(f"no reply to {text}")

        monkeypatch.setattr(moving.arm._dashboard, "request", silent)
        with pytest.raises(DeviceError, match="Press its emergency stop"):
            moving.arm.stop()
        monkeypatch.undo()

    def test_nothing_is_told_to_an_arm_that_was_disconnected(self, moving):
        moving.arm.disconnect()
        with pytest.raises(DeviceNotConnectedError, match="connect"):
            moving.arm.disable()


@pytest.fixture
def feed(monkeypatch):
    """The studio's camera with an armed arm, an emulator of it, and the texts that it ended with."""
    monkeypatch.setattr("hardware.live.studio_mode.open_camera", lambda *_: shows(AT_REST))
    offset = free_offset()
    with Mg400Emulator(port_offset=offset) as emulator:
        made = CameraFeed("any", f"mg400:127.0.0.1:{29999 + offset}", StudioModel.sensor, StudioModel())
        ends, shots = [], []
        made.start(shots.append, ends.append)
        made.robot.arm()
        yield made, emulator, ends
        made.stop()


def test_an_armed_arm_is_let_go_of_though_the_recording_can_not_be_ended(feed, tmp_path):
    made, emulator, _ = feed
    made.record(tmp_path / "session")
    with made._writing:  # no frame is written meanwhile
        made._writer._lines.close()
        made._writer._lines = open("/dev/full", "w")  # noqa: SIM115  (closed by the writer)
        made._writer._lines.write("a line that waits to be written")
        made._end.set()
    with pytest.raises(DeviceError, match="free some space"):
        made.stop()
    assert not emulator.arm.enabled and not made.robot.armed


def test_an_armed_arm_that_is_lost_as_the_feed_ends_is_told(feed):
    made, emulator, _ = feed
    emulator.kill()
    with pytest.raises(DeviceError, match="can't be stopped and may move"):
        made.stop()
    assert not made.robot.armed


def test_a_camera_whose_frames_break_the_program_is_told(feed):
    made, _, ends = feed
    made._session.estimator = lambda frame: 1 / 0
    deadline = time.monotonic() + 5.0
    while not ends:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert "division by zero" in ends[0]
