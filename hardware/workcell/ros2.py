"""Publishes a sensor's frames, pins and estimates as ROS 2 topics, from a thread of its own.

Whoever offers something goes on at once: only the newest frame and the newest estimate are kept. A message is made only if somebody reads
its topic. The estimate's topics contain nothing of an estimate that is not valid; ``/diagnostics`` states the reason.
"""

import logging
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from hardware.arms.arm import ArmState
from hardware.cameras.mjpeg import jpeg_of
from hardware.cameras.reader import LiveSource
from hardware.cameras.source import FrameSource
from hardware.ros2.dds import Participant, Writer
from scenes.files import quote
from twin.camera.projection import pixel_rays
from twin.errors import OptionError
from twin.estimate import Estimate, pins_in, readable_labels
from twin.frames.forms import recording_to_raw
from twin.geometry.pins import rest_pins
from twin.pins import Pipeline
from twin.records import ros2 as ros
from twin.rig.arm_pose import matrix_of
from twin.types import Form, Frame

LOG = logging.getLogger(__name__)
JPEG_QUALITY = 90
"""Quality (0 to 100) of the topic ``image/compressed``."""
QUIET_S = 1.0
"""Time, s, without anything new after which ``/diagnostics`` states that."""
CLOSE_S = 5.0
"""Time, s, that the thread has at the end."""
OLDEST_S = 60.0
"""Age, s, of a frame beyond which its time is that of another clock. It then counts as exposed when it was offered."""
UNKNOWN = 1e6
"""Variance of a number of a pose that is not estimated."""
SD_90 = 3.29
"""Width of the 90 % interval of a normal distribution, in standard deviations."""
PIN_MM = 1.2
"""Size of a pin in ``markers``."""
OK, WARN, ERROR = 0, 1, 2
"""Levels of a diagnostic status."""
_POSE = {"pose_z": 2, "pose_Rx": 3, "pose_Ry": 4} | {f"pose_{k + 1}": k for k in range(6)}
_FORCES = ("Fx", "Fy", "Fz")
_POINT = ("x", "y", "z", "u", "v", "du", "dv")
_SPHERES, _LINES = 7, 5  # kinds of markers
_FLOAT32 = 7  # kind of a number of a point
SENSOR_TOPICS = {
    "image": "sensor_msgs/Image",
    "image/compressed": "sensor_msgs/CompressedImage",
    "points": "sensor_msgs/PointCloud2",
    "markers": "visualization_msgs/MarkerArray",
}
"""Topics in the profile for sensor data (best effort), and their messages."""
TOPICS = {
    **dict.fromkeys(("pins", "estimate", "estimate_low", "estimate_high", "slip"), "std_msgs/Float32MultiArray"),
    "pose": "geometry_msgs/TwistStamped",
    "contact_pose": "geometry_msgs/PoseWithCovarianceStamped",
    "wrench": "geometry_msgs/WrenchStamped",
    "contact": "std_msgs/Int8",
    ros.DIAGNOSTICS_TOPIC: "diagnostic_msgs/DiagnosticArray",
    ros.TF_TOPIC: "tf2_msgs/TFMessage",
}
"""All other topics. Those without a slash are in the sensor's namespace."""


def namespace_of(name: str) -> str:
    """A namespace without slashes at its ends; ``OptionError`` if ROS 2 does not allow it."""
    plain = name.strip("/")
    if not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", plain, re.ASCII) or "__" in plain:
        raise OptionError(f"`ros2` {quote(name)}: expected a namespace of letters, digits and _, such as tactip or left/tactip")
    return plain


class Ros2Publisher:
    """Publishes what a source delivers and what is offered. A context manager.

    Parameters
    ----------
    name : str
        Namespace of the topics; with ``_`` for ``/`` it begins the names of the frames.
    source : FrameSource
        Connected. Frames of a live source are published as they come, and those of a recording when they are offered.
    pipeline : Pipeline
        Finds the pins of frames whose estimates do not contain them. No other thread may use it.
    arm : callable, optional
        Gives the arm's newest known state for ``/tf``, without a request to the arm.
    T_tool_sensor : (4, 4) float, optional
        The sensor's pose on the tool, mm.
    estimates : bool
        Whether estimates will be offered. Otherwise the pins of every frame are published.
    """

    def __init__(
        self,
        name: str,
        source: FrameSource,
        pipeline: Pipeline,
        *,
        arm: Callable[[], ArmState | None] | None = None,
        T_tool_sensor: np.ndarray | None = None,
        estimates: bool = True,
    ) -> None:
        self._name, self._source, self._pipeline, self._arm, self._estimates = namespace_of(name), source, pipeline, arm, estimates
        prefix = self._name.replace("/", "_")
        self.sensor_frame, self.tool_frame, self.contact_frame = f"{prefix}_sensor", f"{prefix}_tool", f"{prefix}_contact"
        self._static = T_tool_sensor
        self._new = threading.Condition()
        self._frame: Frame | None = None
        self._estimated: tuple[Frame, Estimate] | None = None
        self._end, self._failed = False, False
        self._state: ArmState | None = None  # that was published last
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._foreign = (np.nan, 0)  # the last time of another clock, and when it came
        self._thread = threading.Thread(target=self._run, name="ROS 2", daemon=True)
        self._participant: Participant | None = None
        self._writers: dict[str, Writer] = {}

    def __enter__(self) -> "Ros2Publisher":
        participant = self._participant = Participant()
        for sensor, topics in ((True, SENSOR_TOPICS), (False, TOPICS)):
            for topic, kind in topics.items():
                self._writers[topic] = participant.writer(topic if topic[0] == "/" else f"/{self._name}/{topic}", kind, sensor=sensor)
        if self._static is not None:
            kept, now_ns = participant.writer(ros.TF_STATIC_TOPIC, TOPICS[ros.TF_TOPIC], kept=True), time.time_ns()
            place = ros.transform(self._static, ros.header_of(now_ns, self.tool_frame), self.sensor_frame)
            kept.write(ros.encode(TOPICS[ros.TF_TOPIC], place), now_ns)
            self._writers[ros.TF_STATIC_TOPIC] = kept
        if isinstance(self._source, LiveSource):
            self._source.on_frame = self.offer
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if isinstance(self._source, LiveSource):
            self._source.on_frame = None
        with self._new:
            self._end = True
            self._new.notify()
        self._thread.join(CLOSE_S)
        self._writers.clear()
        self._participant = None

    def offer(self, frame: Frame, estimate: Estimate | None = None) -> None:
        """Publish a frame, and its estimate if there is one. This returns at once."""
        with self._new:
            self._frame = frame
            if estimate is not None:
                self._estimated = (frame, estimate)
            self._new.notify()

    def _run(self) -> None:
        shown: Frame | None = None
        estimated: tuple[Frame, Estimate] | None = None
        while True:
            with self._new:
                self._new.wait_for(lambda: self._end or self._frame is not shown or self._estimated is not estimated, QUIET_S)  # noqa: B023
                if self._end:
                    return
                frame = self._frame if self._frame is not shown else None
                done = self._estimated if self._estimated is not estimated else None
                shown, estimated = self._frame, self._estimated
            try:
                if frame is not None:
                    self._publish_frame(frame)
                if done is not None:
                    self._publish_estimate(*done)
                elif frame is None or not self._estimates:
                    self._publish_status(time.time_ns(), None, False)
            except Exception as error:  # whatever happens here, the loop that offers frames goes on
                if not self._failed:
                    LOG.warning("ROS 2: %s; the program goes on, and publishing is tried again with each frame", error)
                self._failed = True

    def _send(self, topic: str, at_ns: int, make: Callable[[], dict[str, Any]]) -> None:
        """Make and write a message if anybody reads the topic."""
        writer = self._writers[topic]
        if writer.heard:
            writer.write(ros.encode((SENSOR_TOPICS | TOPICS)[topic], make()), at_ns)

    def _at_ns(self, time_s: float) -> int:
        """A time of ``time.monotonic()`` in ns since 1970; the present time if it is of another clock. Equal times give equal numbers."""
        if not self._source.is_live or not 0 <= time.monotonic() - time_s < OLDEST_S:
            if self._foreign[0] != time_s:
                self._foreign = (time_s, time.time_ns())
            return self._foreign[1]
        return self._epoch_ns + round(time_s * ros.NS_PER_S)

    def _publish_frame(self, frame: Frame) -> None:
        at_ns, image = self._at_ns(frame.time_s), frame.image
        header = ros.header_of(at_ns, self.sensor_frame)
        colours = 1 if image.ndim == 2 else 3
        plain = {"header": header, "height": image.shape[0], "width": image.shape[1], "encoding": "mono8" if colours == 1 else "rgb8"}
        self._send("image/compressed", at_ns, lambda: {"header": header, "format": "jpeg", "data": jpeg_of(image, JPEG_QUALITY)})
        self._send("image", at_ns, lambda: plain | {"step": image.shape[1] * colours, "data": image.tobytes()})
        state = None if self._arm is None else self._arm()
        if state is not None and state is not self._state:  # tf2 warns of a stamp that comes twice
            self._state = state
            based = ros.header_of(arm_ns := self._at_ns(state.time_s), "base")
            self._send(ros.TF_TOPIC, arm_ns, lambda: ros.transform(matrix_of(state.pose), based, self.tool_frame))
        if not self._estimates:
            self._publish_pins(at_ns, frame, None)

    def _publish_pins(self, at_ns: int, frame: Frame, estimate: Estimate | None) -> None:
        if not any(self._writers[topic].heard for topic in ("pins", "points", "markers")):
            return
        seen = pins_in(frame, estimate, self._pipeline)
        pins_px = seen.pins_px if seen.valid else np.full_like(self._pipeline.reference.pins_px, np.nan)
        places_m = _places_m(self._pipeline, frame.form, pins_px)
        moved = pins_px - self._pipeline.reference.pins_px
        header = ros.header_of(at_ns, self.sensor_frame)
        self._send("pins", at_ns, lambda: ros.number_array(pins_px, "pin", "axis"))
        self._send("points", at_ns, lambda: _cloud(header, np.hstack([places_m, pins_px, moved])))
        self._send("markers", at_ns, lambda: self._markers(header, places_m, frame.form))

    def _markers(self, header: dict[str, Any], places_m: np.ndarray, form: Form) -> dict[str, Any]:
        found = np.isfinite(places_m[:, 0])
        rest_m = _places_m(self._pipeline, form, self._pipeline.reference.pins_px)
        lines = np.stack([rest_m[found], places_m[found]], axis=1).reshape(-1, 3)
        common = {"header": header, "ns": self._name, "pose": {"orientation": {"w": 1.0}}, "color": {"r": 1.0, "g": 0.6, "a": 1.0}}
        size_m = PIN_MM / ros.MM_PER_M
        spheres = {"id": 0, "type": _SPHERES, "scale": ros.vector(np.full(3, size_m)), "points": places_m[found]}
        return {"markers": [common | spheres, common | {"id": 1, "type": _LINES, "scale": {"x": size_m / 3}, "points": lines}]}

    def _publish_estimate(self, frame: Frame, estimate: Estimate) -> None:
        at_ns, names = self._at_ns(frame.time_s), tuple(estimate.names)
        numbers = np.array([estimate.value, estimate.low, estimate.high], float)
        valid = bool(estimate.valid) and bool(np.isfinite(numbers[0]).any())
        if not valid:
            numbers[:] = np.nan
        for topic, row in zip(("estimate", "estimate_low", "estimate_high"), numbers, strict=True):
            self._send(topic, at_ns, partial(ros.number_array, row, ",".join(names)))
        if valid:
            known, header = dict(zip(names, numbers[0].tolist(), strict=True)), ros.header_of(at_ns, self.sensor_frame)
            if not _POSE.keys().isdisjoint(names):
                self._send("pose", at_ns, lambda: {"header": header, "twist": ros.estimated_twist(known)})
                self._send("contact_pose", at_ns, lambda: _contact_pose(ros.header_of(at_ns, self.contact_frame), names, numbers))
            if all(name in known for name in _FORCES):
                force_n = np.array([known[name] for name in _FORCES])
                self._send("wrench", at_ns, lambda: {"header": header, "wrench": ros.wrench(force_n, np.full(3, np.nan))})
                self._send("contact", at_ns, lambda: {"data": int(np.linalg.norm(force_n) > ros.TOUCHES_N)})
            if slip := [name for name in names if name.startswith("slip_")]:
                self._send("slip", at_ns, lambda: ros.number_array(np.array([known[name] for name in slip]), ",".join(slip)))
        self._publish_pins(at_ns, frame, estimate)
        self._publish_status(at_ns, estimate, valid)

    def _publish_status(self, at_ns: int, estimate: Estimate | None, valid: bool) -> None:
        def make() -> dict[str, Any]:
            wrong = self._source.fault or self._source.blind()
            notes = {f"note {n}": note for n, note in enumerate(self._source.notes(), 1)}
            camera = {"dropped": self._source.dropped} | notes
            status = [self._status("camera", ERROR if wrong else OK, wrong or "fresh frames", camera)]
            if estimate is not None and (seen := estimate.seen) is not None:
                level, message = (OK, "found") if seen.valid else (WARN, seen.reason)
                status.append(self._status("pins", level, message, {"found": seen.found, "expected": seen.expected}))
            if estimate is not None:
                rows = zip(readable_labels(estimate.names), estimate.value, estimate.low, estimate.high, estimate.units, strict=True)
                shown = {name: f"{value:.4g} [{low:.4g}, {high:.4g}] {unit}" for name, value, low, high, unit in rows}
                level, message = (OK, "valid") if valid else (WARN, f"not valid: {estimate.reason}")
                status.append(self._status("estimate", level, message, shown if valid else {}))
            return {"header": ros.header_of(at_ns, ""), "status": status}

        self._send(ros.DIAGNOSTICS_TOPIC, at_ns, make)

    def _status(self, part: str, level: int, message: str, values: dict[str, Any]) -> dict[str, Any]:
        pairs = [{"key": key, "value": str(value)} for key, value in values.items()]
        return {"level": level, "name": f"{self._name}: {part}", "message": message, "hardware_id": self._source.name, "values": pairs}


@contextmanager
def publishing(name: str | None, source: FrameSource, pipeline: Pipeline, **options: Any) -> Iterator[Callable[[Frame, Estimate], None]]:
    """Context in which a connected source is published under a name; it gives a function for estimates. Without a name it does nothing."""
    if name is None:
        yield lambda frame, estimate: None
        return
    own = Pipeline(pipeline.spec, source.form, pipeline.reference)  # a separate one for the publisher's thread
    with Ros2Publisher(name, source, own, **options) as publisher:
        yield publisher.offer


def _places_m(pipeline: Pipeline, form: Form, pins_px: np.ndarray) -> np.ndarray:
    """Places (N, 3), m, in the sensor's frame of pins in px (N, 2), each at its height at rest."""
    raw = recording_to_raw(pipeline.spec.recording, pins_px) if form is Form.PROCESSED else pins_px
    place, direction = pixel_rays(pipeline.spec.view, raw)
    up = rest_pins(pipeline.spec.geometry).caps_mm[:, 2] - place[:, 2]
    return (place + direction * (up / direction[:, 2])[:, None]) / ros.MM_PER_M


def _cloud(header: dict[str, Any], points: np.ndarray) -> dict[str, Any]:
    """Points (N, 7) as a point cloud."""
    fields = [{"name": name, "offset": 4 * k, "datatype": _FLOAT32, "count": 1} for k, name in enumerate(_POINT)]
    data = points.astype("<f4").tobytes()
    shape = {"height": 1, "width": len(points), "point_step": 4 * len(_POINT), "row_step": len(data)}
    return {"header": header, "fields": fields, "data": data, "is_dense": bool(np.isfinite(points).all())} | shape


def _contact_pose(header: dict[str, Any], names: tuple[str, ...], numbers: np.ndarray) -> dict[str, Any]:
    """The estimated pose, m and rad, with variances from the intervals; numbers (3, K) are values and ends of the intervals."""
    pose, variance = np.zeros(6), np.full(6, UNKNOWN)
    for name, (value, low, high) in zip(names, numbers.T, strict=True):
        if name in _POSE and np.isfinite(value):
            k = _POSE[name]
            pose[k], unit = value, 1 / ros.MM_PER_M if k < 3 else np.radians(1.0)
            variance[k] = ((high - low) * unit / SD_90) ** 2
    return {"header": header, "pose": {"pose": ros.place(matrix_of(pose)), "covariance": np.diag(variance).ravel()}}
