"""One suite over every frame source: the twin, a folder, a video, a session, a stream over a real socket, a USB camera."""

import re
import socket
import tempfile
import threading
import time
import urllib.request
from contextlib import contextmanager, suppress
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from noisy_camera import NoisyCamera, number_of

from hardware.arms.arm import SimulatedArm
from hardware.cameras import reader
from hardware.cameras.mjpeg import CONTENT_TYPE, MjpegCamera, Parts, jpeg_of, write_part
from hardware.cameras.reader import FIRST_PERIODS, MOST_FAILED_READS, OUTAGE_PERIODS, ReadFailed
from hardware.cameras.source import FrameSource, UvcCamera, apply_settings, exposed_s, measure_settings, node_at, open_camera
from hardware.cameras.twin import TwinCamera
from hardware.emulators.camera import CameraEmulator
from hardware.errors import DeviceError, StaleDataError
from hardware.live.doctor import cameras
from hardware.live.examining import frames_of
from hardware.live.lerobot import LeRobotCamera
from hardware.rig.geometry import PlacedObject
from scenes import PlacementSpec, load_experiment, load_object, load_sensor
from twin.contracts import CameraContract
from twin.errors import FrameError
from twin.frames.images import write_image
from twin.records.session import SessionWriter
from twin.rig.kinematics import Mounting
from twin.types import Form, Frame

COUNT = 6  # frames of the recorded sources
WAIT_S = 60.0  # for the twin's first frame, whose kernels may have to be compiled


def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.integers(40, 220, (48, 64), np.uint8) for _ in range(COUNT)]


def make_folder(path: Path) -> str:
    path.mkdir()
    for k, image in enumerate(pictures()):
        write_image(path / f"frame_{k}.png", image)
    return str(path)


def make_video(path: Path) -> str:
    file = path.with_suffix(".avi")
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48), False)
    for image in pictures():
        writer.write(image)
    writer.release()
    return str(file)


def make_session(path: Path) -> str:
    with SessionWriter(path, {}) as session:
        for k, image in enumerate(pictures()):
            session.append(Frame(image, Form.RAW, f"f{k}", 10.0 + k, k + 1), {})
    return str(path)


def twin_camera(**options) -> tuple[SimulatedArm, TwinCamera]:
    sensor = load_sensor("mg400-331")
    placed = PlacedObject(load_object("plane"), PlacementSpec(), Mounting.of(sensor, load_experiment("surface-2d")))
    arm = SimulatedArm(axes=6, pose=placed.start_pose(0.5), time_scale=20.0)
    arm.connect()
    arm.enable()
    return arm, TwinCamera(sensor, placed, arm.state, Form.PROCESSED, **options)


@pytest.fixture(scope="module")
def twin():
    """One twin for all: its solver is slow to begin."""
    arm, camera = twin_camera()
    yield camera
    camera.disconnect()
    arm.disconnect()


@pytest.fixture(params=["twin", "folder", "video", "session", "mjpeg", "uvc"])
def source(request, tmp_path):
    if request.param == "twin":
        camera = request.getfixturevalue("twin")
        camera.disconnect()
        yield camera
        camera.disconnect()
        return
    if request.param == "uvc":
        found = cameras()
        if not found:
            pytest.skip("no camera is attached to this machine")
        yield open_camera(found[0].node)
        return
    if request.param == "mjpeg":
        with CameraEmulator(NoisyCamera()) as emulator:
            yield open_camera(emulator.url)
        return
    make = {"folder": make_folder, "video": make_video, "session": make_session}[request.param]
    yield open_camera(make(tmp_path / "recorded"))


class OfRecording(CameraContract):
    """The contract on pictures that were recorded."""

    def open(self, stack):
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        return open_camera(self.make(Path(folder) / "recorded"))


class TestFolder(OfRecording):
    make = staticmethod(make_folder)


class TestVideo(OfRecording):
    make = staticmethod(make_video)


class TestSession(OfRecording):
    make = staticmethod(make_session)


class TestHttp(CameraContract):
    def open(self, stack):
        return open_camera(stack.enter_context(CameraEmulator(NoisyCamera())).url)


class TestTwin(CameraContract):
    wait_s = WAIT_S

    def open(self, stack):
        arm, camera = twin_camera()
        stack.callback(arm.disconnect)
        return camera


def test_the_latest_may_be_read_again_and_a_recording_ends(source: FrameSource):
    with source:
        first = source.read(timeout_s=WAIT_S)
        latest = source.read_latest(max_age_s=WAIT_S)
        assert latest.sequence >= first.sequence
        if source.is_live:
            after = source.read_after(time.monotonic(), timeout_s=WAIT_S)
            assert after.time_s > latest.time_s
            with pytest.raises(TimeoutError):
                source.read_after(time.monotonic() + 3600.0, timeout_s=0.05)
            with pytest.raises(StaleDataError):
                source.read_latest(max_age_s=-1.0)
        else:
            assert source.dropped == 0
            for _ in range(COUNT - 1):
                source.read()
            with pytest.raises(EOFError):
                source.read()


def test_every_live_frame_is_delivered_or_counted_as_dropped(source: FrameSource):
    if not source.is_live:
        pytest.skip("a recording drops nothing")
    with source:
        for _ in range(3):
            source.read(timeout_s=WAIT_S)
            time.sleep(0.1)
        with source._new:
            assert source.arrived == source.delivered + source.dropped


def test_the_lerobot_shape(source: FrameSource):
    camera = LeRobotCamera(source)
    if source.is_live:
        source.connect()
        source.read(timeout_s=WAIT_S)
        source.disconnect()
    camera.connect(warmup=True)
    assert camera.is_connected
    assert camera.read().dtype == np.uint8
    assert camera.read_latest(max_age_ms=1e3 * WAIT_S).ndim in (2, 3)
    if source.is_live:
        assert camera.async_read(timeout_ms=1e3 * WAIT_S).size
        with pytest.raises(TimeoutError):
            camera.read_latest(max_age_ms=-1)
    camera.disconnect()
    assert not camera.is_connected
    assert isinstance(LeRobotCamera.find_cameras(), list)


def test_a_folders_pictures_come_as_they_are(tmp_path):
    for make in (make_folder, make_session):
        with open_camera(make(tmp_path / make.__name__)) as source:
            for image in pictures():
                np.testing.assert_array_equal(source.read().image, image)


class TestStream:
    """What may go wrong with a camera, over a real socket."""

    @pytest.fixture
    def stream(self):
        with CameraEmulator(NoisyCamera(fps=60)) as emulator, MjpegCamera(emulator.url) as camera:
            camera.read(timeout_s=5)
            yield emulator, camera

    def test_pictures_are_new_and_their_exposure_is_known(self, stream):
        _, camera = stream
        frame = camera.read_after(time.monotonic(), timeout_s=2)
        assert 0 <= time.monotonic() - frame.time_s < 1.0
        assert number_of(frame.image) == number_of(frame.image) % 20

    def test_a_frozen_picture_is_noticed_and_forgiven(self, stream):
        emulator, camera = stream
        emulator.faults.add("frozen")
        self._until(lambda: camera.fault)
        with pytest.raises(DeviceError, match="frozen"):
            camera.read_latest()
        emulator.faults.clear()
        self._until(lambda: not camera.fault)
        assert camera.read(timeout_s=2).image.size
        assert any("pictures repeat the one before them" in note for note in camera.notes())

    def test_a_black_picture_is_noticed(self, stream):
        emulator, camera = stream
        emulator.faults.add("black")
        self._until(lambda: camera.fault)
        with pytest.raises(DeviceError, match="black"):
            camera.read()

    def test_a_torn_jpeg_is_never_handed_out(self, stream):
        emulator, camera = stream
        emulator.faults.add("torn=3")
        self._until(lambda: camera.failed >= 3)
        frames = [camera.read(timeout_s=2) for _ in range(5)]
        assert all(frame.image.shape == (48, 64) for frame in frames)
        assert all(frame.image[-8:].std() > 10 for frame in frames)  # noise down to the last rows
        assert any(re.match(r"pictures left out, incomplete or damaged: [3-9]\d*; the last: an incomplete JPEG", n) for n in camera.notes())

    def test_lost_pictures_are_counted(self, stream):
        emulator, camera = stream
        before = camera.arrived
        emulator.faults.add("dropped=2")
        made = emulator.made
        for _ in range(5):
            camera.read(timeout_s=2)
        assert camera.arrived - before >= emulator.made - made - 4  # those on the way
        with camera._new:
            assert camera.arrived == camera.delivered + camera.dropped

    def test_late_pictures_are_told_by_their_age(self, stream):
        emulator, camera = stream
        emulator.faults.add("late=0.4")
        asked_s = time.monotonic()
        frame = camera.read_after(asked_s, timeout_s=3)
        assert time.monotonic() - asked_s > 0.35
        assert asked_s < frame.time_s < time.monotonic() - 0.35
        with pytest.raises(StaleDataError):
            camera.read_latest(max_age_s=0.2)

    def test_unplugged_and_back(self, stream):
        emulator, camera = stream
        self._until(lambda: camera.arrived > OUTAGE_PERIODS)  # the usual time between pictures is known
        emulator.faults.add("unplugged=0.8")
        with pytest.raises((TimeoutError, DeviceError)):
            camera.read_after(time.monotonic() + 0.1, timeout_s=0.5)
        assert camera.read_after(time.monotonic(), timeout_s=5).image.size
        assert camera.failed > 0
        assert re.match(r"\d outages? of the camera, \d\.\d s in all, the longest (0\.[5-9]|[1-9])", camera.notes()[0])

    def test_unplugged_for_good_ends_with_a_clear_error(self, stream):
        emulator, camera = stream
        emulator.faults.add("unplugged=60")
        deadline = time.monotonic() + 10
        with pytest.raises(DeviceError, match=f"{MOST_FAILED_READS + 1} reads in a row failed"):
            while time.monotonic() < deadline:
                try:
                    camera.read_after(time.monotonic(), timeout_s=0.2)
                except TimeoutError:
                    continue

    def test_nothing_there_says_so(self):
        with pytest.raises(DeviceError, match="no answer"):
            MjpegCamera("http://127.0.0.1:9/stream").connect()
        with pytest.raises(DeviceError, match="http"):
            MjpegCamera("rtsp://somewhere/stream")
        with pytest.raises(DeviceError, match="rtsp://127.0.0.1:1/live: can't be opened; check the address, the login") as refused:
            open_camera("rtsp://admin:s3cret@127.0.0.1:1/live").connect()
        assert "s3cret" not in str(refused.value)

    @pytest.mark.parametrize("url", ["http://127.0.0.1:99999/x", "http://127.0.0.1:port/x", "http://[::1/x", "ftp://127.0.0.1/x"])
    def test_what_is_no_address_says_so(self, url):
        with pytest.raises(DeviceError, match="expected http"):
            MjpegCamera(url)

    def test_ffmpeg_reads_what_it_opens(self, stream):
        emulator, _ = stream
        with open_camera(f"ffmpeg:{emulator.url}") as camera:
            frame = camera.read_after(camera.read(timeout_s=WAIT_S).time_s, timeout_s=WAIT_S)
            assert frame.image.shape[:2] == (48, 64)
            emulator.faults.add("unplugged=0.5")
            time.sleep(1.0)
            assert camera.read_after(time.monotonic(), timeout_s=WAIT_S).image.size

    def test_opencv_opens_the_emulators_stream_too(self, stream):
        emulator, _ = stream
        capture = cv2.VideoCapture(emulator.url, cv2.CAP_FFMPEG)
        good, image = capture.read()
        capture.release()
        assert good and image.shape == (48, 64, 3)

    @staticmethod
    def _until(condition, timeout_s: float = 5.0):
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, "it did not happen in time"
            time.sleep(0.01)


@contextmanager
def served(script):
    """The address of a foreign stream, which ``script`` writes to the connection's file."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.end_headers()
            with suppress(OSError):
                script(self.wfile)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


def write_pictures(out, *, count=10**6, headers=lambda: {}):
    for k in range(count):
        write_part(out, jpeg_of(pictures()[k % COUNT]), headers())
        time.sleep(0.01)


def test_a_stream_that_drips_is_left_at_once():
    def drip(out):
        write_pictures(out, count=2)
        out.write(b"--frame\r\nContent-Length: 90000\r\n\r\n")
        while True:
            out.write(b"\xff")
            time.sleep(0.05)

    with served(drip) as url:
        camera = MjpegCamera(url)
        camera.connect()
        camera.read(timeout_s=5.0)
        time.sleep(0.1)
        begun_s = time.monotonic()
        camera.disconnect()
        assert time.monotonic() - begun_s < 1.0


def test_frames_of_another_clock_are_told():
    """A camera's computer whose clock jumps: all frames seem old, and would be waited out one by one."""
    jumped = threading.Event()

    def stamped():
        return {"X-Timestamp": f"{time.time() - 40.0 * jumped.is_set():.6f}"}

    with served(lambda out: write_pictures(out, headers=stamped)) as url, MjpegCamera(url) as camera:
        camera.read(timeout_s=5.0)
        jumped.set()
        begun_s = time.monotonic()
        with pytest.raises(DeviceError, match="40 s old.*clock"):
            camera.read_after(begun_s, timeout_s=5.0)
        assert time.monotonic() - begun_s < 1.0
        jumped.clear()
        time.sleep(0.1)
        assert camera.read(timeout_s=2.0).image.size


def test_pictures_of_another_size_name_the_camera_once():
    with served(write_pictures) as url, MjpegCamera(url, load_sensor("mg400-331")) as camera:
        with pytest.raises(DeviceError, match="delivers 64x48") as refused:
            camera.read(timeout_s=5.0)
        assert str(refused.value).count(url) == 1


class TestUvc:
    """Against a device that takes the settings, except that it is slower than requested."""

    class Device:
        def __init__(self):
            self.log, self.values = [], {}

        def set(self, key, value):
            self.log.append(key)
            self.values[key] = 15.0 if key == cv2.CAP_PROP_FPS else value
            return True

        def get(self, key):
            return self.values.get(key, -1.0)

    def test_they_are_asked_for_in_order_and_read_back(self):
        device = self.Device()
        rate = apply_settings(device, 320, 240)
        order = [
            cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS, cv2.CAP_PROP_BUFFERSIZE,
            cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_WB, cv2.CAP_PROP_AUTOFOCUS,
        ]  # fmt: skip
        assert device.log == order
        assert rate == 15.0 and device.values[cv2.CAP_PROP_FRAME_WIDTH] == 320

    def test_a_setting_that_does_nothing_is_found_out_by_the_pictures(self):
        """Each camera says yes to every setting; it ignores some of them."""

        class Real(self.Device):
            rng = np.random.default_rng(0)
            pattern = np.kron(rng.integers(0, 2, (12, 16)), np.ones((4, 4)))

            def __init__(self, obeys):
                super().__init__()
                self.obeys = obeys

            def read(self):
                light = self.values.get(cv2.CAP_PROP_EXPOSURE, 78.0) if "exposure" in self.obeys else 78.0
                light *= 1 + self.values.get(cv2.CAP_PROP_GAIN, 0.0) / 10 if "gain" in self.obeys else 1.0
                image = self.pattern * light + 20
                if "focus" in self.obeys:
                    image = cv2.GaussianBlur(image, (0, 0), 0.3 + abs(self.values.get(cv2.CAP_PROP_FOCUS, 0) - 120) / 40)
                return True, np.clip(image + self.rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)

        asked = {"exposure": 7.8, "gain": 8.0, "focus": 120.0}
        for obeys in ((), ("exposure",), ("gain", "focus"), tuple(asked)):
            device = Real(obeys)
            ignored = [line.partition("=")[0].split()[-1] for line in measure_settings(device, asked)]
            assert ignored == [name for name in asked if name not in obeys]
            assert device.values[cv2.CAP_PROP_EXPOSURE] == 78.0 and device.values[cv2.CAP_PROP_FOCUS] == 120.0

    @pytest.mark.parametrize("text", ["0?exposure=x", "0?shine=3", "0?exposure", "/dev/video0?gain=-1", "usb:1-1?focus=inf"])
    def test_settings_that_are_none(self, text):
        with pytest.raises(DeviceError, match="expected exposure, gain, focus and numbers"):
            open_camera(text)

    def test_equal_cameras_are_told_apart_by_their_ports(self, tmp_path):
        """A tree as the kernel's: each camera has two nodes, and the first one gives the pictures."""
        for number, port in enumerate(["1-1.2", "1-1.2", "1-1.4", "1-1.4"]):
            device = tmp_path / "devices" / f"usb1/{port}/{port}:1.0"
            device.mkdir(parents=True, exist_ok=True)
            (tmp_path / "list" / f"video{number}").mkdir(parents=True)
            (tmp_path / "list" / f"video{number}" / "device").symlink_to(device)
            (tmp_path / "list" / f"video{number}" / "name").write_text("USB Camera\n")
        found = tmp_path / "list"
        assert node_at("usb:1-1.2", found) == "/dev/video0" and node_at("usb:1-1.4", found) == "/dev/video2"
        with pytest.raises(DeviceError, match="no camera at this port; ports with cameras: usb:1-1.2, usb:1-1.4; plug it in"):
            node_at("usb:2-1", found)
        assert [device.description for device in cameras(found)][::2] == ["USB Camera, usb:1-1.2", "USB Camera, usb:1-1.4"]

    def test_the_kernels_time_is_taken_only_where_it_can_be(self):
        now_s = time.monotonic()
        assert exposed_s(1e3 * (now_s - 0.05)) == pytest.approx(now_s - 0.05)
        assert exposed_s(0.0) == pytest.approx(now_s, abs=0.5)
        assert exposed_s(1e3 * (now_s + 100)) == pytest.approx(now_s, abs=0.5)

    def test_a_missing_camera_says_so(self):
        with pytest.raises(DeviceError, match="can't be opened"):
            open_camera("/dev/video97").connect()


def test_a_twin_that_draws_on_demand_draws_no_more_frames_than_are_read():
    arm, camera = twin_camera(on_demand=True)
    with camera:
        first = camera.read(timeout_s=60.0)
        asked_s = time.monotonic()
        second = camera.read_after(asked_s, timeout_s=60.0)
        time.sleep(0.5)
        assert first.time_s < asked_s < second.time_s and camera.arrived <= 3


def test_a_twin_on_demand_draws_again_until_the_arms_state_is_as_new_as_requested():
    """An arm on a network reports its pose every few milliseconds, so its newest state is older than the request for a frame."""
    arm, camera = twin_camera(on_demand=True)
    camera._arm = lambda: replace(state := arm.state(), time_s=state.time_s - 0.1)
    with camera:
        camera.read(timeout_s=60.0)
        asked_s = time.monotonic()
        assert camera.read_after(asked_s, timeout_s=60.0).time_s > asked_s


def test_check_says_what_to_do_about_a_camera_that_gives_nothing(monkeypatch):
    class Silent(NoisyCamera):
        def _grab(self):
            self._end.wait()
            raise ReadFailed("ended")

    monkeypatch.setattr("hardware.live.examining.open_camera", lambda *_: Silent())
    monkeypatch.setattr(reader, "START_S", 0.1)
    with pytest.raises(DeviceError, match=r"noisy camera: no new frame within 0\.15 s; check the camera"):
        frames_of("0", None, None, 2)
    with pytest.raises(FrameError, match="`max_frames` 2000000000: at most 1000 frames of a camera"):
        frames_of("0", None, None, 2_000_000_000)


def test_a_first_frame_is_waited_for_as_long_as_its_source_may_need():
    """Some periods beside the start of a device; minutes only in the twin, which may have to compile kernels, and not behind a stream."""
    slow, fast = NoisyCamera(fps=2.0), NoisyCamera(fps=30.0)
    assert slow.first_frame_s - fast.first_frame_s == pytest.approx(FIRST_PERIODS * (1 / 2.0 - 1 / 30.0))
    assert MjpegCamera("http://127.0.0.1:9/").first_frame_s <= 5.0 and UvcCamera(97).first_frame_s <= 5.0
    assert twin_camera()[1].first_frame_s >= 60.0
    late = NoisyCamera(fps=1.0)
    with CameraEmulator(late) as emulator:  # it listens when there is something to be seen
        assert late.delivered == 1
        with MjpegCamera(emulator.url) as camera:
            assert number_of(camera.read(timeout_s=camera.first_frame_s).image) >= 1


def test_head_is_answered_without_a_body():
    with CameraEmulator(NoisyCamera()) as emulator:
        answer = urllib.request.urlopen(urllib.request.Request(emulator.url, method="HEAD"), timeout=5)
        assert answer.status == 200 and answer.read() == b"" and answer.headers["Content-Type"]


def test_a_client_that_pauses_gets_few_old_pictures():
    with CameraEmulator(NoisyCamera(fps=100)) as emulator:
        parts = urlsplit(emulator.url)
        with socket.create_connection((parts.hostname, parts.port), timeout=5) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.sendall(b"GET /stream.mjpg HTTP/1.0\r\n\r\n")
            stream = client.makefile("rb")
            while stream.readline().strip():
                pass
            parts = Parts(lambda: stream.read1(65536))
            parts.next_part()
            time.sleep(0.6)  # 60 pictures
            resumed_s = time.time()
            old = 0
            while float(parts.next_part()[0]["x-timestamp"]) < resumed_s:
                old += 1
            assert old < 30  # of 60; without a small buffer all of them come
