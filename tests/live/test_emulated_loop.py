"""The whole rig over real sockets: an emulated MG400 and, beside it, the twin's camera that knows the arm by its feedback alone."""

import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from true_estimator import TrueEstimator

from hardware.arms.mg400 import MG400, Mg400Ports
from hardware.arms.mg400_wire import DASHBOARD_PORT, FEEDBACK_PERIOD_S, MOTION_PORT
from hardware.cameras.mjpeg import MjpegCamera
from hardware.cameras.twin import TwinCamera
from hardware.emulators.camera import CameraEmulator, FeedbackPose
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError
from hardware.rig.geometry import PlacedObject
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm
from hardware.servo.following import load_for_outlines, policy_law
from hardware.servo.loop import LoopHooks, LoopSettings, ServoLoop
from hardware.servo.trajectory import measure, trajectory_of
from hardware.workcell.build import Rig
from scenes import load_experiment, load_object, load_sensor, load_servo
from twin.pins import Pipeline
from twin.rig.kinematics import Mounting
from twin.types import Form

FIRST_S = 90.0  # kernels may have to be compiled
STEPS = 12
FPS = 12.0
POLICY = Path(__file__).parents[2] / "training" / "policies" / "SurfaceFollow-mg400-331.safetensors"


@pytest.fixture
def emulated():
    sensor, servo = load_sensor("mg400-331"), load_servo("surface")
    placed = PlacedObject(load_object("can"), servo.placement, Mounting.of(sensor, load_experiment("surface-2d")))
    with Mg400Emulator(port_offset=None, time_scale=4.0) as arm:
        pose = FeedbackPose("127.0.0.1", tuple(arm.ports[port] for port in FEEDBACK_PERIOD_S))
        with pose, CameraEmulator(TwinCamera(sensor, placed, pose, Form.RAW, fps=FPS)) as camera:
            ports = Mg400Ports(arm.ports[DASHBOARD_PORT], arm.ports[MOTION_PORT], tuple(arm.ports[p] for p in list(FEEDBACK_PERIOD_S)[:2]))
            safe = SafeArm(MG400("127.0.0.1", ports=ports), load_limits("mg400"))
            with Rig(MjpegCamera(camera.url, sensor, Form.PROCESSED), safe, placed, True) as rig:
                rig.source.read(timeout_s=FIRST_S)
                truth = SimpleNamespace(track=SimpleNamespace(pose=arm.pose))
                yield rig, servo, camera, TrueEstimator(truth, placed), Pipeline(sensor, Form.PROCESSED)


def assert_let_go(rig):
    deadline = time.monotonic() + 2.0
    while rig.arm.state().enabled and time.monotonic() < deadline:  # feedback comes a little later
        time.sleep(0.01)
    state = rig.arm.state()
    assert not state.enabled
    assert rig.placed.touch(state.pose).indent_mm < -10


def test_it_follows_the_can_and_the_frames_show_the_contact(emulated):
    rig, servo, camera, estimator, pipeline = emulated
    found: list[int] = []

    def look(record, frame, estimate):
        seen = pipeline(frame)
        assert seen.valid, seen.reason
        moved = np.linalg.norm(seen.graph.nodes_px - pipeline.reference.pins_px, axis=1)
        found.append(seen.found)
        assert moved.max() > 4.0  # px: the pins of a sensor that is pressed 3 mm deep

    loop = ServoLoop(rig, servo, estimator, LoopSettings(STEPS, frame_timeout_s=10.0, give_up_s=10.0), LoopHooks(on_step=look))
    timing = loop.run(rig.placed.start_pose(servo.indent_mm))
    assert timing.steps == STEPS
    assert min(found) > 0.95 * 331
    measures = measure(trajectory_of(loop.records, rig.mounting, rig.placed), indent_mm=3.0, angle_deg=0.0, wanted_mm=STEPS)
    assert measures.lost_contacts == 0 and measures.hold_depth_mm < 0.2 and measures.completed > 0.5
    assert_let_go(rig)
    assert camera.made > STEPS


@pytest.mark.slow
def test_a_learnt_policy_follows_the_can(emulated):
    """Trained on the surrogate, run on frames of the finite elements through the live pipeline and the safety layer."""
    rig, servo, camera, _, _ = emulated
    model = load_for_outlines(POLICY)
    hooks = LoopHooks(policy_law(model.policy, rig.mounting), model.at_rest)
    loop = ServoLoop(rig, servo, model, LoopSettings(STEPS, frame_timeout_s=10.0, give_up_s=10.0), hooks)
    loop.run(rig.placed.start_pose(servo.indent_mm))
    measures = measure(trajectory_of(loop.records, rig.mounting, rig.placed), indent_mm=3.0, angle_deg=0.0, wanted_mm=STEPS)
    assert measures.lost_contacts == 0 and measures.hold_depth_mm < 1.0 and measures.completed > 0.5
    assert_let_go(rig)


def test_a_frozen_camera_makes_the_arm_let_go(emulated):
    rig, servo, camera, estimator, _ = emulated
    loop = ServoLoop(rig, servo, estimator, LoopSettings(1000, blocking=False, period_s=0.1, give_up_s=2.0))
    loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: record.index == 3 and camera.faults.add("frozen"))
    with pytest.raises(DeviceError, match="holds still"):
        loop.run(rig.placed.start_pose(servo.indent_mm))
    assert_let_go(rig)
