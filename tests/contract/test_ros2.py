"""ROS 2 topics over real sockets: what is published, what other DDS code reads, and a topic as a camera. Everything stays on loopback."""

import logging
import random
import shutil
import struct
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from any_message import KINDS, messages
from noisy_camera import NoisyCamera, number_of
from rosbags.typesys import Stores, get_typestore
from true_estimator import TrueEstimate

pytest.importorskip("cyclonedds", reason="cyclonedds (the extra ros2) is not installed")

from drawn_frames import drawn_frame
from hypothesis import HealthCheck, given, settings

from hardware.cameras.mjpeg import jpeg_of
from hardware.cameras.reader import LiveSource, ReadFailed
from hardware.cameras.source import Ros2Camera, open_camera
from hardware.errors import DeviceError
from hardware.live.doctor import ros2_topics
from hardware.ros2 import dds
from hardware.ros2.dds import Participant, domain_id
from hardware.workcell import ros2 as publish
from hardware.workcell.ros2 import SENSOR_TOPICS, TOPICS, Ros2Publisher, namespace_of
from scenes import load_sensor
from twin.contracts import CameraContract
from twin.errors import OptionError
from twin.geometry.pins import rest_pins
from twin.pins import Pipeline
from twin.records.ros2 import decode, encode, full_name
from twin.types import Form, Frame

ROS = get_typestore(Stores.ROS2_HUMBLE)
NAMES = ("pose_2", "pose_6", "Fx", "Fy", "Fz", "slip_begins")
WAIT_S = 10.0


@pytest.fixture(scope="module", autouse=True)
def own_domain():
    """A domain of this process alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_LOCALHOST_ONLY", "1")
        patch.setenv("ROS_DOMAIN_ID", str(random.randrange(1, 230)))
        yield


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("mg400-331")


class Heard:
    """Reads topics with Cyclone DDS's own types and decoder, which share no code with the program's."""

    def __init__(self, **topics):
        from cyclonedds.sub import DataReader

        self._participant = Participant()._participant
        topic, qos = dds._topic, dds._qos
        from cyclonedds.core import Policy

        self._readers = {}
        for name, kind in topics.items():
            best = qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, 20)
            self._readers[name] = DataReader(self._participant, topic(self._participant, name.replace("__", "/"), kind), best)

    def wait(self, name, timeout_s=WAIT_S):
        """The newest message of a topic."""
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            if found := self._readers[name].take(N=20):
                return found[-1]
            time.sleep(0.005)
        raise TimeoutError(name)

    def none(self, name):
        time.sleep(0.3)
        return not self._readers[name].take(N=20)


def heard_topics():
    names = {topic if topic.startswith("/") else f"/tactip/{topic}": kind for topic, kind in (SENSOR_TOPICS | TOPICS).items()}
    return Heard(**{name.replace("/", "__"): kind for name, kind in names.items()})


def until(condition, timeout_s=WAIT_S):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "it did not happen in time"
        time.sleep(0.01)


class Given(LiveSource):
    """A source that delivers nothing by itself."""

    def __init__(self):
        super().__init__("given", Form.RAW)

    def _open(self): ...
    def _close(self): ...
    def _grab(self):
        self._end.wait(0.05)
        raise ReadFailed("nothing yet")


def estimate(valid=True, reason=""):
    value = np.array([1.5, -20.0, 0.1, 0.2, 3.0, 0.9])
    return TrueEstimate(NAMES, value, value - 0.329, value + 0.329, valid, reason)


def pinned_frame(sensor):
    """A frame with all pins at rest, exposed 0.1 s ago."""
    pipeline = Pipeline(sensor, Form.RAW)
    drawn = drawn_frame(sensor, Form.RAW, pipeline.reference.pins_px)
    return Frame(drawn.image, Form.RAW, "drawn", time.monotonic() - 0.1, 7), pipeline


@pytest.fixture
def published(sensor):
    """A publisher, what hears it, and a frame with all pins."""
    frame, pipeline = pinned_frame(sensor)
    source = Given()
    with Ros2Publisher("tactip", source, pipeline) as publisher:
        heard = heard_topics()
        until(lambda: all(publisher._writers[t].heard for t in SENSOR_TOPICS | TOPICS))
        yield publisher, heard, frame, pipeline


def test_every_topic_of_a_valid_estimate(published):
    publisher, heard, frame, pipeline = published
    publisher.offer(frame, estimate())
    image = heard.wait("__tactip__image")
    assert (image.width, image.height, image.encoding, image.step) == (*frame.image.shape[::-1], "mono8", frame.image.shape[1])
    np.testing.assert_array_equal(np.array(image.data, np.uint8).reshape(frame.image.shape), frame.image)
    stamp_s = image.header.stamp.sec + image.header.stamp.nanosec / 1e9
    assert time.time() - stamp_s == pytest.approx(time.monotonic() - frame.time_s, abs=0.02)
    assert image.header.frame_id == "tactip_sensor"
    coded = heard.wait("__tactip__image__compressed")
    assert coded.format == "jpeg" and bytes(coded.data) == jpeg_of(frame.image, publish.JPEG_QUALITY)
    pose = heard.wait("__tactip__contact_pose")
    assert pose.header.frame_id == "tactip_contact" and pose.header.stamp == image.header.stamp
    assert pose.pose.pose.position.y == pytest.approx(0.0015)  # m
    assert pose.pose.pose.orientation.z == pytest.approx(np.sin(np.radians(-10)))
    cov = np.array(pose.pose.covariance).reshape(6, 6)
    assert cov[1, 1] == pytest.approx((0.2e-3) ** 2) and cov[5, 5] == pytest.approx(np.radians(0.2) ** 2) and cov[0, 0] == publish.UNKNOWN
    assert heard.wait("__tactip__pose").twist.linear.y == 1.5  # mm, as the public stack has it
    wrench = heard.wait("__tactip__wrench")
    assert (wrench.wrench.force.x, wrench.wrench.force.z) == (0.1, 3.0) and np.isnan(wrench.wrench.torque.x)
    assert heard.wait("__tactip__contact").data == 1
    assert heard.wait("__tactip__slip").data == pytest.approx([0.9])
    for name, shift in (("estimate", 0.0), ("estimate_low", -0.329), ("estimate_high", 0.329)):
        array = heard.wait(f"__tactip__{name}")
        assert array.layout.dim[0].label == ",".join(NAMES) and array.data[0] == pytest.approx(1.5 + shift)
    pins = np.array(heard.wait("__tactip__pins").data).reshape(-1, 2)
    assert np.nanmax(np.abs(pins - pipeline.reference.pins_px)) < 1.0
    cloud = heard.wait("__tactip__points")
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 7)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "u", "v", "du", "dv"] and cloud.width == len(pins)
    np.testing.assert_allclose(points[:, 3:5], pins, atol=1e-3)
    np.testing.assert_allclose(points[:, :3], rest_pins(pipeline.spec.geometry).caps_mm / 1e3, atol=1e-3)  # rest_px are of a real unit
    spheres, lines = heard.wait("__tactip__markers").markers
    assert len(spheres.points) == len(pins) and len(lines.points) == 2 * len(pins) and spheres.ns == "tactip"
    parts = {status.name: status for status in heard.wait("__diagnostics").status}
    assert parts["tactip: estimate"].level == 0 and parts["tactip: estimate"].message == "valid"
    assert "1.5 [1.171, 1.829] mm" in [pair.value for pair in parts["tactip: estimate"].values]


def test_nothing_of_an_estimate_that_is_not_valid_is_published(published):
    publisher, heard, frame, _ = published
    publisher.offer(frame, estimate(False, "an unknown contact"))
    parts = {status.name: status for status in heard.wait("__diagnostics").status}
    assert parts["tactip: estimate"].level == 1 and parts["tactip: estimate"].message == "not valid: an unknown contact"
    assert not parts["tactip: estimate"].values
    assert np.isnan(heard.wait("__tactip__estimate").data).all()
    for topic in ("pose", "contact_pose", "wrench", "contact", "slip"):
        assert heard.none(f"__tactip__{topic}")


def test_the_newest_wins_and_nobody_waits(published, monkeypatch):
    publisher, heard, frame, _ = published
    gate = threading.Event()
    write, sent = dds.Writer.write, []

    def slow(self, message, at_ns):
        gate.wait(WAIT_S)
        sent.append(self.name)
        write(self, message, at_ns)

    monkeypatch.setattr(dds.Writer, "write", slow)
    begun_s = time.monotonic()
    for k in range(100):
        publisher.offer(Frame(frame.image, Form.RAW, "", frame.time_s, k), estimate())
    assert time.monotonic() - begun_s < 0.1  # while the thread is stuck in the first message
    gate.set()
    time.sleep(1.0)
    assert sent.count("/tactip/image") <= 2


def test_a_failure_is_said_once_and_forgiven(published, monkeypatch, caplog):
    publisher, heard, frame, _ = published
    broken = threading.Event()
    broken.set()
    write = dds.Writer.write

    def fail(self, message, at_ns):
        if broken.is_set():
            raise DeviceError("/tactip/image: not sent (DDS code -1)")
        write(self, message, at_ns)

    monkeypatch.setattr(dds.Writer, "write", fail)
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            publisher.offer(Frame(frame.image, Form.RAW, "", frame.time_s), estimate())
            time.sleep(0.05)
    said = [record.getMessage() for record in caplog.records if "ROS 2" in record.getMessage()]
    assert len(said) == 1 and "not sent" in said[0] and "goes on" in said[0]
    broken.clear()
    publisher.offer(Frame(frame.image, Form.RAW, "", frame.time_s), estimate())
    assert heard.wait("__tactip__pose").twist.linear.y == 1.5


def test_a_silent_camera_is_an_error_in_the_diagnostics(published):
    publisher, heard, _, _ = published
    publisher._source.blind = lambda: "no new picture for 3.0 s"
    parts = {status.name: status for status in heard.wait("__diagnostics").status}
    assert parts["tactip: camera"].level == 2 and "no new picture" in parts["tactip: camera"].message


@pytest.mark.parametrize("name", ["", "/", "a b", "1a", "a//b", "a__b", "é"])
def test_a_name_that_ros_refuses(name):
    with pytest.raises(OptionError, match="`ros2` .*expected a namespace"):
        namespace_of(name)


@pytest.mark.parametrize("text", ["233", "-1", "x"])
def test_a_domain_that_is_none(text, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    with pytest.raises(DeviceError, match="ROS_DOMAIN_ID=.*expected 0 to 232"):
        domain_id()


@pytest.fixture(scope="module")
def fast_dds(tmp_path_factory):
    """A program that reads and writes messages with Fast DDS, which is another implementation of DDS, and what ROS 2 uses by default."""
    program = tmp_path_factory.mktemp("fast") / "fast_dds"
    source = Path(__file__).parents[1] / "helpers" / "fast_dds.cpp"
    if shutil.which("g++") is None or not Path("/usr/include/fastdds").is_dir():
        pytest.skip("Fast DDS is not installed: apt-get install g++ libfastrtps-dev")
    subprocess.run(["g++", "-O1", "-std=c++17", str(source), "-o", str(program), "-lfastrtps", "-lfastcdr"], check=True)
    return program


@pytest.mark.parametrize("kind", sorted({*SENSOR_TOPICS.values(), *TOPICS.values()}))
def test_fast_dds_and_this_program_read_each_other(fast_dds, kind):
    """Messages with any content go both ways between two processes and come back as they were; an independent library decodes them."""
    package, name = kind.split("/")
    made = []

    @settings(max_examples=8, suppress_health_check=list(HealthCheck), deadline=None)
    @given(messages(kind))
    def collect(message):
        made.append(encode(kind, message))

    collect()
    where = [f"rt/x/{name}", f"{package}::msg::dds_::{name}_", "2.5"]
    participant = Participant()
    writer, reader = participant.writer(f"/x/{name}", kind), participant.reader(f"/back/{name}", kind)
    theirs = subprocess.Popen([fast_dds, "read", str(domain_id()), *where], stdout=subprocess.PIPE)
    until(lambda: writer.heard)
    time.sleep(0.5)  # until the other side knows it, too
    for data in made:
        writer.write(data, time.time_ns())
        time.sleep(0.01)
    got, at = theirs.communicate(timeout=WAIT_S)[0], 0
    came = []
    while at < len(got):
        size = struct.unpack_from("<I", got, at)[0]
        came.append(got[at + 4 : at + 4 + size])
        at += 4 + size
    padded = [data + bytes(-len(data) % 4) for data in made]
    assert came == padded
    assert all(ROS.deserialize_cdr(data, full_name(kind)) is not None for data in came)
    back = subprocess.Popen([fast_dds, "write", str(domain_id()), f"rt/back/{name}", *where[1:]], stdin=subprocess.PIPE)
    until(lambda: reader.served)
    time.sleep(0.3)
    taken = []
    for data in padded:
        back.stdin.write(struct.pack("<I", len(data)) + data)
        back.stdin.flush()
        taken += reader.take()
    back.stdin.close()
    assert taken == padded
    back.wait(WAIT_S)


class Pictures:
    """Publishes pictures as a topic, as any ROS node would."""

    def __init__(self, topic="/cam/image", kind="sensor_msgs/Image", **changed):
        self._writer = Participant().writer(topic, kind, sensor=True)
        self.kind, self.changed, self.number = kind, changed, 0
        self._rng = np.random.default_rng(0)
        self._end = threading.Event()
        self.paused = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._end.set()
        self._thread.join()

    def message(self):
        self.number += 1
        image = self._rng.integers(60, 200, (48, 64), np.uint8)
        image[:16, :16] = 10 * (self.number % 20) + 30
        now_ns = time.time_ns()
        header = {"stamp": {"sec": now_ns // 10**9, "nanosec": now_ns % 10**9}, "frame_id": "cam"}
        if self.kind == "sensor_msgs/CompressedImage":
            return {"header": header, "format": "jpeg", "data": jpeg_of(image)} | self.changed
        return {"header": header, "height": 48, "width": 64, "encoding": "mono8", "step": 64, "data": image.tobytes()} | self.changed

    def _run(self):
        while not self._end.wait(0.02):
            if not self.paused.is_set():
                self._writer.write(encode(self.kind, self.message()), time.time_ns())


class TestImageTopic(CameraContract):
    kind = "sensor_msgs/Image"

    def open(self, stack):
        stack.enter_context(Pictures(kind=self.kind))
        return open_camera("ros2:/cam/image")


class TestCompressedTopic(TestImageTopic):
    kind = "sensor_msgs/CompressedImage"


def test_stamps_are_exposures_and_pictures_are_whole():
    with Pictures(), Ros2Camera("cam/image") as camera:
        asked_s = time.monotonic()
        frame = camera.read_after(asked_s, timeout_s=WAIT_S)
        assert asked_s < frame.time_s <= time.monotonic()
        assert number_of(frame.image) == number_of(frame.image) % 20


def test_silence_torn_and_repeated_pictures_are_counted():
    with Pictures() as pictures, Ros2Camera("/cam/image") as camera:
        camera.read(timeout_s=WAIT_S)
        time.sleep(0.3)
        pictures.changed = {"data": b"123"}
        until(lambda: camera._torn)
        pictures.changed = {}
        camera.read(timeout_s=WAIT_S)
        until(lambda: not camera.blind())
        pictures.paused.set()
        until(lambda: "no new picture" in camera.blind())
        time.sleep(0.4)
        pictures.paused.clear()
        until(lambda: not camera.blind())
        message = pictures.message()
        pictures.changed = {key: message[key] for key in ("data",)}
        until(lambda: camera.fault)
        with pytest.raises(DeviceError, match="frozen"):
            camera.read_latest()
        notes = "\n".join(camera.notes())
    assert "outage" in notes and "incomplete or damaged" in notes and "an incomplete picture (3 bytes for 64 x 48, mono8)" in notes
    assert "repeat the one before" in notes


@pytest.mark.parametrize(
    ("encoding", "channels", "first"), [("rgb8", 3, 0), ("bgr8", 3, 2), ("rgba8", 4, 0), ("bgra8", 4, 2), ("8UC1", 1, 0)]
)
def test_encodings(encoding, channels, first):
    image = np.random.default_rng(3).integers(0, 255, (48, 64, channels), np.uint8)
    padded = np.concatenate([image.reshape(48, -1), np.zeros((48, 5), np.uint8)], axis=1)  # rows may be longer than their pixels
    with Pictures(encoding=encoding, step=padded.shape[1], data=padded.tobytes()), Ros2Camera("/cam/image") as camera:
        got = camera.read(timeout_s=WAIT_S).image
    np.testing.assert_array_equal(got if channels == 1 else got[..., 0], image[..., first])


def test_an_encoding_that_is_not_read_names_the_remedy():
    with (
        Pictures(encoding="bayer_rggb8"),
        Ros2Camera("/cam/image") as camera,
        pytest.raises(DeviceError, match="encoding bayer_rggb8; publish mono8"),
    ):
        camera.read(timeout_s=WAIT_S)


def test_topics_that_are_no_pictures_or_not_there():
    with Pictures(topic="/there/image"), Pictures(topic="/other", kind="sensor_msgs/CompressedImage"):
        keep = Participant().writer("/wrench", "geometry_msgs/WrenchStamped")
        with pytest.raises(DeviceError, match="nobody publishes it in domain .*; topics with pictures: /other, /there/image"):
            Ros2Camera("/nowhere").connect()
        with pytest.raises(DeviceError, match="its messages are geometry_msgs/WrenchStamped, no pictures"):
            Ros2Camera("/wrench").connect()
        found = {device.node: device.description for device in ros2_topics()}
        assert found["ros2:/there/image"] == "sensor_msgs/Image" and found["/wrench"] == "geometry_msgs/WrenchStamped"
        del keep


def test_a_published_sensor_is_a_camera(sensor):
    """The two ends together: a live source is published as it delivers, and read as a camera; sensors are apart by their namespaces."""
    source = NoisyCamera(fps=50)
    with source, Ros2Publisher("left/tactip", source, Pipeline(sensor, Form.RAW)), Ros2Camera("/left/tactip/image") as camera:
        frame = camera.read_after(time.monotonic(), timeout_s=WAIT_S)
        assert frame.image.shape == (48, 64)


def test_messages_that_are_needed_are_defined():
    assert {*SENSOR_TOPICS.values(), *TOPICS.values()} <= {*KINDS}
    assert decode("std_msgs/Int8", encode("std_msgs/Int8", {"data": -3})) == {"data": -3}
