"""Fit of the housing's opening and the bright ring around it to the still picture, and of the rim's light to all frames.

First the edge of the disc through which the gel is seen is found, because it is the edge of the opening. Then the light of ring and wall
outside of it is fitted. At the end, the light at the edge that no formula describes (glue, burrs, glare) is measured as a table by azimuth
and radius.
"""

import numpy as np
from scipy.optimize import least_squares

from scenes.sensor import CameraSpec, HousingSpec, RimSpec, SensorSpec
from twin.calibration.light.still import ROBUST_LEVELS, Still, fit_bounded, level_misfit, sample_field
from twin.camera.capture import expose, hazed, vignetted
from twin.camera.projection import lens_disc, round_disc, sensor_to_camera
from twin.errors import FrameError
from twin.evaluation.pictures.aligned import SATURATED, Aligned, to_light, with_changes
from twin.optics.glass import ray_table
from twin.optics.static_layer import RIM_UNIT, housing_light, rim_places, static_layer

RAYS = 720
"""Number of rays from the disc's centre along which the edge is searched."""
REACHES = ((0.75, 1.3), (0.9, 1.1), (0.9, 1.1))
"""Range in which each pass searches the edge, relative to the radius found so far. It is wide in the first pass, because the specification
may be wrong."""
STEP_PX = 0.25
"""Step along a ray, px."""
TOP_PX = 4.0
"""Distance outside the beginning of the ring at which its light is measured, px."""
RING_BEGINS = 0.9
"""Share of the largest mean light along the rays at which the ring begins."""
TOP_HALF_STEPS = 4
"""Half of the length over which the ring's light is averaged, in steps along a ray."""
EDGE_PX = 0.5
"""Residual, px, above which a place of the edge has a smaller weight. Cables and flaws of the rim have larger residuals."""
LEAST_RAYS = 0.5
"""Least share of the rays that must cross an edge."""
EVERY = 6
"""One pixel in this many is compared, in each direction, because the ring's light is smooth."""
RIM_PX = 3.0
"""Distance from the disc's edge, px, within which pixels are left out, because the edge is blurred."""
BOUNDS = {
    "ambient": (0.01, 50.0),
    "ambient_falloff_mm": (1.0, 300.0),
    "glow": (0.01, 300.0),
    "glow_radius_mm": (0.9, 1.25),
    "glow_height_mm": (0.2, 15.0),
    "glow_exponent": (0.7, 10.0),
    "wall_fraction": (0.01, 1.0),
    "lip_width_mm": (0.05, 6.0),
    "red": (0.1, 3.0),
    "blue": (0.1, 3.0),
}
"""Least and largest value of each fitted quantity; their logarithms are fitted. ``glow_radius_mm`` is relative to the opening's radius;
``red`` and ``blue`` are the wall's reflectance relative to green."""
START_LIPS_MM = (0.4, 1.0, 2.0, 3.5)
"""Widths of the lip, mm, at which the fit is started. The step at the lip causes local optima, so all starts are tried and the best one is
refined."""
TRIAL_STEPS = 8
"""Steps of the fit from each start."""
SMOOTH_STEPS = 40
"""Steps of the fit without a step at the lip."""
LEAST_STEP_GAIN = 0.05
"""Least relative decrease of the misfit by a step at the lip, compared with the fit without a step."""
LEAST_START = 1e-3
"""Least starting value, because its logarithm is taken."""
NO_STEP = -1e-6
"""Lower bound of the logarithm of ``wall_fraction`` where there is no step: the wall is as bright as the lip."""
INSIDE_MM, OUTSIDE_MM = 1.75, 0.4
"""Distances from the edge of the housing's opening, inwards and outwards, that the rim's table covers. No pin comes so near to the edge."""
AZIMUTHS, RADII = 240, 32
"""Number of azimuths and of radii in the table. There are many radii, because the light changes steeply at the edge."""
ROUNDS, GAIN = 3, 0.9
"""Rounds of correction of the table, and share of the missing light that each round adds. Several rounds are needed, because blur and
sharpening act after the correction."""


class NoRing(FrameError):
    """Frames show no bright ring around the disc."""


def fit_disc_edge(spec: SensorSpec, still: Still) -> SensorSpec:
    """The specification with the centre and radius of the housing's opening as the still picture shows them.

    The edge is a circle in the housing's plane. It is found in the picture, pass by pass, and then carried into that plane.

    Raises
    ------
    NoRing
        There is no bright ring around a darker disc.
    """
    light = to_light(still.gray, spec.response)
    disc = lens_disc(spec.view, spec.housing)
    for reach in REACHES:
        edge_px = _edge_places(light, disc.center_px, disc.radius_px, reach, spec.name)
        x, y, radius = _circle_through(edge_px, [*disc.center_px, disc.radius_px], EDGE_PX)
        disc = round_disc(still.gray.shape[::-1], np.array([x, y]), radius)
    edge_mm = sample_field(still.tangents, edge_px) * (spec.housing.z_mm + spec.camera.distance_mm)
    start = [*spec.housing.center_mm, spec.housing.aperture_radius_mm]
    x, y, radius = _circle_through(edge_mm, start, EDGE_PX * spec.housing.aperture_radius_mm / disc.radius_px)
    return with_changes(spec, housing={"center_mm": (x, y), "aperture_radius_mm": radius})


def _edge_places(light: np.ndarray, center_px: np.ndarray, radius_px: float, reach: tuple[float, float], name: str) -> np.ndarray:
    """Places (n, 2) px of the edge on rays from a centre.

    The edge of a ray is the outermost place where its light crosses the level half way between the disc's and the ring's.
    """
    turn, each = np.linspace(0, 2 * np.pi, RAYS, endpoint=False), np.arange(RAYS)
    outward = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    along_px = radius_px * np.arange(*reach, STEP_PX / radius_px)
    seen = sample_field(light, center_px + along_px[:, None] * outward[:, None])  # (rays, steps)
    mean = np.median(seen, axis=0)
    top = int(np.argmax(mean > RING_BEGINS * mean.max())) + round(TOP_PX / STEP_PX)
    no_ring = NoRing(
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
    """Centre and radius of the circle fitted to points (n, 2). Residuals above ``scale`` have a smaller weight (Cauchy)."""
    fit = least_squares(lambda c: np.linalg.norm(points - c[:2], axis=1) - c[2], start, loss="cauchy", f_scale=scale)
    x, y, radius = fit.x.tolist()
    return x, y, radius


def fit_ring(spec: SensorSpec, still: Still) -> SensorSpec:
    """The specification with the light of ring and wall outside the disc.

    Only the product of ``housing.albedo`` and light can be measured, so the largest channel of the albedo is not changed.
    """
    ring, few = spec.housing, (slice(None, None, EVERY),) * 2
    at_mm = still.tangents[few] * (ring.z_mm + spec.camera.distance_mm)  # where each pixel's ray meets the housing's plane
    beyond_mm = np.linalg.norm(at_mm - ring.center_mm, axis=-1) - ring.aperture_radius_mm
    wall = beyond_mm >= 0
    compared = beyond_mm > RIM_PX * ring.aperture_radius_mm / lens_disc(spec.view, ring).radius_px
    levels, inside = still.image[few], to_light(still.image, spec.response)[few].astype(np.float32)  # the disc's light is not modelled
    loss = vignetted(np.ones((*still.gray.shape, 1), np.float32), spec.camera)[few]
    gel = spec.gel.alter(haze_sigma_px=spec.gel.haze_sigma_px / EVERY)  # in thinned-out pixels
    start, (low, high) = _start_values(ring), np.log(np.array(list(BOUNDS.values())).T)

    def residual(values: np.ndarray) -> np.ndarray:
        trial = spec.alter(housing=_housing_values(ring, values))
        light = inside.copy()
        light[wall] = housing_light(trial.leds, trial.housing, at_mm[wall])
        return level_misfit(hazed(light, gel) * loss, levels, spec.response)[compared].ravel()

    def fitted(changed: dict[str, float], least: np.ndarray, most_steps: int) -> tuple[float, np.ndarray]:
        """Misfit and values from one start."""
        first = np.log(np.maximum(list((start | changed).values()), LEAST_START))
        found = fit_bounded(residual, first, least, high, most_steps=most_steps)
        return float(np.sum(np.log1p((residual(found) / ROBUST_LEVELS) ** 2))), found

    without_step = np.where(np.array(list(BOUNDS)) == "wall_fraction", NO_STEP, low)
    smooth_misfit, smooth = fitted({"wall_fraction": 1.0}, without_step, SMOOTH_STEPS)
    tried = [fitted({"lip_width_mm": width_mm}, low, TRIAL_STEPS) for width_mm in START_LIPS_MM]
    step_misfit, stepped = min(tried, key=lambda fit: fit[0])
    if step_misfit > (1 - LEAST_STEP_GAIN) * smooth_misfit:
        return with_changes(spec, housing=_housing_values(ring, smooth) | {"lip_width_mm": ring.lip_width_mm, "wall_fraction": 1.0})
    return with_changes(spec, housing=_housing_values(ring, fit_bounded(residual, stepped, low, high)))


def _start_values(ring: HousingSpec) -> dict[str, float]:
    """The specification's values of the fitted quantities, in the order of ``BOUNDS``."""
    red, green, blue = ring.albedo
    start = {name: getattr(ring, name) for name in BOUNDS if hasattr(ring, name)} | {"red": red / green, "blue": blue / green}
    return start | {"glow_radius_mm": start["glow_radius_mm"] / ring.aperture_radius_mm}


def _housing_values(ring: HousingSpec, values: np.ndarray) -> dict[str, float | tuple[float, ...]]:
    """Fields of ``[housing]`` for the fit's values, which are logarithms."""
    found = dict(zip(BOUNDS, np.exp(values).tolist(), strict=True))
    colour = np.array([found.pop("red"), 1.0, found.pop("blue")])
    found["glow_radius_mm"] *= ring.aperture_radius_mm
    return {**found, "albedo": tuple((colour * max(ring.albedo) / colour.max()).tolist())}


def fit_rim(spec: SensorSpec, frames: list[Aligned], light: list[np.ndarray]) -> SensorSpec:
    """The specification with ``housing.rim``: the light of real frames minus that of rendered ones, mean over the frames.

    A saturated pixel never lowers the light.

    Parameters
    ----------
    spec : SensorSpec
        A specification in which everything else was fitted.
    frames : list of Aligned
    light : list of (H, W, 3) or (H, W) float
        Rendered light of each frame's state.
    """
    ring = spec.housing
    inner, outer = ring.aperture_radius_mm - INSIDE_MM, ring.aperture_radius_mm + OUTSIDE_MM
    cell, weight, pixels = _cells(spec.camera, ring, inner, outer)
    window = (0, 0, spec.camera.width_px, spec.camera.height_px)
    before = static_layer(spec, window)[0]
    table = np.zeros((AZIMUTHS, RADII, 3))
    if ring.rim is not None and np.shape(ring.rim.light) == table.shape:
        table += np.array(ring.rim.light) / RIM_UNIT
    total = np.maximum(np.bincount(cell.ravel(), weight.ravel(), minlength=AZIMUTHS * RADII), 1e-6)
    for _ in range(ROUNDS):
        spec = _with_rim(spec, inner, outer, table)
        more = static_layer(spec, window)[0] - before
        more = more if spec.camera.channels == "color" else more.mean(axis=2)
        missing = np.mean([_missing(spec, frame, np.maximum(lit + more, 0)) for frame, lit in zip(frames, light, strict=True)], axis=0)
        for k, flat in enumerate(np.broadcast_to(np.atleast_3d(missing), (*missing.shape[:2], 3)).reshape(-1, 3)[pixels].T):
            sums = np.bincount(cell.ravel(), (weight * flat[:, None]).ravel(), minlength=AZIMUTHS * RADII)
            table[..., k] += GAIN * (sums / total).reshape(AZIMUTHS, RADII)
    return _with_rim(spec, inner, outer, table)


def _with_rim(spec: SensorSpec, inner_mm: float, outer_mm: float, table: np.ndarray) -> SensorSpec:
    """The specification with a table (A, R, 3) of linear light as its rim."""
    rim = RimSpec(inner_mm=inner_mm, outer_mm=outer_mm, light=np.rint(RIM_UNIT * table).astype(int).tolist())
    return with_changes(spec, housing={"rim": rim.model_dump()})


def _missing(spec: SensorSpec, frame: Aligned, light: np.ndarray) -> np.ndarray:
    """Light of a real frame minus that of a render, in the renderer's unit."""
    shown = expose(light, spec.capture)
    lacking = to_light(frame.image, spec.response) - to_light(shown, spec.response)
    return np.where((frame.image >= SATURATED) & (shown >= SATURATED), 0.0, lacking)


def _cells(camera: CameraSpec, ring: HousingSpec, inner_mm: float, outer_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The four table entries (n, 4) around each pixel of the band, their bilinear weights (n, 4), and the pixels' flat indices (n,)."""
    corners = ray_table(camera, (0, 0, camera.width_px, camera.height_px)) @ sensor_to_camera(camera)[:3, :3]
    rays = ((corners[:-1, :-1] + corners[1:, 1:]) / 2).reshape(-1, 3)
    turn, along = rim_places(ring, inner_mm, outer_mm, (AZIMUTHS, RADII), rays[:, :2] / rays[:, 2:] * (ring.z_mm + camera.distance_mm))
    pixels = np.flatnonzero((along > 0) & (along < RADII - 1))
    turn, along = turn[pixels], along[pixels]
    row, column = np.floor(turn).astype(int), np.minimum(np.floor(along).astype(int), RADII - 2)
    a, b = turn - row, along - column
    cell = np.stack([(row + j) % AZIMUTHS * RADII + column + k for j in (0, 1) for k in (0, 1)], axis=1)
    weight = np.stack([(a if j else 1 - a) * (b if k else 1 - b) for j in (0, 1) for k in (0, 1)], axis=1)
    return cell, weight, pixels
