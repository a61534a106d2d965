"""How far a camera has moved since its calibration, told from the outermost pins, which a contact moves least."""

from dataclasses import dataclass

import numpy as np

# Least share of the outermost pins that must be seen.
LEAST_RIM = 0.5
# Relative growth of the rim for a contact that moves the pins by rms one radius of the rim. Measured: 0.90, 0.98 and 1.09 in recordings
# of three sensors, 0.7 to 1.4 in the twin.
BULGE = 1.0


@dataclass(frozen=True)
class Drift:
    """The similarity that carries the calibrated rim of pins to the one seen.

    Attributes
    ----------
    shift_px : (2,) float
        Shift of the rim's centre.
    turn_deg : float
        From x towards y.
    scale : float
    contact : float
        Rms of the pins' motion without the similarity, in the rim's mean radius: how much a contact deforms the skin.
    """

    shift_px: np.ndarray
    turn_deg: float
    scale: float
    contact: float

    @property
    def scale_at_rest(self) -> float:
        """The scale without the contact's part: the gel keeps its volume, so that it bulges at the rim when it is pressed in the middle."""
        return self.scale / (1 + BULGE * self.contact)


def drift_of(pins_px: np.ndarray, rest_px: np.ndarray, outmost: np.ndarray) -> Drift | None:
    """Drift by least squares over the outermost pins (m,) of pins (N, 2), NaN where lost; None where too few are seen.

    With complex coordinates about the means: ``a = sum conj(r) p / sum |r|^2`` (Horn 1987, in the plane).
    """
    rim = outmost[np.isfinite(pins_px[outmost, 0])]
    if len(rim) < LEAST_RIM * len(outmost):
        return None
    seen, rest = pins_px @ [1, 1j], rest_px @ [1, 1j]
    middle, rest_middle = seen[rim].mean(), rest[rim].mean()
    a = np.vdot(rest[rim] - rest_middle, seen[rim] - middle) / np.vdot(rest[rim] - rest_middle, rest[rim] - rest_middle)
    carried = middle + a * (rest - rest_middle)
    shift = carried[outmost].mean() - rest[outmost].mean()
    radius = np.abs(rest[outmost] - rest[outmost].mean()).mean()
    contact = np.sqrt(np.nanmean(np.abs(seen - carried) ** 2)) / radius
    return Drift(np.array([shift.real, shift.imag]), float(np.degrees(np.angle(a))), float(abs(a)), float(contact))
