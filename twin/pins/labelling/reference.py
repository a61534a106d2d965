"""The reference: places of the pins of a sensor in a frame without contact, and their neighbours; and the camera's view of such pins.

A view compares pins at rest with known places: how the picture is displaced, and what no displacement explains. The known places are mapped
to the present ones by an affine map: shift, turn, scale, stretch, mirror. What it leaves, less the effects of another tilt, distance or
distortion of the camera, has two parts. Motion that neighbouring pins share is a dent: the skin is pressed. Motion of each pin alone is
noise or tolerances of the print. On a symmetric layout the pins of a turned or mirrored picture can be named as if it were not; only the
tolerances of the known unit decide. So all namings are tried, and the decision is sure if one explains them far better.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from scenes.pins import PinsSpec
from scenes.sensor import SensorSpec
from twin.camera.projection import project_in_form
from twin.errors import FrameError
from twin.frames.forms import form_named
from twin.geometry.drift import coherent_motions
from twin.geometry.pins import namings, pin_lattice, rest_pins
from twin.pins.voronoi import Net, net_of, voronoi
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
SURE = 0.8
"""Largest ratio of what the best and the second naming leave of each pin alone, for the best to be sure. The unit of the known places has
0.01 to 0.05 in a frame at rest and about 0.7 in a contact of 1 mm, another unit of the same drawing 0.90."""
SAME_LEFT = 0.012
"""What is left of each pin alone, in spacings, below which the frame shows the unit of the known places, as it also does if a naming is
sure. Two units of one drawing differ by 0.017 or more."""
MOST_DENT, MOST_FLAT = (0.02, 0.045), (0.08, 0.09)
"""Largest dent without contact, in spacings, on the unit of the known places and on others: if the camera's distance and lens may differ,
and if only its tilt may (``flat``, because a plate from the front is much like another lens). Measured at rest: 0.022 to 0.031 and 0.024 to
0.060 on other units. Contacts: ``docs/your-own-sensor.md``."""
NOISE = 0.6
"""Largest dent relative to what is left of each pin alone: in coarse pictures the noise of the pins is larger than the limits above."""
MOST_UNEVEN = 0.06
"""Largest dent, in spacings, from the smooth view of a layout, if no places at rest are known. Measured at rest: 0.011 to 0.025 in real
sensors, 0.053 with a camera tilted by 7 deg."""
AROUND, ALONE = 18, 6
"""Number of nearest pins with which a pin's motion is averaged in a dent, and from which its motion alone is counted."""
MOST_TURN_DEG, MOST_STRETCH, MOST_ZOOM, MOST_SHIFT = 5.0, 0.03, 0.05, 1.0
"""Largest turn, stretch, zoom, and shift (spacings) of the picture with which estimates were measured to hold
(``docs/your-own-sensor.md``)."""
MOST_ZOOM_PRESSED = 0.12
"""Largest zoom if the pins are those of contacts, which bulge the rim by 0.03 in the median and 0.1 at most."""
TILTED = 8
"""Number of the terms that an affine map and the camera's tilt have."""
TILT_DEG, NEARER, CURVED = 0.3, 0.01, 0.01
"""Steps of the camera's tilt, distance (share) and distortion by which their effects are computed."""


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
    def beside(self) -> np.ndarray:
        """Places (N, k, 3) of the neighbours relative to each pin, in its spacings, and their weights 1 / (0.5 + x^2 + y^2)."""
        away = (self.pins_px[self.neighbours] - self.pins_px[:, None]) / self.spacing_px[:, None, None]
        return np.concatenate([away, 1 / (0.5 + (away**2).sum(axis=2, keepdims=True))], axis=2)

    @cached_property
    def rim_radius_px(self) -> float:
        """Mean distance of the outmost pins from their mean."""
        return mean_radius(self.pins_px[self.outmost])

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

    def rim_scale(self, px: np.ndarray) -> float:
        """Mean distance of the outmost pins from their mean when the pins move to ``px`` (N, 2), relative to that at rest."""
        return mean_radius(px[self.outmost]) / self.rim_radius_px

    def folded_fraction(self, px: np.ndarray) -> float:
        """Share of the triangles whose orientation is reversed when the pins move to ``px`` (N, 2)."""
        over = np.count_nonzero(_areas2(px, self.triangles) <= 0)
        return over / max(len(self.triangles), 1)  # a small layout has outmost pins alone, and no triangles

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


def median_px(px: np.ndarray) -> np.ndarray:
    """Medians (2,) of finite points (n, 2): as ``np.median``, in a fifth of its time."""
    ordered = np.sort(px, axis=0)
    return (ordered[(len(px) - 1) // 2] + ordered[len(px) // 2]) / 2


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
    return np.where(_areas2(px, triangles)[:, None] < 0, triangles[:, ::-1], triangles)


def _areas2(px: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Twice the signed areas (t,) of triangles (t, 3) over points (N, 2)."""
    (ax, bx, cx), (ay, by, cy) = px[:, 0].take(triangles).T, px[:, 1].take(triangles).T
    areas: np.ndarray = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    return areas


def count_turned_over(px: np.ndarray, triangles: np.ndarray, known: np.ndarray) -> int:
    """Number of triangles (t, 3) of pins whose orientation is reversed when the pins move to ``px`` (N, 2).

    Only those count whose three pins are ``known`` (N,) bool.
    """
    if not known.all():
        triangles = triangles[known[triangles].all(axis=1)]
    return int(np.count_nonzero(_areas2(px, triangles) <= 0))


def smooth_view(places: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Fit a smooth view of a layout to its pins, and return the positions (N, 2), px, of all pins in this view.

    The view is a polynomial of the third degree with radial terms of the fifth degree. It can represent the camera's position, turn, tilt
    and distortion, and the projection of the dome.

    Parameters
    ----------
    places : (N, 2) float
        Places of the layout.
    px : (N, 2) float
        Pins, px; NaN where unknown.
    """
    known, terms = np.isfinite(px[:, 0]), view_terms(places)
    solved = np.linalg.lstsq(terms[known], px[known], rcond=None)[0]
    return terms @ solved


def view_terms(places: np.ndarray) -> np.ndarray:
    """The terms (N, 10) of a smooth view at places (N, 2)."""
    x, y = places.T
    r2 = x * x + y * y
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y, x * r2, y * r2, x * r2 * r2, y * r2 * r2])


@dataclass(frozen=True)
class PinView:
    """The affine map from known places of the pins to present ones, and what it leaves.

    Attributes
    ----------
    shift_px : (2,) float
        Shift of the pins' middle.
    matrix : (2, 2) float
        Map of the places relative to their middle.
    left : float
        Rms motion of each pin alone, in spacings.
    dent, flat : float
        Largest motion that neighbouring pins share and that no camera explains, in spacings; ``flat``: none of the same distance and lens.
    spacing_px : float
        Mean spacing of the known places.
    order : (N,) int
        Present pin at each known place; -1 if it is missing.
    sure : bool
        Whether the tolerances of the pins decide between the namings of a symmetric layout.
    same : bool
        Whether the pins are those of the unit that the known places are of.
    """

    shift_px: np.ndarray
    matrix: np.ndarray
    left: float
    dent: float
    flat: float
    spacing_px: float
    order: np.ndarray
    sure: bool = False
    same: bool = False

    @property
    def mirrored(self) -> bool:
        """Whether the picture is mirrored left to right."""
        return bool(np.linalg.det(self.matrix) < 0)

    @property
    def turn_deg(self) -> float:
        """Turn from x towards y, after the mirror: that of the polar decomposition."""
        left, _, right = np.linalg.svd(self.matrix @ np.diag([-1.0 if self.mirrored else 1.0, 1.0]))
        turn = left @ right
        return float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))

    @property
    def scale(self) -> float:
        """Mean scale."""
        return float(np.sqrt(abs(np.linalg.det(self.matrix))))

    @property
    def stretch(self) -> float:
        """By how much the largest scale exceeds the smallest, as a share."""
        large, small = np.linalg.svd(self.matrix)[1]
        return float(large / small - 1)

    @property
    def pressed(self) -> bool:
        """Whether the pins are dented more than without contact."""
        return self._dented[0] > self._dented[1]

    @property
    def _dented(self) -> tuple[float, float]:
        """The dent, or its flat part, that is larger relative to the largest one without contact, and that largest one."""
        both = ((self.dent, MOST_DENT), (self.flat, MOST_FLAT))
        return max(((value, max(most[not self.same], NOISE * self.left)) for value, most in both), key=lambda each: each[0] / each[1])

    def require_unpressed(self, name: str, spec: SensorSpec) -> None:
        """Refuse the frame ``name`` as one without contact of a sensor if its pins are dented.

        Raises
        ------
        FrameError
        """
        if self.pressed:
            raise FrameError(
                f"{name}: the sensor seems pressed, or it is another one: neighbouring pins are dented by {self._dented[0]:.2f} of their "
                f"spacing from where {spec.name} has them without contact (allowed {self._dented[1]:.2f}); {NO_CONTACT_REMEDY}"
            )

    def displacements(self, *, contacts: bool = False) -> list[str]:
        """The displacements of the picture that estimates do not tolerate, in words; ``contacts``: the pins are those of contacts."""
        shift, zoom = float(np.linalg.norm(self.shift_px)) / self.spacing_px, self.scale - 1
        found = ["mirrored"] if self.mirrored else []
        found += [f"turned by {self.turn_deg:.1f} deg"] if abs(self.turn_deg) > MOST_TURN_DEG else []
        found += [f"stretched by {self.stretch:.1%}"] if self.stretch > MOST_STRETCH * (2 if contacts else 1) else []
        found += [f"zoomed by {zoom:+.1%}"] if abs(zoom) > (MOST_ZOOM_PRESSED if contacts else MOST_ZOOM) else []
        return found + ([f"shifted by {shift:.1f} spacings of the pins"] if shift > MOST_SHIFT else [])

    def describe_ambiguity(self) -> str:
        """What can't be seen of the view, and what decides; "" if the view is sure."""
        return "" if self.sure else f"{UNDECIDED}: {DECIDES}"

    def require_small(self, name: str, known: str, *, contacts: bool = False) -> None:
        """Refuse a displaced picture ``name``; ``known`` says whose places are known.

        Raises
        ------
        FrameError
        """
        if found := self.displacements(contacts=contacts):
            raise FrameError(
                f"{name}: the camera's picture is {' and '.join(found)} against {known}, so estimates would be wrong; another frame "
                "without contact does not help: put the camera back, or write this view into a copy of the specification ('twin check "
                "FRAMES --no-contact REST --push x:FRAME --push y:FRAME --out mine.toml') and train on it"
            )


NO_CONTACT_REMEDY = (
    "move it clear of everything and take a frame without contact (init_0.png beside the frames, `no_contact` FRAME, `at_rest` FRAME), or "
    "leave this one out"
)
"""What to do if a frame is refused as one without contact."""
UNDECIDED = (
    "the pins look alike under turns and mirror images of their layout, and are not those of the known unit, so a turn by a symmetry of "
    "the layout or a mirror can't be seen"
)
DECIDES = "two pushes to known sides decide ('twin check FRAMES --no-contact REST --push x:FRAME --push y:FRAME --out mine.toml')"


def camera_modes(spec: SensorSpec, form: Form) -> np.ndarray:
    """Motions (4, N, 2), px, of the pins at rest by a tilt about x and y, another distance and another distortion of the camera."""
    steps = {"tilt_x_deg": TILT_DEG, "tilt_y_deg": TILT_DEG, "distance_mm": NEARER * spec.camera.distance_mm, "k1": CURVED}

    def project_with(**added: float) -> np.ndarray:
        camera = {key: getattr(spec.camera, key) + by for key, by in added.items()}
        return project_in_form(spec.alter(camera=camera), form, rest_pins(spec.geometry).caps_mm)

    return np.stack([project_with(**{key: by}) for key, by in steps.items()]) - project_with()


def view_of(pins_px: np.ndarray, known: Reference, pins: PinsSpec, modes: np.ndarray | None = None) -> PinView:
    """The view of pins (N, 2), px, NaN where lost, whose known places are ``known``; ``modes`` as by ``camera_modes``.

    If no naming is sure, it is the one with the smallest turn, and without a mirror.
    """
    tried = sorted(views_of(pins_px, known, pins, modes), key=lambda view: view.left)
    ratio = tried[0].left / max(tried[1].left, 1e-12) if len(tried) > 1 else 0.0
    sure = ratio < SURE
    chosen = tried[0] if sure else min(tried, key=lambda view: (view.mirrored, abs(view.turn_deg)))
    return replace(chosen, sure=sure, same=chosen.left < SAME_LEFT or (sure and len(tried) > 1))


def views_of(pins_px: np.ndarray, known: Reference, pins: PinsSpec, modes: np.ndarray | None = None) -> list[PinView]:
    """The views by all namings of the layout, none of them sure; parameters as for ``view_of``."""
    spacing, middle = float(known.spacing_px.mean()), known.pins_px.mean(axis=0)
    place = (known.pins_px - middle) / spacing
    terms = np.column_stack([np.ones(len(place)), place])
    flat = np.kron(terms, np.eye(2))
    if modes is not None:
        flat = np.column_stack([flat, *(mode.ravel() / max(float(np.abs(mode).max()), 1e-12) for mode in modes)])
    nearest = np.column_stack([np.arange(len(place)), known.neighbours[:, :AROUND]])
    padded, found = np.vstack([pins_px, [np.nan, np.nan]]), []
    for order in namings(pins):
        px = padded[order]
        seen = np.isfinite(px[:, 0])
        carry = np.linalg.lstsq(terms[seen], px[seen], rcond=None)[0]
        moved = (px - carry[0]) @ np.linalg.pinv(carry[1:]) - place
        away, still = (
            moved - (by @ np.linalg.lstsq(by[np.repeat(seen, 2)], moved[seen].ravel(), rcond=None)[0]).reshape(-1, 2)
            for by in (flat, flat[:, :TILTED])
        )
        alone = (away - _mean(away[nearest[:, 1 : ALONE + 1]]))[seen]
        left = float(np.sqrt(np.mean(np.sum(alone**2, axis=1)) * ALONE / (ALONE + 1)))
        dent, unlike = (float(np.linalg.norm(_mean(each[nearest]), axis=1).max()) for each in (away, still))
        found.append(PinView(carry[0] - middle, carry[1:].T / spacing, left, dent, unlike, spacing, order))
    return found


def uneven_dent(pins: PinsSpec, pins_px: np.ndarray) -> float:
    """Largest dent, in spacings, of pins (N, 2), NaN where lost, from every smooth view of their layout."""
    places = pin_lattice(pins).places
    smooth = smooth_view(places, pins_px)
    known = make_reference(smooth, pins)
    away = (pins_px - smooth)[np.column_stack([np.arange(len(places)), known.neighbours])]
    return float(np.linalg.norm(_mean(away), axis=1).max() / known.spacing_px.mean())


def _mean(moved: np.ndarray) -> np.ndarray:
    """Means (N, 2) of motions (N, k, 2) without NaN; 0 where all are NaN."""
    known = np.isfinite(moved[..., :1])
    return np.where(known, moved, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
