"""Statistics of a set of frames, and comparison of two sets: caps by the distance from the disc's centre, noise, spectrum, bright spots."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import binned_statistic
from skimage.measure import label, regionprops

from scenes.sensor import Polarity
from twin.camera.projection import Disc
from twin.geometry.pins import usual_spacing
from twin.pins.finding.caps import measure_caps

CLEAR_SHARE = 0.55
"""Least distance of bare skin from every pin, as a share of the pins' spacing."""
RADIAL_MEASURES = ("level", "contrast", "skin", "diameter_px", "eccentricity", "edge_px")
"""Measures of caps that are compared by the distance from the disc's centre."""
TARGET = 0.05
TARGET_MEASURES = ("level", "diameter_px", "edge_px")
"""Target: largest relative difference in any bin, and the measures for which it is the target."""
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
GROUND_PX, RISE = 25, 20.0
"""Side of the median filter that computes the background, px; smallest difference of a spot from the background, gray levels."""
MIN_AREA_PX2 = 4
"""Least area of a spot."""
RIM_PX = 4.0
"""Distance from the disc's edge within which nothing is searched, px."""
PIN_SHARE = 0.75
"""Distance from a pin, as a share of the pins' spacing, within which nothing is searched."""
STEADY_PX, STEADY_SHARE = 3.0, 0.5
"""Largest difference of a steady spot's place between frames, px; least share of the frames that show it. Pins hide it in others."""
MOST_APART_PX = 6.0
"""Largest distance of a real spot from its rendered counterpart, px."""


class FrameStatistics:
    """Measures of a gray frame (H, W) uint8 with bright or dark pins at (N, 2) px.

    Attributes
    ----------
    caps : Caps
    distance_px : (N,) float
        Distance of each cap from the disc's centre.
    skin_level : float
        Median gray level of bare skin among the pins.
    noise_sd : float
        Standard deviation of the noise on bare skin, gray levels.
    frequency, power : (b,) float
        Radial spectrum over the disc: cycles per px, and squared gray levels.
    spots : Spots
    """

    def __init__(self, gray: np.ndarray, pins_px: np.ndarray, disc: Disc, *, polarity: Polarity = "bright") -> None:
        self.caps, self.distance_px = measure_caps(gray, pins_px, polarity=polarity), disc.distance_px(pins_px)
        bare = bare_skin(gray.shape, pins_px, disc)
        self.skin_level = float(np.median(gray[bare])) if bare.any() else np.nan
        self.noise_sd = noise_sd(gray, bare) if bare.any() else np.nan
        self.frequency, self.power = radial_spectrum(gray, disc.center_px, disc.radius_px)
        self.spots = find_spots(gray, disc, pins_px, usual_spacing(pins_px))


class Statistics:
    """Comparison of all measures of two sets of frames, real and rendered. All bins have equally many real caps.

    Attributes
    ----------
    radial : list of RadialRow
    scalars : dict of str to (float, float)
        Real and rendered values by name.
    frequency, real_power, rendered_power : (b,) float
        Mean spectra.
    spectrum_db : float
        Difference of the mean spectra (see ``log_distance_db``).
    real_spots, rendered_spots : Spots
    spots_apart_px : (m,) float
        Distances of spots that have a counterpart.
    """

    def __init__(self, real: list[FrameStatistics], rendered: list[FrameStatistics]) -> None:
        edges = equal_count_edges(np.concatenate([f.distance_px for f in real]))
        self.radial: list[RadialRow] = []
        for measure in RADIAL_MEASURES:
            self.radial += radial_rows(measure, _by_distance(real, measure), _by_distance(rendered, measure), edges)
        self.scalars = {name: (_mean(real, name), _mean(rendered, name)) for name in ("skin_level", "noise_sd")}
        self.frequency = real[0].frequency
        self.real_power, self.rendered_power = (np.mean([f.power for f in frames], axis=0) for frames in (real, rendered))
        self.spectrum_db = log_distance_db(self.real_power, self.rendered_power)
        self.real_spots, self.rendered_spots = (steady_spots([f.spots for f in frames]) for frames in (real, rendered))
        self.spots_apart_px = pair_spots(self.real_spots, self.rendered_spots)

    def worst(self, measure: str) -> float:
        """Largest relative difference of a measure in any bin."""
        return float(np.nanmax([abs(row.difference) for row in self.radial if row.measure == measure]))


def _by_distance(frames: list[FrameStatistics], measure: str) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) px from the disc's centre and a measure (n,) of all frames' caps."""
    return np.concatenate([f.distance_px for f in frames]), np.concatenate([getattr(f.caps, measure) for f in frames])


def _mean(frames: list[FrameStatistics], name: str) -> float:
    """Mean of an attribute over the frames."""
    return float(np.nanmean([getattr(f, name) for f in frames]))


def bare_skin(shape: tuple[int, ...], pins_px: np.ndarray, disc: Disc) -> np.ndarray:
    """(H, W) bool: pixels between the pins at (N, 2) px that show no pin."""
    places = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=2)
    among = disc.distance_px(places) < np.nanmax(disc.distance_px(pins_px))
    return clear_of_pins(shape, pins_px, CLEAR_SHARE * usual_spacing(pins_px)) & disc.inside & among


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
    mean = binned_statistic(f.ravel(), power.ravel(), bins=edges).statistic
    used = np.isfinite(mean)
    return np.sqrt(edges[:-1] * edges[1:])[used], mean[used]


def log_distance_db(real: np.ndarray, rendered: np.ndarray) -> float:
    """Rms over the rings of the logarithmic ratio of two spectra, dB."""
    return float(np.sqrt(np.mean((10 * np.log10(rendered / real)) ** 2)))


@dataclass(frozen=True)
class Spots:
    """Bright spots: places (k, 2) px, peaks (k,) in gray levels."""

    px: np.ndarray
    peak: np.ndarray


def find_spots(gray: np.ndarray, disc: Disc, pins_px: np.ndarray, spacing_px: float) -> Spots:
    """Spots of a gray frame (H, W) in the disc and away from the pins (n, 2)."""
    looked = (disc.inside & clear_of_pins(gray.shape, pins_px, PIN_SHARE * spacing_px)).astype(np.uint8)
    looked &= cv2.circle(np.zeros_like(looked), np.rint(disc.center_px).astype(int).tolist(), int(disc.radius_px - RIM_PX), 1, -1)
    rise = gray.astype(np.float32) - cv2.medianBlur(np.ascontiguousarray(gray), GROUND_PX)
    spots = [spot for spot in regionprops(label((rise > RISE) & (looked > 0)), rise) if spot.area >= MIN_AREA_PX2]
    peaks = [float(gray[spot.slice][spot.image].max()) for spot in spots]
    return Spots(np.array([spot.centroid_weighted[::-1] for spot in spots]).reshape(-1, 2), np.array(peaks))


def steady_spots(frames: list[Spots], share: float = STEADY_SHARE) -> Spots:
    """Spots that are visible in at least the fraction ``share`` of the frames, with their mean places and mean peaks."""
    px, peak = np.concatenate([spots.px for spots in frames]), np.concatenate([spots.peak for spots in frames])
    of = np.repeat(np.arange(len(frames)), [len(spots.px) for spots in frames])
    places, peaks, left = [], [], np.ones(len(px), bool)
    for k in np.argsort(-peak, kind="stable"):
        if left[k]:
            near = left & (np.linalg.norm(px - px[k], axis=1) < STEADY_PX)
            left &= ~near
            if len(np.unique(of[near])) >= share * len(frames):
                places.append(px[near].mean(axis=0))
                peaks.append(peak[near].mean())
    return Spots(np.array(places).reshape(-1, 2), np.array(peaks))


def clear_of_pins(shape: tuple[int, ...], pins_px: np.ndarray, radius_px: float) -> np.ndarray:
    """(H, W) bool: pixels farther than ``radius_px`` from every pin."""
    blocked = np.zeros(shape[:2], np.uint8)
    for x, y in pins_px[np.isfinite(pins_px).all(axis=1)]:
        cv2.circle(blocked, (round(float(x)), round(float(y))), int(np.ceil(radius_px)), 1, -1)
    return blocked == 0


def pair_spots(real: Spots, rendered: Spots) -> np.ndarray:
    """Distances (m,) px of real spots and their rendered counterparts, for all pairs within ``MOST_APART_PX``."""
    apart = np.linalg.norm(real.px[:, None] - rendered.px[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(apart, 2 * MOST_APART_PX))
    found = apart[rows, columns]
    return found[found < MOST_APART_PX]
