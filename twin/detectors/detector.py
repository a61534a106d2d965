"""Any way to find pins as one call: frame in, claims, names and graph out."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import QhullError, cKDTree

from scenes.sensor import SensorSpec
from twin.camera import record
from twin.detectors.finders import find
from twin.detectors.spec import DetectorSpec
from twin.errors import FrameError
from twin.preprocess.forms import frame_size, from_raw, gray_levels, recording_to_raw
from twin.preprocess.graph import make_graph
from twin.preprocess.legacy import LegacyPipeline, legacy_graph
from twin.preprocess.mask import circular_mask
from twin.preprocess.matching import match
from twin.preprocess.pipeline import MIN_FOUND, Pipeline
from twin.preprocess.reference import Reference, make_reference, nominal_reference
from twin.types import Form, Frame, PinGraph


@dataclass(frozen=True)
class Found:
    """What a detector claims of one frame.

    Attributes
    ----------
    claims_px : (K, 2) float
        Where it says that pins are, px of the frame, in any order.
    pins_px : (N, 2) float or None
        The same by name, in the specification's order, NaN where lost; None if it gives no names.
    graph : PinGraph or None
        In the specification's order if there are names, else in the order of the claims. None if the frame is not valid.
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

    ``second_look`` as `Pipeline` takes it: whoever judges thresholds by what they find wants none.

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
        return LegacyDetector(sensor, detector)
    reference = (
        make_reference(np.array(detector.pins_px), sensor.pins.rings) if detector.pins_px else nominal_reference(sensor, detector.form)
    )
    if detector.method == "twin":
        return TwinDetector(sensor, detector, reference, second_look=second_look)
    return PlainDetector(sensor, detector, reference)


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
    """A plain blob detector, whose blobs get their names from the same matching as ours: what differs is how blobs are found."""

    def __init__(self, sensor: SensorSpec, spec: DetectorSpec, reference: Reference) -> None:
        self.spec, self._reference = spec, reference
        self._mask = circular_mask(frame_size(sensor, spec.form), spec.blob.mask_center_px, spec.blob.mask_radius_px)

    def __call__(self, frame: Frame) -> Found:
        window = np.ascontiguousarray(gray_levels(np.ascontiguousarray(frame.image[self._mask.window])))
        px, area = find(window, self._mask, self.spec)
        count = len(self._reference.pins_px)
        if len(px) > 4 * count:
            return Found(px, np.full((count, 2), np.nan), None, False, f"too many blobs: {len(px)}")
        found = match(self._reference, px, area)
        paired = found.blob >= 0
        pins_px = np.full((count, 2), np.nan)
        pins_px[paired] = px[found.blob[paired]]
        nodes_px = np.where(paired[:, None], pins_px, found.predicted_px)
        valid = paired.sum() >= MIN_FOUND * count and bool(np.isfinite(nodes_px).all())
        reason = "" if valid else f"too few pins: {int(paired.sum())} of {count}"
        return Found(pins_px[paired], pins_px, self.graph_of(nodes_px) if valid else None, valid, reason)

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph:
        return make_graph("voronoi", nodes_px, outmost=self._reference.outmost)


class LegacyDetector:
    """The published method; raw frames go through the published recorder first."""

    def __init__(self, sensor: SensorSpec, spec: DetectorSpec) -> None:
        recording = spec.recording or sensor.recording
        if recording is None:
            raise FrameError(
                f"'{spec.name}': the published method needs a recorder's crop and threshold, {sensor.name} has none;"
                " run 'twin tune --method legacy'"
            )
        self.spec = spec
        self._sensor = sensor.model_copy(update={"recording": recording})
        self._pipeline = LegacyPipeline(self._sensor)

    def __call__(self, frame: Frame) -> Found:
        raw = frame.form == Form.RAW
        if raw:
            frame = Frame(record(frame.image, self._sensor.recording), Form.RECORDING, frame.name)
        seen = self._pipeline(frame)
        px = recording_to_raw(self._sensor, seen.nodes_px) if raw else seen.nodes_px
        return Found(px, None, seen.graph, seen.valid, seen.reason)

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph | None:
        size = self._pipeline.parameters.size_px
        recorded = from_raw(self._sensor, Form.RECORDING, nodes_px) if self.spec.form == Form.RAW else nodes_px
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
