"""Fit of lights and colours to the gray levels of caps and skin, by the Gauss-Newton method with the differentiable renderer.

Only the product of LED power, exposure and reflectance can be measured. Therefore the caps' largest reflectance is held at ``CAP_ALBEDO``
(printed white) and the exposure is not changed; the power is fitted. Caps that differ from the others have smaller (robust) weights;
``twin.calibration.light.caps`` fits their individual reflectance afterwards.
"""

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.camera.capture import blurred
from twin.evaluation.pictures.aligned import SATURATED, Aligned, levels_slope, to_levels, to_light, with_changes
from twin.evaluation.pictures.statistics import clear_of_pins
from twin.geometry.pins import usual_spacing
from twin.optics.light_model import Knobs, LightModel
from twin.optics.render import Renderer
from twin.progress import Step

CAP_ALBEDO = 0.8
"""Reflectance of the caps' brightest channel. Assumed: white printing resin."""
SKIN_SAMPLES = 250
"""Number of pixels of bare skin that are used of a frame."""
SKIN_CLEARANCE = 0.6
"""Least distance of a pixel of bare skin from every cap's middle, as a share of the pins' spacing."""
DISC_SHARE = 0.9
"""Share of the mask's radius outside of which pixels are left out, because light from the rim reaches them."""
STEPS = 6
"""Number of Gauss-Newton steps."""
SLOPES_EVERY = 2
"""Number of steps after which derivatives are computed again. The light is nearly linear in the unknowns."""
ROBUST_LEVELS = 12.0
"""Residual, gray levels, above which a sample has a smaller weight (Cauchy)."""
BALANCE_SD = 0.3
"""Prior standard deviation of the logarithm of an LED's share."""
LARGEST_STEP = 0.7
"""Largest change of an unknown (a logarithm) in one step."""
DAMPING = 1e-9
"""Damping of the normal equations, relative to their trace, which keeps them solvable."""
MOST_HAZE = 0.5
"""Largest haze that is allowed."""


def sample_frame(
    frame: Aligned, around: tuple[np.ndarray, np.ndarray], spec: SensorSpec, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sample the caps' middles and bare skin of a frame. Each sample is the mean of 3 x 3 px.

    The veil is the light that haze adds: the frame's own light, blurred. Where the static layer covers the gel, the frame is often
    saturated; there the layer's own light is used instead.

    Parameters
    ----------
    frame : Aligned
    around : (H, W[, 3]) float, (H, W) float
        The static layer's light, and its transmittance for the gel's light.
    spec : SensorSpec
    rng : numpy.random.Generator
        Generator that chooses the pixels of bare skin.

    Returns
    -------
    pixels : (n, 2) int
        x and y of each place.
    levels : (n, channels) float
        Gray levels.
    veil : (n, channels) float
        Light of the blurred frame, which the haze adds.
    caps : (n,) bool
        Whether the place is on a cap; otherwise it is on bare skin.
    """
    image, (outside, through), blob = np.atleast_3d(frame.image), around, spec.pipeline.raw
    mean = cv2.blur(image.astype(np.float32), (3, 3)).reshape(image.shape)
    light = np.where(through[..., None] > 0, to_light(image, spec.response), outside.reshape(image.shape)).astype(np.float32)
    veil = blurred(light, spec.gel.haze_sigma_px).reshape(image.shape)
    caps = np.rint(frame.pins_px[np.isfinite(frame.pins_px).all(axis=1)]).astype(int)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    bare = np.hypot(x - blob.mask_center_px[0], y - blob.mask_center_px[1]) < DISC_SHARE * blob.mask_radius_px
    bare &= clear_of_pins(image.shape, caps, round(SKIN_CLEARANCE * usual_spacing(caps)))
    rows, columns = np.nonzero(bare)
    chosen = rng.permutation(len(rows))[:SKIN_SAMPLES]
    pixels = np.concatenate([caps, np.column_stack([columns[chosen], rows[chosen]])])
    at = pixels[:, 1], pixels[:, 0]
    return pixels, mean[at], veil[at], np.arange(len(pixels)) < len(caps)


def fit_photometry(spec: SensorSpec, frames: list[Aligned], progress: Step) -> SensorSpec:
    """Fit LED powers, colours of caps and skin, and the gel's haze.

    Parameters
    ----------
    spec : SensorSpec
        The specification at the start of the fit. Geometry and response are not changed.
    frames : list of Aligned
    progress : callable
        ``progress(done, total)``.
    """
    rng, renderer, width = np.random.default_rng(0), Renderer(spec), spec.camera.width_px
    samples = [sample_frame(frame, renderer.static, spec, rng) for frame in frames]
    models = [
        LightModel(renderer, frame.state, pixels[:, 1] * width + pixels[:, 0], seed)
        for seed, (frame, (pixels, *_)) in enumerate(zip(frames, samples, strict=True))
    ]
    _, levels, veil, caps = (np.concatenate(each) for each in zip(*samples, strict=True))
    useful = np.all(levels < SATURATED, axis=1)
    layout = _Layout(models[0].led_count, levels.shape[1])
    x = layout.start(models, to_light(levels[caps & useful], spec.response), caps & useful, spec.gel.haze)
    slopes: dict[str, np.ndarray] = {}
    for step in range(STEPS):
        light = np.concatenate([m.light(layout.knobs(x)) for m in models])
        if step % SLOPES_EVERY == 0:
            found = [m.slopes(layout.knobs(x)) for m in models]
            slopes = {name: np.concatenate([f[name] for f in found]) for name in found[0]}
        seen = (1 - x[-1]) * light + x[-1] * veil
        residual = np.where(useful[:, None], levels - to_levels(seen, spec.response), 0.0)
        jacobian = layout.jacobian(slopes, light, veil, x[-1], levels_slope(seen, spec.response)) * useful[:, None, None]
        x = x + np.clip(layout.move(jacobian, residual, x, len(frames)), -LARGEST_STEP, LARGEST_STEP)
        x[-1] = np.clip(x[-1], 0, MOST_HAZE)
        progress(step + 1, STEPS)
    return layout.apply_values(spec, x)


class _Layout:
    """Order of the unknowns in their vector: logarithms of the factors on LEDs, skin and caps, then the haze."""

    def __init__(self, leds: int, channels: int) -> None:
        self.leds, self.channels = leds, channels
        self.count = leds + 2 * channels + 1
        self.skin, self.caps = slice(leds, leds + channels), slice(leds + channels, leds + 2 * channels)

    def start(self, models: list[LightModel], cap_light: np.ndarray, caps: np.ndarray, haze: float) -> np.ndarray:
        """Unknowns at the start: neutral, but caps and skin are scaled to the median of the real ``cap_light`` (n, channels)."""
        x = np.zeros(self.count)
        light = np.concatenate([m.light(self.knobs(x)) for m in models])
        ratio = np.median(cap_light, axis=0) / np.median(light[caps], axis=0)
        x[self.caps] = x[self.skin] = np.log(ratio)
        x[-1] = haze
        return x

    def knobs(self, x: np.ndarray) -> Knobs:
        """The light model's knobs. The stems have the knob of the skin."""
        skin, caps = (np.broadcast_to(np.exp(x[part]), 3) for part in (self.skin, self.caps))
        return Knobs(np.exp(x[: self.leds]), skin, caps, skin)

    def jacobian(self, slopes: dict[str, np.ndarray], light: np.ndarray, veil: np.ndarray, haze: float, curve: np.ndarray) -> np.ndarray:
        """Derivatives (n, channels, unknowns) of the gray levels."""
        result = np.zeros((*light.shape, self.count))
        for k in range(self.leds):
            result[..., k] = slopes[f"led{k}"]
        for c in range(self.channels):
            result[:, c, self.skin.start + c] = (slopes["skin"] + slopes["stems"])[:, c]
            result[:, c, self.caps.start + c] = slopes["caps"][:, c]
        result *= (1 - haze) * curve[..., None]
        result[..., -1] = (veil - light) * curve
        return result

    def move(self, jacobian: np.ndarray, residual: np.ndarray, x: np.ndarray, frames: int) -> np.ndarray:
        """The Gauss-Newton step (unknowns,) from ``x`` for residuals (n, channels) of ``frames`` frames, with robust weights (Cauchy).

        The prior of the LEDs' shares has the weight of one frame.
        """
        weight = 1 / (1 + (residual / ROBUST_LEVELS) ** 2)
        a = jacobian.reshape(-1, len(x))
        hessian = (a * weight.reshape(-1, 1)).T @ a
        prior = np.zeros(len(x))
        prior[: self.leds] = weight.sum() / frames / self.leds * (1.0 / BALANCE_SD) ** 2
        return np.linalg.solve(hessian + np.diag(prior + DAMPING * hessian.trace()), a.T @ (weight * residual).ravel() - prior * x)

    def apply_values(self, spec: SensorSpec, x: np.ndarray) -> SensorSpec:
        """The specification with the values of the unknowns. The brightness of the visible ring is kept."""
        lit = [k for k in range(len(spec.leds.azimuth_deg)) if k not in spec.leds.off]
        balance = np.array(spec.leds.balance or np.ones(len(spec.leds.azimuth_deg)))
        balance[lit] *= np.exp(x[: self.leds])
        knobs, look = self.knobs(x), spec.appearance
        caps = knobs.caps * look.cap_albedo
        scale = CAP_ALBEDO / caps.max()
        power = float(balance[lit].mean() / scale)
        dark = {
            name: tuple((knobs.skin * scale * getattr(look, name)).clip(0, 1).round(6).tolist()) for name in ("skin_albedo", "pin_albedo")
        }
        return with_changes(
            spec,
            leds={"balance": tuple((balance / balance[lit].mean()).round(4).tolist()), "power": round(spec.leds.power * power, 6)},
            housing={"ambient": spec.housing.ambient / power, "glow": spec.housing.glow / power, "fill": spec.housing.fill / power},
            appearance={"cap_albedo": tuple((scale * caps).round(5).tolist())} | dark,
            gel={"haze": round(float(x[-1]), 5)},
        )
