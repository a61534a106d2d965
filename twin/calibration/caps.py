"""What each cap of a printed sensor has of its own: its reflectance and its outline.

Both are ratios of real to rendered frames, so that light, window and blur drop out; the median over the frames keeps
bubbles and glints from counting.
"""

from collections.abc import Callable

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.calibration.aligned import SATURATED, Aligned, revised, to_light
from twin.optics.surfaces import cap_outlines
from twin.preprocess.forms import gray_levels
from twin.projection import project

DIRECTIONS = 24  # in which an outline is measured
REACH = np.linspace(0.35, 1.75, 29)  # of the cap's radius: where its edge may be
ORDERS = 4  # highest of an outline's harmonics
LEVEL_BOUNDS, SHAPE_BOUND = (0.3, 3.0), 0.35
SKIN_PERCENTILE = 10.0  # of what surrounds a cap
DAMPING = 0.8  # of a correction: the blur makes outlines rounder than they are, noise makes them rougher

Shoot = Callable  # shoot(spec, frames) gives the captured renders (M, H, W[, 3]) uint8 without noise


def fit_caps(spec: SensorSpec, frames: list[Aligned], shoot: Shoot) -> SensorSpec:
    """One correction of every cap's reflectance and outline.

    Parameters
    ----------
    spec : SensorSpec
    frames : list of Aligned
    shoot : callable
        Renders the frames' states under a specification.

    Returns
    -------
    SensorSpec
        With ``appearance.cap_levels`` and ``cap_shapes``.
    """
    rendered = shoot(spec, frames)
    level = np.array([_levels(spec, f, f.image) / _levels(spec, f, r) for f, r in zip(frames, rendered, strict=True)])
    edge = np.array([cap_edges(spec, f, f.image) / cap_edges(spec, f, r) for f, r in zip(frames, rendered, strict=True)])
    level, edge = np.nan_to_num(_median(level), nan=1.0), _reliable(edge)
    before = np.array(spec.appearance.cap_levels or np.ones(spec.pins.count))
    levels = np.clip(before * level**DAMPING, *LEVEL_BOUNDS)
    outline = cap_outlines(spec, DIRECTIONS)
    outline = np.ones((spec.pins.count, DIRECTIONS)) if outline is None else outline
    return revised(
        spec,
        appearance={
            "cap_levels": tuple(levels.round(3).tolist()),
            "cap_shapes": tuple(map(tuple, harmonics(outline * edge**DAMPING).round(3).tolist())),
        },
    )


def _reliable(edge: np.ndarray) -> np.ndarray:
    """Outline ratios (N, DIRECTIONS) of frames (M, N, DIRECTIONS), each harmonic shrunk by what of it differs from frame to frame.

    A cap's print is the same in all frames; noise, and an edge seen too flat, is not: a coefficient counts
    ``signal / (signal + noise / M)``, its variance over the caps of like harmonics against that over the frames.
    """
    middle = _median(edge)
    each = np.array([harmonics(np.where(np.isfinite(one), one, np.nan_to_num(middle, nan=1.0))) for one in edge])
    mean = np.median(each, axis=0)
    if len(edge) > 1:
        noise = 1.57 * np.var(each, axis=0, ddof=1) / len(edge)  # of a median
        signal = np.maximum(np.mean(mean**2, axis=0) - noise.mean(axis=0), 0)
        mean = mean * signal / (signal + noise + 1e-12)
    turn = np.arange(edge.shape[2]) * 2 * np.pi / edge.shape[2]
    orders = np.arange(2, ORDERS + 1)[:, None]
    return 1 + mean[:, :1] + mean[:, 1::2] @ np.cos(orders * turn) + mean[:, 2::2] @ np.sin(orders * turn)


def harmonics(outline: np.ndarray) -> np.ndarray:
    """Coefficients (N, 2 ORDERS - 1) as in ``AppearanceSpec.cap_shapes`` of outlines (N, DIRECTIONS) relative to a circle."""
    turn = np.arange(outline.shape[1]) * 2 * np.pi / outline.shape[1]
    columns = [np.mean(outline - 1, axis=1)]
    for order in range(2, ORDERS + 1):
        columns += [2 * np.mean(outline * wave(order * turn), axis=1) for wave in (np.cos, np.sin)]
    return np.clip(np.stack(columns, axis=1), -SHAPE_BOUND, SHAPE_BOUND)


def cap_edges(spec: SensorSpec, frame: Aligned, image: np.ndarray) -> np.ndarray:
    """Distance (N, DIRECTIONS) from each cap's centre to where it falls to half, in cap radii in the cap's plane; NaN where not found."""
    u = np.array([1.0, 0.0, 0.0]) - frame.state.axis[:, :1] * frame.state.axis
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, frame.state.axis)
    turn = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    way = np.cos(turn)[:, None, None] * u + np.sin(turn)[:, None, None] * v
    face = frame.state.caps_mm + 0.5 * spec.pins.cap_height_mm * frame.state.axis
    radius = 0.5 * spec.pins.cap_diameter_mm
    at = project(spec, face + radius * REACH[:, None, None, None] * way).astype(np.float32)  # (reach, directions, N, 2)
    gray = gray_levels(image).astype(np.float32)
    profile = cv2.remap(gray, at[..., 0].reshape(len(REACH), -1), at[..., 1].reshape(len(REACH), -1), cv2.INTER_LINEAR).reshape(
        at.shape[:3]
    )
    top = profile[0].mean(axis=0)
    bottom = np.percentile(profile, SKIN_PERCENTILE, axis=(0, 1))
    share = (profile - bottom) / np.maximum(top - bottom, 1.0)
    below = share < 0.5
    first = np.argmax(below, axis=0)
    found = below.any(axis=0) & (first > 0)
    after = np.maximum(first, 1)
    high, low = (np.take_along_axis(share, k[None], axis=0)[0] for k in (after - 1, after))
    place = REACH[after - 1] + (REACH[1] - REACH[0]) * (high - 0.5) / np.maximum(high - low, 1e-6)
    return np.where(found, place, np.nan).T


def _levels(spec: SensorSpec, frame: Aligned, image: np.ndarray) -> np.ndarray:
    """Light (N,) of the caps' middles, 3 x 3 px, summed over the channels; NaN where lost or saturated."""
    image = image if image.ndim == 3 else image[..., None]
    mean = cv2.blur(image.astype(np.float32), (3, 3)).reshape(image.shape)
    seen = np.isfinite(frame.pins_px).all(axis=1)
    at = np.rint(np.where(seen[:, None], frame.pins_px, 0)).astype(int)
    levels = mean[at[:, 1], at[:, 0]]
    light = to_light(levels, spec.response).sum(axis=1)
    return np.where(seen & (levels < SATURATED).all(axis=1), np.maximum(light, 1e-6), np.nan)


def _median(values: np.ndarray) -> np.ndarray:
    """Median over the frames; NaN (without a warning) where there is nothing."""
    some = np.isfinite(values).any(axis=0)
    return np.where(some, np.nanmedian(np.where(some, values, 1.0), axis=0), np.nan)
