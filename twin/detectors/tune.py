"""Parameters of a detector, found from frames and the pins' layout alone."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scenes.sensor import BlobSpec, RecordingSpec, SensorSpec
from twin.detectors.detector import make_detector
from twin.detectors.layout import Sighting, rest_of, see_layout
from twin.detectors.spec import DetectorSpec, Evidence, Method
from twin.errors import FrameError
from twin.preprocess.forms import gray_levels
from twin.preprocess.legacy import LEGACY
from twin.preprocess.reference import Reference
from twin.types import Form, Frame

TUNED_ON = 12  # frames, evenly spread: parameters hardly depend on more
SLOW_TUNED_ON = 3  # of them, for detectors that take a second a frame
SLOW = ("log", "dog", "doh")
MASK_SPACINGS = 0.85  # beyond the outermost pins seen, in spacings at the rim
BLOCK_PITCHES = (2.0, 3.0, 4.5)
STRICTNESS = (0.04, 0.07, 0.1, 0.15, 0.22, 0.3, 0.4, 0.55)  # thresholds, in the caps' contrast
RECORDER_BLOCKS_PITCHES = (2.0, 4.5)
GLANCE = 4  # one frame in so many tells which settings are hopeless ...
HOPELESS = 0.3  # ... in exact rate and found share together
NEAR = 0.02  # in exact rate: thresholds that lose no more than that belong to the plateau
LEAST_AREA = 0.2  # of the caps' median area
CAP_RADII = (0.6, 1.4)  # of the caps' radius, from the smallest to the largest
Z_90 = 1.645  # of a one-sided 95 %, two-sided 90 % interval
SURE_LOW_RATE, SURE_SLACK = 0.8, 1.0  # lower end of the exact rate; gray levels of threshold


@dataclass(frozen=True)
class Tuned:
    """What a tuning found.

    Attributes
    ----------
    detector : DetectorSpec
    rates : list of dict
        Every setting tried: ``block_px``, ``threshold``, ``exact_rate``, ``found_share``.
    notes : list of str
        What speaks against it, and what to do.
    """

    detector: DetectorSpec
    rates: list
    notes: list


def tune(frames: list[Frame], sensor: SensorSpec, method: Method = "twin", *, progress: Callable | None = None) -> Tuned:
    """Find mask, threshold and blob parameters from frames of one size and form.

    Of the sensor only the layout of its pins is used: count, rings, round or hexagon. The frames may show any contact.

    Raises
    ------
    FrameError
        No frame shows the layout.
    """
    frames = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, min(TUNED_ON, len(frames))).round().astype(int))]
    form = frames[0].form
    binary = form == Form.RECORDING
    seen = _sightings(frames, sensor, binary, progress)
    reference = rest_of(seen, sensor.pins.rings)
    start = _start(frames[0], reference, seen, method, form, sensor)
    tried, judged = list(_settings(start, reference, seen, sensor, binary)), frames
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
    table = [
        {"block_px": _block(d), "threshold": _threshold(d), "exact_rate": exact, "found_share": share}
        for d, (exact, share) in zip(tried, rates, strict=True)
    ]
    return Tuned(tried[best].model_copy(update={"evidence": evidence}), table, _notes(evidence, len(seen), len(frames)))


def _sightings(frames: list[Frame], sensor: SensorSpec, binary: bool, progress) -> list[Sighting]:
    seen = []
    for k, frame in enumerate(frames):
        sighting = see_layout(gray_levels(frame.image), sensor, binary=binary)
        seen += [] if sighting is None else [sighting]
        if progress:
            progress(k + 1, 2 * len(frames))
    if not seen:
        raise FrameError(
            f"none of {len(frames)} frames shows {sensor.pins.count} pins in {sensor.pins.rings} rings ({sensor.pins.layout}); "
            "check --sensor, focus and light, or give frames with less contact"
        )
    best = max(s.score for s in seen)
    return [s for s in seen if s.score > 0.9 * best]


def _start(frame: Frame, reference: Reference, seen: list[Sighting], method: Method, form: Form, sensor: SensorSpec) -> DetectorSpec:
    """Mask and caps' size; no threshold yet."""
    rim = reference.pins_px[reference.outmost]
    center = (rim.max(axis=0) + rim.min(axis=0)) / 2
    reach = max(np.nanmax(np.linalg.norm(s.pins_px - center, axis=1)) for s in seen)
    radius = reach + MASK_SPACINGS * np.median(reference.spacing_px[reference.outmost])
    area = float(np.median([s.area_px2 for s in seen]))
    cap = np.sqrt(area / np.pi)
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
        radius_px=tuple(round(float(max(share * cap, 1.0)), 2) for share in CAP_RADII),
        recording=_recorder(frame, blob, sensor) if method == "legacy" and form == Form.RAW else None,
        pins_px=tuple(map(tuple, reference.pins_px.round(2).tolist())),
    )


def _recorder(frame: Frame, blob: BlobSpec, sensor: SensorSpec) -> RecordingSpec:
    """The published recorder with a square crop that puts the mask where the published method looks."""
    release = LEGACY[sensor.pins.layout]
    half = release.size_px // 2
    side = 2 * blob.mask_radius_px * half / (half - release.mask_margin_px)
    corner = np.array(blob.mask_center_px) - side * (0.5 + np.array(release.mask_offset_px) / release.size_px)
    height, width = frame.image.shape[:2]
    side = int(min(round(side), width, height))
    x0, y0 = (int(np.clip(round(c), 0, extent - side)) for c, extent in zip(corner, (width, height), strict=True))
    return RecordingSpec(
        crop_px=(x0, y0, x0 + side, y0 + side), width_px=side, height_px=side, threshold_block_px=61, threshold_offset=-5.0
    )


def _settings(start: DetectorSpec, reference: Reference, seen: list[Sighting], sensor: SensorSpec, binary: bool):
    """Every setting to try: thresholds in the caps' contrast, blocks in pitches."""
    contrast = max(float(np.median([s.contrast for s in seen])), 4.0)
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
        for level in (60.0, 80.0, 100.0, 127.0, 150.0, 175.0) if binary else np.linspace(20, 220, 21):
            yield _with_blob(start, threshold=float(level))
    elif start.method in ("twin", "adaptive"):
        for erosion in (1, 2):
            for block in (int(p * pitch) | 1 for p in BLOCK_PITCHES):
                for level in levels:
                    yield _with_blob(start, threshold=-level, threshold_block_px=block, erosion_px=erosion)
    else:
        for level in levels:
            yield _with_blob(start, threshold=level)


def _with_blob(detector: DetectorSpec, **values) -> DetectorSpec:
    return detector.model_copy(update={"blob": detector.blob.model_copy(update=values)})


def _rate(detect, frames: list[Frame], count: int) -> tuple[float, float]:
    """Share of frames with exactly all pins, and mean share of pins found (blobs too many count against it)."""
    found = np.array([len(detect(frame).claims_px) for frame in frames])
    return float(np.mean(found == count)), float(np.mean(1 - np.minimum(np.abs(found - count) / count, 1)))


def _block(detector: DetectorSpec) -> int:
    return detector.recording.threshold_block_px if detector.recording is not None else detector.blob.threshold_block_px


def _threshold(detector: DetectorSpec) -> float:
    return detector.recording.threshold_offset if detector.recording is not None else detector.blob.threshold


def _series(tried: list[DetectorSpec], k: int) -> list[int]:
    """Settings that differ from the k-th in nothing but the threshold, in its order."""
    same = [j for j, d in enumerate(tried) if _block(d) == _block(tried[k]) and d.blob.erosion_px == tried[k].blob.erosion_px]
    return sorted(same, key=lambda j: _threshold(tried[j]))


def _plateau(tried: list[DetectorSpec], rates: list, k: int) -> list[int]:
    """The k-th setting and those beside it, threshold by threshold, that do nearly as well."""
    series = _series(tried, k)
    at = series.index(k)
    low = high = at
    good = [sum(rates[j]) >= sum(rates[k]) - NEAR for j in series]
    while low > 0 and good[low - 1]:
        low -= 1
    while high < len(series) - 1 and good[high + 1]:
        high += 1
    return series[low : high + 1]


def _middle_of_plateau(tried: list[DetectorSpec], rates: list) -> int:
    """The best setting farthest from where it fails: the middle of the widest plateau."""
    score = np.array([exact + share for exact, share in rates])
    best = np.flatnonzero(score >= score.max() - 1e-9)
    widest = max((_plateau(tried, rates, k) for k in best), key=lambda p: abs(_threshold(tried[p[-1]]) - _threshold(tried[p[0]])))
    middle = (_threshold(tried[widest[0]]) + _threshold(tried[widest[-1]])) / 2
    return min((k for k in widest if score[k] >= score.max() - 1e-9), key=lambda k: abs(_threshold(tried[k]) - middle))


def _evidence(tried, rates, best: int, frames: list[Frame], reference: Reference, start: DetectorSpec) -> Evidence:
    exact, n = rates[best][0], len(frames)
    spread = Z_90 * np.sqrt(exact * (1 - exact) / n + Z_90**2 / (4 * n * n))  # Wilson's interval
    low = max((exact + Z_90**2 / (2 * n) - spread) / (1 + Z_90**2 / n), 0.0)
    plateau = _plateau(tried, rates, best)
    ends = [_threshold(tried[k]) for k in (plateau[0], plateau[-1])]
    slack = min(abs(_threshold(tried[best]) - end) for end in ends)
    reach = np.linalg.norm(reference.pins_px - start.blob.mask_center_px, axis=1).max()
    sure = "sure" if low >= SURE_LOW_RATE and slack >= SURE_SLACK else "fairly sure" if exact >= 0.5 else "unsure"
    return Evidence(
        frames=n,
        exact_rate=exact,
        low_rate=round(float(low), 4),
        threshold_slack=round(float(slack), 2),
        mask_slack_px=round(float(start.blob.mask_radius_px - reach), 2),
        sure=sure,
    )


def _notes(evidence: Evidence, seen: int, frames: int) -> list[str]:
    notes = []
    if seen < frames:
        notes.append(f"{frames - seen} of {frames} frames don't show the whole layout clearly; they took no part in finding the mask")
    if evidence.low_rate < SURE_LOW_RATE:
        rate = 100 * evidence.exact_rate
        notes.append(f"all pins in {rate:.0f} % of {evidence.frames} frames: too few frames, or too poor ones, to be sure; give more")
    if evidence.threshold_slack < SURE_SLACK:
        notes.append("the threshold has hardly any slack: better light or focus would help")
    return notes
