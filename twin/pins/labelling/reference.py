"""The reference: places of the pins of a sensor in a frame without contact, and their neighbours."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from scenes.pins import PinsSpec
from scenes.sensor import SensorSpec
from twin.camera.projection import project_in_form
from twin.compiled import compiled
from twin.errors import FrameError
from twin.frames.forms import form_named
from twin.geometry.drift import coherent_motions
from twin.geometry.pins import pin_lattice, rest_pins
from twin.pins.flips import Net, double_area, net_of
from twin.pins.voronoi import voronoi
from twin.types import Form

# Number of neighbours of a pin: two rings of a triangular lattice. They are enough for a local affine fit without the pin itself.
NEIGHBOURS = 18
# Least spread of the pins in every direction (smallest singular value of their places), px. The shipped sensors have 460 to 1600 px.
LEAST_SPREAD_PX = 1.0
# Least distance between two pins at rest, in median spacings. If two pins are nearer to each other, no frame shows them apart.
FOLDED = 0.02
# Number of pins at the rim from which labellings start, and approximate number of those inside.
RIM_STARTS, INSIDE_STARTS = 12, 6
# Largest distance of a pin from the frame's origin, px. It is larger than any camera's frame.
FARTHEST_PX = 1e6


@dataclass(frozen=True)
class Reference:
    """The layout without contact in px of one form of frame, in the specification's pin order.

    Attributes
    ----------
    pins_px : (N, 2) float
    neighbours : (N, k) int
        The k nearest other pins, by increasing distance.
    spacing_px : (N,) float
        Distance to the nearest other pin.
    triangles : (t, 3) int
        Delaunay triangles, all with the same orientation. Those of three outmost pins are left out.
    outmost : (m,) int
        The outmost pins, in order around the layout.
    area_px2 : (N,) float
        Voronoi cell areas.
    slots, ring_ends : (S,) int, (R + 1,) int
        Which pins form rings: see ``twin.geometry.pins.Lattice``.
    """

    pins_px: np.ndarray
    neighbours: np.ndarray
    spacing_px: np.ndarray
    triangles: np.ndarray
    outmost: np.ndarray
    area_px2: np.ndarray
    slots: np.ndarray
    ring_ends: np.ndarray
    _motions: dict[float, np.ndarray] = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def pitch_px(self) -> float:
        """Median of the spacings."""
        return float(np.median(self.spacing_px))

    @cached_property
    def starts(self) -> list[int]:
        """Pins from which labellings start: around the rim, where motion is least, then inside."""
        rim = self.outmost
        inner = np.setdiff1d(np.arange(len(self.pins_px)), rim)
        around = rim[np.linspace(0, len(rim), RIM_STARTS, endpoint=False).astype(int)]
        starts: list[int] = np.concatenate([around, inner[:: max(len(inner) // INSIDE_STARTS, 1)]]).tolist()
        return starts

    @cached_property
    def net(self) -> Net | None:
        """The triangles as a net from which those of moved pins follow; None if they make none.

        An outmost pin that is in none of them makes one with those beside it.
        """
        ears = np.column_stack([np.roll(self.outmost, 1), self.outmost, np.roll(self.outmost, -1)])
        ears = ears[~np.isin(self.outmost, self.triangles)]
        return net_of(_turned_alike(self.pins_px, np.concatenate([self.triangles, ears])), len(self.pins_px))

    @cached_property
    def rim_radius_px(self) -> float:
        """Mean distance of the outmost pins from their mean."""
        return mean_radius(self.pins_px[self.outmost])

    def motions(self, width: float) -> np.ndarray:
        """Coherent motions (N, m) of the pins (`twin.geometry.drift`), for a kernel of this width in spacings."""
        if width not in self._motions:
            self._motions[width] = coherent_motions(self.pins_px / self.pitch_px, width)
        return self._motions[width]

    def map_to(self, other: "Reference") -> np.ndarray:
        """Linear map (2, 2) of the same pins about their middle in another view: ``displacements @ map`` are those in that view."""
        here, there = (each.pins_px - each.pins_px.mean(axis=0) for each in (self, other))
        return np.linalg.lstsq(here, there, rcond=None)[0]


def mean_radius(px: np.ndarray) -> float:
    """Mean distance of points (n, 2) from their mean."""
    return float(np.linalg.norm(px - px.mean(axis=0), axis=1).mean())


@compiled()
def median_px(px: np.ndarray) -> np.ndarray:
    """Medians (2,) of points (n, 2)."""
    return np.array([np.median(px[:, 0]), np.median(px[:, 1])])


def spread_out(pins_px: np.ndarray) -> bool:
    """Whether pins (N, 2) spread over an area, as in every real frame. They do not if they lie at one place, on a line, or too far away."""
    if not np.isfinite(pins_px).all() or np.abs(pins_px).max() > FARTHEST_PX:
        return False
    return bool(np.linalg.svd(pins_px - pins_px.mean(axis=0), compute_uv=False)[-1] > LEAST_SPREAD_PX)


def together(pins_px: np.ndarray) -> np.ndarray:
    """Pins (N,) bool of pins (N, 2) that are at the place of another one: nearer to it than ``FOLDED`` median spacings."""
    spacing = cKDTree(pins_px).query(pins_px, k=2)[0][:, 1]
    return spacing <= FOLDED * np.median(spacing)


def make_reference(pins_px: np.ndarray, pins: PinsSpec) -> Reference:
    """Reference from rest positions (N, 2) of the pins of a layout.

    Raises
    ------
    FrameError
        The pins lie at one place, on a line, or farther away than in any camera's frame, or two of them at the same place.
    """
    lattice = pin_lattice(pins)
    pins_px = np.ascontiguousarray(pins_px, float)
    if not spread_out(pins_px):
        raise FrameError(
            "the pins at rest lie in one place, on a line or far off any frame; repair [camera] and [pins] of the sensor's specification, "
            "or pins_px of the tuned file"
        )
    n = len(pins_px)
    distance, index = cKDTree(pins_px).query(pins_px, k=min(NEIGHBOURS + 1, n))
    if distance[:, 1].min() == 0:
        one, other = index[distance[:, 1].argmin(), :2]
        raise FrameError(
            f"pins {one} and {other} are at the same place at rest; repair rest_px of the specification, or pins_px of the tuned file"
        )
    triangles = _turned_alike(pins_px, Delaunay(pins_px).simplices.astype(np.int64))
    inner = ~np.isin(triangles, lattice.outmost).all(axis=1)  # thin triangles of three outmost pins turn over without a wrong labelling
    triangles = triangles[inner]
    area_px2 = voronoi(pins_px, outmost=lattice.outmost).area_px2
    neighbours = np.ascontiguousarray(index[:, 1:])
    return Reference(pins_px, neighbours, distance[:, 1], triangles, lattice.outmost, area_px2, lattice.slots, lattice.ring_ends)


def nominal_reference(spec: SensorSpec, form: Form) -> Reference:
    """Reference from the specification alone: the measured places of its pins at rest, or its caps at rest projected by its camera.

    Raises
    ------
    FrameError
        The sensor has no processed form, or there is no such form.
    """
    blob = spec.pipeline.raw if form_named(form) == Form.RAW else spec.pipeline.processed
    if blob is not None and blob.rest_px:
        return make_reference(np.array(blob.rest_px), spec.pins)
    return make_reference(project_rest(spec, form), spec.pins)


def project_rest(spec: SensorSpec, form: Form) -> np.ndarray:
    """Places (N, 2) in px at which the specification's camera sees its caps at rest."""
    return project_in_form(spec, form, rest_pins(spec.geometry).caps_mm)


def _turned_alike(px: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Triangles (t, 3) over points (N, 2), turned over where their area is negative."""
    (ax, ay), (bx, by), (cx, cy) = px[triangles].transpose(1, 2, 0)
    negative = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0
    return np.where(negative[:, None], triangles[:, ::-1], triangles)


@compiled()
def count_turned_over(px: np.ndarray, triangles: np.ndarray, known: np.ndarray) -> int:
    """Number of triangles (t, 3) of pins whose orientation is reversed when the pins move to ``px`` (N, 2).

    Only those count whose three pins are ``known`` (N,) bool.
    """
    count = 0
    for a, b, c in triangles:
        count += known[a] and known[b] and known[c] and double_area(px, a, b, c) <= 0
    return count


def folded_fraction(reference: Reference, nodes_px: np.ndarray) -> float:
    """Share of the reference's triangles whose orientation is reversed when the pins move to ``nodes_px`` (N, 2)."""
    over: int = count_turned_over(nodes_px, reference.triangles, np.ones(len(nodes_px), bool))
    return over / max(len(reference.triangles), 1)  # a small layout has outmost pins alone, and no triangles
