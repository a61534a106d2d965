"""A camera emulated on this machine: it serves JPEG pictures over HTTP (multipart/x-mixed-replace), with faults on request.

``emulate_camera`` serves the twin's view of the contact at the pose of an arm that another process drives. ``FeedbackPose`` reads this pose
from the feedback ports of an MG400.
"""

import threading
import time

import numpy as np

from hardware.arms.arm import ArmState
from hardware.arms.mg400_wire import FEEDBACK_PERIOD_S, Feedback, address_of, pose_in
from hardware.cameras.mjpeg import STREAM, WAIT_S, JpegServer, StreamPart, jpeg_of
from hardware.cameras.source import FrameSource, await_frame
from hardware.cameras.twin import TwinCamera
from hardware.emulators.faults import EVERY_NTH, SECONDS, Emulator, Fault, Faults
from hardware.errors import DeviceError, on_error
from hardware.rig.geometry import PlacedObject
from hardware.workcell.build import draw_window
from scenes import ObjectSpec, SensorSpec, ServoSpec, load_experiment
from twin.errors import OptionError, TwinError
from twin.rig.kinematics import Mounting
from twin.types import Form

FAULTS = {
    "frozen": Fault("the same picture again and again"),
    "black": Fault("the lamps are off"),
    "resized": Fault("the pictures have half the height"),
    "dropped": Fault("every n-th picture is lost", 2.0, EVERY_NTH),
    "late": Fault("pictures arrive this many seconds after their exposure", 0.3, SECONDS),
    "torn": Fault("every n-th JPEG ends too early", 3.0, EVERY_NTH),
    "unplugged": Fault("the connection is cut and none taken for this many seconds, once", 1.0, SECONDS),
    "silent": Fault("connections stay open, nothing comes"),
}


class CameraEmulator(Emulator):
    """Serves a source's frames as a stream. A context manager, which listens between ``start`` and ``stop``.

    Parameters
    ----------
    source : FrameSource
        A live source. It is connected and disconnected with the emulator.
    host : str
    port : int
        Port; 0 for a free one, see ``url``.
    faults : iterable of str
        ``NAME`` or ``NAME=VALUE`` of ``FAULTS``; ``faults`` can be changed while it runs.

    Attributes
    ----------
    made : int
        Number of pictures so far, including lost ones.
    """

    def __init__(self, source: FrameSource, *, host: str = "127.0.0.1", port: int = 0, faults: tuple[str, ...] = ()) -> None:
        self.faults = Faults(FAULTS, faults)
        self._source, self._address = source, (host, port)
        self._running: tuple[JpegServer, threading.Thread] | None = None
        self.made, self._pulled_s = 0, 0.0

    @property
    def url(self) -> str:
        """Address of the stream."""
        if self._running is None:
            raise DeviceError("camera emulator: not started; call start() first")
        return f"{self._running[0].url}{STREAM[1:]}"

    def start(self) -> None:
        server = JpegServer("camera emulator", *self._address, self._is_unplugged)
        self._source.connect()
        with on_error(self._source.disconnect), on_error(server.stop):
            await_frame(self._source)  # the first frame compiles kernels, so it is made before a client can connect
        self._running = server, threading.Thread(target=self._make, args=(server,), name="camera emulator", daemon=True)
        server.start()
        self._running[1].start()
        self.place = f"camera {self.url}"

    def stop(self) -> None:
        if self._running is not None:
            self._running[0].stop()
            self._running[1].join(timeout=15.0)
        self._source.disconnect()

    def _is_unplugged(self) -> bool:
        """Whether the fault that cuts the connections does so at present."""
        span_s = self.faults.value("unplugged")
        self._pulled_s = 0.0 if span_s is None else self._pulled_s or time.monotonic()
        return span_s is not None and time.monotonic() - self._pulled_s < span_s

    def _make(self, server: JpegServer) -> None:
        last: np.ndarray | None = None
        while not server.ended.is_set():
            try:
                frame = self._source.read(timeout_s=WAIT_S)
            except TimeoutError:
                continue
            except (TwinError, EOFError) as error:
                self.error = error
                return
            image = frame.image
            if "frozen" in self.faults and last is not None:
                image = last
            last = image
            if "black" in self.faults:
                image = np.zeros_like(image)
            if "resized" in self.faults:
                image = image[::2]
            self.made += 1
            if "silent" in self.faults or self.faults.every("dropped", self.made):
                continue
            jpeg = jpeg_of(image)
            if self.faults.every("torn", self.made):
                jpeg = jpeg[: len(jpeg) // 2]
            age_s = time.monotonic() - frame.time_s
            headers = {"X-Timestamp": f"{time.time() - age_s:.6f}", "X-Sequence": self.made}
            server.give(StreamPart(self.made, jpeg, headers, time.monotonic() + (self.faults.value("late") or 0.0)))


# Largest age, s, of feedback that is used.
MAX_AGE_S = 1.0


class FeedbackPose:
    """Reads the newest state from the feedback ports. It opens no command connection, so a driver may be connected at the same time.

    Parameters
    ----------
    host : str
    ports : tuple of int
        Feedback ports, tried in order.
    lenient : bool
        See ``Feedback``.
    """

    def __init__(self, host: str, ports: tuple[int, ...] = tuple(FEEDBACK_PERIOD_S), *, lenient: bool = False) -> None:
        self._feedback = Feedback(f"arm at {host}", host, ports, lenient=lenient)

    @classmethod
    def of(cls, spec: str) -> "FeedbackPose":
        """The reader for ``mg400:ADDRESS[:DASHBOARD_PORT]``. The feedback ports have the same offset as the dashboard port."""
        kind, _, rest = spec.partition(":")
        if kind not in ("mg400", "mg400-lenient") or rest[:1] in ("", ":"):
            raise OptionError(f"`arm` {spec}: expected mg400:ADDRESS, for example mg400:127.0.0.1 with 'twin emulate mg400' running")
        host, offset = address_of(rest)
        return cls(host, tuple(number + offset for number in FEEDBACK_PERIOD_S), lenient=kind != "mg400")

    def __enter__(self) -> "FeedbackPose":
        self._feedback.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._feedback.close()

    def __call__(self) -> ArmState:
        """The newest state; raises ``StaleDataError`` if it is too old."""
        packet, time_s = self._feedback.newest(MAX_AGE_S)
        return ArmState(pose_in(packet), packet["q_actual"][:4].copy(), time_s, bool(packet["enabled"]), False)


def emulate_camera(
    arm: str,
    sensor: SensorSpec,
    obj: ObjectSpec,
    servo: ServoSpec,
    *,
    host: str = "127.0.0.1",
    port: int = 8081,
    fps: float = 30.0,
    faults: tuple[str, ...] = (),
    plain_light: bool = False,
) -> None:
    """Stream the twin's frames as JPEGs over HTTP until it is ended.

    Parameters
    ----------
    arm : str
        Arm whose feedback gives the pose, as text for ``FeedbackPose.of``.
    servo : ServoSpec
        Specification with the object's place.
    port : int
        Port; 0 for a free one.
    fps : float
        Most pictures per second.
    faults : tuple of str
        See ``CameraEmulator``.
    plain_light : bool
        Without path tracing at the start; see ``hardware.workcell.build.draw_window``.
    """
    placed = PlacedObject(obj, servo.placement, Mounting.of(sensor, load_experiment(servo.experiment)))
    pose = FeedbackPose.of(arm)
    source = TwinCamera(sensor, placed, pose, fps=fps, preview=draw_window(sensor, Form.RAW, plain_light), waits_for_arm=True)
    device = CameraEmulator(source, host=host, port=port, faults=faults)
    with pose:
        device.run()
