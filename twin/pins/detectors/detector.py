"""Detectors: objects that find pins in a frame. All have the same interface, which gives places, labelled pins and a graph.

The detectors are this program's pipeline, the published method, plain blob detectors of OpenCV and scikit-image, and functions of the
user.

The published method is that of the Tac-VGNN release (Apache-2.0), step by step. The following properties of the release are kept: frames
are resized to a fixed size; the mask is about the image's centre; pins are found by OpenCV's SimpleBlobDetector; nodes are centred by one
scalar median over x and y together; the hull's vertices are scaled about that origin; a frame is refused if the number of blobs is not
exactly the sensor's; nodes have the detector's order.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import cv2
import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError, Voronoi, cKDTree

from scenes.pins import PinsSpec
from scenes.sensor import RecordingSpec, SensorSpec
from twin.camera.capture import record
from twin.errors import FrameError
from twin.frames.forms import frame_size, from_raw, gray_levels, pin_levels, recording_to_raw, times
from twin.pins.detectors.detector_spec import OWN, DetectorSpec, own_places, with_detector
from twin.pins.finding.blobs import Mask, circular_mask, threshold
from twin.pins.graph import make_graph
from twin.pins.labelling.matching import match
from twin.pins.labelling.reference import Reference, nominal_reference
from twin.pins.pipeline import MIN_FOUND, Pipeline
from twin.pins.voronoi import directed_edges
from twin.types import Form, Frame, PinGraph

LEVELS = 255.0
"""Difference in gray levels of full contrast."""
LOG_STEPS = 3
"""Number of blob sizes, from the smallest to the largest, that the scale-space detectors search."""
LOG_PEAK = 0.5
"""Approximate response of scikit-image's blob_log and blob_dog to a disc of the searched size with contrast 1."""
DOH_PEAK = 0.05
"""Approximate response of blob_doh to such a disc. It is proportional to the square of the contrast."""
DOG_RATIO = 1.4
"""Ratio of neighbouring sizes of blob_dog."""
OVERLAP = 0.3
"""Share of a smaller blob that may overlap with a larger one."""
SIMPLE_STEP = 10.0
"""Gray levels between the thresholds of SimpleBlobDetector."""
SIMPLE_HIGHEST = 240.0
"""Highest first threshold of SimpleBlobDetector, gray levels."""
MOST_CAPS = 4
"""Largest area of a blob, in units of the largest cap's area."""
MOST_BLOBS = 4
"""Number of blobs per pin above which a frame is refused as clutter."""
HULL_SCALE = 1.1
"""Factor by which the published method scales the hull's vertices about the origin."""


@dataclass(frozen=True)
class Found:
    """The pins that a detector found in one frame.

    Attributes
    ----------
    claims_px : (K, 2) float
        Places at which the detector finds pins, px of the frame, in any order.
    pins_px : (N, 2) float or None
        The same places in the specification's pin order, NaN where lost; None if the detector does not identify the pins.
    graph : PinGraph or None
        Graph in the order of ``pins_px`` if that is given, else in the order of ``claims_px``. None if the frame is not valid.
    expected : int
        Pins that should be in view.
    valid : bool
    reason : str
    """

    claims_px: np.ndarray
    pins_px: np.ndarray | None
    graph: PinGraph | None
    expected: int
    valid: bool
    reason: str = ""


Places = Callable[[Frame], tuple[np.ndarray, np.ndarray]]


class Detector(Protocol):
    """Finds pins in frames of one form."""

    spec: DetectorSpec

    def __call__(self, frame: Frame) -> Found: ...

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph | None:
        """The method's graph of pins (N, 2) in the specification's order. Areas are in the method's own unit."""


def make_detector(sensor: SensorSpec, detector: DetectorSpec, *, second_look: bool = True) -> Detector:
    """Make a detector from its parameters.

    ``second_look`` is as for `Pipeline`. It must be False if thresholds are compared, because a second look finds pins that a threshold
    loses.

    Raises
    ------
    FrameError
        The method can't be used for the frames' form, or the parameters are those of a sensor with another number of pins.
    """
    sensor = with_detector(sensor, detector)
    if detector.method == "legacy":
        return LegacyDetector(sensor.pins, sensor.recording, detector)
    reference = nominal_reference(sensor, detector.form)
    if detector.method == "twin":
        return TwinDetector(sensor, detector, second_look=second_look)
    blob = detector.blob
    mask = circular_mask(frame_size(sensor, detector.form), blob.mask_center_px, blob.mask_radius_px)
    places = partial(_own, detector) if detector.method == OWN else partial(_find_blobs, detector, mask)
    return MatchedDetector(detector, places, reference)


class TwinDetector:
    """This program's pipeline."""

    def __init__(self, sensor: SensorSpec, spec: DetectorSpec, *, second_look: bool = True) -> None:
        self.spec = spec
        self._pipeline = Pipeline(sensor, spec.form, second_look=second_look)

    def __call__(self, frame: Frame) -> Found:
        seen = self._pipeline(frame)
        return Found(seen.pins_px[np.isfinite(seen.pins_px[:, 0])], seen.pins_px, seen.graph, seen.expected, seen.valid, seen.reason)

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph:
        return make_graph("voronoi", nodes_px, outmost=self._pipeline.reference.outmost, net=self._pipeline.reference.net)


class MatchedDetector:
    """A detector that gives places. They are matched to the pins as in the pipeline, so that only the method of finding them differs.

    Parameters
    ----------
    spec : DetectorSpec
    places : callable
        From a frame to the places (K, 2), px, and areas (K,), px^2, of its blobs. Raises ``FrameError`` if it can't find any.
    reference : Reference
    """

    def __init__(self, spec: DetectorSpec, places: Places, reference: Reference) -> None:
        self.spec, self._places, self._reference = spec, places, reference

    def __call__(self, frame: Frame) -> Found:
        count = len(self._reference.pins_px)
        pins_px = np.full((count, 2), np.nan)
        try:
            px, area = self._places(frame)
        except FrameError as error:
            return Found(np.zeros((0, 2)), pins_px, None, count, False, str(error))
        if len(px) > MOST_BLOBS * count:
            return Found(px, pins_px, None, count, False, f"too many blobs: {len(px)}")
        found = match(self._reference, px, area)
        paired = found.blob >= 0
        pins_px[paired] = px[found.blob[paired]]
        nodes_px = np.where(paired[:, None], pins_px, found.predicted_px)
        valid = bool(paired.sum() >= MIN_FOUND * count) and bool(np.isfinite(nodes_px).all())
        reason = "" if valid else f"too few pins: {int(paired.sum())} of {count}"
        return Found(pins_px[paired], pins_px, self.graph_of(nodes_px) if valid else None, count, valid, reason)

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph:
        return make_graph("voronoi", nodes_px, outmost=self._reference.outmost, net=self._reference.net)


@dataclass(frozen=True)
class LegacyParameters:
    """The release's constants for one layout. Lengths are in px of the resized image.

    Attributes
    ----------
    size_px : int
        Side of the square that a frame is resized to.
    threshold : int
        Threshold of the detector, gray levels.
    mask_offset_px : (int, int)
        Offset of the mask's centre from the image's centre, x and y.
    mask_margin_px : int
        Distance between the mask and the image's border.
    min_area_px2 : float
    virtual_rotations_deg, virtual_scales : tuple of float
        Turns and scales of the copies of the hull that fill the concave sides of a hexagon.
    """

    size_px: int
    threshold: int
    mask_offset_px: tuple[int, int]
    mask_margin_px: int
    min_area_px2: float
    virtual_rotations_deg: tuple[float, ...] = ()
    virtual_scales: tuple[float, ...] = ()


LEGACY: dict[str, LegacyParameters] = {
    "rings": LegacyParameters(300, 100, (-1, -2), 14, 10.0),
    "hexagon": LegacyParameters(
        256, 80, (0, 2), 15, 1.0, (7.0, 12.0, 22.0, 30.0, 38.0, 48.0, 53.0), (0.95, 0.9, 0.85, 0.85, 0.85, 0.9, 0.95)
    ),
}


def legacy_parameters(layout: str) -> LegacyParameters:
    """The release's constants for a layout.

    Raises
    ------
    FrameError
        The release has none for it.
    """
    if layout not in LEGACY:
        raise FrameError(f"the published method knows only layouts of rings and hexagons, not '{layout}'; use another `method`")
    return LEGACY[layout]


def legacy_detector(parameters: LegacyParameters) -> cv2.SimpleBlobDetector:
    """The release's blob detector."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.blobColor = 255
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = 50, 220, 5
    settings.minDistBetweenBlobs, settings.minRepeatability = 3, 3
    settings.filterByArea, settings.minArea, settings.maxArea = True, parameters.min_area_px2, 5000
    settings.filterByCircularity, settings.minCircularity = True, 0.01
    settings.filterByConvexity, settings.minConvexity = True, 0.01
    settings.filterByInertia, settings.minInertiaRatio = True, 0.01
    return cv2.SimpleBlobDetector.create(settings)


def boundary_nodes(nodes: np.ndarray, parameters: LegacyParameters) -> np.ndarray:
    """The enlarged vertices of the hull. For a hexagon also turned and scaled copies of them, which fill its concave sides."""
    bound = HULL_SCALE * nodes[ConvexHull(nodes).vertices]
    nodes_around = [bound]
    for degrees, scale in zip(parameters.virtual_rotations_deg, parameters.virtual_scales, strict=True):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        nodes_around.append(scale * bound @ [[c, s], [-s, c]])
    return np.concatenate(nodes_around)


def legacy_graph(nodes: np.ndarray, parameters: LegacyParameters) -> PinGraph:
    """Delaunay edges and Voronoi areas of centred nodes (N, 2), as published (Algorithm 1 of the paper).

    The edges of a convex layout are those of its triangulation. For a hexagon, nodes and boundary nodes are triangulated together, and the
    edges between nodes are used.
    """
    n = len(nodes)
    extended = np.concatenate([nodes, boundary_nodes(nodes, parameters)])
    triangulated = extended if parameters.virtual_scales else nodes
    edges = directed_edges(Delaunay(triangulated).simplices, len(triangulated))
    edges = edges[(edges < n).all(axis=1)]
    diagram = Voronoi(extended)
    area, cells = np.full(n, np.nan), []
    for i in range(n):
        region, cell = diagram.regions[diagram.point_region[i]], np.empty((0, 2))
        if region and -1 not in region:
            cell = diagram.vertices[region]
            cell = cell[ConvexHull(cell).vertices]
            area[i] = ConvexHull(cell).volume
        cells.append(cell)
    return PinGraph("voronoi", nodes, edges, area, cells)


class LegacyDetector:
    """The published method. Raw frames are first converted by the published recorder.

    The pins' layout decides which of the release's constants are used, and their count is the only accepted number of blobs. Graphs are in
    the release's unit: px of the resized image, centred by the scalar median.
    """

    def __init__(self, pins: PinsSpec, recording: RecordingSpec | None, spec: DetectorSpec) -> None:
        recording = spec.recording or recording
        if spec.blob.polarity == "dark":
            raise FrameError("the published method finds bright pins only, and the sensor's are dark (polarity); use another method")
        if recording is None:
            raise FrameError(
                f"'{spec.name}': the published method needs a recorder's crop and threshold ([recording]), the sensor has none;"
                " run 'twin tune --method legacy'"
            )
        self.spec, self._recording, self._count, self._parameters = spec, recording, pins.count, legacy_parameters(pins.layout)
        self._size_px = recording.width_px, recording.height_px
        self._detector = legacy_detector(self._parameters)
        size, (right, down) = self._parameters.size_px, self._parameters.mask_offset_px
        radius = size // 2 - self._parameters.mask_margin_px
        self._mask = cv2.circle(np.zeros((size, size), np.uint8), (size // 2 + right, size // 2 + down), radius, 255, -1)

    def __call__(self, frame: Frame) -> Found:
        if frame.form == Form.RAW:
            seen = self(Frame(record(frame.image, self._recording), Form.PROCESSED, frame.name))
            return replace(seen, claims_px=recording_to_raw(self._recording, seen.claims_px))
        if frame.image.shape[1::-1] != self._size_px:
            raise FrameError(f"{frame.name or 'frame'}: the published method takes recordings of {times(self._size_px)} only")
        n, size = self._count, self._parameters.size_px
        _, binary = cv2.threshold(cv2.resize(gray_levels(frame.image), (size, size)), self._parameters.threshold, 255, cv2.THRESH_BINARY)
        nodes = np.array([point.pt for point in self._detector.detect(cv2.bitwise_and(binary, self._mask))], float).reshape(-1, 2)
        nodes_px = (nodes + 0.5) * (np.array(self._size_px) / size) - 0.5
        if len(nodes) != n:
            return Found(nodes_px, None, None, n, False, f"{len(nodes)} blobs found, exactly {n} expected")
        graph = self._graph(nodes)
        return Found(nodes_px, None, graph, n, graph is not None, "" if graph else "the blobs have no tessellation")

    def graph_of(self, nodes_px: np.ndarray) -> PinGraph | None:
        recorded = from_raw(self._recording, Form.PROCESSED, nodes_px) if self.spec.form == Form.RAW else nodes_px
        return self._graph((recorded + 0.5) * self._parameters.size_px / np.array(self._size_px) - 0.5)

    def _graph(self, nodes: np.ndarray) -> PinGraph | None:
        """The graph of nodes (N, 2), px of the resized image; None if they have no tessellation."""
        try:
            return legacy_graph(nodes - np.median(nodes), self._parameters)
        except QhullError:
            return None


def _find_blobs(detector: DetectorSpec, mask: Mask, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Places and areas of the blobs in a frame's mask."""
    window = pin_levels(np.ascontiguousarray(frame.image[mask.window]), detector.blob.polarity)
    return FINDERS[detector.method](np.ascontiguousarray(window), mask, detector)


def _own(detector: DetectorSpec, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Places of the user's function. All have the area of a usual cap, because the function gives none."""
    px = own_places(detector, frame)
    return px, np.full(len(px), np.pi * detector.radius_px[0] * detector.radius_px[1])


def _components(window: np.ndarray, mask: Mask, detector: DetectorSpec) -> tuple[np.ndarray, np.ndarray]:
    """Connected components above a fixed or adaptive threshold."""
    blob = detector.blob if detector.method == "adaptive" else detector.blob.model_copy(update={"threshold_block_px": 0})
    binary = threshold(window, mask.disc, blob)
    if blob.erosion_px > 1:
        binary = cv2.erode(binary, np.ones((blob.erosion_px, blob.erosion_px), np.uint8))
    _, _, stats, centroids = cv2.connectedComponentsWithStats(binary, connectivity=8)
    area = stats[1:, cv2.CC_STAT_AREA].astype(float)
    keep = (area >= blob.min_area_px2) & (area <= MOST_CAPS * np.pi * detector.radius_px[1] ** 2)
    return centroids[1:][keep] + mask.corner_px, area[keep]


def _simple(window: np.ndarray, mask: Mask, detector: DetectorSpec) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's SimpleBlobDetector."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.blobColor = 255
    settings.minThreshold = min(detector.blob.threshold, SIMPLE_HIGHEST)
    settings.maxThreshold, settings.thresholdStep = 255.0, SIMPLE_STEP
    settings.minDistBetweenBlobs, settings.minRepeatability = max(detector.radius_px[0], 1.0), 1
    settings.filterByArea, settings.minArea = True, max(detector.blob.min_area_px2, 1.0)
    settings.maxArea = MOST_CAPS * np.pi * detector.radius_px[1] ** 2
    settings.filterByCircularity = settings.filterByConvexity = settings.filterByInertia = False
    found = cv2.SimpleBlobDetector.create(settings).detect(cv2.bitwise_and(window, mask.disc))
    px = np.array([point.pt for point in found], float).reshape(-1, 2)
    return px + mask.corner_px, np.array([np.pi / 4 * point.size**2 for point in found])


def _scale_space(window: np.ndarray, mask: Mask, detector: DetectorSpec) -> tuple[np.ndarray, np.ndarray]:
    """scikit-image's Laplacian or difference of Gaussians, or determinant of Hessian."""
    from skimage.feature import blob_dog, blob_doh, blob_log  # takes a tenth of a second, and other methods need none

    contrast = detector.blob.threshold / LEVELS
    small, large = (radius / np.sqrt(2) for radius in detector.radius_px)
    inside = mask.disc > 0
    image = np.where(inside, window, np.median(window[inside])) / LEVELS
    if detector.method == "log":
        found = blob_log(image, min_sigma=small, max_sigma=large, num_sigma=LOG_STEPS, threshold=LOG_PEAK * contrast, overlap=OVERLAP)
    elif detector.method == "dog":
        found = blob_dog(image, min_sigma=small, max_sigma=large, sigma_ratio=DOG_RATIO, threshold=LOG_PEAK * contrast, overlap=OVERLAP)
    else:
        found = blob_doh(image, min_sigma=small, max_sigma=large, num_sigma=LOG_STEPS, threshold=DOH_PEAK * contrast**2, overlap=OVERLAP)
    rows, columns = found[:, 0].astype(int), found[:, 1].astype(int)
    found = found[inside[rows, columns]]
    return found[:, 1::-1] + mask.corner_px, 2 * np.pi * found[:, 2] ** 2


FINDERS = {"adaptive": _components, "fixed": _components, "simple": _simple, "log": _scale_space, "dog": _scale_space, "doh": _scale_space}


def reorder_to(graph: PinGraph, claims_px: np.ndarray, pins_px: np.ndarray) -> PinGraph:
    """A graph over found places (N, 2), reordered to the order of the pins (N, 2) that they are nearest to."""
    _, order = cKDTree(claims_px).query(pins_px)
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    return PinGraph(graph.kind, pins_px, place[graph.edges], graph.area_px2[order], [])
