"""Two sensors and a gripper, live: one loop runs a policy in the scene of ``GraspLift`` and on an emulated arm with a digital output."""

import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from arms import mg400_of
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from noisy_camera import NoisyCamera

from hardware.arms.arm import SimulatedArm
from hardware.cameras.twin import TwinCamera
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import RefusedMoveError, SafeArm
from hardware.servo.grip import GripperRig, GripPlan, OutputGripper, Ros2Gripper, grip, open_gripper, run_gripper
from scenes import load_sensor
from twin.errors import OptionError
from twin.frames import open_recording
from twin.pins import Pipeline
from twin.records import RecordError, convert, open_records
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
    assert sessions[0].steps[0]["width_mm"] == OPEN_MM and sessions[0].steps[-1]["sent_mm"] == found[-1].width_mm
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


def test_an_arm_that_can_not_be_stopped_at_the_end_is_an_error():
    """It is lost with the last motion of the gripper, after which nothing asks it any more."""
    with Mg400Emulator(port_offset=None, time_scale=4.0) as emulator:
        hand = SimpleNamespace(name="hand", width_mm=9.0, move=lambda width_mm: width_mm == 1.0 and emulator.kill())
        rig = GripperRig({"left": NoisyCamera(), "right": NoisyCamera()}, mg400_of(emulator), hand)
        with pytest.raises(DeviceError, match="stop failed: .*may move.*disable failed"):
            run_gripper(rig, dict.fromkeys(rig.sources, OnePipeline()), lambda step: (np.zeros(6), 2.0 - step.index), steps=2)


def test_a_safe_arm_does_not_move_on_an_old_frame():
    """The policy takes longer than the limits allow a frame to age, though the cameras deliver."""
    with Mg400Emulator(port_offset=None, time_scale=4.0) as emulator:
        arm = SafeArm(mg400_of(emulator), load_limits("mg400").model_copy(update={"frame_age_s": 0.3}))
        rig = GripperRig({"left": NoisyCamera(), "right": NoisyCamera()}, arm, OutputGripper(arm, 3, open_mm=40.0, closed_mm=10.0))

        def decide(step):
            time.sleep(0.5 * (step.index == 1))
            return np.array([0, 0, 1.0, 0, 0, 0]), 15.0

        start = emulator.pose()
        with pytest.raises(RefusedMoveError, match="stale-frame.*the sensor's frame is 0.5"):
            run_gripper(rig, dict.fromkeys(rig.sources, OnePipeline()), decide, steps=3)
        assert np.allclose(emulator.pose() - start, [0, 0, 1.0, 0, 0, 0], atol=0.1) and not emulator.arm.enabled


def test_an_arm_without_outputs_has_no_such_gripper():
    with pytest.raises(DeviceError, match="no digital outputs"):
        open_gripper("output:1,40,10", SimulatedArm(), load_sensor(SENSOR))


@pytest.mark.parametrize("text", ["", "nothing", "output", "output:1", "output:x,40,10", "ros2:/topic,x"])
def test_an_unknown_gripper_is_refused_with_those_that_there_are(text):
    with pytest.raises(DeviceError, match="no gripper.*there are: output:N,OPEN_MM,CLOSED_MM.*ros2:TOPIC"):
        open_gripper(text, SimulatedArm(), load_sensor(SENSOR))


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"left": "0", "right": "2"}, "`gripper` mujoco:gripper is in a scene; leave out `left`"),
        ({"arm": "mg400"}, "is in a scene"),
        ({"gripper": "ros2:/g/commands", "left": "0"}, "is real; give the sensors' cameras with `left` and `right`"),
    ],
)
def test_parts_that_do_not_fit_together_are_refused(given, why):
    pytest.importorskip("mujoco", reason="mujoco (the extra) is not installed")
    with pytest.raises(OptionError, match=why):
        GripPlan(load_sensor(SENSOR), **given).build()


@pytest.mark.parametrize(("joints", "sent_m"), [(1, [0.03]), (2, [0.015, 0.015])])
def test_a_gripper_behind_ros_2_gets_its_width(joints, sent_m, monkeypatch):
    pytest.importorskip("cyclonedds", reason="cyclonedds (the extra ros2) is not installed")
    from rosbags.typesys import Stores, get_typestore

    from hardware.ros2.dds import Participant

    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.randrange(1, 230)))
    monkeypatch.setattr("hardware.servo.grip.CONNECT_S", 0.2)
    gripper, kind = Ros2Gripper("/hand/commands", joints), "std_msgs/Float64MultiArray"
    with pytest.raises(DeviceError, match="ROS 2 gripper at /hand/commands: nobody takes std_msgs/Float64MultiArray"):
        gripper.move(30.0)
    assert np.isnan(gripper.width_mm)
    monkeypatch.setattr("hardware.servo.grip.CONNECT_S", 20.0)
    reader = Participant().reader("/hand/commands", kind)
    gripper.move(30.0)
    until_s, found = time.monotonic() + 10.0, []
    while not found and time.monotonic() < until_s:
        found = reader.take()
        gripper.move(30.0)
    message = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(found[0], "std_msgs/msg/Float64MultiArray")
    assert message.data.tolist() == pytest.approx(sent_m) and gripper.width_mm == 30.0


CLOSINGS, GRASP_STEPS = 13, 55
"""Decisions in which the fingers close, to 1.6 N, and all of a short run. The block needs 1.5 N."""


def test_a_dry_run_checks_both_sensors_and_moves_nothing(tmp_path, monkeypatch, caplog):
    pytest.importorskip("mujoco", reason="mujoco (the extra) is not installed")
    monkeypatch.setattr(SimulatedArm, "enable", lambda arm: pytest.fail("enabled"))
    done = grip(GripPlan(load_sensor(SENSOR), dry_run=True), lambda step: pytest.fail("asked"), tmp_path / "out", steps=1)
    assert "nothing was moved" in done.lines()[0] and not (tmp_path / "out" / "left").exists()
    assert all(f"{name}: sensor: 331 of 331 pins" in caplog.text and f"{name}: limits: " in caplog.text for name in ("left", "right"))


def test_both_sensors_are_published(monkeypatch):
    pytest.importorskip("cyclonedds", reason="cyclonedds (the extra ros2) is not installed")
    from hardware.ros2.dds import Participant

    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.randrange(1, 230)))
    monkeypatch.setattr(OnePipeline, "reference", None, raising=False)
    hand = SimpleNamespace(name="hand", width_mm=9.0, move=lambda width_mm: None)
    rig = GripperRig({"left": NoisyCamera(), "right": NoisyCamera()}, SimulatedArm(time_scale=np.inf), hand)
    readers, seen = {name: Participant().reader(f"/hand/{name}/image", "sensor_msgs/Image") for name in rig.sources}, set()

    def decide(step):
        seen.update(name for name, reader in readers.items() if reader.take())
        time.sleep(0.05)
        return np.zeros(6), 9.0

    run_gripper(rig, dict.fromkeys(rig.sources, OnePipeline()), decide, steps=60, ros2="hand")
    assert seen == {"left", "right"}


@pytest.fixture(scope="module")
def grasped(tmp_path_factory):
    """A short run of a policy in the scene: its folder, its result, what the policy observed, and the pins without a camera."""
    pytest.importorskip("mujoco", reason="mujoco (the extra) is not installed")
    from training.environments.grasp import PERIOD_S, GraspPolicy

    observed, exact, out = [], [], tmp_path_factory.mktemp("grasp") / "out"
    policy = GraspPolicy(lambda seen: observed.append(seen) or np.array([float(len(observed) <= CLOSINGS)]), 40.0)

    def watched(step):
        exact.append([scene.read(site).pins_px for site in scene.sensors])
        return policy(step)

    class Watching(GripPlan):
        def build(self):
            nonlocal scene
            rig = super().build()
            scene = rig.gripper.scene
            return rig

    scene = None
    plan = Watching(load_sensor(SENSOR), also=("lerobot", "mcap"))
    return out, grip(plan, watched, out, steps=GRASP_STEPS, period_s=PERIOD_S), observed, exact


def test_a_policy_of_the_environment_runs_live_on_what_the_environment_observes(grasped):
    """Pins from pictures differ from the scene's own by the noise of a camera."""
    from training.environments.grasp import SETTLE_STEPS, in_spacings

    _, gripped, observed, exact = grasped
    assert len(gripped.steps) == GRASP_STEPS and len(observed) == GRASP_STEPS - 2 * SETTLE_STEPS
    found = np.array([seen["tactile"][0] for seen in observed])
    truth = np.array([in_spacings(pins, exact[SETTLE_STEPS]) for pins in exact[2 * SETTLE_STEPS :]])
    assert np.abs(truth[-1]).max() > 0.5 and np.median(np.abs(found - truth)) < 0.02
    changes = np.array([seen["tactile"][1] for seen in observed])
    np.testing.assert_allclose(changes[1:], 10 * np.diff(found, axis=0), atol=1e-4)
    heights_mm = [step.state.pose[2] for step in gripped.steps]
    assert (
        observed[-1]["state"][1] * 50.0 == pytest.approx(heights_mm[-1] - heights_mm[0], abs=0.01) and heights_mm[-1] > heights_mm[0] + 20
    )


def test_records_of_several_sensors_are_one_record_with_a_picture_and_pins_for_each(grasped, tmp_path):
    out, gripped, *_ = grasped
    records = open_records(out)
    assert records.about.views == ("left", "right")
    assert set(records.about.numbers) == {"pins.left", "pins.right", "pose", "width", "action"}
    (episode,) = records.episodes
    mine = list(episode.steps())
    assert len(mine) == GRASP_STEPS
    for step, record in zip(gripped.steps, mine, strict=True):
        for image, name in zip(record.images, ("left", "right"), strict=True):
            np.testing.assert_array_equal(image, step.frames[name].image)
            np.testing.assert_allclose(record.values[f"pins.{name}"], step.pins[name].pins_px, atol=1e-3)
        np.testing.assert_allclose(record.values["pose"], step.state.pose, atol=1e-4)
        assert record.values["width"] == pytest.approx(step.width_mm)
    np.testing.assert_array_equal([record.values["action"][6] for record in mine[:-1]], [record.values["width"][0] for record in mine[1:]])
    convert([out], tmp_path / "video", "lerobot", video=True)
    for folder, exact in ((out / "lerobot", True), (out / "mcap", True), (tmp_path / "video", False)):
        again = open_records(folder)
        assert again.about == records.about
        for one, other in zip(mine, again.episodes[0].steps(), strict=True):
            assert one.time_s == other.time_s and list(one.values) == list(other.values)
            for name, values in one.values.items():
                np.testing.assert_array_equal(values, other.values[name])
            for image, its in zip(one.images, other.images, strict=True):
                assert np.abs(image.astype(int) - its).mean() <= (0 if exact else 8)
    assert np.abs(mine[-1].image.astype(int) - mine[-1].beside[0]).mean() > 8  # both sensors' pictures differ
    for to in ("recording", "huggingface"):
        with pytest.raises(RecordError, match="one picture in a step, this record has 2; give lerobot or mcap, or one session"):
            convert([out], tmp_path / to, to)
    convert([out / "left"], tmp_path / "left", "recording")
    assert len(open_recording(tmp_path / "left", load_sensor(SENSOR))) == GRASP_STEPS


def test_the_mcap_reader_sees_topics_of_each_sensor(grasped):
    with (grasped[0] / "mcap" / "episode_000000.mcap").open("rb") as file:
        found = {}
        for _, channel, _, ros in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(channel.topic, []).append(ros)
    own = {f"/{name}/{topic}" for name in ("left", "right") for topic in ("image/compressed", "pins")}
    assert set(found) == own | {"/tactip/arm_pose", "/tactip/gripper_width", "/tactip/command", "/tf"}
    assert {len(messages) for messages in found.values()} == {GRASP_STEPS}
    assert [found[f"/{name}/image/compressed"][0].header.frame_id for name in ("left", "right")] == ["left_sensor", "right_sensor"]
    assert found["/tactip/command"][0].data[6] == pytest.approx(44.0)


LEROBOT = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("local/records", root=sys.argv[1], video_backend="pyav")
row = data[len(data) - 1]
print(json.dumps({"cameras": data.meta.camera_keys, "shapes": {key: list(getattr(value, "shape", ())) for key, value in row.items()},
                  "levels": [float((255 * row[key]).round().sum()) for key in data.meta.camera_keys]}))
"""


@pytest.mark.slow
def test_lerobot_reads_both_sensors(grasped, tmp_path):
    python = os.environ.get("TACTIP_LEROBOT")
    if not python:
        pytest.skip("TACTIP_LEROBOT names no Python with lerobot")
    own = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    home = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hf"), "HOME": str(tmp_path)}
    done = subprocess.run([python, "-c", LEROBOT, grasped[0] / "lerobot"], capture_output=True, text=True, env=own | home, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["cameras"] == ["observation.images.left", "observation.images.right"]
    pins = {f"observation.tactile.{name}.pins": [331, 2] for name in ("left", "right")}
    assert found["shapes"].items() >= (pins | {"action": [7], "observation.state": [6]}).items()
    *_, last = open_records(grasped[0]).episodes[0].steps()
    assert found["levels"] == [3.0 * image.sum() for image in last.images]


def test_the_command_refuses_a_missing_policy_and_names_what_is_wrong(tmp_path):
    run = [sys.executable, "-m", "twin", "grasp", "nowhere.zip", "--out", tmp_path / "out"]
    done = subprocess.run(
        run, capture_output=True, text=True, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    )
    assert done.returncode == 1 and "nowhere.zip: no such file; give a ZIP file" in done.stderr and not (tmp_path / "out").exists()
