"""Measures by distance from the disc's centre, noise, and radial power spectrum of frames."""

from dataclasses import dataclass

import cv2
import numpy as np

BINS = 8
"""Number of bins of the distance from the disc's centre."""
SPECTRUM_BINS = 24
"""Number of rings of the spectrum."""
LOWEST_CYCLES = 4.0
"""Lowest frequency, cycles per diameter of the disc. Below it the spectrum is that of the Hann window."""
GAUSSIAN_MAD = 1.4826
"""Ratio of a Gaussian's standard deviation to its median absolute deviation."""
CLIP_ROUNDS = 3
"""Number of rounds in which residuals above three standard deviations are removed."""
NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
"""Kernel whose response to constant, linear and bilinear surfaces is zero, and whose gain for white noise is 1 (Immerkaer 1996)."""


@dataclass(frozen=True)
class RadialRow:
    """One measure in one bin: its mean over the real caps and over the rendered ones."""

    measure: str
    inner_px: float
    outer_px: float
    real: float
    rendered: float

    @property
    def difference(self) -> float:
        """Difference of the rendered mean from the real one, relative to the real one."""
        return self.rendered / self.real - 1


def equal_count_edges(distance_px: np.ndarray, bins: int = BINS) -> np.ndarray:
    """(bins + 1,) edges of bins with equally many distances."""
    return np.quantile(distance_px[np.isfinite(distance_px)], np.linspace(0, 1, bins + 1))


def bin_of(distance_px: np.ndarray, edges_px: np.ndarray) -> np.ndarray:
    """Index of each distance's bin. Distances beyond the edges belong to the outer bins; NaN has the index -1."""
    index = np.clip(np.searchsorted(edges_px, distance_px, side="right") - 1, 0, len(edges_px) - 2)
    return np.where(np.isfinite(distance_px), index, -1)


def radial_rows(
    measure: str, real: tuple[np.ndarray, np.ndarray], rendered: tuple[np.ndarray, np.ndarray], edges_px: np.ndarray
) -> list[RadialRow]:
    """A measure in every bin. ``real`` and ``rendered`` are distances in px and values, (n,) each. NaN values are ignored."""
    means = []
    for distance, values in (real, rendered):
        where = bin_of(distance, edges_px)
        each = [values[(where == k) & np.isfinite(values)] for k in range(len(edges_px) - 1)]
        means.append([float(v.mean()) if len(v) else np.nan for v in each])
    pairs = zip(edges_px[:-1], edges_px[1:], *means, strict=True)
    return [RadialRow(measure, float(inner), float(outer), a, b) for inner, outer, a, b in pairs]


def noise_sd(gray: np.ndarray, where: np.ndarray) -> float:
    """Standard deviation of the noise in gray levels, over the pixels ``where`` (H, W) bool.

    Immerkaer's kernel (1996) removes constant, linear and bilinear surfaces. Edges are removed by leaving out residuals above three
    standard deviations; the first standard deviation is estimated from the median absolute deviation.
    """
    residual = cv2.filter2D(gray.astype(np.float32), cv2.CV_32F, NOISE_KERNEL)[where]
    sd = GAUSSIAN_MAD * float(np.median(np.abs(residual)))
    for _ in range(CLIP_ROUNDS):
        sd = float(np.sqrt(np.mean(residual[np.abs(residual) <= 3 * sd] ** 2)))
    return sd


def radial_spectrum(gray: np.ndarray, center_px: np.ndarray, radius_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Power against spatial frequency inside a disc.

    The disc's mean is subtracted, a round Hann window is applied, and the power of the discrete Fourier transform is averaged over rings
    of equal width in the logarithm of frequency. White noise with the standard deviation s has the power s^2 at all frequencies.

    Returns
    -------
    frequency : (b,) float
        Cycles per px, up to 0.5; rings without a sample are omitted.
    power : (b,) float
        Squared gray levels.
    """
    half = int(radius_px)
    x, y = np.rint(center_px).astype(int)
    if min(x, y) < half or x + half >= gray.shape[1] or y + half >= gray.shape[0]:
        half = int(min(x, y, gray.shape[1] - 1 - x, gray.shape[0] - 1 - y))
    patch = gray[y - half : y + half + 1, x - half : x + half + 1].astype(float)
    v, u = np.mgrid[-half : half + 1, -half : half + 1] / half
    r = np.hypot(u, v)
    window = np.where(r < 1, np.cos(0.5 * np.pi * r) ** 2, 0.0)
    patch = (patch - (patch * window).sum() / window.sum()) * window
    power = np.abs(np.fft.fft2(patch)) ** 2 / (window**2).sum()
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(len(patch)), np.fft.fftfreq(len(patch))))
    edges = np.geomspace(LOWEST_CYCLES / (2 * half), 0.5, SPECTRUM_BINS + 1)
    ring = np.digitize(f.ravel(), edges) - 1
    inside = (ring >= 0) & (ring < SPECTRUM_BINS)
    count = np.bincount(ring[inside], minlength=SPECTRUM_BINS)
    total = np.bincount(ring[inside], power.ravel()[inside], SPECTRUM_BINS)
    used = count > 0
    return np.sqrt(edges[:-1] * edges[1:])[used], total[used] / count[used]


def log_distance_db(real: np.ndarray, rendered: np.ndarray) -> float:
    """Rms over the rings of the logarithmic ratio of two spectra, dB."""
    return float(np.sqrt(np.mean((10 * np.log10(rendered / real)) ** 2)))
