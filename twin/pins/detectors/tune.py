"""Tuning: finds the parameters of a detector from frames and the pins' layout alone."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scenes.pins import PinsSpec
from scenes.sensor import BlobSpec, Polarity, RecordingSpec, SensorSpec
from twin.errors import FrameError, format_count
from twin.frames import spread_indices
from twin.frames.forms import pin_levels, polarity_of
from twin.geometry.pins import pin_lattice
from twin.pins.detectors.detector import Found, legacy_parameters, make_detector
from twin.pins.detectors.detector_spec import DetectorSpec, Evidence, Method, with_detector
from twin.pins.labelling.identify import SAME_SHAPE, SHOWN, SURE_EXPLAINED, Candidate, Identified, identify, score_layout, symmetries
from twin.pins.labelling.reference import Reference, camera_modes, make_reference, nominal_reference, smooth_view, together, view_of
from twin.pins.labelling.rest import Rest, rest_of
from twin.progress import Step, report_each, unheard
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
# The recorder's threshold before it is tuned: side, px, and offset, gray levels.
RECORDER_BLOCK_PX, RECORDER_OFFSET = 61, -5.0
# Standard normal quantile of a two-sided 90 % interval.
Z_90 = 1.645
# A tuning is sure if the lower end of the interval of its exact rate is at least SURE_LOW_RATE, and its threshold may change by
# SURE_SLACK gray levels.
SURE_LOW_RATE, SURE_SLACK = 0.8, 1.0
# Least share of the pins and spots in the frames that a layout must explain to count as seen; lead of another layout in this share above
# which the other layout is named.
LEAST_SHOWN, MORE_EXPLAINED = 0.6, 0.02
# Least number of pixels around a pin from which its cap is measured.
LEAST_PIXELS = 9
# Sizes of spots that are tried (standard deviation, in radii of the median cap); least lead of spots over thresholds, in the sum of exact
# rate and found share, for spots to be chosen.
SPOT_SIZES, SPOTS_AHEAD = (0.55, 0.7, 0.9), 0.03
# Least exact rate of a tuning that counts as fairly sure.
FAIR_RATE = 0.5

# Share of the frames with exactly all pins, and mean share of the pins found.
Rate = tuple[float, float]


@dataclass(frozen=True)
class Tuned:
    """The result of a tuning.

    Attributes
    ----------
    detector : DetectorSpec
    notes : list of str
        Reasons to doubt the result, and what to do.
    rest : Rest
        Pins at rest that the detector uses, and their source.
    """

    detector: DetectorSpec
    notes: list[str]
    rest: Rest


def tune(
    frames: list[Frame],
    sensor: SensorSpec,
    method: Method = "twin",
    *,
    known: Candidate | None = None,
    rest: Rest | None = None,
    given: Frame | None = None,
    progress: Step = unheard,
) -> Tuned:
    """Find mask, threshold and blob parameters from frames of one size and form.

    Only the layout and the polarity of the sensor's pins are used. The frames may show any contact, and be of any size.

    Parameters
    ----------
    known : Candidate, optional
        The result for this layout in exactly these frames, if the layout was identified in them. Without it the frames are also searched
        for other layouts, and the tuning is unsure if another layout explains more.
    rest : Rest, optional
        Pins of ``known`` at rest, if they are known already.
    given : Frame, optional
        A frame without contact. By default a frame that shows none, else a rest layout estimated from contacts.

    Raises
    ------
    FrameError
        No frame shows the layout, or the given frame without contact does not.
    """
    chosen = spread_indices(len(frames), TUNED_ON)
    frames = [frames[k] for k in chosen]
    form = frames[0].form
    polarity = polarity_of(sensor.pipeline, form)
    images = [pin_levels(frame.image, polarity) for frame in frames]
    doubts: list[str] = []
    layout = score_layout(sensor.pins, images) if known is None else replace(known, seen=tuple(known.seen[k] for k in chosen))
    if layout is None or layout.explained < LEAST_SHOWN:
        raise FrameError(
            f"none of {format_count(len(frames), 'frames')} shows {sensor.pins.in_words()}{_shown_instead(images)}; "
            "check `sensor`, focus and light, or give frames with less contact"
        )
    if known is None:
        doubts = other_layout(layout, images)
    if rest is None:
        given_levels = None if given is None else pin_levels(given.image, polarity)
        rest = rest_of(layout, [f.name for f in frames], given_levels, given.name if given else "")
        if given is not None:
            view = view_of(rest.pins_px, nominal_reference(sensor, form), sensor.pins, camera_modes(sensor, form))
            if not view.displacements():  # else the specification is of another camera, and its places carry no information
                view.require_unpressed(given.name, sensor)
    reference = make_reference(turned_as(sensor.pins, layout.rest_px), sensor.pins)
    caps = [caps_in(image, seen.pins_px, reference.spacing_px) for image, seen in zip(images, layout.seen, strict=True)]
    area, contrast = (float(np.nanmedian(values)) for values in zip(*caps, strict=True))
    start = _start(frames[0], reference, layout, area, method, polarity)
    sensor = with_detector(sensor, start)
    tried, judged = list(_settings(start, reference, contrast, form == Form.PROCESSED)), frames
    if method in SLOW:
        judged = frames[:: max(len(frames) // SLOW_TUNED_ON, 1)][:SLOW_TUNED_ON]
    rates = [_rate(make_detector(sensor, detector, second_look=False), judged[::GLANCE]) for detector in tried]
    hopeful = max(map(sum, rates)) - HOPELESS
    for k, detector in enumerate(report_each(tried, progress)):
        if sum(rates[k]) >= hopeful:
            rates[k] = _rate(make_detector(sensor, detector, second_look=False), judged)
    best = _middle_of_plateau(tried, rates)
    evidence = _evidence(tried, rates, best, judged, reference, start)
    if doubts:
        evidence = evidence.alter(sure="unsure")
    seen = sum(one.explained >= SHOWN for one in layout.seen)
    found = _at_rest(tried[best].alter(evidence=evidence), sensor.pins, rest, layout)
    return Tuned(found, doubts + _notes(tried[best], evidence, seen, len(frames)), rest)


def _at_rest(detector: DetectorSpec, pins: PinsSpec, rest: Rest, layout: Candidate) -> DetectorSpec:
    """The detector with the pins at rest. A pin out of view gets its median place over the frames; if another pin is there, as if frames
    were labelled differently, its place in a smooth view of the pins in view."""
    unseen = ~np.isfinite(rest.pins_px[:, 0])
    places = np.where(unseen[:, None], layout.rest_px, rest.pins_px)
    smooth = smooth_view(pin_lattice(pins).places, rest.pins_px)
    places = turned_as(pins, np.where((unseen & together(places.round(2)))[:, None], smooth, places))
    blob = {"rest_origin": "contacts" if rest.source == "made" else "measured"}
    return detector.alter(pins_px=tuple(map(tuple, places.round(2).tolist())), blob=blob)


def _shown_instead(images: list[np.ndarray]) -> str:
    """What the frames show instead of the expected layout, for an error message; "" if nothing is recognised."""
    try:
        return f"; they show {_in_words(identify(images))}"
    except FrameError:
        return ""


def _in_words(found: Identified) -> str:
    """An identified layout in words, with the remedy if its polarity is not the expected one."""
    other = "" if found.polarity == "bright" else " of the other polarity (bright or dark, 'polarity' in the specification)"
    return found.best.pins.in_words() + other


def other_layout(layout: Candidate, images: list[np.ndarray]) -> list[str]:
    """Reasons to doubt a given layout: what it leaves unexplained, and which other layout explains more."""
    try:
        found = identify(images)
    except FrameError:
        return []
    other = found.best
    same = (other.pins.layout, other.pins.complete_count) == (layout.pins.layout, layout.pins.complete_count)
    more = other.explained > layout.explained + MORE_EXPLAINED
    smoother = other.explained > layout.explained - MORE_EXPLAINED and other.misfit < SAME_SHAPE * layout.misfit
    if not same and (more or smoother):
        return [
            f"these frames show {_in_words(found)} rather than {layout.pins.in_words()}: {layout.differences()}; "
            "give the right `sensor`, or make one with 'twin new'"
        ]
    if layout.explained < SURE_EXPLAINED:
        return [f"{layout.line()}; look at the frames: are there other pins, stray light or dirt?"]
    return []


def turned_as(pins: PinsSpec, rest_px: np.ndarray) -> np.ndarray:
    """Pins (N, 2), px, in the one of the layout's symmetric orders whose turn from the specification is smallest."""
    places = pin_lattice(pins).places @ [1, 1j] * np.exp(1j * np.radians(pins.phase_deg))
    places -= places.mean()
    orders = [rest_px[order] for order in symmetries(pins)]
    turns = [abs(np.angle(np.vdot(places, (px - px.mean(axis=0)) @ [1, 1j]))) for px in orders]
    return orders[int(np.argmin(turns))]


def caps_in(gray: np.ndarray, pins_px: np.ndarray, spacing_px: np.ndarray) -> tuple[float, float]:
    """Median area, px^2, of the caps at pins (N, 2) of a gray frame, and median contrast, gray levels; NaN where no pin is seen.

    A cap's area is the area of the pixels within half a spacing of the pin whose level is above the middle between skin and cap.
    """
    areas, contrasts = [], []
    for (x, y), spacing in zip(pins_px, spacing_px, strict=True):
        half = spacing / 2
        if not np.isfinite(x) or half < 1:
            continue
        left, top = max(int(x - half), 0), max(int(y - half), 0)
        patch = gray[top : int(y + half) + 2, left : int(x + half) + 2].astype(float)
        rows, columns = np.mgrid[: patch.shape[0], : patch.shape[1]]
        near = patch[(columns + left - x) ** 2 + (rows + top - y) ** 2 <= half**2]
        if near.size < LEAST_PIXELS:
            continue
        dark, light = np.percentile(near, (10, 95))
        areas.append(float((near > (dark + light) / 2).sum()))
        contrasts.append(light - dark)
    return (float(np.median(areas)), float(np.median(contrasts))) if areas else (np.nan, np.nan)


def _start(frame: Frame, reference: Reference, layout: Candidate, area: float, method: Method, polarity: Polarity) -> DetectorSpec:
    """A detector with the mask and the caps' size, before a threshold is chosen."""
    rim = reference.pins_px[reference.outmost]
    center = (rim.max(axis=0) + rim.min(axis=0)) / 2
    reach = max(np.nanmax(np.linalg.norm(s.pins_px - center, axis=1)) for s in layout.seen if s.explained >= LEAST_SHOWN)
    radius = reach + MASK_SPACINGS * np.median(reference.spacing_px[reference.outmost])
    smallest, largest = (round(float(max(share * np.sqrt(area / np.pi), 1.0)), 2) for share in CAP_RADII)
    blob = BlobSpec(
        polarity=polarity,
        threshold=0.0,
        mask_center_px=tuple(center.round(1).tolist()),
        mask_radius_px=round(float(radius), 1),
        min_area_px2=round(max(LEAST_AREA * area, 1.0), 1),
    )
    height, width = frame.image.shape[:2]
    recorded = method == "legacy" and frame.form == Form.RAW
    return DetectorSpec(
        name=method,
        method=method,
        form=frame.form,
        size_px=(width, height),
        blob=blob,
        radius_px=(smallest, largest),
        recording=_recorder((width, height), blob, layout.pins.layout) if recorded else None,
        pins_px=tuple(map(tuple, reference.pins_px.round(2).tolist())),
    )


def _recorder(size_px: tuple[int, int], blob: BlobSpec, layout: str) -> RecordingSpec:
    """The published recorder, with a square crop that puts the mask at the place where the published method expects it."""
    release = legacy_parameters(layout)
    half = release.size_px // 2
    side = 2 * blob.mask_radius_px * half / (half - release.mask_margin_px)
    corner = np.array(blob.mask_center_px) - side * (0.5 + np.array(release.mask_offset_px) / release.size_px)
    width, height = size_px
    side = int(min(round(side), width, height))
    x0, y0 = (int(np.clip(round(c), 0, extent - side)) for c, extent in zip(corner, (width, height), strict=True))
    return RecordingSpec(
        crop_px=(x0, y0, x0 + side, y0 + side),
        width_px=side,
        height_px=side,
        threshold_block_px=RECORDER_BLOCK_PX,
        threshold_offset=RECORDER_OFFSET,
    )


def _settings(start: DetectorSpec, reference: Reference, contrast: float, binary: bool) -> Iterator[DetectorSpec]:
    """Every setting to try: thresholds as shares of the caps' ``contrast`` (gray levels), blocks in spacings, spots in cap sizes."""
    contrast = max(contrast, LEAST_CONTRAST)
    pitch = float(np.median(reference.spacing_px))
    levels = [round(share * contrast, 1) for share in STRICTNESS]
    if start.method == "twin":
        cap = start.radius_px[0] / CAP_RADII[0]
        for share in SPOT_SIZES:
            yield start.alter(blob={"spot_sigma_px": round(share * cap, 2)})
    if start.method == "legacy" and start.recording is not None:
        for block in (int(p * pitch) | 1 for p in RECORDER_BLOCKS_PITCHES):
            for level in levels:
                yield start.alter(recording={"threshold_block_px": block, "threshold_offset": -level})
    elif start.method == "legacy":  # the published threshold is a part of the method
        yield start
    elif binary or start.method in ("fixed", "simple"):
        for level in BINARY_LEVELS if binary else RAW_LEVELS:
            yield start.alter(blob={"threshold": level})
    elif start.method in ("twin", "adaptive"):
        for erosion in EROSIONS_PX:
            for block in (int(p * pitch) | 1 for p in BLOCK_PITCHES):
                for level in levels:
                    yield start.alter(blob={"threshold": -level, "threshold_block_px": block, "erosion_px": erosion})
    else:
        for level in levels:
            yield start.alter(blob={"threshold": level})


def _rate(detect: Callable[[Frame], Found], frames: list[Frame]) -> Rate:
    """Share of frames with exactly the expected number of blobs, and mean share of pins found. A surplus blob counts like a lost pin."""
    looks = [detect(frame) for frame in frames]
    found, count = np.array([len(look.claims_px) for look in looks]), np.array([look.expected for look in looks])
    return float(np.mean(found == count)), float(np.mean(1 - np.minimum(np.abs(found - count) / count, 1)))


def _threshold(detector: DetectorSpec) -> float:
    """Threshold, gray levels; the recorder's if there is one."""
    return detector.recording.threshold_offset if detector.recording is not None else detector.blob.threshold


def _series_of(d: DetectorSpec) -> tuple[int, int, float]:
    """Parameters that all settings of one series have in common."""
    return (d.recording or d.blob).threshold_block_px, d.blob.erosion_px, d.blob.spot_sigma_px


def _plateau(tried: list[DetectorSpec], rates: list[Rate], k: int) -> list[int]:
    """Indices of the k-th setting and of those with neighbouring thresholds whose rates are nearly as good."""
    series = [j for j, detector in enumerate(tried) if _series_of(detector) == _series_of(tried[k])]
    series.sort(key=lambda j: _threshold(tried[j]))
    at = series.index(k)
    worse = [place for place, j in enumerate(series) if sum(rates[j]) < sum(rates[k]) - NEAR]
    low = max((place + 1 for place in worse if place < at), default=0)
    high = min((place for place in worse if place > at), default=len(series))
    return series[low:high]


def _middle_of_plateau(tried: list[DetectorSpec], rates: list[Rate]) -> int:
    """Index of the best setting in the middle of the widest plateau, which is as far as possible from thresholds that fail."""
    score = np.array([exact + share for exact, share in rates])
    spots = np.array([d.blob.spot_sigma_px > 0 for d in tried])
    if (~spots).any():
        score = np.where(spots, score - SPOTS_AHEAD, score)  # centroids are more exact with a threshold
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
    if low >= SURE_LOW_RATE and (slack >= SURE_SLACK or tried[best].blob.spot_sigma_px):
        sure = "sure"
    return Evidence(
        frames=n,
        exact_rate=exact,
        low_rate=round(float(low), 4),
        threshold_slack=round(float(slack), 2),
        mask_slack_px=round(float(start.blob.mask_radius_px - reach), 2),
        sure=sure,
    )


def _notes(best: DetectorSpec, evidence: Evidence, seen: int, frames: int) -> list[str]:
    """Reasons to doubt a tuning, and what to do."""
    notes = []
    if seen < frames:
        notes.append(f"the mask was found without {frames - seen} of {format_count(frames, 'frames')}, which don't show the whole layout")
    if evidence.low_rate < SURE_LOW_RATE:
        rate = 100 * evidence.exact_rate
        notes.append(
            f"all pins in view found in {rate:.0f} % of {format_count(evidence.frames, 'frames')}: to be sure, give more or better ones"
        )
    if evidence.threshold_slack < SURE_SLACK and not best.blob.spot_sigma_px:
        notes.append("the threshold may hardly change without losing pins: better light or focus would help")
    return notes
