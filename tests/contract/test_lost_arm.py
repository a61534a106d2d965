"""An arm that is killed, freezes or falls silent: within a second it is held and that is said; the end comes soon and tells it, too."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from arms import mg400_of
from noisy_camera import NoisyCamera
from true_estimator import TrueEstimator

from hardware.cameras.twin import TwinCamera
from hardware.collect.collect import Collection, collect
from hardware.emulators.camera import FeedbackPose
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError
from hardware.rig.geometry import PlacedObject
from hardware.safety.decide import SafetyLimits
from hardware.safety.eyes import ArmWatch
from hardware.safety.safe_arm import SafeArm
from hardware.servo.loop import LoopHooks, LoopSettings, ServoLoop
from hardware.workcell.build import Rig
from scenes import load_experiment, load_object, load_sensor, load_servo
from twin.rig.kinematics import Mounting
from twin.types import Form, Frame

WORD_S = 1.0  # from the last valid feedback to the first word
END_S = 4.0  # from the last valid feedback to the end: a stop, an emergency stop and a disable were tried, each with its own wait
FREE = SafetyLimits(box_mm=((-2000, 2000),) * 3)
LOST = ("frozen=0", "killed", "silent-feedback=0")


@pytest.fixture
def placed():
    servo = load_servo("surface")
    return PlacedObject(load_object("can"), servo.placement, Mounting.of(load_sensor("mg400-331"), load_experiment(servo.experiment)))


@pytest.fixture
def emulator(placed):
    with Mg400Emulator(port_offset=None, time_scale=5.0) as emulator:
        start = placed.start_pose(-60.0)
        emulator.arm.track.__init__(emulator.arm.kinematics, emulator.arm.kinematics.inverse(emulator.arm.kinematics.nearest_pose(start)))
        yield emulator


class Clock:
    """Loses the arm, and keeps when each word was said after that."""

    def __init__(self, emulator, fault):
        self.emulator, self.fault, self.begun_s = emulator, fault, None
        self.said = []

    def lose(self):
        if self.begun_s is None:
            self.begun_s = time.monotonic()
            self.emulator.kill() if self.fault == "killed" else self.emulator.faults.add(self.fault)

    def tell(self, line):
        self.said.append((time.monotonic() - (self.begun_s or np.inf), line))

    def check(self, error):
        ended_s = time.monotonic() - self.begun_s
        lost = [(after_s, line) for after_s, line in self.said if "press its emergency stop" in line]
        assert lost and lost[0][0] < WORD_S, self.said
        assert ended_s < END_S
        if self.fault == "silent-feedback=0":  # it hears, so it was stopped
            assert any("stopped" in line for _, line in self.said)
            time.sleep(0.1)
            still = self.emulator.pose()
            time.sleep(0.1)
            assert np.array_equal(self.emulator.pose(), still) and not self.emulator.arm.enabled
        else:
            assert "can't be stopped and may move. Press its emergency stop" in str(error)


@pytest.mark.parametrize("blocking", [True, False])
@pytest.mark.parametrize("fault", LOST)
def test_a_loop_tells_a_lost_arm_at_once(emulator, placed, fault, blocking):
    clock = Clock(emulator, fault)
    arm = SafeArm(mg400_of(emulator), FREE)
    with NoisyCamera() as source:
        servo = load_servo("surface").model_copy(update={"clear_mm": 5.0})
        truth = TrueEstimator(SimpleNamespace(track=SimpleNamespace(pose=emulator.pose)), placed)
        settings = LoopSettings(1000, blocking=blocking, period_s=0.05)
        with pytest.raises(DeviceError) as raised, arm:
            loop = ServoLoop(Rig(source, arm, placed, False), servo, truth, settings)
            loop.mover.watch._report = clock.tell
            loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: record.index == 3 and clock.lose())
            loop.run(placed.start_pose(2.0))
    clock.check(raised.value)


def test_a_lost_arm_is_told_while_a_frame_is_waited_for(emulator, placed, tmp_path):
    class Blind(NoisyCamera):
        def read_after(self, time_s, *, timeout_s=2.0):
            clock.lose()
            time.sleep(timeout_s)
            raise TimeoutError("no frame")

    clock = Clock(emulator, "frozen=0")
    arm = SafeArm(mg400_of(emulator), FREE)
    with pytest.MonkeyPatch.context() as patch, Blind() as source:
        patch.setattr("hardware.workcell.build.ArmWatch", lambda arm: ArmWatch(arm, report=clock.tell))
        with pytest.raises(DeviceError) as raised, arm:
            about = Collection(tmp_path, {"seed": 1}, Form.RAW)
            collect(Rig(source, arm, placed, False), load_experiment("surface-2d"), about, 3, seed=1, speed=(200.0, 200.0))
    clock.check(raised.value)


def test_what_takes_long_is_said(caplog):
    with Mg400Emulator(port_offset=None) as emulator, mg400_of(emulator) as arm:
        watch = ArmWatch(arm)
        with watch.watching(), watch.doing("moving"):
            time.sleep(1.7)
            assert f"{arm.name}: moving, 2 s so far" in caplog.text


def test_a_camera_survives_the_death_of_its_arm_and_takes_it_back(placed, caplog):
    class Drawn(TwinCamera):
        """What it shows is the arm's y: drawing takes too long for this test."""

        def _open(self):
            pass

        def _require_open(self):
            follower = SimpleNamespace(move=lambda T, time_s: T)
            picture = np.full((480, 640), 99.0) + np.random.default_rng(0).random((480, 640))
            return follower, SimpleNamespace(render=lambda state: picture / 255, window_px=(0, 0, 640, 480))

        def _finish(self, image):
            return image

    with Mg400Emulator(port_offset=None) as arm:
        ports = dict(arm.ports)
        pose = FeedbackPose("127.0.0.1", (ports[30004],))
        pose.__enter__()
        camera = Drawn(load_sensor("mg400-331"), placed, pose, fps=100, waits_for_arm=True)
        camera.connect()
        assert isinstance(camera.read(), Frame)
        arm.kill()
    time.sleep(1.2)
    with pytest.raises(TimeoutError):
        camera.read_after(time.monotonic(), timeout_s=0.3)
    with Mg400Emulator(port_offset=ports[30004] - 30004) as arm:
        frame = camera.read_after(time.monotonic(), timeout_s=5.0)
        assert time.monotonic() - frame.time_s < 0.5
        camera.disconnect()
        pose.__exit__()
    assert "waits for its arm" in caplog.text and "is back" in caplog.text
