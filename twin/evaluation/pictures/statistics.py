"""Statistics of a set of frames, and comparison of two sets."""

from dataclasses import dataclass

import numpy as np

from scenes.sensor import Polarity
from twin.camera.projection import Disc
from twin.evaluation.pictures.spectra import RadialRow, equal_count_edges, log_distance_db, noise_sd, radial_rows, radial_spectrum
from twin.evaluation.pictures.spots import Spots, clear_of_pins, find_spots, pair_spots, steady_spots
from twin.geometry.pins import usual_spacing
from twin.pins.finding.caps import Caps, measure_caps

# Least distance of bare skin from every pin, as a share of the pins' spacing.
CLEAR_SHARE = 0.55
# Measures of caps that are compared by the distance from the disc's centre.
RADIAL_MEASURES = ("level", "contrast", "skin", "diameter_px", "eccentricity", "edge_px")
# Target: largest relative difference in any bin, and the measures for which it is the target.
TARGET = 0.05
TARGET_MEASURES = ("level", "diameter_px", "edge_px")


@dataclass(frozen=True)
class FrameStatistics:
    """Measures of one frame.

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

    caps: Caps
    distance_px: np.ndarray
    skin_level: float
    noise_sd: float
    frequency: np.ndarray
    power: np.ndarray
    spots: Spots


@dataclass(frozen=True)
class Statistics:
    """Comparison of real with rendered frames.

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

    radial: list[RadialRow]
    scalars: dict[str, tuple[float, float]]
    frequency: np.ndarray
    real_power: np.ndarray
    rendered_power: np.ndarray
    spectrum_db: float
    real_spots: Spots
    rendered_spots: Spots
    spots_apart_px: np.ndarray

    def worst(self, measure: str) -> float:
        """Largest relative difference of a measure in any bin."""
        return float(np.nanmax([abs(row.difference) for row in self.radial if row.measure == measure]))


def measure_frame(gray: np.ndarray, pins_px: np.ndarray, disc: Disc, *, polarity: Polarity = "bright") -> FrameStatistics:
    """Measure a gray frame (H, W) uint8 with bright or dark pins at (N, 2) px."""
    bare = bare_skin(gray.shape, pins_px, disc)
    frequency, power = radial_spectrum(gray, disc.center_px, disc.radius_px)
    return FrameStatistics(
        caps=measure_caps(gray, pins_px, polarity=polarity),
        distance_px=disc.distance_px(pins_px),
        skin_level=float(np.median(gray[bare])) if bare.any() else np.nan,
        noise_sd=noise_sd(gray, bare) if bare.any() else np.nan,
        frequency=frequency,
        power=power,
        spots=find_spots(gray, disc, pins_px, usual_spacing(pins_px)),
    )


def bare_skin(shape: tuple[int, ...], pins_px: np.ndarray, disc: Disc) -> np.ndarray:
    """(H, W) bool: pixels between the pins at (N, 2) px that show no pin."""
    places = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=2)
    among = disc.distance_px(places) < np.nanmax(disc.distance_px(pins_px))
    return clear_of_pins(shape, pins_px, CLEAR_SHARE * usual_spacing(pins_px)) & disc.inside & among


def compare_statistics(real: list[FrameStatistics], rendered: list[FrameStatistics]) -> Statistics:
    """Compare all measures of two sets of frames. All bins have equally many real caps."""
    edges = equal_count_edges(np.concatenate([f.distance_px for f in real]))
    rows: list[RadialRow] = []
    for measure in RADIAL_MEASURES:
        rows += radial_rows(measure, _by_distance(real, measure), _by_distance(rendered, measure), edges)
    real_power, rendered_power = (np.mean([f.power for f in frames], axis=0) for frames in (real, rendered))
    real_spots, rendered_spots = (steady_spots([f.spots for f in frames]) for frames in (real, rendered))
    return Statistics(
        radial=rows,
        scalars={name: (_mean(real, name), _mean(rendered, name)) for name in ("skin_level", "noise_sd")},
        frequency=real[0].frequency,
        real_power=real_power,
        rendered_power=rendered_power,
        spectrum_db=log_distance_db(real_power, rendered_power),
        real_spots=real_spots,
        rendered_spots=rendered_spots,
        spots_apart_px=pair_spots(real_spots, rendered_spots),
    )


def _by_distance(frames: list[FrameStatistics], measure: str) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) px from the disc's centre and a measure (n,) of all frames' caps."""
    return np.concatenate([f.distance_px for f in frames]), np.concatenate([getattr(f.caps, measure) for f in frames])


def _mean(frames: list[FrameStatistics], name: str) -> float:
    """Mean of an attribute over the frames."""
    return float(np.nanmean([getattr(f, name) for f in frames]))
