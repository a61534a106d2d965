"""The edge of the disc through which the gel is seen: where the housing's opening lies, from the still picture."""

import numpy as np
from scipy.optimize import least_squares

from scenes.sensor import SensorSpec
from twin.calibration.aligned import revised, to_light
from twin.calibration.still import Still, sampled
from twin.errors import FrameError
from twin.realism.disc import lens_disc, round_disc

# Rays from the disc's centre along which the edge is looked for.
RAYS = 720
# Where the edge is looked for in each pass, as shares of the radius found so far: the first pass forgives a wrong specification.
REACHES = ((0.75, 1.3), (0.9, 1.1), (0.9, 1.1))
# Step along a ray, px.
STEP_PX = 0.25
# The ring's light is read this far outside the place where the ring begins, px.
TOP_PX = 4.0
# Share of the brightest mean light along a ray at which the ring begins.
RING_BEGINS = 0.9
# Half of the width over which the ring's light is averaged, in steps along a ray.
TOP_HALF_STEPS = 4
# Residual, px, beyond which a place of the edge counts less: cables and flaws of the rim stand out by more.
EDGE_PX = 0.5
# Least share of the rays that must cross an edge.
LEAST_RAYS = 0.5


def fit_disc_edge(spec: SensorSpec, still: Still) -> SensorSpec:
    """The specification with the centre and radius of the housing's opening as the still picture shows them.

    The edge is a circle in the housing's plane. It is found in the picture, pass by pass, and then carried into that plane.

    Raises
    ------
    FrameError
        There is no bright ring around a darker disc.
    """
    light = to_light(still.gray, spec.response)
    disc = lens_disc(spec)
    for reach in REACHES:
        edge_px = _edge_places(light, disc.center_px, disc.radius_px, reach, spec.name)
        x, y, radius = _circle_through(edge_px, [*disc.center_px, disc.radius_px], EDGE_PX)
        disc = round_disc(still.gray.shape[::-1], np.array([x, y]), radius)
    edge_mm = sampled(still.tangents, edge_px) * (spec.housing.z_mm + spec.camera.distance_mm)
    start = [*spec.housing.center_mm, spec.housing.aperture_radius_mm]
    x, y, radius = _circle_through(edge_mm, start, EDGE_PX * spec.housing.aperture_radius_mm / disc.radius_px)
    return revised(spec, housing={"center_mm": (x, y), "aperture_radius_mm": radius})


def _edge_places(light: np.ndarray, center_px: np.ndarray, radius_px: float, reach: tuple[float, float], name: str) -> np.ndarray:
    """Places (n, 2) px of the edge on rays from a centre.

    The edge of a ray is the outermost place where its light crosses the level half way between the disc's and the ring's.
    """
    turn, each = np.linspace(0, 2 * np.pi, RAYS, endpoint=False), np.arange(RAYS)
    outward = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    along_px = radius_px * np.arange(*reach, STEP_PX / radius_px)
    seen = sampled(light, center_px + along_px[:, None] * outward[:, None])  # (rays, steps)
    mean = np.median(seen, axis=0)
    top = int(np.argmax(mean > RING_BEGINS * mean.max())) + round(TOP_PX / STEP_PX)
    no_ring = FrameError(
        f"{name}: no bright ring around the disc, {along_px[0]:.0f} to {along_px[-1]:.0f} px from its centre; "
        "check [camera] and [housing] of the specification, or the frames"
    )
    if top > len(along_px):  # still growing brighter where the search ends
        raise no_ring
    ring = np.median(seen[:, top - TOP_HALF_STEPS : top + TOP_HALF_STEPS + 1], axis=1)
    level = 0.5 * (np.median(seen[:, : top // 2], axis=1) + ring)
    last = top - 1 - np.argmax((seen[:, :top] < level[:, None])[:, ::-1], axis=1)  # last step below the level
    below, above = seen[each, last], seen[each, np.minimum(last + 1, len(along_px) - 1)]
    good = (below < level) & (above >= level)
    if good.mean() < LEAST_RAYS:
        raise no_ring
    crossing_px = along_px[last[good]] + STEP_PX * ((level - below) / np.where(good, above - below, 1))[good]
    return center_px + crossing_px[:, None] * outward[good]


def _circle_through(points: np.ndarray, start: list[float], scale: float) -> tuple[float, float, float]:
    """Centre and radius of the circle through most of the points (n, 2); residuals beyond ``scale`` count less (Cauchy)."""
    fit = least_squares(lambda c: np.linalg.norm(points - c[:2], axis=1) - c[2], start, loss="cauchy", f_scale=scale)
    x, y, radius = fit.x.tolist()
    return x, y, radius
