"""No motion towards an object without fresh frames: every command, with a camera, an arm or a program that fails in each phase."""

import os
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from threading import Timer
from types import SimpleNamespace

import numpy as np
import pytest
from arms import bench
from blind_runs import CAMERA_FAULTS, COMMANDS, FAULTS, HEALTHY, KINDS, PHASES, draw, faults_of, measure, table
from noisy_camera import NoisyCamera
from pins_camera import AT_REST, SENSOR, StudioModel, Switched, shows
from true_estimator import TrueEstimate, TrueEstimator

from hardware.arms.arm import SimulatedArm
from hardware.cameras.mjpeg import MjpegCamera
from hardware.cameras.reader import DevicePicture
from hardware.collect.collect import LIFT_MM, Collection, CollectPlan, collect, collect_frames
from hardware.emulators.camera import CameraEmulator
from hardware.errors import DeviceError
from hardware.live.studio_mode import CameraFeed
from hardware.rig.geometry import PlacedObject, shift_in_tool
from hardware.safety.decide import SafetyLimits, load_limits
from hardware.safety.eyes import NEAR_MM, PIECE_MM, BlindError, FreshFrames, pieces_to
from hardware.safety.safe_arm import SafeArm
from hardware.servo.following import FollowPlan, follow
from hardware.servo.loop import LoopHooks, LoopSettings, ServoLoop
from hardware.workcell.build import Rig, check_plan
from scenes import PlacementSpec, load_experiment, load_object, load_sensor, load_servo
from twin.pins import Pipeline, measure_reference, nominal_reference
from twin.rig.kinematics import Mounting
from twin.types import Form

RUNS, HEALTHY_RUNS = 320, 20
SAMPLE = [(COMMANDS[k % 4], PHASES[(k + k // 4) % 4], fault) for k, fault in enumerate((*CAMERA_FAULTS, *FAULTS))]
FREE = SafetyLimits(box_mm=((-2000, 2000),) * 3)
FASTER = 3.0
"""Factor on the arm's speed in healthy runs. Under a fault it has its own: so a move lasts long enough for a missing stop to be seen."""


def tried(seed, case=None, kind="mg400"):
    case = case or draw(seed, kind)
    return measure(seed, case, kind, scale=FASTER if case[2] == HEALTHY else 1.0)


@pytest.mark.parametrize(("seed", "case"), list(enumerate(SAMPLE)), ids=[" ".join(case) for case in SAMPLE])
def test_a_fault_in_a_phase_stops_the_arm(seed, case):
    found = tried(seed, case)
    assert not found.wrong(), found


@pytest.mark.parametrize("seed", range(0, 4 * len(faults_of("magician")), 5))  # each fault, in a phase of its own
def test_a_fault_in_a_phase_stops_a_magician(seed):
    found = tried(seed, kind="magician")
    assert not found.wrong(), found


@pytest.mark.parametrize("seed", range(0, 4 * len(FAULTS), 7))
def test_a_fault_in_a_phase_stops_an_arm_behind_ros_2(seed):
    found = tried(seed, kind=("ros2-twist", "ros2-pose")[seed % 2])
    assert not found.wrong(), found


@pytest.mark.parametrize("seed", range(2, 4 * len(faults_of("ur")), 7))
def test_a_fault_in_a_phase_stops_a_ur(seed):
    found = tried(seed, kind="ur")
    assert not found.wrong(), found


@pytest.mark.parametrize(("command", "kind"), list(zip(2 * COMMANDS, 2 * tuple(KINDS), strict=False)))
def test_a_healthy_run_comes_to_its_end(command, kind):
    """Each command with two of the arms, and each arm; the slow test below has the others, too."""
    found = tried(7, (command, "contact", HEALTHY), kind)
    assert found.safe and not found.told, found


def all_of(cases):
    """The runs of some seeds and cases, side by side."""
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        return list(pool.map(measure, *zip(*cases, strict=True)))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "count"), [("mg400", RUNS), ("magician", RUNS // 4), ("ur", RUNS // 4)])
def test_no_fault_in_any_phase_goes_on(kind, count):
    runs = all_of([(seed, draw(seed, kind), kind) for seed in range(count)])
    print(f"\n{len(runs)} runs with a {kind}, seeds 0 to {count - 1}\n{table(runs)}")
    assert not [run for run in runs if run.wrong()], "\n".join(f"{run}: {run.wrong()}" for run in runs if run.wrong())


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_healthy_runs_all_come_to_their_end(kind):
    runs = all_of([(seed, (COMMANDS[seed % 4], "contact", HEALTHY), kind) for seed in range(HEALTHY_RUNS if kind == "mg400" else 4)])
    assert not [run for run in runs if run.told or not run.safe], runs


@pytest.fixture
def placed():
    return PlacedObject(load_object("can"), PlacementSpec(), Mounting.of(load_sensor("mg400-331"), load_experiment("surface-2d")))


@pytest.fixture
def arm(placed):
    with SimulatedArm(pose=placed.start_pose(-60.0)) as arm:
        arm.enable()
        yield arm


def test_the_last_millimetres_are_made_in_pieces():
    start, target = np.zeros(6), np.array([0, 30.0, 0, 0, 0, 10.0])
    poses = pieces_to(start, target, NEAR_MM)
    steps = np.diff([0.0, *(pose[1] for pose in poses)])
    assert np.isclose(steps[0], 30.0 - NEAR_MM) and (steps[1:] <= PIECE_MM + 1e-9).all() and np.allclose(poses[-1], target)
    assert len(pieces_to(start, start, NEAR_MM)) == len(pieces_to(start, target, 0.0)) == 1


def test_an_arm_does_not_leave_standstill_without_a_frame(arm):
    source = Switched()
    source.off = True
    with source:
        eyes, before = FreshFrames(arm, source), arm.state().pose
        with pytest.raises(BlindError, match="moves only with fresh frames"):
            eyes.await_frame(timeout_s=0.3)
        with eyes.watching(), pytest.raises(BlindError):
            eyes.move(lambda: arm.move_linear(before + [0, 5, 0, 0, 0, 0]))
    np.testing.assert_array_equal(arm.state().pose, before)


def test_a_motion_that_is_sent_after_the_stop_is_stopped_too(arm):
    with Switched() as source:
        eyes, target = FreshFrames(arm, source), arm.state().pose + [0, 90, 0, 0, 0, 0]
        eyes.await_frame(timeout_s=2.0)

        def send():
            source.off = True
            time.sleep(0.5)
            return arm.move_linear(target, wait=False)

        with eyes.watching(), pytest.raises(BlindError, match="no new picture"):
            eyes.move(send, ends=False)
        assert not arm.state().moving


def test_a_picture_without_noise_may_repeat_at_rest_and_not_in_contact(arm, placed):
    """As a stream of thresholded pictures gives."""
    source = Switched()
    source.notices_still = False
    source.picture = np.full((48, 64), 200, np.uint8)
    poses = {}

    def pose_at(time_s):
        return placed.start_pose(poses["indent_mm"] if time_s > source.same_s[0] else poses["before_mm"])

    with source:
        eyes = FreshFrames(arm, source, pose_at, lambda pose: float(placed.touch(pose).indent_mm))
        while source.same_s is None or eyes._source.blind():
            time.sleep(0.01)
        for before_mm, indent_mm, sees in ((-9.0, -3.0, True), (-9.0, 0.5, True), (2.0, 2.0, True), (-9.0, 1.5, False), (1.0, 2.5, False)):
            poses.update(before_mm=before_mm, indent_mm=indent_mm)
            reason = eyes.blind()
            assert (reason == "") is sees, (before_mm, indent_mm)
        assert "in contact" in reason


def test_a_stream_of_thresholded_pictures_is_not_frozen_at_rest():
    class Thresholded(NoisyCamera):
        notices_still = False

        def _grab(self):
            made = super()._grab()
            return DevicePicture(np.where(np.indices((360, 360)).sum(axis=0) % 24 < 8, 255, 0).astype(np.uint8), made.time_s)

    with CameraEmulator(Thresholded(fps=60)) as emulator, MjpegCamera(emulator.url, load_sensor("mg400-331"), Form.PROCESSED) as camera:
        first = camera.read(timeout_s=2.0)
        time.sleep(1.0)
        assert not camera.fault and not camera.blind() and camera.read_latest().time_s > first.time_s + 0.5
        assert not any("repeat" in note for note in camera.notes()), camera.notes()


@pytest.mark.parametrize("blocking", [True, False])
def test_an_arm_that_stopped_for_want_of_frames_goes_on_with_them(placed, blocking):
    with Switched(fps=60) as source, SimulatedArm(pose=placed.start_pose(-60.0), time_scale=10.0) as arm:
        servo = load_servo("surface").model_copy(update={"clear_mm": 20.0})
        loop = ServoLoop(Rig(source, arm, placed, False), servo, TrueEstimator(arm, placed), LoopSettings(6, blocking=blocking))
        waits = iter((True,))

        def step(record, frame, estimate):
            if record.index == 2 and next(waits, False):
                source.off = True
                Timer(0.6, lambda: setattr(source, "off", False)).start()

        loop.hooks = LoopHooks(on_step=step)
        loop.run(placed.start_pose(3.0))
    assert len(loop.records) == 6 and len(loop.notes) == (not blocking) and all("held still" in note for note in loop.notes)


@pytest.mark.parametrize("command", ["servo", "collect"])
def test_where_the_limits_allow_no_way_back_the_arm_goes_back_the_way_it_came(placed, tmp_path, caplog, command):
    arm = SimulatedArm(pose=placed.start_pose(-60.0), time_scale=20.0)
    safe = SafeArm(arm, FREE)
    with NoisyCamera() as source, safe:
        rig, servo = Rig(source, safe, placed, True), load_servo("surface")

        def narrow(*_):
            safe.retreat = lambda: None
            if command == "collect":
                raise DeviceError("in contact")

        if command == "servo":
            loop = ServoLoop(rig, servo, TrueEstimator(arm, placed), LoopSettings(3), LoopHooks(on_step=narrow))
            loop.run(placed.start_pose(servo.indent_mm))
            clear_mm, told = 40.0, loop.notes
        else:
            contacts = Collection(tmp_path, {"seed": 1}, Form.RAW)
            contacts.keep = narrow
            with pytest.raises(DeviceError, match="in contact"):
                collect(rig, load_experiment("surface-2d"), contacts, 1, seed=1, speed=(200.0, 200.0))
            clear_mm, told = LIFT_MM - 1.0, [record.getMessage() for record in caplog.records]
        assert placed.touch(arm.state().pose).indent_mm < -clear_mm
    assert any("returned on its own path" in note for note in told)


def dented():
    """The pins of a contact at the side."""
    away = AT_REST - AT_REST.mean(axis=0) - [60.0, 0.0]
    return AT_REST + 0.25 * away * np.exp(-np.sum(away**2, axis=1, keepdims=True) / 2 / 60.0**2)


def other_sensor():
    """A camera of a sensor with fewer pins in the same picture."""
    return shows(nominal_reference(load_sensor("mg400-127"), Form.RAW).pins_px)


@pytest.fixture
def studio_arm(monkeypatch):
    """Starts the studio's feed with a camera, and gives its arm."""
    feeds = []

    def start(source):
        monkeypatch.setattr("hardware.live.studio_mode.open_camera", lambda *_: source)
        feeds.append(CameraFeed("any", "simulated", StudioModel.sensor, StudioModel()))
        feeds[0].start(lambda shot: None, lambda why: None)
        return feeds[0].robot

    yield start
    feeds[0].stop()


def test_the_studio_moves_an_arm_only_with_frames_and_back_without(studio_arm):
    source = shows(AT_REST)
    robot = studio_arm(source)
    try:
        assert [line.split(":")[0] for line in robot.arm()] == ["camera", "sensor", "limits"]
        robot.nudge(1, 1.0)
        source.off = True
        time.sleep(0.4)
        with pytest.raises(DeviceError, match="fresh frames"):
            robot.nudge(1, 1.0)
        robot.nudge(1, -1.0)
        with pytest.raises(DeviceError, match="fresh frames"):
            robot.nudge(1, -1.0)
        np.testing.assert_allclose(robot._arm.state().pose[1], 0.0, atol=1e-6)
    finally:
        source.off = False


@pytest.mark.parametrize(
    ("make", "outside", "refused"),
    [(NoisyCamera, False, "expected 640x480"), (lambda: shows(AT_REST[:20]), False, "no pins"), (lambda: shows(AT_REST), True, "outside")],
    ids=["other size", "covered", "outside the limits"],
)
def test_the_studio_arms_nothing_without_the_sensor_or_outside_the_limits(studio_arm, make, outside, refused):
    robot = studio_arm(make())
    if outside:
        robot._arm.limits = FREE.model_copy(update={"box_mm": ((50.0, 60.0),) * 3})
    with pytest.raises(DeviceError, match=refused):
        robot.arm()
    assert not robot.armed and not robot._arm.state().enabled


@pytest.mark.parametrize(
    ("kind", "servo", "refused"), [("mg400", "surface", ""), ("magician", "surface", "magician"), ("magician", "magician", "")]
)
def test_the_plan_is_checked_before_anything_moves(kind, servo, refused):
    spec = load_servo(servo)
    placed = PlacedObject(load_object("can"), spec.placement, Mounting.of(SENSOR, load_experiment(spec.experiment)))
    with bench(kind) as at, shows(AT_REST) as source, SafeArm(at.arm, load_limits(kind)) as arm:
        rig, start, before = Rig(source, arm, placed, False), placed.start_pose(spec.indent_mm), at.reads()
        clear = shift_in_tool(start, -spec.clear_mm * placed.mounting.axis)
        check = partial(check_plan, rig, Pipeline(SENSOR, Form.RAW), clear, [start], linear_mm_s=spec.linear_mm_s, spent_s=1.0)
        if refused:
            with pytest.raises(DeviceError, match=refused):
                check()
        else:
            lines = check()
            assert [line.split(":")[0] for line in lines] == ["camera", "sensor", "path", "limits", "time"] and "frames/s" in lines[0]
            assert "331 of 331 pins of mg400-331" in lines[1]
        np.testing.assert_array_equal(at.reads(), before)


@pytest.mark.parametrize("command", ["servo", "servo without a rest frame", "policy", "collect"])
@pytest.mark.parametrize(
    ("make", "refused"),
    [
        (NoisyCamera, "expected 640x480"),
        (lambda: shows(AT_REST[:20]), "no pins"),
        (other_sensor, "pins"),
        (lambda: shows(dented()), "pressed"),
    ],
    ids=["other size", "covered", "other sensor", "pressed"],
)
def test_nothing_moves_with_a_camera_that_does_not_show_the_sensor(monkeypatch, tmp_path, command, make, refused):
    class Model(SimpleNamespace):
        counts_from_rest = True
        at_rest = partial(measure_reference, SENSOR, Form.RAW)

        def seeking_rest(self):
            return self

        def __call__(self, frame):
            return TrueEstimate(("pose_2", "pose_6"), *np.zeros((3, 2)))

    monkeypatch.setattr("hardware.workcell.build.open_camera", lambda *_, **__: make())
    can, spec = load_object("can"), load_servo("surface")
    with bench("mg400") as at:
        monkeypatch.setattr("hardware.workcell.build.open_arm", lambda _: at.arm)
        arm, before = "mg400:any", at.reads()
        if command == "collect":
            plan = CollectPlan(
                can,
                spec,
                sensor=SENSOR,
                experiment=load_experiment("surface-2d"),
                camera="any",
                arm=arm,
                count=1,
                form=Form.RAW,
                dry_run=True,
            )
            run = partial(collect_frames, plan, tmp_path)
        else:
            at_rest = "none" if "without" in command else "first"
            plan = FollowPlan(can, spec, camera="any", arm=arm, at_rest=at_rest, dry_run=True)
            run = partial(follow, plan, Model(sensor=SENSOR, form=Form.RAW, pipeline=Pipeline(SENSOR, Form.RAW)), tmp_path)
        if refused == "pressed" and "without" in command:
            run()
        else:
            with pytest.raises(DeviceError, match=f"nothing was moved: .*{refused}"):
                run()
        np.testing.assert_array_equal(at.reads(), before)
