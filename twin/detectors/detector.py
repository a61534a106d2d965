"""Each way to find pins behind one call: a frame goes in; claimed places, pins by name and a graph come out."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import QhullError, cKDTree

from scenes.sensor import PinsSpec, RecordingSpec, SensorSpec
from twin.camera import record
from twin.detectors.finders import find
from twin.detectors.spec import DetectorSpec
from twin.errors import FrameError
from twin.preprocess.graph import make_graph
from twin.preprocess.legacy import LegacyPipeline, legacy_graph
from twin.preprocess.mask import circular_mask
from twin.preprocess.matching import match
from twin.preprocess.pipeline import MIN_FOUND, Pipeline
from twin.preprocess.reference import Reference, make_reference, nominal_reference
from twin.recordings.forms import frame_size, from_raw, gray_levels, recording_to_raw
from twin.types import Form, Frame, PinGraph

# A frame with more blobs than this for each pin is refused as clutter.
MOST_BLOBS = 4


@dataclass(frozen=True)
class Found:
    """What a detector claims of one frame.

    Attributes
    ----------
    claims_px : (K, 2) float
        Places where it claims pins, px of the frame, in any order.
    pins_px : (N, 2) float or None
        The same places in the specification's pin order, NaN where lost; None if it does not tell which pin is which.
    graph : PinGraph or None
        In the order of ``pins_px`` if it is given, else of the claims. None if the frame is not valid.
    valid : bool
    reason : str
    """

    claims_px: np.ndarray
    pins_px: np.ndarray | None
    graph: PinGraph | None
    valid: bool
    reason: str = ""


class Detector(Protocol):
    """Finds pins in frames of one form."""

    spec: DetectorSpec

    def __call__(self, frame: Frame) -> Found: ...

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph | None:
        """The graph that its method makes of pins (N, 2) in the specification's order, areas in its own unit."""


def make_detector(sensor: SensorSpec, detector: DetectorSpec, *, second_look: bool = True) -> Detector:
    """A detector ready for frames.

    ``second_look`` as `Pipeline` takes it. Set it to False to judge thresholds: a second look hides what a threshold loses.

    Raises
    ------
    FrameError
        The method does not suit the frames' form, or the pins are another sensor's.
    """
    if detector.pins_px and len(detector.pins_px) != sensor.pins.count:
        raise FrameError(
            f"'{detector.name}' was tuned for {len(detector.pins_px)} pins, {sensor.name} has {sensor.pins.count}: tune it for this sensor"
        )
    if detector.method == "legacy":
        return LegacyDetector(sensor.pins, sensor.recording, detector)
    reference = (
        make_reference(np.array(detector.pins_px), sensor.pins.rings) if detector.pins_px else nominal_reference(sensor, detector.form)
    )
    if detector.method == "twin":
        return TwinDetector(sensor, detector, reference, second_look=second_look)
    return PlainDetector(frame_size(sensor, detector.form), detector, reference)


class TwinDetector:
    """This program's pipeline."""

    def __init__(self, sensor: SensorSpec, spec: DetectorSpec, reference: Reference, *, second_look: bool = True) -> None:
        self.spec = spec
        section = sensor.pipeline.model_copy(update={str(spec.form): spec.blob})
        self._pipeline = Pipeline(sensor.model_copy(update={"pipeline": section}), spec.form, reference, second_look=second_look)

    def __call__(self, frame: Frame) -> Found:
        seen = self._pipeline(frame)
        return Found(seen.pins_px[np.isfinite(seen.pins_px[:, 0])], seen.pins_px, seen.graph, seen.valid, seen.reason)

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph:
        return make_graph("voronoi", nodes_px, outmost=self._pipeline.reference.outmost)


class PlainDetector:
    """A plain blob detector. Its blobs are matched to the pins as the pipeline's are, so that only the way to find blobs differs."""

    def __init__(self, size_px: tuple[int, int], spec: DetectorSpec, reference: Reference) -> None:
        self.spec, self._reference = spec, reference
        self._mask = circular_mask(size_px, spec.blob.mask_center_px, spec.blob.mask_radius_px)

    def __call__(self, frame: Frame) -> Found:
        window = np.ascontiguousarray(gray_levels(np.ascontiguousarray(frame.image[self._mask.window])))
        px, area = find(window, self._mask, self.spec)
        count = len(self._reference.pins_px)
        if len(px) > MOST_BLOBS * count:
            return Found(px, np.full((count, 2), np.nan), None, False, f"too many blobs: {len(px)}")
        found = match(self._reference, px, area)
        paired = found.blob >= 0
        pins_px = np.full((count, 2), np.nan)
        pins_px[paired] = px[found.blob[paired]]
        nodes_px = np.where(paired[:, None], pins_px, found.predicted_px)
        valid = bool(paired.sum() >= MIN_FOUND * count) and bool(np.isfinite(nodes_px).all())
        reason = "" if valid else f"too few pins: {int(paired.sum())} of {count}"
        return Found(pins_px[paired], pins_px, self.graph_of(nodes_px) if valid else None, valid, reason)

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph:
        return make_graph("voronoi", nodes_px, outmost=self._reference.outmost)


class LegacyDetector:
    """The published method; raw frames go through the published recorder first."""

    def __init__(self, pins: PinsSpec, recording: RecordingSpec | None, spec: DetectorSpec) -> None:
        recording = spec.recording or recording
        if recording is None:
            raise FrameError(
                f"'{spec.name}': the published method needs a recorder's crop and threshold, the sensor has none;"
                " run 'twin tune --method legacy'"
            )
        self.spec, self._recording = spec, recording
        self._pipeline = LegacyPipeline(pins, recording)

    def __call__(self, frame: Frame) -> Found:
        raw = frame.form == Form.RAW
        if raw:
            frame = Frame(record(frame.image, self._recording), Form.RECORDING, frame.name)
        seen = self._pipeline(frame)
        px = recording_to_raw(self._recording, seen.nodes_px) if raw else seen.nodes_px
        return Found(px, None, seen.graph, seen.valid, seen.reason)

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph | None:
        size = self._pipeline.parameters.size_px
        recorded = from_raw(self._recording, Form.RECORDING, nodes_px) if self.spec.form == Form.RAW else nodes_px
        nodes = (recorded + 0.5) * size / np.array(self._pipeline.size_px) - 0.5
        try:
            return legacy_graph(nodes - np.median(nodes), self._pipeline.parameters)
        except QhullError:
            return None


def named(graph: PinGraph, claims_px: np.ndarray, pins_px: np.ndarray) -> PinGraph:
    """A graph over claims (N, 2) in the order of the pins (N, 2) that they are nearest to."""
    _, order = cKDTree(claims_px).query(pins_px)
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    return PinGraph(graph.kind, pins_px, place[graph.edges], graph.area_px2[order], [])
