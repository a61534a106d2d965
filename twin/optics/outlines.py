"""Outlines of pins on the film: of stem, cap side and cap face, in px of the raw frame."""

import numpy as np

from scenes.sensor import AppearanceSpec, PinsSpec, ViewSpec
from twin.optics.surfaces import CAP_BEVEL, cap_outlines
from twin.projection import project
from twin.types import FloatArray

SIDES = 16
"""Corners of an outline's polygon."""
RIM_PLACES = 6
"""Places of a rim that are projected. The image of a rim is smooth, so that they determine it."""
EVENLY = np.sqrt(np.sin(np.pi / 12) / (np.pi / 12) * (2 * np.pi / SIDES) / np.sin(2 * np.pi / SIDES))
"""Factor on the radius that gives the polygon the area of its round outline."""
TURN = np.arange(SIDES) * 2 * np.pi / SIDES
"""Azimuths of an outline's corners (rad)."""


class PinOutlines:
    """Projects the pins of one sensor.

    A cap's rim is projected at `RIM_PLACES` places t. The part of its image that is odd under half a turn grows with the
    radius, the even part with the square of the radius. That gives every outline about the same axis: with f the radius relative
    to the rim's, it is ``centre + f(t) odd(t) + f(t)^2 even(t)``. The image of a disc further along the axis is taken to be the
    same image, shifted.
    """

    def __init__(self, view: ViewSpec, pins: PinsSpec, appearance: AppearanceSpec) -> None:
        self._view, self._pins = view, pins
        shapes = cap_outlines(appearance, SIDES)
        self._cap = EVENLY * (np.ones((1, SIDES)) if shapes is None else shapes)[..., None]
        apart = TURN[:, None] - np.arange(RIM_PLACES) * 2 * np.pi / RIM_PLACES
        self._odd = np.cos(apart) * 2 / RIM_PLACES
        self._even = (0.5 + np.cos(2 * apart)) * 2 / RIM_PLACES

    def __call__(self, base_mm: FloatArray, axis: FloatArray, caps_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Feet (N, 2), and outlines (N, 3, SIDES, 2) of stem, side and face of each pin, given (N, 3) each."""
        pins = self._pins
        radius, half = 0.5 * pins.cap_diameter_mm, 0.5 * pins.cap_height_mm
        bevel = min(CAP_BEVEL * pins.cap_height_mm, 0.5 * radius)
        u = np.array([1.0, 0.0, 0.0]) - axis[:, :1] * axis  # where an outline starts (`surfaces`)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        places = np.arange(RIM_PLACES) * 2 * np.pi / RIM_PLACES
        rim = caps_mm + radius * (np.cos(places)[:, None, None] * u + np.sin(places)[:, None, None] * np.cross(u, axis))
        seen = project(self._view, np.concatenate([rim, caps_mm[None], base_mm[None]]))
        centre, foot = seen[-2, :, None], seen[-1, :, None]
        from_centre = seen[:-2] - seen[-2]
        odd, even = (np.einsum("kj,jnc->nkc", series, from_centre) for series in (self._odd, self._even))
        along = (centre - foot) / np.linalg.norm(caps_mm - base_mm, axis=1)[:, None, None]  # px per mm of the axis

        def disc(factor: float | FloatArray) -> FloatArray:
            return factor * odd + factor**2 * even

        stem = disc(EVENLY * 0.5 * pins.diameter_mm / radius)
        bottom, edge = (centre + height * along + disc(self._cap) for height in (-half, half - bevel))
        face = centre + half * along + disc(self._cap * (1 - bevel / radius))
        return seen[-1], np.stack([_hull(foot + stem, centre - half * along + stem), _hull(bottom, edge, face), face], axis=1)


def _hull(*discs: FloatArray) -> FloatArray:
    """Outline (N, K, 2) around similar closed outlines (N, K, 2) each: of their points number k the one that lies furthest out."""
    tangent = np.roll(discs[0], -1, axis=1) - np.roll(discs[0], 1, axis=1)
    outward = np.stack([tangent[..., 1], -tangent[..., 0]], axis=-1)
    arm = discs[0] - discs[0].mean(axis=1, keepdims=True)
    outward = outward * np.sign(np.sum(arm * outward, axis=(1, 2)))[:, None, None]
    hull, far = discs[0], np.sum(discs[0] * outward, axis=-1)
    for disc in discs[1:]:
        reach = np.sum(disc * outward, axis=-1)
        hull, far = np.where((reach > far)[..., None], disc, hull), np.maximum(far, reach)
    return hull
