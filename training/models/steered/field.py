"""The displacement of the pins as a smooth field that can be turned exactly, for any layout.

With the complex displacement u = u_x + i u_y at the place r (cos p, sin p) about the layout's middle, the field is a sum of waves,

    u = sum_mn  c_mn R_mn(r) exp(i m p)

with the radial polynomials R_mn of Zernike (1934). A contact that is turned by an angle t in the picture has the displacement
exp(i t) u(r, p - t), and therefore the coefficients c_mn exp(i t (1 - m)).
"""

from dataclasses import dataclass
from math import factorial

import numpy as np

# Number of pins for each coefficient: with fewer pins the fit follows the noise of single pins.
PINS_A_WAVE = 2.5
# Highest degree of the waves: finer ones are below the noise of a pin in every recording.
MOST_DEGREE = 14


@dataclass(frozen=True)
class Waves:
    """The waves of a layout with N pins.

    Attributes
    ----------
    fit : (C, N) complex
        From the complex displacements of the pins to the C coefficients, by least squares.
    order : (C,) int
        1 - m of each coefficient: how many times a coefficient turns when the contact turns once.
    """

    fit: np.ndarray
    order: np.ndarray


def waves_of(rest_px: np.ndarray) -> Waves:
    """The waves of a layout at rest (N, 2). Waves of the same m are orthogonal over the pins."""
    place = (rest_px - rest_px.mean(axis=0)) @ [1, 1j]
    place = place / np.abs(place).max()
    degree = 0
    while degree < MOST_DEGREE and PINS_A_WAVE * (degree + 2) * (degree + 3) / 2 <= len(rest_px):
        degree += 1
    parts, order = [], []
    for m in range(-degree, degree + 1):
        radial = np.stack([_radial(n, abs(m), np.abs(place)) for n in range(abs(m), degree + 1, 2)], axis=1)
        smooth, _ = np.linalg.qr(radial * np.exp(1j * m * np.angle(place))[:, None])
        parts.append(smooth)
        order += [1 - m] * smooth.shape[1]
    return Waves(np.linalg.pinv(np.concatenate(parts, axis=1)), np.array(order))


def _radial(n: int, m: int, r: np.ndarray) -> np.ndarray:
    total = np.zeros_like(r)
    for k in range((n - m) // 2 + 1):
        size = factorial(n - k) / (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
        total += (-1) ** k * size * r ** (n - 2 * k)
    return total
