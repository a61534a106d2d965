"""Two sensors and a gripper, live: one loop runs a policy in the scene of ``GraspLift`` and on an emulated arm with a digital output."""

import numpy as np
import pytest
from arms import mg400_of
from noisy_camera import NoisyCamera

from hardware.arms.simulated import SimulatedArm
from hardware.cameras.twin import TwinCamera
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError
from hardware.servo.grip import GripperRig, OutputGripper, run_gripper
from scenes import load_sensor
from twin.pins import Pipeline
from twin.records.session import Session
from twin.types import Form

SENSOR = "mg400-331"
OPEN_MM, CLOSE_MM, LIFT_MM = 44.0, 1.0, 4.0
"""Width at the start, and motions of a step."""
FIRM_PX, LOOSE_PX = 4.0, 2.0
"""Mean displacement of the pins at which a policy lifts. The block needs 1.5 N at each finger; the skin then gives way by 3 px."""
STEPS, LIFTS = 30, 5


class ByHand:
    """A policy: close until both sensors' pins are displaced, then lift."""

    def __init__(self, firm_px):
        self.firm_px, self.rest, self.lifted = firm_px, {}, 0

    def __call__(self, step):
        if not self.rest:
            self.rest = {name: pins.pins_px for name, pins in step.pins.items()}
        moved = [np.nanmean(np.linalg.norm(pins.pins_px - self.rest[name], axis=1)) for name, pins in step.pins.items()]
        if min(moved) < self.firm_px and not self.lifted:
            return np.zeros(6), step.width_mm - CLOSE_MM
        self.lifted += 1
        return np.array([0, 0, LIFT_MM * (self.lifted <= LIFTS), 0, 0, 0]), step.width_mm


@pytest.mark.parametrize(("firm_px", "lifts"), [(FIRM_PX, True), (LOOSE_PX, False)], ids=["firm", "loose"])
def test_a_policy_lifts_a_block_in_the_scene_and_records_have_both_sensors(firm_px, lifts, tmp_path):
    """A loose grip slips, so that it is the friction at the two skins that lifts."""
    mujoco = pytest.importorskip("mujoco", reason="mujoco (the extra) is not installed")
    from training.mujoco.carried import SceneGripper

    sensor = load_sensor(SENSOR)
    gripper = SceneGripper("gripper", sensor, width_mm=OPEN_MM)
    arm = SimulatedArm(time_scale=np.inf)
    form = Form.PROCESSED if sensor.recording else Form.RAW
    sources = {site: TwinCamera(sensor, None, arm.state, form, on_demand=True, world=world) for site, world in gripper.worlds().items()}
    mujoco.mj_forward(gripper.scene.model, gripper.scene.data)
    from_mm = 1e3 * gripper.scene.data.body("block").xpos[2]
    policy = ByHand(firm_px)
    rig, pipelines = GripperRig(sources, arm, gripper), {name: Pipeline(sensor, form) for name in sources}
    found = run_gripper(rig, pipelines, policy, steps=STEPS, out=tmp_path, timeout_s=60.0)
    lifted_mm = 1e3 * gripper.scene.data.body("block").xpos[2] - from_mm
    assert policy.lifted > LIFTS and (lifted_mm > 0.6 * LIFTS * LIFT_MM if lifts else lifted_mm < 1.0)
    sessions = [Session(tmp_path / name) for name in sources]
    assert len(sessions) == 2 and all(len(session.steps) == len(found) == STEPS for session in sessions)
    for session, name in zip(sessions, sources, strict=True):
        assert [step["width_mm"] for step in session.steps] == [step["width_mm"] for step in sessions[0].steps]
        np.testing.assert_allclose(np.array(session.steps[-1]["pins"], float), found[-1].pins[name].pins_px, atol=1e-3)


class OnePipeline:
    """Finds pins in any picture, until it is told not to."""

    spec = load_sensor(SENSOR)

    def __init__(self):
        self.reason = ""

    def __call__(self, frame):
        from types import SimpleNamespace

        return SimpleNamespace(valid=not self.reason, reason=self.reason, pins_px=np.zeros((3, 2)))


def test_the_same_loop_with_an_mg400_and_its_digital_output(tmp_path):
    """Without the pins of one of two sensors arm and gripper hold still; the arm ends disabled, and the grip stays."""
    with Mg400Emulator(port_offset=None, time_scale=4.0) as emulator:
        arm = mg400_of(emulator)
        rig = GripperRig({"left": NoisyCamera(), "right": NoisyCamera()}, arm, OutputGripper(arm, 3, open_mm=40.0, closed_mm=10.0))
        pipelines = {"left": OnePipeline(), "right": OnePipeline()}
        start = emulator.pose()

        def decide(step):
            if step.index == 4:
                pipelines["right"].reason = "too few pins"
            return np.array([0, 0, 2.0, 0, 0, 0]), 40.0 if step.index < 2 else 15.0

        with pytest.raises(DeviceError, match="held still for 0.5 s.*right: too few pins"):
            run_gripper(rig, pipelines, decide, steps=20, out=tmp_path, give_up_s=0.5)
        assert np.allclose(emulator.pose() - start, [0, 0, 10.0, 0, 0, 0], atol=0.1) and not emulator.arm.enabled
        assert emulator.arm.digital_out == 1 << 2 and rig.gripper.width_mm == 10.0
        assert len(Session(tmp_path / "left").steps) == len(Session(tmp_path / "right").steps) == 5


def test_an_arm_without_outputs_has_no_such_gripper():
    with pytest.raises(DeviceError, match="no digital outputs"):
        OutputGripper(SimulatedArm(), 1, open_mm=40.0, closed_mm=10.0)
