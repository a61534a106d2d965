"""The live commands in the twin, with a stand-in for a trained model that knows the simulated arm's pose."""

import csv
import json
import random
import re
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_frames import drawn_frame
from free_ports import free_offset
from noisy_camera import NoisyCamera
from studio_client import StudioClient
from true_estimator import TrueEstimate, TrueEstimator
from typer.testing import CliRunner

from hardware.arms.arm import SimulatedArm
from hardware.cameras.reader import DevicePicture, LiveSource
from hardware.cameras.source import SessionSource
from hardware.cameras.twin import preview_of
from hardware.emulators.camera import CameraEmulator
from hardware.emulators.faults import Emulator
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError
from hardware.live.live import LiveSession, Shower, WatchPlan, watch
from hardware.rig.geometry import PlacedObject
from hardware.ros2.dds import Writer
from hardware.servo import following
from hardware.servo.following import steps_round
from hardware.workcell.build import build_rig
from scenes import load_experiment, load_object, load_sensor, load_servo
from training.estimate.estimator import PoseEstimator
from training.estimate.rest import FEWEST_CONTACTS
from twin.camera.capture import expose, record
from twin.cli import command_line
from twin.errors import OptionError, TwinError
from twin.frames import open_recording
from twin.frames.forms import frame_size
from twin.frames.images import write_image
from twin.pins import Pipeline
from twin.pins.batch import voronoi_map
from twin.records import open_records
from twin.records.ros2 import decode
from twin.rig.kinematics import Mounting
from twin.studio.page import LivePage, frame_pictures
from twin.types import Form, Frame

STEPS = 6


class StandIn:
    """Looks like a ``PoseEstimator``; in the twin it knows the truth, elsewhere it tells the picture's mean level."""

    def __init__(self) -> None:
        self.sensor, self.form, self.counts_from_rest = load_sensor("mg400-331"), Form.PROCESSED, False
        self.pipeline = Pipeline(self.sensor, self.form)
        self.true: TrueEstimator | None = None

    def check(self, sensor, form) -> None:
        assert form == self.form

    def with_history(self) -> "StandIn":
        return self

    def seeking_rest(self) -> "StandIn":
        return self

    def __call__(self, frame):
        if self.true is not None:
            return self.true(frame)
        value = np.array([frame.image.mean(), frame.image.std()])
        return TrueEstimate(("pose_2", "pose_6"), value, value - 1, value + 1)


@pytest.fixture
def stand_in(monkeypatch):
    model = StandIn()

    def build(*arguments, **options):
        rig = build_rig(*arguments, **options)
        model.true = TrueEstimator(rig.arm, rig.placed, noise_mm=0.03, noise_deg=0.3)
        return rig

    monkeypatch.setattr(following, "build_rig", build)
    monkeypatch.setattr(PoseEstimator, "load", classmethod(lambda cls, run: model))
    return model


def run(*arguments) -> str:
    result = CliRunner().invoke(command_line(), [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_servo_writes_what_it_says_and_a_session_that_replays(stand_in, tmp_path):
    out = tmp_path / "servo"
    told = run("servo", "--object", "can", "--model", "any", "--out", out, "--steps", STEPS, "--plain-light", "--record", "--also", "mcap")
    assert f"{STEPS} steps" in told
    with (out / "trajectory.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == STEPS
    assert all(abs(float(row["true_depth_mm"]) - load_servo("surface").indent_mm) < 0.5 for row in rows)
    content = json.loads((out / "measures.json").read_text())
    assert content["failure"] == "" and content["measures"]["lost_contacts"] == 0 and content["model"] == "any"
    assert (out / "trajectory.png").stat().st_size > 10_000
    with SessionSource(out / "session") as session:
        frames = [session.read() for _ in range(STEPS)]
    kept = open_records(out / "session" / "mcap")
    assert [episode.length for episode in kept.episodes] == [STEPS]
    for row, step in zip(rows, kept.episodes[0].steps(), strict=True):
        assert step.values["action"][0] == np.float32(session.session.steps[int(row["step"])]["sent"][0])
    # the frames show a contact: pins have moved, and the pipeline sees them
    seen = stand_in.pipeline(frames[-1])
    assert seen.valid
    assert np.linalg.norm(seen.graph.nodes_px - stand_in.pipeline.reference.pins_px, axis=1).max() > 4.0


@pytest.fixture
def ros2(monkeypatch):
    """Messages that this computer alone hears, as they are published; none is dropped for want of readers."""
    pytest.importorskip("cyclonedds", reason="cyclonedds (the extra ros2) is not installed")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.randrange(1, 230)))
    sent, write = {}, Writer.write

    def keep(self, message, at_ns):
        sent.setdefault(self.name, []).append(message)
        write(self, message, at_ns)

    monkeypatch.setattr(Writer, "write", keep)
    monkeypatch.setattr(Writer, "heard", True)
    return sent


def test_commands_publish_ros2_topics(stand_in, ros2, tmp_path):
    run("servo", "--object", "can", "--out", tmp_path / "servo", "--steps", STEPS, "--plain-light", "--ros2", "left/tactip")
    assert {"/left/tactip/image", "/left/tactip/contact_pose", "/left/tactip/points", "/tf", "/tf_static", "/diagnostics"} <= ros2.keys()
    moved = [decode("tf2_msgs/TFMessage", data)["transforms"][0] for data in ros2["/tf"]]
    assert {(each["header"]["frame_id"], each["child_frame_id"]) for each in moved} == {("base", "left_tactip_tool")}
    assert len({each["transform"]["translation"]["x"] for each in moved}) > 2
    place = decode("tf2_msgs/TFMessage", ros2["/tf_static"][0])["transforms"][0]
    assert (place["header"]["frame_id"], place["child_frame_id"]) == ("left_tactip_tool", "left_tactip_sensor")
    pose = decode("geometry_msgs/PoseWithCovarianceStamped", ros2["/left/tactip/contact_pose"][-1])
    image = [decode("sensor_msgs/Image", data)["header"]["stamp"] for data in ros2["/left/tactip/image"]]
    assert pose["header"]["stamp"] in image
    ros2.clear()
    folder = tmp_path / "servo" / "frames"
    folder.mkdir()
    write_image(folder / "frame_0.png", np.full(frame_size(stand_in.sensor, stand_in.form)[::-1], 90, np.uint8))
    stand_in.true = None
    run("live", "--camera", folder, "--headless", "--ros2", "tactip", "--rate", 50)
    assert {"/tactip/image", "/tactip/pose"} <= ros2.keys() and "/tf" not in ros2
    assert "expected a namespace" in refused("live", "--camera", folder, "--headless", "--ros2", "a b")


def test_a_dds_that_fails_does_not_stop_the_arm(stand_in, ros2, tmp_path, monkeypatch, caplog):
    def fail(self, frame):
        time.sleep(0.5)
        raise DeviceError("/tactip/image: not sent")

    out = tmp_path / "without"
    begun_s = time.monotonic()
    run("servo", "--object", "can", "--out", out, "--steps", STEPS, "--plain-light")
    without_s = time.monotonic() - begun_s
    monkeypatch.setattr("hardware.workcell.ros2.Ros2Publisher._publish_frame", fail)
    begun_s = time.monotonic()
    told = run("servo", "--object", "can", "--out", tmp_path / "with", "--steps", STEPS, "--plain-light", "--ros2", "tactip")
    assert f"{STEPS} steps" in told and time.monotonic() - begun_s < without_s + 5.0
    assert len([record for record in caplog.records if "not sent" in record.getMessage()]) == 1


def test_a_follow_that_ends_early_is_written_and_is_an_exit_code(stand_in, tmp_path, monkeypatch):
    monkeypatch.setattr(following, "GIVE_UP_S", 0.2)
    calls = []

    def fails_later(model, frame):
        calls.append(frame)
        model.true.fail = "no pins" if len(calls) > 4 else ""
        return model.true(frame)

    monkeypatch.setattr(StandIn, "__call__", fails_later)
    result = CliRunner().invoke(
        command_line(), ["servo", "--object", "can", "--model", "any", "--out", str(tmp_path), "--steps", "9", "--plain-light"]
    )
    assert result.exit_code == 1 and "ended early" in result.output and (tmp_path / "trajectory.csv").is_file()


def test_pins_are_counted_from_a_frame_taken_clear_of_the_object_and_so_they_are_in_a_replay(tmp_path):
    out = tmp_path / "servo"
    run("servo", "--object", "can", "--out", out, "--steps", 4, "--plain-light", "--record")
    rest = SessionSource(out / "session").session.rest
    pipeline = Pipeline(load_sensor("mg400-331"), Form.PROCESSED)
    seen = pipeline(rest)
    assert seen.valid and np.linalg.norm(seen.graph.nodes_px - pipeline.reference.pins_px, axis=1).max() < 1.0  # px: nothing is touched
    assert "4 of 4 estimates equal the recorded ones" in run("live", "--replay", out / "session", "--headless")
    (out / "session" / "rest.png").unlink()
    assert "4 of 4 estimates" not in run("live", "--replay", out / "session", "--headless")


def test_a_model_that_fails_is_a_result_of_the_study(stand_in, tmp_path, monkeypatch):
    monkeypatch.setattr(following, "GIVE_UP_S", 0.5)
    calls = {"count": 0}
    truth = StandIn.__call__

    def fails_later(model, frame):
        calls["count"] += 1
        if calls["count"] > 4:  # one before anything moves
            model.true.fail = "no pins"
        return truth(model, frame)

    StandIn.__call__ = fails_later
    try:
        told = run("study", "servo", "--model", "a/one", "--objects", "can", "--out", tmp_path, "--steps", STEPS, "--plain-light")
    finally:
        StandIn.__call__ = truth
    assert "ended early" in told and "no pins" in told
    with (tmp_path / "study.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["model"] == "one" and row["object"] == "can" and row["steps"] == "3"
    assert (tmp_path / "one" / "can" / "trajectory.csv").is_file() and (tmp_path / "study.png").is_file()
    assert 'href="one/can/index.html"' in (tmp_path / "index.html").read_text()


def test_collect_in_the_twin_makes_a_recording_that_is_gone_on_with(tmp_path):
    arguments = (
        "collect",
        "--camera",
        "twin",
        "--arm",
        "simulated",
        "--sensor",
        "mg400-331",
        "--out",
        tmp_path,
        "--plain-light",
        "--also",
        "huggingface",
        "--count",
    )
    assert "1 contact in" in run(*arguments, 1)
    assert len(open_records(tmp_path / "huggingface").episodes) == 1
    assert "(1 new)" in run(*arguments, 2)
    kept = open_records(tmp_path / "huggingface")
    assert len(kept.episodes) == 2 and kept.about.sensor == "mg400-331" and set(kept.about.numbers) == {"pins", "pose", "move", "action"}
    sensor = load_sensor("mg400-331")
    recording = open_recording(tmp_path, sensor)
    assert recording.form is Form.PROCESSED and len(recording) == 2 and not recording.problems
    pipeline, rest = Pipeline(sensor, Form.PROCESSED), recording.reference
    without = pipeline(rest).graph.nodes_px
    for frame in recording:
        assert np.linalg.norm(pipeline(frame).graph.nodes_px - without, axis=1).max() > 2.0


def test_a_replay_takes_no_other_frame_at_rest(tmp_path):
    with pytest.raises(OptionError, match="leave `at_rest` out"):
        run("live", "--replay", tmp_path, "--at-rest", "first", "--headless")


def test_live_records_and_replays_the_same(stand_in, tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(5):
        write_image(folder / f"frame_{k}.png", (rng.random((360, 360)) > 0.7).astype(np.uint8) * 255)
    told = run("live", "--camera", folder, "--model", "any", "--headless", "--record", tmp_path / "s", "--also", "lerobot")
    assert "5 steps" in told and "5 of 5 frames valid" in told
    assert [episode.length for episode in open_records(tmp_path / "s" / "lerobot").episodes] == [5]
    with pytest.raises(OptionError, match="`also` needs `record`"):
        run("live", "--camera", folder, "--model", "any", "--headless", "--also", "lerobot")
    assert "5 of 5 estimates" in run("live", "--replay", tmp_path / "s", "--model", "any", "--headless")


class ShownPictures(LiveSource):
    """A live source of given pictures, one after the other, again and again."""

    def __init__(self, images) -> None:
        super().__init__("pictures", Form.PROCESSED)
        self._images, self._next = images, 0

    def _open(self) -> None:
        pass

    def _close(self) -> None:
        pass

    def _grab(self) -> DevicePicture:
        self._end.wait(0.02)
        self._next += 1
        return DevicePicture(self._images[self._next % len(self._images)], time.monotonic())


@pytest.mark.slow
def test_a_camera_that_was_never_shown_a_rest_is_counted_from_where_its_contacts_tell():
    """As a recording of the same contacts is: here of another unit than the weights', over the emulated camera."""
    model = PoseEstimator.load("mg400-127")
    known = model.at_known_rest()
    rest_px = known.pipeline.reference.pins_px
    spread = np.random.default_rng(7).normal(size=(FEWEST_CONTACTS + 5, 6))
    moved = model.displacements.at(spread).reshape(len(spread), -1, 2)
    off_px = [0.1 * float(np.median(known.pipeline.reference.spacing_px)), 0.0]
    images = [drawn_frame(model.sensor, model.form, px).image for px in rest_px + off_px + moved]
    newest = []

    def keep(frame, estimate) -> None:
        newest[:] = [frame, estimate]
        if seeker.other and estimate.valid:
            raise KeyboardInterrupt

    seeker = model.seeking_rest()
    with CameraEmulator(ShownPictures(images)) as camera:
        count = 200 * len(images)  # ends a test that fails; a machine with other work needs more than twenty rounds
        watched = watch(WatchPlan(camera=camera.url, shown=False, count=count), seeker, on_estimate=keep)
    assert watched.interrupted, "the contacts told other rest places"
    frame, estimate = newest
    recorded, other = model.at_rest_of([Frame(image, model.form) for image in images])
    as_recorded, as_known = (each(frame).value - estimate.value for each in (recorded, known))
    assert other and np.abs(as_recorded).max() < 0.2 * np.abs(as_known).max(), (as_recorded, as_known)


def test_the_page_shows_the_newest_frame_with_estimate_and_rates():
    pipeline = Pipeline(load_sensor("mg400-331"), Form.RAW)
    view = LivePage("TacTip <live>", pipeline.spec, pipeline.reference)
    with NoisyCamera(fps=50, size_px=pipeline.size_px) as source:
        session = LiveSession(source, lambda frame: TrueEstimate(("pose_2",), np.ones(1), np.zeros(1), np.full(1, 2.0)))
        with Shower(session, pipeline, view):
            session.run(most=20)
            with StudioClient(view.url) as client:
                session.run(seconds=30.0, going=lambda: "frames/s" not in client.html())
                html = client.html()
    assert "+1.00" in html and "+0.00 to +2.00" in html and "TacTip &lt;live&gt;" in html and re.search(r"pins found: \d+ of 331", html)


def test_a_view_draws_pins_graph_cells_and_text():
    sensor = load_sensor("mg400-331")
    preview = preview_of(sensor, Form.PROCESSED)
    image = record(
        expose(preview.render(), sensor.capture, origin_px=preview.window_px[:2]), sensor.recording, origin_px=preview.window_px[:2]
    )
    pipeline = Pipeline(sensor, Form.PROCESSED)
    frame = Frame(image, Form.PROCESSED, "rest")
    seen = pipeline(frame)
    assert seen.valid
    same = voronoi_map(image.shape, seen, seen.graph.area_px2)
    other = voronoi_map(image.shape, seen, 0.5 * seen.graph.area_px2)
    inside = tuple(np.round(seen.graph.nodes_px[0]).astype(int)[::-1])
    assert tuple(same[inside]) != tuple(other[inside])
    camera, cells = frame_pictures(sensor, pipeline.reference, frame, seen)
    assert camera.shape == cells.shape == (*image.shape, 3)
    assert (camera[inside] != image[inside]).any()
    assert tuple(cells[inside]) == tuple(voronoi_map(image.shape, seen, pipeline.reference.area_px2)[inside])


def test_a_round_takes_the_tools_way():
    sensor, servo = load_sensor("mg400-331"), load_servo("surface")
    placed = PlacedObject(load_object("can"), servo.placement, Mounting.of(sensor, load_experiment(servo.experiment)))
    steps, way_mm = steps_round(placed, servo, 1.0)
    assert way_mm == pytest.approx(2 * np.pi * 33, rel=1e-3)
    assert way_mm <= steps * servo.feed_mm < way_mm + 2 * np.pi * 5


def refused(*arguments) -> str:
    """The one line that a command ends with."""
    result = CliRunner().invoke(command_line(), [str(a) for a in arguments])
    assert result.exit_code and isinstance(result.exception, TwinError), result.exception
    return str(result.exception)


def test_a_dry_run_tells_the_plan_and_moves_nothing(stand_in, tmp_path, monkeypatch, caplog):
    enabled = []
    monkeypatch.setattr(SimulatedArm, "enable", lambda arm: enabled.append(arm))
    told = run("servo", "--object", "can", "--model", "any", "--out", tmp_path / "s", "--steps", 3, "--plain-light", "--dry-run")
    common = ("--camera", "twin", "--arm", "simulated", "--sensor", "mg400-331", "--plain-light", "--count", 2)
    run("collect", *common, "--out", tmp_path / "c", "--dry-run")
    assert not enabled and "nothing was moved" in told
    assert all(caplog.text.count(f"{part}: ") >= 2 for part in ("camera", "path", "limits", "time"))


def test_what_is_not_attached_leaves_no_session_in_the_way(stand_in, tmp_path):
    common = ("--model", "any", "--record")
    told = refused(
        "servo", "--object", "can", "--arm", "mg400:127.0.0.1:1", "--camera", "twin", "--plain-light", "--out", tmp_path / "servo", *common
    )
    assert "twin emulate mg400" in told and not (tmp_path / "servo" / "session").exists()
    told = refused("live", "--camera", "http://127.0.0.1:1/", "--headless", *common, tmp_path / "live")
    assert "start the stream" in told and not (tmp_path / "live").exists()


def test_a_model_that_tells_something_else_is_refused_before_anything_moves(stand_in, tmp_path, monkeypatch):
    enabled = []
    monkeypatch.setattr(SimulatedArm, "enable", lambda arm: enabled.append(arm))
    other = TrueEstimate(("pose_3",), np.zeros(1), np.zeros(1), np.zeros(1))
    monkeypatch.setattr(StandIn, "__call__", lambda model, frame: other)
    told = refused("servo", "--object", "can", "--model", "any", "--out", tmp_path, "--steps", 3, "--plain-light")
    assert "pose_3" in told and "pose_2" in told and not enabled


def test_a_view_that_breaks_ends_the_session_with_its_error():
    class Broken(LivePage):
        def show(self, *_):
            raise ValueError("no such colour")

    pipeline = Pipeline(load_sensor("mg400-331"), Form.RAW)
    camera = NoisyCamera(fps=50, size_px=pipeline.size_px)
    session = LiveSession(camera, lambda frame: TrueEstimate(("pose_2",), *np.zeros((3, 1))))
    shower = Shower(session, pipeline, Broken("live", pipeline.spec, pipeline.reference))
    with session.source, pytest.raises(DeviceError, match="no such colour.*`headless`"), shower:
        session.run(seconds=30.0, going=lambda: shower.open)
    assert session.timing().steps < 1000  # it did not go on for half a minute


def test_a_view_that_can_not_be_opened_is_told_before_anything_is_recorded(stand_in, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", SimpleNamespace(RecordingStream=lambda title: None))
    (tmp_path / "frames").mkdir()
    write_image(tmp_path / "frames" / "frame_0.png", np.full((360, 360), 99, np.uint8))
    common = ("live", "--camera", tmp_path / "frames", "--model", "any", "--record", tmp_path / "s")
    told = refused(*common, "--rerun", "rerun+http://127.0.0.1:1/proxy")
    assert "start a viewer" in told and not (tmp_path / "s").exists()


def test_pins_are_not_counted_from_a_pressed_sensor(tmp_path):
    sensor = load_sensor("mg400-331")
    pipeline = Pipeline(sensor, Form.PROCESSED)
    rest_px = pipeline.reference.pins_px
    away = rest_px - rest_px.mean(axis=0)
    pressed_px = rest_px + 0.15 * away * np.exp(-((np.linalg.norm(away, axis=1) / 60.0)[:, None] ** 2))
    (tmp_path / "pressed").mkdir()
    write_image(tmp_path / "pressed" / "frame_0.png", drawn_frame(sensor, Form.PROCESSED, pressed_px).image)
    common = ("live", "--camera", tmp_path / "pressed", "--headless", "--record", tmp_path / "s", "--at-rest")
    told = refused(*common, "first")
    assert "seems pressed" in told and "`at_rest` FRAME" in told and not (tmp_path / "s").exists()
    assert "seems pressed" in refused(*common, tmp_path / "pressed" / "frame_0.png")


def test_an_emulator_that_fails_ends_with_its_error():
    device = nullcontext()
    device.place, device.error = "a device", DeviceError("the arm is gone")
    with pytest.raises(DeviceError, match="the arm is gone"):
        Emulator.run(device)


@pytest.mark.slow
def test_sigterm_makes_a_command_let_go_of_its_arm(tmp_path):
    offset = free_offset()
    port = 29999 + offset
    with Mg400Emulator(port_offset=offset) as arm:
        options = ["--camera", "twin", "--arm", f"mg400:127.0.0.1:{port}", "--sensor", "mg400-331", "--plain-light", "--out", str(tmp_path)]
        command = [sys.executable, "-c", "from twin.cli import main; main()", "collect", *options]
        with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
            while not arm.arm.busy() and process.poll() is None:
                time.sleep(0.01)
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=60) == 143
        assert not arm.arm.enabled and not arm.arm.busy()
