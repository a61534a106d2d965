"""Shapes of a skin at rest (a spherical cap, a flat round pad and a flat rectangular pad, with one interface), and their charts.

A place on a skin is a complex number w. On caps and round pads it is a point of the unit disc: its angle is the azimuth, and its radius is
the distance along the skin from the centre, relative to the rim. On a rectangular pad it is a point of the square with corners at
+-1 +-i. The points with the same w on the outside, on the inside and on the window form one straight column through the body.

Each place also has a direction, a unit vector. On a hemisphere it points from the sphere's centre to the place. The places of other skins
are mapped to a hemisphere in the same way, so that the grid's focus (``Focus``) has the same meaning on all of them. A cap that is
larger than a hemisphere keeps its own directions.

A chart maps a square to the places of a dome or a rectangular pad. The grid of the square is fine around the contact. A ``Focus`` rotates
and stretches the image of the square:

    (u, v) -> w1 (squared disc) -> w2 = e^(i turn) w1 s(|w1|) / |w1| -> w = (w2 + a) / (1 + conj(a) w2)

The elliptical map x = u sqrt(1 - v^2 / 2), y = v sqrt(1 - u^2 / 2) maps the square to a disc without degenerate elements (Fong, "Analytical
methods for squaring the disc", 2015). The function s(r) = c r + (1 - c) r^5 concentrates the lines of the grid at the centre. A Moebius
transformation moves the centre to the contact, and maps the rim to itself. All three maps are smooth.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from scenes.base import SpecError
from scenes.body import SkinSpec
from scenes.pins import PinsSpec
from twin.types import BoolArray, ComplexArray, FloatArray

_POWER = 5
"""Power in s(r) = c r + (1 - c) r^5. A higher power makes the spacing of the lines within the focus more uniform."""
_FINE = 0.75
"""Radius of the part of the square that is mapped to the focus, relative to half the square's side."""
_LARGEST_SHIFT = 0.45
"""Largest shift a of the Moebius transformation. With more than 0.5, elements at the rim turn inside out for some rotations of the grid."""
_LEAST_SLOPE = 0.2
"""Smallest c on round skins. It limits how small the elements at the centre of the focus become."""

_LEAST_PAD_SLOPE = 0.5
"""Smallest c on rectangles: elements twice as fine are enough. The grid of a rectangle is fine along two whole strips, and coarse
elsewhere."""
_GOLDEN_RAD = np.pi * (1 + np.sqrt(5))
"""Angle from each point of a Fibonacci lattice to the next."""
_PIN_ROUNDING_MM = 1e-6
"""Tolerance for rounding: largest distance of a pin beyond the flat part of a pad."""


@dataclass(frozen=True)
class Focus:
    """The part of the dome on which the grid is fine.

    Attributes
    ----------
    polar_rad, azimuth_rad : float
        Direction of the centre of the fine part.
    radius_rad : float
        Angular radius of the fine part.
    turn_rad : float
        Rotation of the grid's rows about the centre. At the apex it is the azimuth of the rows.
    """

    polar_rad: float = 0.0
    azimuth_rad: float = 0.0
    radius_rad: float = float(np.radians(50.0))
    turn_rad: float = 0.0


@dataclass(frozen=True)
class Chart:
    """The map between (u, v) in [-1, 1]^2 and the unit disc, for a focus on a dome that ends at ``largest_polar_rad``."""

    focus: Focus
    largest_polar_rad: float

    @property
    def _shift(self) -> complex:
        size = min(self.focus.polar_rad / self.largest_polar_rad, _LARGEST_SHIFT)
        return complex(size * np.exp(1j * self.focus.azimuth_rad))

    @property
    def _centre_slope(self) -> float:
        return _slope(self.focus.radius_rad / self.largest_polar_rad / (1 - abs(self._shift) ** 2))

    def disc(self, square: FloatArray) -> ComplexArray:
        """Complex disc points (k,) of square points (k, 2)."""
        w = disc_of_square(square)
        r = np.minimum(np.abs(w), 1.0)
        c = self._centre_slope
        w = w * (c + (1 - c) * r ** (_POWER - 1)) * np.exp(1j * self.focus.turn_rad)
        a = self._shift
        return (w + a) / (1 + a.conjugate() * w)

    def square(self, disc: ComplexArray) -> FloatArray:
        """Square points (k, 2) of complex disc points (k,)."""
        a = self._shift
        w = (disc - a) / (1 - a.conjugate() * disc) * np.exp(-1j * self.focus.turn_rad)
        r = _ungather(np.minimum(np.abs(w), 1.0), self._centre_slope)
        return square_of_disc(w / np.maximum(np.abs(w), 1e-300) * r)


@dataclass(frozen=True)
class RectangleChart:
    """The map between (u, v) in [-1, 1]^2 and the places x + i y of a rectangle, in the same square, for a focus.

    Each axis uses the one-dimensional maps of ``Chart``: t -> s(t) -> (s + a) / (1 + a s). The lines of the grid stay parallel to the
    sides, so that corners are mapped to corners. The rotation of the focus is ignored.
    """

    focus: Focus
    largest_polar_rad: float

    @property
    def _axes(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Shift a and slope c of the axes u and v."""
        size = min(self.focus.polar_rad / self.largest_polar_rad, 1.0)
        middle = square_of_disc(np.array([size * np.exp(1j * self.focus.azimuth_rad)]))[0]
        reach = self.focus.radius_rad / self.largest_polar_rad
        shifts = np.clip(middle, -_LARGEST_SHIFT, _LARGEST_SHIFT).tolist()
        slopes = [max(_slope(reach / (1 - a * a)), _LEAST_PAD_SLOPE) for a in shifts]
        return (shifts[0], slopes[0]), (shifts[1], slopes[1])

    def disc(self, square: FloatArray) -> ComplexArray:
        """Places (k,) of square points (k, 2)."""
        x, y = ((s + a) / (1 + a * s) for s, a in ((_gather(t, c), a) for t, (a, c) in zip(square.T, self._axes, strict=True)))
        return x + 1j * y

    def square(self, disc: ComplexArray) -> FloatArray:
        """Square points (k, 2) of places (k,)."""
        shifted = ((p - a) / (1 - a * p) for p, (a, _) in zip((disc.real, disc.imag), self._axes, strict=True))
        return np.column_stack(
            [np.sign(s) * _ungather(np.minimum(np.abs(s), 1.0), c) for s, (_, c) in zip(shifted, self._axes, strict=True)]
        )


def disc_of_square(square: FloatArray) -> ComplexArray:
    """Complex disc points (k,) of square points (k, 2), by the elliptical map."""
    u, v = square.T
    return u * np.sqrt(1 - v * v / 2) + 1j * v * np.sqrt(1 - u * u / 2)


def square_of_disc(disc: ComplexArray) -> FloatArray:
    """Inverse of ``disc_of_square``."""
    x, y = disc.real, disc.imag
    root = 2 * np.sqrt(2)

    def half(p: FloatArray, q: FloatArray) -> FloatArray:
        plus = np.sqrt(np.maximum(2 + p * p - q * q + root * p, 0))
        return (plus - np.sqrt(np.maximum(2 + p * p - q * q - root * p, 0))) / 2

    return np.column_stack([half(x, y), half(y, x)])


def _slope(share: float) -> float:
    """Slope c with which s maps ``_FINE`` to ``share``, the radius of the focus relative to the rim; limited to permitted values."""
    return float(np.clip((share - _FINE**_POWER) / (_FINE - _FINE**_POWER), _LEAST_SLOPE, 1.0))


def _gather(r: FloatArray, c: float) -> FloatArray:
    """s(r) = c r + (1 - c) r^5."""
    return r * (c + (1 - c) * r ** (_POWER - 1))


def _ungather(wanted: FloatArray, c: float) -> FloatArray:
    """Inverse of ``_gather`` for values from 0 to 1, by Newton's method from above: s is convex there."""
    r = np.ones_like(wanted)
    for _ in range(60):
        step = (_gather(r, c) - wanted) / (c + _POWER * (1 - c) * r ** (_POWER - 1))
        r = r - step
        if np.abs(step).max(initial=0) < 1e-15:
            break
    return r


@dataclass(frozen=True)
class SkinShape(ABC):
    """Geometry of one skin at rest, as functions of places.

    Attributes
    ----------
    skin : SkinSpec
    """

    skin: SkinSpec

    @property
    def largest_rad(self) -> float:
        """Angle between the direction of the rim and the sensor's axis."""
        return float(np.pi / 2)

    def chart(self, focus: Focus) -> Chart | RectangleChart:
        """The map from the grid's square to places, fine around a focus."""
        return Chart(focus, self.largest_rad)

    @abstractmethod
    def outside(self, place: ComplexArray) -> FloatArray:
        """Points (k, 3) mm of the outside."""

    @abstractmethod
    def inside(self, place: ComplexArray) -> FloatArray:
        """Points (k, 3) mm of the inside."""

    @abstractmethod
    def flat(self, place: ComplexArray) -> FloatArray:
        """x and y (k, 2) mm at which the columns of the places end on the window."""

    @abstractmethod
    def place(self, inside_mm: FloatArray) -> ComplexArray:
        """Places (k,) of points (k, 3) of the inside."""

    @abstractmethod
    def on_outside(self, near_mm: FloatArray) -> FloatArray:
        """Projections (k, 3) onto the outside of points (k, 3) close to it."""

    @abstractmethod
    def beneath(self, place: ComplexArray, depth_mm: float) -> FloatArray:
        """Points (k, 3) mm at a depth below the outside: towards the centre of a cap, or along z below a pad."""

    @abstractmethod
    def pins(self, layout: FloatArray, pins: PinsSpec) -> tuple[FloatArray, FloatArray]:
        """Feet (N, 3) mm and outward normals (N, 3) of pins, from their layout (N, 2) with the outermost pin at distance 1."""

    @abstractmethod
    def normals(self, inside_mm: FloatArray) -> FloatArray:
        """Outward unit normals (k, 3) at points (k, 3) of the inside."""

    def disc(self, place: ComplexArray) -> ComplexArray:
        """Points (k,) of the unit disc to which places are mapped; the rim has the radius 1."""
        return place

    def even(self, count: int, *, turn_rad: float = 0.0) -> ComplexArray:
        """Places that are evenly distributed over the outside; ``count`` is their number on a whole sphere.

        On round shapes they are rotated by ``turn_rad``.
        """
        k = np.arange(count // 2) + 0.5
        return np.sqrt(2 * k / count) * np.exp(1j * (_GOLDEN_RAD * k + turn_rad))

    def near(self, place: complex, spread: float, count: int) -> ComplexArray:
        """About ``count`` places around ``place``, within a distance of ``spread`` relative to the rim."""
        k = np.arange(count) + 0.5
        around = place + spread * np.sqrt(k / count) * np.exp(1j * _GOLDEN_RAD * k)
        return around[self.rim_share(around) <= 1]

    def rim_share(self, place: ComplexArray) -> FloatArray:
        """Distance (k,) of places from the centre along the skin: 0 at the centre, 1 at the rim."""
        return np.abs(place)

    def rim(self, around: int) -> ComplexArray:
        """Places (around,) on the rim, one turn from x towards y."""
        return np.exp(2j * np.pi * np.arange(around) / around)

    def directions(self, place: ComplexArray) -> FloatArray:
        """Unit vectors (k, 3) of places."""
        disc = self.disc(place)
        polar, azimuth = self.largest_rad * np.abs(disc), np.angle(disc)
        return np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])

    def body(self, place: ComplexArray, depth: float, window_z_mm: float) -> FloatArray:
        """Points (k, 3) of the body: depth 0 is the outside, 1 the inside, 2 the window, with straight lines between them."""
        inner = self.inside(place)
        if depth <= 1:
            outer = self.outside(place)
            return outer + depth * (inner - outer)
        window = np.column_stack([self.flat(place), np.full(len(place), window_z_mm)])
        return inner + (depth - 1) * (window - inner)


@dataclass(frozen=True)
class Cap(SkinShape):
    """Part of a sphere."""

    @property
    def _inner_mm(self) -> float:
        return self.skin.outer_radius_mm - self.skin.thickness_mm

    def _polar(self, radius_mm: float) -> float:
        return float(np.arccos(np.clip(self.skin.rim_z_mm / radius_mm, -1, 1)))

    @property
    def largest_rad(self) -> float:
        return max(self._polar(self._inner_mm), np.pi / 2)

    def _sphere(self, place: ComplexArray, radius_mm: float) -> FloatArray:
        polar, azimuth = self._polar(radius_mm) * np.abs(place), np.angle(place)
        return radius_mm * np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])

    def outside(self, place: ComplexArray) -> FloatArray:
        return self._sphere(place, self.skin.outer_radius_mm)

    def inside(self, place: ComplexArray) -> FloatArray:
        return self._sphere(place, self._inner_mm)

    def flat(self, place: ComplexArray) -> FloatArray:
        ends = np.sqrt(self._inner_mm**2 - self.skin.rim_z_mm**2) * place
        return np.column_stack([ends.real, ends.imag])

    def place(self, inside_mm: FloatArray) -> ComplexArray:
        x, y, z = inside_mm.T
        return np.arctan2(np.hypot(x, y), z) / self._polar(self._inner_mm) * np.exp(1j * np.arctan2(y, x))

    def on_outside(self, near_mm: FloatArray) -> FloatArray:
        return near_mm * (self.skin.outer_radius_mm / np.linalg.norm(near_mm, axis=1, keepdims=True))

    def beneath(self, place: ComplexArray, depth_mm: float) -> FloatArray:
        return self._sphere(place, self.skin.outer_radius_mm) * (1 - depth_mm / self.skin.outer_radius_mm)

    def normals(self, inside_mm: FloatArray) -> FloatArray:
        return inside_mm / np.linalg.norm(inside_mm, axis=1, keepdims=True)

    def even(self, count: int, *, turn_rad: float = 0.0) -> ComplexArray:
        k = np.arange(count) + 0.5
        polar = np.arccos(1 - 2 * k / count)
        disc = polar / self._polar(self.skin.outer_radius_mm) * np.exp(1j * (_GOLDEN_RAD * k + turn_rad))
        return disc[np.abs(disc) <= 1]

    def pins(self, layout: FloatArray, pins: PinsSpec) -> tuple[FloatArray, FloatArray]:
        place = layout @ [1, 1j]
        largest = pins.largest_polar_rad(self._inner_mm)
        if largest is None:
            raise SpecError("pins.reach_mm puts pins behind skin.rim_z_mm")
        polar = largest * np.abs(place) if pins.spacing == "polar" else np.arcsin(np.sin(largest) * np.abs(place))
        azimuth = np.angle(place) + np.radians(pins.phase_deg)
        outward = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
        return self._inner_mm * outward, outward


@dataclass(frozen=True)
class Pad(SkinShape):
    """A flat skin with an edge that is rounded to a quarter of a circle, so that the rim is ``edge_mm`` behind the outside."""

    @property
    def edge_mm(self) -> float:
        """Radius of the rounded edge on the outside; 0 for a skin that is flat up to its rim."""
        return -self.skin.rim_z_mm

    @property
    def _inner_edge_mm(self) -> float:
        return max(self.edge_mm - self.skin.thickness_mm, 0.0)

    def _profile(self, share: FloatArray, half_mm: float, edge_mm: float) -> tuple[FloatArray, FloatArray]:
        """Distance from the centre (mm), and height (1 on the flat part, 0 at the rim), at a relative distance ``share`` along the outside.

        ``half_mm`` is half the outside's size, and ``edge_mm`` is the radius of the rounded edge of the requested surface.
        """
        size, flat_mm = np.abs(share), half_mm - self.edge_mm
        length_mm = flat_mm + self.edge_mm * np.pi / 2
        if self.edge_mm == 0:
            return share * half_mm, np.ones_like(size)
        angle = np.maximum(size * length_mm - flat_mm, 0) / self.edge_mm
        return np.sign(share) * (np.minimum(size * length_mm, flat_mm) + edge_mm * np.sin(angle)), np.cos(np.minimum(angle, np.pi / 2))

    def _share(self, at_mm: FloatArray, half_mm: float, radius_mm: float) -> FloatArray:
        """Inverse of the inside's profile: the relative distance for distances from the centre in mm."""
        size, flat_mm = np.abs(at_mm), half_mm - self.edge_mm
        if self.edge_mm == 0:
            return at_mm / half_mm
        sine = np.clip((size - flat_mm) / radius_mm, 0, 1)
        return np.sign(at_mm) * (np.minimum(size, flat_mm) + self.edge_mm * np.arcsin(sine)) / (flat_mm + self.edge_mm * np.pi / 2)

    @abstractmethod
    def _on_flat(self, feet_mm: FloatArray) -> BoolArray:
        """Whether places (k, 2) in mm are on the flat part."""

    def pins(self, layout: FloatArray, pins: PinsSpec) -> tuple[FloatArray, FloatArray]:
        if pins.reach_mm is None:
            raise SpecError("pins.reach_mm is missing: on a flat pad it is the distance of the outermost pin from the axis")
        turned = layout @ [1, 1j] * pins.reach_mm * np.exp(1j * np.radians(pins.phase_deg))
        feet = np.column_stack([turned.real, turned.imag])
        if beyond := np.count_nonzero(~self._on_flat(feet)):
            raise SpecError(f"pins beyond the flat part of the pad: {beyond}; make pins.reach_mm smaller, or turn the layout")
        return np.column_stack([feet, np.full(len(feet), -self.skin.thickness_mm)]), np.tile([0.0, 0.0, 1.0], (len(feet), 1))

    @abstractmethod
    def _surface(self, place: ComplexArray, edge_mm: float, drop_mm: float) -> FloatArray:
        """Points (n, 3) of a surface whose edge has this radius, and whose flat part lies this deep."""

    def outside(self, place: ComplexArray) -> FloatArray:
        return self._surface(place, self.edge_mm, 0.0)

    def inside(self, place: ComplexArray) -> FloatArray:
        return self._surface(place, self._inner_edge_mm, self.skin.thickness_mm)

    def on_outside(self, near_mm: FloatArray) -> FloatArray:
        return self.outside(self._outside_place(near_mm))

    def beneath(self, place: ComplexArray, depth_mm: float) -> FloatArray:
        return self.outside(place) - [0, 0, depth_mm]

    @abstractmethod
    def _outside_place(self, near_mm: FloatArray) -> ComplexArray:
        """Places (k,) of points (k, 3) near the outside."""

    def normals(self, inside_mm: FloatArray) -> FloatArray:
        step = 1e-6
        place = self.place(inside_mm) * (1 - 2 * step)  # keeps the difference quotient within the rim
        along_x, along_y = (self.inside(place + d) - self.inside(place - d) for d in (step, 1j * step))
        across = np.cross(along_x, along_y)
        return across / np.linalg.norm(across, axis=1, keepdims=True)


@dataclass(frozen=True)
class RoundPad(Pad):
    """A flat disc."""

    def _surface(self, place: ComplexArray, edge_mm: float, drop_mm: float) -> FloatArray:
        far, height = self._profile(np.abs(place), self.skin.outer_radius_mm, edge_mm)
        at = far * np.exp(1j * np.angle(place))
        return np.column_stack([at.real, at.imag, edge_mm * (height - 1) - drop_mm])

    def flat(self, place: ComplexArray) -> FloatArray:
        ends = (self.skin.outer_radius_mm - self.edge_mm + self._inner_edge_mm) * place
        return np.column_stack([ends.real, ends.imag])

    def place(self, inside_mm: FloatArray) -> ComplexArray:
        far = np.hypot(inside_mm[:, 0], inside_mm[:, 1])
        turn: ComplexArray = np.exp(1j * np.arctan2(inside_mm[:, 1], inside_mm[:, 0]))
        return turn * self._share(far, self.skin.outer_radius_mm, self._inner_edge_mm)

    def _outside_place(self, near_mm: FloatArray) -> ComplexArray:
        x, y, z = near_mm.T
        flat_mm, far = self.skin.outer_radius_mm - self.edge_mm, np.hypot(x, y)
        angle = np.arctan2(np.maximum(far - flat_mm, 0), np.maximum(z + self.edge_mm, 0))
        along = np.where(far > flat_mm, flat_mm + self.edge_mm * angle, far) if self.edge_mm else far
        return along / (flat_mm + self.edge_mm * np.pi / 2) * np.exp(1j * np.arctan2(y, x))

    def _on_flat(self, feet_mm: FloatArray) -> BoolArray:
        return np.hypot(*feet_mm.T) <= self.skin.outer_radius_mm - self.edge_mm + _PIN_ROUNDING_MM


@dataclass(frozen=True)
class RectangularPad(Pad):
    """A flat rectangle. At its rounded edge the height is the product of the heights of both directions, which also rounds the corners."""

    def chart(self, focus: Focus) -> RectangleChart:
        return RectangleChart(focus, self.largest_rad)

    def disc(self, place: ComplexArray) -> ComplexArray:
        return disc_of_square(np.column_stack([place.real, place.imag]))

    def even(self, count: int, *, turn_rad: float = 0.0) -> ComplexArray:
        width, height = self.skin.half_size_mm
        columns = int(np.ceil(np.sqrt(count / 2 * width / height)))
        rows = int(np.ceil(count / 2 / columns))
        y, x = np.mgrid[:rows, :columns]
        return ((2 * x + 1) / columns - 1 + 1j * ((2 * y + 1) / rows - 1)).ravel()

    def rim_share(self, place: ComplexArray) -> FloatArray:
        return np.maximum(np.abs(place.real), np.abs(place.imag))

    def rim(self, around: int) -> ComplexArray:
        turn = np.exp(2j * np.pi * np.arange(around) / around)
        return turn / np.maximum(np.abs(turn.real), np.abs(turn.imag))

    def _surface(self, place: ComplexArray, edge_mm: float, drop_mm: float) -> FloatArray:
        (x, high_x), (y, high_y) = (
            self._profile(part, half, edge_mm) for part, half in zip((place.real, place.imag), self.skin.half_size_mm, strict=True)
        )
        return np.column_stack([x, y, edge_mm * (high_x * high_y - 1) - drop_mm])

    def flat(self, place: ComplexArray) -> FloatArray:
        shrunk = self._inner_edge_mm - self.edge_mm
        width, height = self.skin.half_size_mm
        return np.column_stack([(width + shrunk) * place.real, (height + shrunk) * place.imag])

    def _place(self, at_mm: FloatArray, edge_mm: float) -> tuple[FloatArray, FloatArray]:
        """x and y of the places of points (k, 3) of the surface whose edge has this radius."""
        width, height = self.skin.half_size_mm
        return self._share(at_mm[:, 0], width, edge_mm), self._share(at_mm[:, 1], height, edge_mm)

    def place(self, inside_mm: FloatArray) -> ComplexArray:
        x, y = self._place(inside_mm, self._inner_edge_mm)
        return x + 1j * y

    def _outside_place(self, near_mm: FloatArray) -> ComplexArray:
        x, y = np.clip(self._place(near_mm, self.edge_mm), -1, 1)
        return x + 1j * y

    def _on_flat(self, feet_mm: FloatArray) -> BoolArray:
        return np.abs(feet_mm / (np.array(self.skin.half_size_mm) - self.edge_mm + _PIN_ROUNDING_MM)).max(axis=1) <= 1


_SHAPES: dict[str, type[SkinShape]] = {"cap": Cap, "round-pad": RoundPad, "rectangular-pad": RectangularPad}


def shape_of(skin: SkinSpec) -> SkinShape:
    """The shape of a specification's skin."""
    return _SHAPES[skin.shape](skin)
