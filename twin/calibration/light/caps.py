"""Fit of the reflectance and the outline of each cap, which differ from cap to cap of a printed sensor.

The reflectance follows from the ratio of real to rendered light at a cap's middle. Light, window and blur cancel in this ratio, and bubbles
and glints do not change its median over the frames. The outline follows from a Gauss-Newton step on gray levels: if an outline of radius
r(t) grows by dr(t), the image changes by ``-grad I . dr(t) e(t)``, where e(t) is the outward direction at the azimuth t in the picture.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

from scenes.sensor import ResponseSpec, SensorSpec
from twin.evaluation.pictures.aligned import SATURATED, Aligned, to_light, with_changes
from twin.frames.forms import gray_levels
from twin.optics.relief import cap_planes

# Highest order of an outline's harmonics.
ORDERS = 6
# Prior standard deviation of a harmonic, cap radii; standard deviation of gray levels that outlines do not explain.
SHAPE_SD, MISFIT_LEVELS = 0.03, 10.0
# Distance from a cap's middle, in cap radii, within which pixels are compared.
REACH = 1.7
# Bounds of a cap's relative reflectance, and of a harmonic, cap radii.
LEVEL_BOUNDS, SHAPE_BOUND = (0.3, 3.0), 0.35
# Largest change of a harmonic in one step, cap radii, within which the gray levels are nearly linear.
LARGEST_STEP = 0.1
# Percentile of the gray levels around a cap that is taken as the skin's level.
SKIN_PERCENTILE = 10.0
# Damping: exponent with which a correction factor of the reflectance is applied.
DAMPING = 0.8
# Weight of the prior of contrast and skin level. Both are free, so the weight is only large enough to make the equations solvable.
FREE = 1e-6


def fit_caps(spec: SensorSpec, frames: list[Aligned], rendered: Sequence[np.ndarray]) -> SensorSpec:
    """Correct the reflectance and the outline of every cap once.

    Parameters
    ----------
    spec : SensorSpec
    frames : list of Aligned
    rendered : sequence of (H, W[, 3]) uint8
        Captured renders of the frames' states under this specification, without noise.

    Returns
    -------
    SensorSpec
        The specification with new ``appearance.cap_levels``, ``cap_shapes`` and ``cap_offsets``.
    """
    look, count = spec.appearance, spec.pins.count
    level = np.array([_levels(spec.response, f, f.image) / _levels(spec.response, f, r) for f, r in zip(frames, rendered, strict=True)])
    level = np.nanmedian(np.where(np.isfinite(level).any(axis=0), level, 1.0), axis=0)
    levels = np.clip(np.array(look.cap_levels or np.ones(count)) * level**DAMPING, *LEVEL_BOUNDS)
    before = np.zeros((count, 2 * ORDERS + 1))
    if look.cap_offsets:
        before[:, 1:3] = look.cap_offsets
    if look.cap_shapes:
        known = np.array(look.cap_shapes)[:, : 2 * ORDERS - 1]
        before[:, 0], before[:, 3 : 2 + known.shape[1]] = known[:, 0], known[:, 1:]
    shapes = np.clip(before + outline_steps(spec, frames, rendered), -SHAPE_BOUND, SHAPE_BOUND).round(3)
    return with_changes(
        spec,
        appearance={
            "cap_levels": tuple(levels.round(3).tolist()),
            "cap_shapes": tuple(map(tuple, np.delete(shapes, [1, 2], axis=1).tolist())),
            "cap_offsets": tuple(map(tuple, shapes[:, 1:3].tolist())),
        },
    )


def outline_steps(spec: SensorSpec, frames: list[Aligned], rendered: Sequence[np.ndarray]) -> np.ndarray:
    """Changes (N, 2 ORDERS + 1) of each outline's ``a_0, a_1, b_1, a_2, ...``, in cap radii, that make renders more like the frames."""
    unknowns = 2 * ORDERS + 3  # the last two are the cap's contrast and the skin's level
    normal, right = np.zeros((spec.pins.count, unknowns, unknowns)), np.zeros((spec.pins.count, unknowns))
    for frame, image in zip(frames, rendered, strict=True):
        for cap, slopes, missing in _changes(spec, frame, image):
            normal[cap] += slopes.T @ slopes
            right[cap] += slopes.T @ missing
    prior = np.full(unknowns, (MISFIT_LEVELS / SHAPE_SD) ** 2)
    prior[-2:] = FREE
    steps = np.linalg.solve(normal + np.diag(prior), right[..., None])[:, : 2 * ORDERS + 1, 0]
    return np.clip(steps, -LARGEST_STEP, LARGEST_STEP)


def _changes(spec: SensorSpec, frame: Aligned, image: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """For each found cap: index; derivatives (n, 2 ORDERS + 3) of its n pixels' levels by the unknowns; real minus rendered levels (n,)."""
    state, real, ours = frame.state, gray_levels(frame.image).astype(np.float32), gray_levels(image).astype(np.float32)
    slope = np.stack([cv2.Sobel(ours, cv2.CV_32F, *way, ksize=3) / 8 for way in ((1, 0), (0, 1))], axis=-1)
    middle, plane = cap_planes(spec.view, spec.pins, state)  # px per cap radius
    others = cKDTree(middle)
    height, width = real.shape
    for cap in np.flatnonzero(np.isfinite(frame.pins_px).all(axis=1)):
        half = np.abs(plane[cap]).max() * REACH
        (x0, y0), (x1, y1) = np.floor(middle[cap] - half).astype(int), np.ceil(middle[cap] + half).astype(int) + 1
        if min(x0, y0) < 0 or x1 > width or y1 > height:
            continue
        pixels = np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1).reshape(-1, 2)
        place = (pixels - middle[cap]) @ np.linalg.inv(plane[cap]).T
        near = (np.linalg.norm(place, axis=1) < REACH) & (others.query(pixels)[1] == cap)
        near &= (real[pixels[:, 1], pixels[:, 0]] < SATURATED) & (ours[pixels[:, 1], pixels[:, 0]] < SATURATED)
        at = pixels[near, 1], pixels[near, 0]
        turn = np.arctan2(place[near, 1], place[near, 0])
        way = np.stack([np.cos(turn), np.sin(turn)], axis=1) @ plane[cap].T
        edge = -np.sum(slope[at] * way, axis=1)
        waves = [np.ones_like(turn), *(wave(order * turn) for order in range(1, ORDERS + 1) for wave in (np.cos, np.sin))]
        level = ours[at]
        contrast = level - np.percentile(level, SKIN_PERCENTILE) if len(level) else level
        yield int(cap), np.stack([*(edge * wave for wave in waves), contrast, np.ones_like(level)], axis=1), real[at] - level


def _levels(response: ResponseSpec, frame: Aligned, image: np.ndarray) -> np.ndarray:
    """Light (N,) of the caps' middles, 3 x 3 px, summed over the channels; NaN if lost or saturated."""
    image = np.atleast_3d(image)
    mean = cv2.blur(image.astype(np.float32), (3, 3)).reshape(image.shape)
    seen = np.isfinite(frame.pins_px).all(axis=1)
    at = np.rint(np.where(seen[:, None], frame.pins_px, 0)).astype(int)
    levels = mean[at[:, 1], at[:, 0]]
    light = to_light(levels, response).sum(axis=1)
    return np.where(seen & (levels < SATURATED).all(axis=1), np.maximum(light, 1e-6), np.nan)
