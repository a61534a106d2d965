"""Fit of the camera's sharpness, colour fringes, compression and noise to whole frames, after the light was fitted."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from scenes.sensor import LensSpec, ResponseSpec, SensorSpec
from twin.calibration.light.photometry import MOST_HAZE
from twin.camera.capture import expose, hazed, luma_weights, stream_of
from twin.camera.projection import lens_disc, project
from twin.evaluation.pictures.aligned import SATURATED, Aligned, with_changes
from twin.evaluation.pictures.statistics import bare_skin, bin_of, equal_count_edges, noise_sd
from twin.frames.forms import gray_levels
from twin.pins.finding.caps import measure_caps

# Fitted quantities in ``[response]``: least value, largest value, and step of the numerical derivatives.
BOUNDS = {"blur_sigma_px": (0.05, 4.0, 0.03), "sharpening": (0.0, 4.0, 0.05), "sharpening_sigma_px": (0.5, 4.0, 0.05)}
# Further fitted quantities of colour cameras: softness of colour (``[response]``) and fringes (``[camera]``). The numbers are as above.
CHROMA = {"chroma_sigma_px": (0.05, 4.0, 0.05)}
FRINGES = {"red_scale": (0.985, 1.015, 0.0003), "blue_scale": (0.985, 1.015, 0.0003)}
SHIFTS = {f"{colour}_shift_px.{axis}": (-3.0, 3.0, 0.03) for colour in ("red", "blue") for axis in (0, 1)}
# Least sharpening at the start, because without sharpening its width has no effect.
LEAST_SHARPENING = 0.2
# Ratio of the colour step within a pair of columns to the step to the next pair, below which the columns of a pair share their colour.
SAME_CHROMA = 0.5
# JPEG qualities that are tried (0: not compressed).
QUALITIES = (0, 95, 90, 80, 70)
# Residual, gray levels, above which a pixel has a smaller weight (soft L1).
ROBUST_LEVELS = 10.0
# Most evaluations of the least-squares fit.
MOST_TRIES = 60
# Most frames that the sharpness is fitted to; one pixel in EVERY is used in each direction.
MOST_FRAMES, EVERY = 3, 3
# Tolerance of the search for the haze, as a share of light.
HAZE_STEP = 5e-4
# Largest aperture, mm. A larger one would need more samples per pixel than the frames for training have.
MOST_APERTURE_MM = 3.0
# Range of the focus, relative to the distances of the nearest and farthest caps; number of tried values of focus and of aperture.
FOCUS_RANGE, TRIED = (0.85, 1.15), 31
# Ratio of the 10-90 % edge width of a Gaussian blur to its standard deviation.
GAUSSIAN_WIDTH = 2.563
# Ratio of the 10-90 % edge width of a uniform disc to its diameter.
DISC_WIDTH = 0.69
# Least variance of a render's noise, gray levels^2, that is divided by; least ratio of the real noise to it.
LEAST_NOISE2, LEAST_NOISE_SHARE = 1e-4, 0.01


@dataclass(frozen=True)
class Sharpness:
    """Cap edge widths (10-90 %, px) by distance to the pupil: medians of real and of rendered ones in each bin of ``distance_mm``."""

    distance_mm: np.ndarray
    real_px: np.ndarray
    rendered_px: np.ndarray


def fit_response(spec: SensorSpec, frames: list[Aligned], light: list[np.ndarray], inside: np.ndarray) -> SensorSpec:
    """Fit blur, sharpening and colour fringes by least squares over the disc, then choose the compression that fits best.

    Parameters
    ----------
    spec : SensorSpec
    frames : list of Aligned
    light : list of (H, W, 3) or (H, W) float
        Rendered light of each frame's state.
    inside : (H, W) bool
        The disc.
    """
    bounds = BOUNDS | (CHROMA | FRINGES | SHIFTS if spec.camera.channels == "color" else {})
    names = list(bounds)
    frames, light = frames[:MOST_FRAMES], [hazed(np.asarray(x, np.float32), spec.gel) for x in light[:MOST_FRAMES]]
    useful = _compared_pixels(frames, inside)
    real = np.concatenate([f.image[u].astype(float).ravel() for f, u in zip(frames, useful, strict=True)])
    images = [f.image for f in frames]
    stream = {"stream": stream_of(images), "chroma_columns": chroma_columns(images)}
    flat = with_changes(spec, response={"jpeg_quality": 0} | stream, gel={"haze": 0.0})  # the light already includes the haze

    def with_values(values: np.ndarray) -> SensorSpec:
        return _with_values(flat, dict(zip(names, map(float, values), strict=True)))

    def misfit(shown: SensorSpec) -> np.ndarray:
        return np.concatenate([expose(x, shown.capture)[u].astype(float).ravel() for x, u in zip(light, useful, strict=True)]) - real

    def residual(values: np.ndarray) -> np.ndarray:
        return misfit(with_values(values))

    low, high, unit = np.array([bounds[name] for name in names]).T
    start = np.clip([_value(spec, name) for name in names], low + 1e-6, high - 1e-6)
    start[names.index("sharpening")] = max(spec.response.sharpening, LEAST_SHARPENING)

    def slopes(values: np.ndarray) -> np.ndarray:
        at = residual(values)
        steps = np.where(values + unit <= high, unit, -unit)
        return np.stack([(residual(values + step * row) - at) / step for step, row in zip(steps, np.eye(len(names)), strict=True)], axis=1)

    fit = least_squares(
        residual, start, slopes, bounds=(low, high), x_scale=unit, loss="soft_l1", f_scale=ROBUST_LEVELS, max_nfev=MOST_TRIES
    )
    best = with_values(fit.x)
    errors = {q: float(np.mean(np.abs(misfit(with_changes(best, response={"jpeg_quality": q}))))) for q in QUALITIES}
    return with_changes(best, response={"jpeg_quality": min(QUALITIES, key=lambda q: errors[q])}, gel={"haze": spec.gel.haze})


def fit_haze(spec: SensorSpec, frames: list[Aligned], light: list[np.ndarray], inside: np.ndarray) -> SensorSpec:
    """Fit the share of light that the gel scatters, to light that includes its background.

    The haze's veil is computed from the light of the whole frame. A background that was added after the haze was fitted, for example bright
    glare around the disc, makes the veil brighter. A background cannot correct this where the light is already 0.

    Parameters
    ----------
    light : list of (H, W, 3) or (H, W) float
        Rendered light of each frame's state.
    inside : (H, W) bool
        The disc.
    """
    chosen = list(zip(frames, light, strict=True))[:MOST_FRAMES]
    useful = _compared_pixels(frames[:MOST_FRAMES], inside)

    def misfit(haze: float) -> float:
        shown = with_changes(spec, gel={"haze": haze}, response={"jpeg_quality": 0}).capture
        away = [np.abs(expose(x, shown)[u] - f.image[u].astype(float)).mean() for (f, x), u in zip(chosen, useful, strict=True)]
        return float(np.mean(away))

    found = minimize_scalar(misfit, bounds=(0.0, MOST_HAZE), method="bounded", options={"xatol": HAZE_STEP, "maxiter": MOST_TRIES})
    haze = round(float(found.x), 5)
    return with_changes(spec, gel={"haze": haze}) if misfit(haze) < misfit(spec.gel.haze) else spec


def _compared_pixels(frames: list[Aligned], inside: np.ndarray) -> list[np.ndarray]:
    """The compared pixels of each frame, (H, W) bool: one in ``EVERY`` each way that is in the disc and not saturated."""
    pick = np.zeros_like(inside)
    pick[::EVERY, ::EVERY] = True
    return [inside & pick & (gray_levels(frame.image) < SATURATED) for frame in frames]


def chroma_columns(images: list[np.ndarray]) -> int:
    """2 if frames (H, W, 3) come from a 4:2:2 stream, in which columns 2k and 2k + 1 share their colour differences; else 1."""
    steps, weights = np.zeros(2), luma_weights(stream_of(images))
    for image in images:
        if image.ndim == 3:
            levels = image.astype(np.float32)
            chroma = levels - (levels @ weights)[..., None]
            step = np.abs(np.diff(chroma, axis=1)).mean(axis=(0, 2))
            steps += step[0::2].mean(), step[1::2].mean()
    return 2 if steps[0] < SAME_CHROMA * steps[1] else 1


def _value(spec: SensorSpec, name: str) -> float:
    """Value of a fitted quantity, by its name in the tables above; ``.0`` and ``.1`` are x and y of a shift."""
    key, _, axis = name.partition(".")
    value = getattr(spec.response if key in BOUNDS | CHROMA else spec.camera, key)
    return value[int(axis)] if axis else value


def _with_values(spec: SensorSpec, values: dict[str, float]) -> SensorSpec:
    """The specification with values of the fitted quantities."""
    changes: dict[str, dict[str, Any]] = {"response": {}, "camera": {}}
    for name, value in values.items():
        key, _, axis = name.partition(".")
        of = changes["response" if key in BOUNDS | CHROMA else "camera"]
        of[key] = (*of.get(key, ()), value) if axis else value
    return with_changes(spec, **changes)


def sharpness(spec: SensorSpec, frames: list[Aligned], rendered: Sequence[np.ndarray], bins: int = 5) -> Sharpness:
    """Edge widths of caps in real and rendered frames, by their apparent distance from the pupil (in air)."""
    distances, reals, rendereds = [], [], []
    for frame, image in zip(frames, rendered, strict=True):
        distances.append(apparent_mm(frame.state.caps_mm[:, 2], spec.camera.distance_mm, spec.lens, spec.gel.refractive_index))
        reals.append(measure_caps(gray_levels(frame.image), frame.pins_px).edge_px)
        rendereds.append(measure_caps(gray_levels(image), project(spec.view, frame.state.caps_mm)).edge_px)
    distance, real, ours = np.concatenate(distances), np.concatenate(reals), np.concatenate(rendereds)
    good = np.isfinite(real) & np.isfinite(ours)
    which = bin_of(distance, equal_count_edges(distance[good], bins))
    parts = [good & (which == k) for k in range(bins)]
    return Sharpness(*(np.array([np.median(values[p]) for p in parts]) for values in (distance, real, ours)))


def fit_blur(spec: SensorSpec, frames: list[Aligned], light: list[np.ndarray], rounds: int = 3) -> SensorSpec:
    """The specification with the blur for which rendered edges are as wide as real ones, in the mean over all caps.

    A least-squares fit to gray levels would give too much blur, because real and rendered edges are not exactly at the same place.
    """
    for _ in range(rounds):
        seen = sharpness(spec, frames, [expose(x, spec.capture) for x in light], bins=1)
        lacking = float((seen.real_px**2 - seen.rendered_px**2)[0]) / GAUSSIAN_WIDTH**2
        blur = np.sqrt(max(spec.response.blur_sigma_px**2 + lacking, BOUNDS["blur_sigma_px"][0] ** 2))
        spec = with_changes(spec, response={"blur_sigma_px": round(float(blur), 4)})
    return spec


def fit_focus(spec: SensorSpec, seen: Sharpness) -> SensorSpec:
    """The specification with the aperture and the focus that explain how the edges' width changes with distance.

    The circle of confusion of a point at the distance d with the focus at d0 is ``f a |1/d - 1/d0|`` px, and the squares of widths add up.
    Both values are found on a grid. A part of the width that is the same at all distances is attributed to the blur.
    """
    before = defocus_px(spec.camera.fx_px, spec.camera.aperture_mm, spec.camera.focus_mm, seen.distance_mm)
    wanted = seen.real_px**2 - seen.rendered_px**2 + (DISC_WIDTH * before) ** 2
    nearest, farthest = FOCUS_RANGE[0] * seen.distance_mm.min(), FOCUS_RANGE[1] * seen.distance_mm.max()
    tried = list(product(np.linspace(nearest, farthest, TRIED), np.linspace(0, MOST_APERTURE_MM, TRIED)))
    grown = [(DISC_WIDTH * defocus_px(spec.camera.fx_px, aperture, focus, seen.distance_mm)) ** 2 for focus, aperture in tried]
    focus, aperture = tried[int(np.argmin(np.var(wanted - grown, axis=1)))]
    return with_changes(spec, camera={"aperture_mm": round(float(aperture), 3), "focus_mm": round(float(focus), 2)})


def defocus_px(focal_px: float, aperture_mm: float, focus_mm: float, distance_mm: np.ndarray) -> np.ndarray:
    """Diameter of the circle of confusion, px, of points at ``distance_mm`` from the pupil."""
    return focal_px * aperture_mm * np.abs(1 / distance_mm - 1 / focus_mm)


def apparent_mm(z_mm: np.ndarray, pupil_mm: float, lens: LensSpec, gel_index: float) -> np.ndarray:
    """Apparent distance from the pupil, in air, of points near the axis at ``z_mm`` in the gel.

    A layer of thickness h and index n has the apparent thickness h / n (paraxial). ``pupil_mm`` is the distance of the pupil from the
    dome's centre.
    """
    return lens.back_mm + pupil_mm + lens.thickness_mm / lens.refractive_index + (z_mm - lens.z_mm) / gel_index


def fit_noise(spec: SensorSpec, frames: list[Aligned], light: list[np.ndarray], rounds: int = 3) -> SensorSpec:
    """The specification with its noise scaled so that bare skin has the same noise in renders as in the real frames."""
    disc, scale = lens_disc(spec.view, spec.housing), 1.0
    bare = [bare_skin(f.image.shape, f.pins_px, disc) for f in frames]

    def roughness(images: Iterable[np.ndarray]) -> float:
        return float(np.median([noise_sd(gray_levels(image), skin) for image, skin in zip(images, bare, strict=True)]))

    real, still = roughness(f.image for f in frames), roughness(expose(x, spec.capture) for x in light)
    for _ in range(rounds):
        noisy = with_changes(spec, response=_noise(spec.response, scale))
        ours = roughness(expose(x, noisy.capture, np.random.default_rng(k)) for k, x in enumerate(light))
        grown = max(ours**2 - still**2, LEAST_NOISE2)
        scale *= float(np.sqrt(max(real**2 - still**2, LEAST_NOISE_SHARE * grown) / grown))
    return with_changes(spec, response=_noise(spec.response, scale))


def _noise(response: ResponseSpec, scale: float) -> dict[str, float]:
    """Fields of ``[response]`` for noise whose standard deviation is multiplied by ``scale``."""
    return {"read_noise": response.read_noise * scale, "shot_noise": response.shot_noise * scale**2}
