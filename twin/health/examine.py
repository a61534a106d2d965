"""Light, focus, pins, glare and place of a sensor's frames, against what its specification promises."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial import cKDTree

from scenes.sensor import SensorSpec
from twin.camera import expose
from twin.detectors import DetectorSpec, shipped_detector
from twin.health.drift import drift_of
from twin.optics.preview import Preview
from twin.preprocess.forms import blob_spec, gray_levels
from twin.preprocess.mask import circular_mask
from twin.preprocess.pipeline import Pipeline
from twin.preprocess.reference import make_reference
from twin.realism.caps import Caps, measure_caps
from twin.types import Form, Frame, Observation

SATURATED_LEVEL = 250
STEADY = 0.5  # of the frames: a pin lost, or a spot seen, in so many is a fault of the sensor, not of a contact
SAME_SPOT = 0.3  # pitches
CAPS_MEASURED = 3  # frames at most, evenly spread: light and focus hardly differ between them
LEAST_DEFORMED = 0.3  # of the frames, those with the least contact, tell the camera's place
TOLD_BULGE = 0.002  # of the size: a smaller part of the contact in it is not mentioned
LISTED = 8  # numbers of pins in a sentence


class Verdict(StrEnum):
    """How good a finding is."""

    GOOD = "good"
    WATCH = "watch"
    BAD = "bad"


@dataclass(frozen=True)
class Finding:
    """One thing looked at.

    Attributes
    ----------
    name : str
    verdict : Verdict
    value : float
        What ``limits`` of its check are about; NaN where it can't be told.
    text : str
        What was seen, with the figure and what was expected.
    remedy : str
        What to do, "" where nothing.
    """

    name: str
    verdict: Verdict
    value: float
    text: str
    remedy: str


def examine(
    frames: list[Frame], spec: SensorSpec, detector: DetectorSpec | None = None, *, progress: Callable | None = None
) -> list[Finding]:
    """Findings on frames of one form, with or without contact.

    Parameters
    ----------
    frames : list of Frame
    spec : SensorSpec
        What the sensor should look like.
    detector : DetectorSpec, optional
        What ``twin tune`` found for method ``twin``; the specification's own pipeline by default.

    Raises
    ------
    FrameError
        A frame is not one of this sensor's.
    """
    form = frames[0].form
    detector = detector or shipped_detector(spec, form)
    section = spec.pipeline.model_copy(update={str(form): detector.blob})
    tuned = spec.model_copy(update={"pipeline": section})
    reference = make_reference(np.array(detector.pins_px), spec.pins.rings) if detector.pins_px else None
    pipeline = Pipeline(tuned, form, reference)
    seen = []
    for k, frame in enumerate(frames):
        seen.append(pipeline(frame))
        if progress:
            progress(k + 1, len(frames))
    findings = [_pins(seen), _spots(seen, pipeline), *_place(seen, spec, form)]
    return findings if form == Form.RECORDING else [*_light(frames, seen, spec, tuned), *findings]


def _verdict(value: float, watch: float, bad: float) -> Verdict:
    """By two limits; bad is beyond watch, above or below. What can't be told is bad."""
    sign = 1 if bad > watch else -1
    if not np.isfinite(value) or sign * value > sign * bad:
        return Verdict.BAD
    return Verdict.WATCH if sign * value > sign * watch else Verdict.GOOD


def _finding(name: str, value: float, limits: tuple[float, float], text: str, remedy: str) -> Finding:
    verdict = _verdict(value, *limits)
    return Finding(name, verdict, float(value), text, "" if verdict is Verdict.GOOD else remedy)


def _pins(seen: list[Observation]) -> Finding:
    lost = np.isnan(np.stack([o.pins_px[:, 0] for o in seen]))
    steady = np.flatnonzero(lost.mean(axis=0) >= STEADY)
    text = f"{100 * lost.mean():.2f} % of the pins lost; {sum(o.valid for o in seen)} of {len(seen)} frames can be used"
    if 0 < len(steady) < lost.shape[1] / 2:
        text += f"; steadily lost: pin {', '.join(map(str, steady[:LISTED]))}{', ...' if len(steady) > LISTED else ''}"
    unusable = next((o.reason for o in seen if not o.valid), "")
    remedy = (
        "look at these places: caps may be off, dirty or hidden by glare"
        if not unusable
        else f"{unusable}; run 'twin tune' on these frames"
    )
    return _finding("pins", lost.mean(), (0.002, 0.05), text, remedy)


def _spots(seen: list[Observation], pipeline: Pipeline) -> Finding:
    """Bright spots among the pins that are no pins and stay where they are."""
    within = SAME_SPOT * float(np.mean(pipeline.reference.spacing_px))
    radius = np.linalg.norm(pipeline.reference.pins_px - pipeline.reference.pins_px[0], axis=1).max()
    places = [o.extra_px[np.linalg.norm(o.extra_px - pipeline.reference.pins_px[0], axis=1) < radius] for o in seen]
    steady = 0
    if len(places[0]):
        hits = np.array([[len(p) and cKDTree(p).query(spot)[0] < within for p in places] for spot in places[0]], float)
        steady = int((hits.mean(axis=1) >= STEADY).sum())
    remedy = "bubbles, dust or LED reflections: clean the window, turn the sensor's LEDs, or mask them"
    return _finding("specks", steady / len(pipeline.reference.pins_px), (0.02, 0.2), f"{steady} steady bright spots among the pins", remedy)


def _place(seen: list[Observation], spec: SensorSpec, form: Form) -> list[Finding]:
    """Where the rim of pins is, against where the specification's camera would see it, in the frames that a contact deforms least."""
    nominal = Pipeline(spec, form).reference
    pitch = float(np.mean(nominal.spacing_px))
    found = [d for o in seen if o.valid and (d := drift_of(o.pins_px, nominal.pins_px, nominal.outmost))]
    if not found:
        return [
            Finding(
                "place", Verdict.BAD, np.nan, "the camera's place can't be told: too few pins at the rim", "see the other findings first"
            )
        ]
    found = sorted(found, key=lambda d: d.contact)[: max(round(LEAST_DEFORMED * len(found)), 1)]
    shift = np.median([d.shift_px for d in found], axis=0)
    turn, scale, seen_scale = (float(np.median([getattr(d, name) for d in found])) for name in ("turn_deg", "scale_at_rest", "scale"))
    bulge = f" ({seen_scale:.3f} with the bulge of the contact)" if seen_scale - scale > TOLD_BULGE else ""
    away = float(np.linalg.norm(shift))
    again = "fix the camera, or calibrate again ('twin calibrate optics'); 'twin tune' moves the mask"
    return [
        _finding("shift", away / pitch, (0.2, 1.0), f"displaced by ({shift[0]:.1f}, {shift[1]:.1f}) px, {away / pitch:.2f} pitches", again),
        _finding("turn", abs(turn), (1.5, 6.0), f"turned by {turn:.2f} deg", again),
        _finding("scale", abs(scale - 1), (0.02, 0.1), f"{scale:.3f} times its calibrated size{bulge}", again),
    ]


def _light(frames: list[Frame], seen: list[Observation], spec: SensorSpec, tuned: SensorSpec) -> list[Finding]:
    """Brightness, evenness, focus and glare of raw frames, against the twin's own frame at rest."""
    expected = promised_caps(spec)
    looked = list(zip(frames, seen, strict=True))[:: -(-len(frames) // CAPS_MEASURED)]
    caps = [measure_caps(gray_levels(f.image), o.pins_px) for f, o in looked if np.isfinite(o.pins_px).any()]
    blob = blob_spec(tuned, Form.RAW)
    mask = circular_mask((spec.camera.width_px, spec.camera.height_px), blob.mask_center_px, blob.mask_radius_px)
    windows = [gray_levels(np.ascontiguousarray(f.image[mask.window])) for f in frames]
    brightest = float(np.median([np.percentile(w[mask.disc > 0], 99) for w in windows]))
    level, contrast, edge, diameter = (
        float(np.nanmedian([np.nanmedian(getattr(c, name)) for c in caps])) if caps else np.nan
        for name in ("level", "contrast", "edge_px", "diameter_px")
    )
    promised, sharp = float(np.nanmedian(expected.contrast)), float(np.nanmedian(expected.edge_px))
    glare = float(np.median([_glare(w, mask.disc, np.pi / 4 * (diameter if np.isfinite(diameter) else 8.0) ** 2) for w in windows]))
    dark = (
        f"caps {level:.0f} gray levels, {contrast:.0f} above the skin ({promised:.0f} expected)"
        if caps
        else f"brightest percent at {brightest:.0f} gray levels"
    )
    return [
        _finding("brightness", contrast / promised, (0.6, 0.3), dark, "raise exposure or gain; look for dead LEDs, dirt, a foggy window"),
        _finding("saturation", _white(caps), (0.02, 0.2), f"{100 * _white(caps):.1f} % of the caps white", "lower exposure or gain"),
        _finding(
            "focus",
            edge / sharp,
            (1.35, 2.0),
            f"caps' edges {edge:.2f} px wide ({sharp:.2f} px expected)",
            "focus the camera; clean the window; hold still",
        ),
        _finding(
            "glare",
            glare,
            (0.003, 0.03),
            f"{100 * glare:.2f} % of the disc in white patches larger than caps",
            "shade the sensor; move or dim the LED",
        ),
    ]


@lru_cache(maxsize=2)
def promised_caps(spec: SensorSpec) -> Caps:
    """The caps of the twin's own frame at rest."""
    twin = expose(Preview(spec).render(), spec.capture)
    return measure_caps(gray_levels(twin), Pipeline(spec, Form.RAW)(Frame(twin, Form.RAW)).pins_px)


def _white(caps: list) -> float:
    return float(np.mean(np.concatenate([c.level for c in caps]) >= SATURATED_LEVEL)) if caps else 0.0


def _glare(window: np.ndarray, disc: np.ndarray, cap_px2: float) -> float:
    """Share of the disc in saturated patches that are larger than two caps."""
    white = ((window >= SATURATED_LEVEL) & (disc > 0)).astype(np.uint8)
    area = cv2.connectedComponentsWithStats(white)[2][1:, cv2.CC_STAT_AREA]
    return float(area[area > 2 * cap_px2].sum() / (disc > 0).sum())
