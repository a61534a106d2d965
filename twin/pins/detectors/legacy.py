"""The published method as in the Tac-VGNN release (Apache-2.0), step by step. It is used for comparison.

The following properties of the release are kept: frames are resized to a fixed size; the mask is about the image's centre; pins are found
by OpenCV's SimpleBlobDetector; nodes are centred by one scalar median over x and y together; the hull's vertices are scaled about that
origin; a frame is refused if the number of blobs is not exactly the sensor's; nodes have the detector's order.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError, Voronoi

from scenes.pins import PinsSpec
from scenes.sensor import Polarity, RecordingSpec
from twin.errors import FrameError
from twin.frames.forms import gray_levels
from twin.pins.flips import directed_edges
from twin.types import Form, Frame, PinGraph

# Factor by which the hull's vertices are scaled about the origin (release).
HULL_SCALE = 1.1


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


@dataclass(frozen=True)
class LegacyObservation:
    """The result of the published method for a frame.

    Attributes
    ----------
    nodes_px : (K, 2) float
        Blobs in the detector's order, px of the input frame.
    found : int
        Number of blobs.
    valid : bool
        Whether exactly the sensor's number of pins was found.
    reason : str
        Why the frame is not valid; empty if it is.
    graph : PinGraph or None
        Nodes, cells and areas are in the release's unit: px of the resized image, centred by the scalar median.
    """

    nodes_px: np.ndarray
    found: int
    valid: bool
    reason: str
    graph: PinGraph | None


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


class LegacyPipeline:
    """The published preprocessing of a sensor's recordings.

    Parameters
    ----------
    pins : PinsSpec
        The layout decides which of the release's constants are used; the count is the only accepted number of blobs.
    recording : RecordingSpec or None

    Raises
    ------
    FrameError
        The sensor has no processed form.
    """

    def __init__(self, pins: PinsSpec, recording: RecordingSpec | None, *, polarity: Polarity = "bright") -> None:
        if polarity == "dark":
            raise FrameError("the published method finds bright pins only, and the sensor's are dark (polarity); use another method")
        if recording is None:
            raise FrameError("the published method takes recordings, and the sensor has no processed form ([recording])")
        self.count = pins.count
        self.parameters = legacy_parameters(pins.layout)
        self.size_px = recording.width_px, recording.height_px
        self._detector = legacy_detector(self.parameters)
        size = self.parameters.size_px
        center = (size // 2 + self.parameters.mask_offset_px[0], size // 2 + self.parameters.mask_offset_px[1])
        self._mask = cv2.circle(np.zeros((size, size), np.uint8), center, size // 2 - self.parameters.mask_margin_px, 255, -1)

    def __call__(self, frame: Frame) -> LegacyObservation:
        """Observe a recorded frame."""
        if frame.form != Form.PROCESSED or frame.image.shape[1::-1] != self.size_px:
            raise FrameError(f"{frame.name or 'frame'}: the published method takes recordings of {self.size_px[0]}x{self.size_px[1]} only")
        n, size = self.count, self.parameters.size_px
        gray = cv2.resize(gray_levels(frame.image), (size, size))
        _, binary = cv2.threshold(gray, self.parameters.threshold, 255, cv2.THRESH_BINARY)
        keypoints = self._detector.detect(cv2.bitwise_and(binary, self._mask))
        nodes = np.array([point.pt for point in keypoints], float).reshape(-1, 2)
        nodes_px = (nodes + 0.5) * (np.array(self.size_px) / size) - 0.5
        if len(nodes) != n:
            return LegacyObservation(nodes_px, len(nodes), False, f"{len(nodes)} blobs found, exactly {n} expected", None)
        try:
            return LegacyObservation(nodes_px, n, True, "", legacy_graph(nodes - np.median(nodes), self.parameters))
        except QhullError:
            return LegacyObservation(nodes_px, n, False, "the blobs have no tessellation", None)
