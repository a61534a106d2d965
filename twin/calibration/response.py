"""Sharpness, colour fringes, compression and noise of the camera, from whole frames with the light already right."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from scenes.sensor import SensorSpec
from twin.calibration.aligned import SATURATED, Aligned, revised
from twin.camera import expose, hazed
from twin.preprocess.forms import gray_levels
from twin.projection import project
from twin.realism.caps import measure_caps
from twin.realism.disc import lens_disc
from twin.realism.radial import bin_of, equal_count_edges
from twin.realism.spectra import noise_sd
from twin.realism.statistics import bare_skin
from twin.video import luma_weights, stream_of

BOUNDS = {  # name: least, largest, unit of a step
    "blur_sigma_px": (0.05, 4.0, 0.03),
    "sharpening": (0.0, 4.0, 0.05),
    "sharpening_sigma_px": (0.5, 4.0, 0.05),
}
CHROMA = {"chroma_sigma_px": (0.05, 4.0, 0.05)}
FRINGES = {"red_scale": (0.985, 1.015, 0.0003), "blue_scale": (0.985, 1.015, 0.0003)}
SHIFTS = {f"{colour}_shift_px.{axis}": (-3.0, 3.0, 0.03) for colour in ("red", "blue") for axis in (0, 1)}
LEAST_SHARPENING = 0.2  # to start from: a mask of no weight has no width
SAME_CHROMA = 0.5  # colour step between columns that share it, relative to the step to the next pair
QUALITIES = (0, 95, 90, 80, 70)
MOST_TRIES = 10  # of the least squares
MOST_FRAMES = 3  # that the sharpness is fitted to
EVERY = 3  # pixels that the fit looks at: one in this many, in both directions
MOST_APERTURE_MM = 3.0  # more needs more samples a pixel than frames for learning have
GAUSSIAN_WIDTH = 2.563  # 10-90 % edge width of a Gaussian blur relative to its sd
DISC_WIDTH = 0.69  # 10-90 % edge width of a uniform disc relative to its diameter


@dataclass(frozen=True)
class Sharpness:
    """Cap edge widths (10-90 %, px) by distance to the pupil: real and rendered medians of each of ``distance_mm``'s bins."""

    distance_mm: np.ndarray
    real_px: np.ndarray
    rendered_px: np.ndarray


def fit_response(spec: SensorSpec, frames: list[Aligned], light: list[np.ndarray], inside: np.ndarray) -> SensorSpec:
    """Blur, sharpening and colour fringes by least squares over the disc, then the compression that fits best.

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
    pick = np.zeros_like(inside)
    pick[::EVERY, ::EVERY] = True
    frames, light = frames[:MOST_FRAMES], [hazed(np.asarray(x, np.float32), spec.gel) for x in light[:MOST_FRAMES]]
    useful = [inside & pick & (gray_levels(f.image) < SATURATED) for f in frames]
    real = np.concatenate([f.image[u].astype(float).ravel() for f, u in zip(frames, useful, strict=True)])
    images = [f.image for f in frames]
    stream = {"stream": stream_of(images), "chroma_columns": chroma_columns(images)}
    flat = revised(spec, response={"jpeg_quality": 0} | stream, gel={"haze": 0.0})  # the light is hazed already

    def with_values(values) -> SensorSpec:
        return _changed(flat, dict(zip(names, map(float, values), strict=True)))

    def misfit(shown: SensorSpec) -> np.ndarray:
        return np.concatenate([expose(x, shown)[u].astype(float).ravel() for x, u in zip(light, useful, strict=True)]) - real

    def residual(values) -> np.ndarray:
        return misfit(with_values(values))

    low, high, unit = np.array([bounds[name] for name in names]).T
    start = np.clip([_value(spec, name) for name in names], low + 1e-6, high - 1e-6)
    start[names.index("sharpening")] = max(spec.response.sharpening, LEAST_SHARPENING)

    def slopes(values):
        at = residual(values)
        steps = np.where(values + unit <= high, unit, -unit)
        return np.stack([(residual(values + step * row) - at) / step for step, row in zip(steps, np.eye(len(names)), strict=True)], axis=1)

    fit = least_squares(residual, start, slopes, bounds=(low, high), x_scale=unit, loss="soft_l1", f_scale=10.0, max_nfev=MOST_TRIES)
    best = with_values(fit.x)
    errors = {q: np.mean(np.abs(misfit(revised(best, response={"jpeg_quality": q})))) for q in QUALITIES}
    return revised(best, response={"jpeg_quality": min(errors, key=errors.get)}, gel={"haze": spec.gel.haze})


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
    field, _, index = name.partition(".")
    value = getattr(spec.response if field in BOUNDS | CHROMA else spec.camera, field)
    return value[int(index)] if index else value


def _changed(spec: SensorSpec, values: dict[str, float]) -> SensorSpec:
    response = {name: value for name, value in values.items() if name in BOUNDS | CHROMA}
    camera = {name: value for name, value in values.items() if name in FRINGES}
    for name in values.keys() & SHIFTS.keys():
        field = name.partition(".")[0]
        camera[field] = (values[f"{field}.0"], values[f"{field}.1"])
    return revised(spec, response=response, camera=camera)


def sharpness(spec: SensorSpec, frames: list[Aligned], rendered: list[np.ndarray], bins: int = 5) -> Sharpness:
    """Edge widths of caps in real and rendered frames against their distance from the pupil as light counts it (apparent, in air)."""
    distance, real, ours = [], [], []
    for frame, image in zip(frames, rendered, strict=True):
        distance.append(apparent_mm(spec, frame.state.caps_mm[:, 2]))
        real.append(measure_caps(gray_levels(frame.image), frame.pins_px).edge_px)
        ours.append(measure_caps(gray_levels(image), project(spec, frame.state.caps_mm)).edge_px)
    distance, real, ours = map(np.concatenate, (distance, real, ours))
    good = np.isfinite(real) & np.isfinite(ours)
    which = bin_of(distance, equal_count_edges(distance[good], bins))
    parts = [good & (which == k) for k in range(bins)]
    return Sharpness(*(np.array([np.median(values[p]) for p in parts]) for values in (distance, real, ours)))


def fit_blur(spec: SensorSpec, frames: list[Aligned], light: list[np.ndarray], rounds: int = 3) -> SensorSpec:
    """The blur under which rendered edges are as wide as real ones, of all caps together.

    Least squares on gray levels, where edges don't lie exactly on each other, prefer them too soft.
    """
    for _ in range(rounds):
        seen = sharpness(spec, frames, [expose(x, spec) for x in light], bins=1)
        lacking = float((seen.real_px**2 - seen.rendered_px**2)[0]) / GAUSSIAN_WIDTH**2
        blur = np.sqrt(max(spec.response.blur_sigma_px**2 + lacking, BOUNDS["blur_sigma_px"][0] ** 2))
        spec = revised(spec, response={"blur_sigma_px": round(float(blur), 4)})
    return spec


def fit_focus(spec: SensorSpec, seen: Sharpness) -> SensorSpec:
    """Aperture and focus whose defocus explains how the edges' width changes with distance.

    The circle of confusion of a point at d with focus at d0 is ``f a |1/d - 1/d0|`` px; squares of widths add. Both
    are found on a grid, with the evenly spread rest left to the blur.
    """
    before = defocus_px(spec.camera.fx_px, spec.camera.aperture_mm, spec.camera.focus_mm, seen.distance_mm)
    wanted = seen.real_px**2 - seen.rendered_px**2 + (DISC_WIDTH * before) ** 2
    best = (np.inf, 0.0, spec.camera.focus_mm)
    for focus in np.linspace(0.85 * seen.distance_mm.min(), 1.15 * seen.distance_mm.max(), 31):
        for aperture in np.linspace(0, MOST_APERTURE_MM, 31):
            grown = (DISC_WIDTH * defocus_px(spec.camera.fx_px, aperture, focus, seen.distance_mm)) ** 2
            miss = float(np.var(wanted - grown))
            if miss < best[0]:
                best = miss, aperture, focus
    return revised(spec, camera={"aperture_mm": round(best[1], 3), "focus_mm": round(float(best[2]), 2)})


def defocus_px(focal_px: float, aperture_mm: float, focus_mm: float, distance_mm: np.ndarray) -> np.ndarray:
    """Diameter of the circle of confusion."""
    return focal_px * aperture_mm * np.abs(1 / distance_mm - 1 / focus_mm)


def apparent_mm(spec: SensorSpec, z_mm: np.ndarray) -> np.ndarray:
    """Distance in air at which what lies at z in the gel seems to be, near the axis."""
    lens = spec.lens
    return (
        lens.back_mm + spec.camera.distance_mm + lens.thickness_mm / lens.refractive_index + (z_mm - lens.z_mm) / spec.gel.refractive_index
    )


def fit_noise(spec: SensorSpec, frames: list[Aligned], light: list[np.ndarray], rounds: int = 3) -> SensorSpec:
    """Scale the noise until bare skin of renders is as rough as the real frames'."""
    disc, scale = lens_disc(spec), 1.0
    bare = [bare_skin(f.image.shape, f.pins_px, disc) for f in frames]

    def roughness(images) -> float:
        return float(np.median([noise_sd(gray_levels(image), skin) for image, skin in zip(images, bare, strict=True)]))

    real, still = roughness(f.image for f in frames), roughness(expose(x, spec) for x in light)
    for _ in range(rounds):
        ours = roughness(expose(x, _noisier(spec, scale), np.random.default_rng(k)) for k, x in enumerate(light))
        grown = max(ours**2 - still**2, 1e-4)
        scale *= float(np.sqrt(max(real**2 - still**2, 0.01 * grown) / grown))
    return _noisier(spec, scale)


def _noisier(spec: SensorSpec, scale: float) -> SensorSpec:
    """Noise sd times ``scale``."""
    response = spec.response
    return revised(spec, response={"read_noise": response.read_noise * scale, "shot_noise": response.shot_noise * scale**2})
