"""How far a camera has moved since its calibration, told from the clamped outermost pins."""

from dataclasses import dataclass

import numpy as np

LEAST_RIM = 0.5  # of the outermost pins must be seen


@dataclass(frozen=True)
class Drift:
    """The similarity that carries the calibrated rim of pins to the one seen.

    Attributes
    ----------
    shift_px : (2,) float
        Of the rim's centre.
    turn_deg : float
        From x towards y.
    scale : float
    """

    shift_px: np.ndarray
    turn_deg: float
    scale: float


def drift_of(pins_px: np.ndarray, rest_px: np.ndarray, outmost: np.ndarray) -> Drift | None:
    """Drift by least squares over the outermost pins (m,) of pins (N, 2), NaN where lost; None where too few are seen.

    With complex coordinates about the means: ``a = sum conj(r) p / sum |r|^2`` (Horn 1987, in the plane).
    """
    rim = outmost[np.isfinite(pins_px[outmost, 0])]
    if len(rim) < LEAST_RIM * len(outmost):
        return None
    seen, rest = pins_px[rim] @ [1, 1j], rest_px[rim] @ [1, 1j]
    middle, rest_middle = seen.mean(), rest.mean()
    a = np.vdot(rest - rest_middle, seen - middle) / np.vdot(rest - rest_middle, rest - rest_middle)
    center = outmost_center(rest_px, outmost)
    now = middle + a * (center @ [1, 1j] - rest_middle)
    return Drift(np.array([now.real, now.imag]) - center, float(np.degrees(np.angle(a))), float(abs(a)))


def outmost_center(rest_px: np.ndarray, outmost: np.ndarray) -> np.ndarray:
    """Mean (2,) of the rim at rest."""
    return rest_px[outmost].mean(axis=0)
