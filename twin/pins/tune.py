"""Tuning: the parameters of a detector are found from frames and the pins' layout alone."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypedDict

import numpy as np

from scenes.sensor import BlobSpec, PinsSpec, RecordingSpec, SensorSpec
from twin.errors import FrameError
from twin.frames.forms import gray_levels
from twin.pins.detector import Found, make_detector
from twin.pins.detector_spec import DetectorSpec, Evidence, Method
from twin.pins.layout import Sighting, flat_layout, rest_of, see_layout
from twin.pins.legacy import LEGACY
from twin.pins.reference import Reference
from twin.progress import Step
from twin.types import Form, Frame

# Number of frames that are used, spread evenly. With more frames the parameters hardly change.
TUNED_ON = 12
# Methods that take about a second for a frame, and number of frames that are used for them.
SLOW, SLOW_TUNED_ON = ("log", "dog", "doh"), 3
# Distance of the mask's edge from the outermost pins, in spacings at the rim.
MASK_SPACINGS = 0.85
# Values that are tried: sides of the block of an adaptive threshold, in median spacings; the same for the published recorder's
# threshold; erosions, px.
BLOCK_PITCHES, RECORDER_BLOCKS_PITCHES, EROSIONS_PX = (2.0, 3.0, 4.5), (2.0, 4.5), (1, 2)
# Thresholds that are tried, as shares of the caps' contrast; least contrast that is assumed, gray levels.
STRICTNESS, LEAST_CONTRAST = (0.04, 0.07, 0.1, 0.15, 0.22, 0.3, 0.4, 0.55), 4.0
# Fixed thresholds that are tried, gray levels: on thresholded frames, and on raw frames.
BINARY_LEVELS, RAW_LEVELS = (60.0, 80.0, 100.0, 127.0, 150.0, 175.0), tuple(float(level) for level in np.linspace(20, 220, 21))
# First, all settings are tried on one frame in GLANCE. Settings whose sum of exact rate and found share is smaller than the best one by
# more than HOPELESS are not tried on the other frames.
GLANCE, HOPELESS = 4, 0.3
# Largest difference from the best rate of a threshold that belongs to the plateau.
NEAR = 0.02
# Least area of a pin's blob, as a share of the caps' median area.
LEAST_AREA = 0.2
# Smallest and largest radius of a cap, relative to the median one.
CAP_RADII = (0.6, 1.4)
# Least score of a sighting that is used, relative to the best one's.
LIKE_THE_BEST = 0.9
# The recorder's threshold before it is tuned: side of the block, px, and offset, gray levels.
RECORDER_BLOCK_PX, RECORDER_OFFSET = 61, -5.0
# Standard normal quantile of a two-sided 90 % interval.
Z_90 = 1.645
# A tuning is sure if the lower end of the interval of its exact rate is at least SURE_LOW_RATE, and its threshold may change by
# SURE_SLACK gray levels.
SURE_LOW_RATE, SURE_SLACK = 0.8, 1.0
# Exact rate from which on a tuning that is not sure is fairly sure.
FAIR_RATE = 0.5

# Share of the frames with exactly all pins, and mean share of the pins found.
Rate = tuple[float, float]


class RateRow(TypedDict):
    """A setting that was tried, and its result."""

    block_px: int
    threshold: float
    exact_rate: float
    found_share: float


@dataclass(frozen=True)
class Tuned:
    """The result of a tuning.

    Attributes
    ----------
    detector : DetectorSpec
    rates : list of RateRow
        All settings that were tried.
    notes : list of str
        Reasons to doubt the result, and what to do.
    """

    detector: DetectorSpec
    rates: list[RateRow]
    notes: list[str]


def tune(frames: list[Frame], sensor: SensorSpec, method: Method = "twin", *, progress: Step | None = None) -> Tuned:
    """Find mask, threshold and blob parameters from frames of one size and form.

    Only the layout of the sensor's pins is used (count, rings, round or hexagon). The frames may show any contact.

    Raises
    ------
    FrameError
        No frame shows the layout.
    """
    frames = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, min(TUNED_ON, len(frames))).round().astype(int))]
    form = frames[0].form
    binary = form == Form.RECORDING
    seen = _sightings(frames, flat_layout(sensor.geometry), sensor.pins, binary, progress)
    reference = rest_of(seen, sensor.pins.rings)
    start = _start(frames[0], reference, seen, method, form, sensor.pins.layout)
    tried, judged = list(_settings(start, reference, seen, binary)), frames
    if method in SLOW:
        judged = frames[:: max(len(frames) // SLOW_TUNED_ON, 1)][:SLOW_TUNED_ON]
    rates = [_rate(make_detector(sensor, detector, second_look=False), judged[::GLANCE], sensor.pins.count) for detector in tried]
    hopeful = max(map(sum, rates)) - HOPELESS
    for k, detector in enumerate(tried):
        if sum(rates[k]) >= hopeful:
            rates[k] = _rate(make_detector(sensor, detector, second_look=False), judged, sensor.pins.count)
        if progress:
            progress(len(frames) + k + 1, len(frames) + len(tried))
    best = _middle_of_plateau(tried, rates)
    evidence = _evidence(tried, rates, best, judged, reference, start)
    table: list[RateRow] = [
        {"block_px": _block(d), "threshold": _threshold(d), "exact_rate": exact, "found_share": share}
        for d, (exact, share) in zip(tried, rates, strict=True)
    ]
    return Tuned(tried[best].model_copy(update={"evidence": evidence}), table, _notes(evidence, len(seen), len(frames)))


def _sightings(frames: list[Frame], flat: np.ndarray, pins: PinsSpec, binary: bool, progress: Step | None) -> list[Sighting]:
    """The sightings of the layout in the frames that show it clearly; ``flat`` (N, 2) as ``flat_layout`` gives it.

    Raises
    ------
    FrameError
        No frame shows it.
    """
    seen: list[Sighting] = []
    for k, frame in enumerate(frames):
        sighting = see_layout(gray_levels(frame.image), flat, pins.rings, binary=binary)
        seen += [] if sighting is None else [sighting]
        if progress:
            progress(k + 1, 2 * len(frames))
    if not seen:
        raise FrameError(
            f"none of {len(frames)} frames shows {pins.count} pins in {pins.rings} rings ({pins.layout}); "
            "check --sensor, focus and light, or give frames with less contact"
        )
    best = max(s.score for s in seen)
    return [s for s in seen if s.score > LIKE_THE_BEST * best]


def _start(
    frame: Frame, reference: Reference, seen: list[Sighting], method: Method, form: Form, layout: Literal["rings", "hexagon"]
) -> DetectorSpec:
    """A detector with the mask and the caps' size, before a threshold is chosen."""
    rim = reference.pins_px[reference.outmost]
    center = (rim.max(axis=0) + rim.min(axis=0)) / 2
    reach = max(np.nanmax(np.linalg.norm(s.pins_px - center, axis=1)) for s in seen)
    radius = reach + MASK_SPACINGS * np.median(reference.spacing_px[reference.outmost])
    area = float(np.median([s.area_px2 for s in seen]))
    smallest, largest = (round(float(max(share * np.sqrt(area / np.pi), 1.0)), 2) for share in CAP_RADII)
    blob = BlobSpec(
        threshold=0.0,
        mask_center_px=tuple(center.round(1).tolist()),
        mask_radius_px=round(float(radius), 1),
        min_area_px2=round(max(LEAST_AREA * area, 1.0), 1),
    )
    return DetectorSpec(
        name=method,
        method=method,
        form=form,
        blob=blob,
        radius_px=(smallest, largest),
        recording=_recorder(frame.image.shape, blob, layout) if method == "legacy" and form == Form.RAW else None,
        pins_px=tuple(map(tuple, reference.pins_px.round(2).tolist())),
    )


def _recorder(shape: tuple[int, ...], blob: BlobSpec, layout: Literal["rings", "hexagon"]) -> RecordingSpec:
    """The published recorder, with a square crop in which the mask is at the place that the published method uses."""
    release = LEGACY[layout]
    half = release.size_px // 2
    side = 2 * blob.mask_radius_px * half / (half - release.mask_margin_px)
    corner = np.array(blob.mask_center_px) - side * (0.5 + np.array(release.mask_offset_px) / release.size_px)
    height, width = shape[:2]
    side = int(min(round(side), width, height))
    x0, y0 = (int(np.clip(round(c), 0, extent - side)) for c, extent in zip(corner, (width, height), strict=True))
    return RecordingSpec(
        crop_px=(x0, y0, x0 + side, y0 + side),
        width_px=side,
        height_px=side,
        threshold_block_px=RECORDER_BLOCK_PX,
        threshold_offset=RECORDER_OFFSET,
    )


def _settings(start: DetectorSpec, reference: Reference, seen: list[Sighting], binary: bool) -> Iterator[DetectorSpec]:
    """All settings to try. Thresholds are in units of the caps' contrast, blocks in units of the pitch."""
    contrast = max(float(np.median([s.contrast for s in seen])), LEAST_CONTRAST)
    pitch = float(np.median(reference.spacing_px))
    levels = [round(share * contrast, 1) for share in STRICTNESS]
    if start.method == "legacy" and start.recording is not None:
        for block in (int(p * pitch) | 1 for p in RECORDER_BLOCKS_PITCHES):
            for level in levels:
                recording = start.recording.model_copy(update={"threshold_block_px": block, "threshold_offset": -level})
                yield start.model_copy(update={"recording": recording})
    elif start.method == "legacy":  # the published threshold is part of the method
        yield start
    elif binary or start.method in ("fixed", "simple"):
        for level in BINARY_LEVELS if binary else RAW_LEVELS:
            yield _with_blob(start, threshold=level)
    elif start.method in ("twin", "adaptive"):
        for erosion in EROSIONS_PX:
            for block in (int(p * pitch) | 1 for p in BLOCK_PITCHES):
                for level in levels:
                    yield _with_blob(start, threshold=-level, threshold_block_px=block, erosion_px=erosion)
    else:
        for level in levels:
            yield _with_blob(start, threshold=level)


def _with_blob(detector: DetectorSpec, **values: Any) -> DetectorSpec:
    """The detector with values of its ``blob`` changed."""
    return detector.model_copy(update={"blob": detector.blob.model_copy(update=values)})


def _rate(detect: Callable[[Frame], Found], frames: list[Frame], count: int) -> Rate:
    """Share of frames with exactly all pins, and mean share of found pins. An additional blob counts as a lost pin."""
    found = np.array([len(detect(frame).claims_px) for frame in frames])
    return float(np.mean(found == count)), float(np.mean(1 - np.minimum(np.abs(found - count) / count, 1)))


def _block(detector: DetectorSpec) -> int:
    """Side of the adaptive threshold's block, px; the recorder's if there is one."""
    return detector.recording.threshold_block_px if detector.recording is not None else detector.blob.threshold_block_px


def _threshold(detector: DetectorSpec) -> float:
    """Threshold, gray levels; the recorder's if there is one."""
    return detector.recording.threshold_offset if detector.recording is not None else detector.blob.threshold


def _series(tried: list[DetectorSpec], k: int) -> list[int]:
    """Indices of the settings that differ from the k-th only in the threshold, in the order of the threshold."""
    same = [j for j, d in enumerate(tried) if _block(d) == _block(tried[k]) and d.blob.erosion_px == tried[k].blob.erosion_px]
    return sorted(same, key=lambda j: _threshold(tried[j]))


def _plateau(tried: list[DetectorSpec], rates: list[Rate], k: int) -> list[int]:
    """Indices of the k-th setting and of those with neighbouring thresholds whose rates are nearly as good."""
    series = _series(tried, k)
    at = series.index(k)
    low = high = at
    good = [sum(rates[j]) >= sum(rates[k]) - NEAR for j in series]
    while low > 0 and good[low - 1]:
        low -= 1
    while high < len(series) - 1 and good[high + 1]:
        high += 1
    return series[low : high + 1]


def _middle_of_plateau(tried: list[DetectorSpec], rates: list[Rate]) -> int:
    """Index of the best setting in the middle of the widest plateau, which is as far as possible from thresholds that fail."""
    score = np.array([exact + share for exact, share in rates])
    best = np.flatnonzero(score >= score.max() - 1e-9)
    widest = max((_plateau(tried, rates, int(k)) for k in best), key=lambda p: abs(_threshold(tried[p[-1]]) - _threshold(tried[p[0]])))
    middle = (_threshold(tried[widest[0]]) + _threshold(tried[widest[-1]])) / 2
    return min((k for k in widest if score[k] >= score.max() - 1e-9), key=lambda k: abs(_threshold(tried[k]) - middle))


def _evidence(
    tried: list[DetectorSpec], rates: list[Rate], best: int, frames: list[Frame], reference: Reference, start: DetectorSpec
) -> Evidence:
    """Evidence for the best setting: its rate with a 90 % interval (Wilson 1927), and the slack of threshold and mask."""
    exact, n = rates[best][0], len(frames)
    spread = Z_90 * np.sqrt(exact * (1 - exact) / n + Z_90**2 / (4 * n * n))
    low = max((exact + Z_90**2 / (2 * n) - spread) / (1 + Z_90**2 / n), 0.0)
    plateau = _plateau(tried, rates, best)
    ends = [_threshold(tried[k]) for k in (plateau[0], plateau[-1])]
    slack = min(abs(_threshold(tried[best]) - end) for end in ends)
    reach = np.linalg.norm(reference.pins_px - start.blob.mask_center_px, axis=1).max()
    sure: Literal["sure", "fairly sure", "unsure"] = "fairly sure" if exact >= FAIR_RATE else "unsure"
    if low >= SURE_LOW_RATE and slack >= SURE_SLACK:
        sure = "sure"
    return Evidence(
        frames=n,
        exact_rate=exact,
        low_rate=round(float(low), 4),
        threshold_slack=round(float(slack), 2),
        mask_slack_px=round(float(start.blob.mask_radius_px - reach), 2),
        sure=sure,
    )


def _notes(evidence: Evidence, seen: int, frames: int) -> list[str]:
    """Reasons to doubt a tuning, and what to do."""
    notes = []
    if seen < frames:
        notes.append(f"{frames - seen} of {frames} frames don't show the whole layout clearly; they took no part in finding the mask")
    if evidence.low_rate < SURE_LOW_RATE:
        rate = 100 * evidence.exact_rate
        notes.append(f"all pins in {rate:.0f} % of {evidence.frames} frames: too few frames, or too poor ones, to be sure; give more")
    if evidence.threshold_slack < SURE_SLACK:
        notes.append("the threshold has hardly any slack: better light or focus would help")
    return notes
