"""Check of a sensor's condition by a few of its frames.

Light, focus, pins, glare and the camera's place are compared with those expected from the sensor's specification. The camera's
displacement since its calibration is measured by the outermost pins, because a contact moves them least.
"""

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial import cKDTree

from scenes.sensor import Polarity, SensorSpec, UsualCapsSpec
from twin.camera.capture import expose
from twin.errors import format_count
from twin.frames import spread_indices
from twin.frames.forms import blob_spec, gray_levels, known_sizes, pin_levels
from twin.optics.preview import Preview
from twin.pins.detectors.detector_spec import DetectorSpec, shipped_detector, with_detector
from twin.pins.detectors.tune import other_layout
from twin.pins.finding.caps import Caps, measure_caps
from twin.pins.labelling.identify import score_layout
from twin.pins.labelling.reference import DECIDES, MOST_STRETCH, UNDECIDED, Reference, nominal_reference, project_rest, view_of
from twin.pins.pipeline import Pipeline
from twin.progress import Step, report_each, unheard
from twin.types import Form, Frame, Observation

LEAST_RIM = 0.5
"""Least share of the outermost pins that must be found."""
BULGE = 1.0
"""Relative growth of the rim of a dome by a contact, divided by the pins' rms motion relative to the rim's mean radius. Measured: 0.90,
0.98 and 1.09 in recordings of three sensors, 0.7 to 1.4 in the twin. The rim of a pad hardly grows."""
SATURATED_LEVEL = 250
"""Least gray level of a saturated pixel."""
STEADY = 0.5
"""Share of the frames from which on a lost pin, or a bright spot, counts as a fault of the sensor and not as an effect of contacts."""
SAME_SPOT = 0.3
"""Distance in spacings below which spots in two frames are the same spot."""
CAPS_MEASURED = 3
"""Most frames in which caps are measured. They are spread evenly; light and focus hardly differ between frames."""
LEAST_DEFORMED = 0.3
"""Share of the frames, those with the least contact, by which the camera's place is measured."""
TOLD_BULGE = 0.002
"""Change of the rim's size by a contact, as a share, below which a text does not mention it."""
LAYOUT_JUDGED = 4
"""Most frames on which the layout is evaluated, evenly spread."""
LISTED = 8
"""Most pins that a sentence lists by number."""
BRIGHT_PERCENTILE = 99
"""Percentile of the gray levels around the pins that is taken as the caps' level if no pin is found."""
USUAL_CAP_PX = 8.0
"""Assumed diameter of a cap, px, if none can be measured."""
STRAY_PERCENTILE = 97
"""Percentile of the skin's levels around the caps that is compared with their median. Stray light falls on a part of the skin only."""
GLARE_CAPS = 2
"""Area of a white patch, in cap areas, above which it counts as glare."""
REPLACED = "fix the camera, or calibrate again ('twin calibrate optics'); 'twin tune' moves the mask"
"""What to do if the camera is not at its calibrated place."""
CHECKS = {
    "brightness": (0.6, 0.3, "raise exposure or gain; look for dead LEDs, dirt, a foggy window"),
    "saturation": (0.02, 0.2, "lower exposure or gain"),
    "focus": (1.35, 2.0, "focus the camera; clean the window; hold still"),
    "glare": (0.003, 0.03, "shade the sensor; move or dim the LED"),
    "stray light": (0.2, 0.6, "keep room light off the tip there; look for a leak between skin and housing, or an LED that is bent"),
    "layout": (0.9, 0.75, "give the `sensor` that these frames are of, or make one with 'twin new'; look for stray light"),
    "pins": (0.002, 0.05, "look at these places: caps may be off, dirty or hidden by glare"),
    "specks": (0.02, 0.2, "bubbles, dust or LED reflections: clean the window, turn the sensor's LEDs, or mask them"),
    "place": (0.0, 0.0, "see the other findings first"),
    "shift": (0.2, 1.0, REPLACED),
    "turn": (1.5, 6.0, REPLACED),
    "scale": (0.02, 0.1, REPLACED),
    "stretch": (MOST_STRETCH, 2 * MOST_STRETCH, "give frames as the camera took them"),
    "mirror": (0.0, 0.5, "turn mirroring off where the frames are taken, or see `push`"),
    "twin": (
        0.2,
        0.5,
        "lengths in mm, camera and rest_px do not belong together: the twin's pictures are not of this sensor; make the specification "
        "again ('twin new', with `radius_mm` for a tip of another size)",
    ),
}
"""Values of each check above which (below which, if the second is smaller) a sensor is degraded and has failed, and what to do then."""


class Grade(StrEnum):
    """Grade of a finding; unsure if the frames do not show what it is about."""

    HEALTHY = "healthy"
    DEGRADED = "degraded"
    FAILED = "failed"
    UNSURE = "unsure"


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes
    ----------
    name : str
    verdict : Grade
    value : float
        The number that is compared with the check's limits; NaN if it can't be measured.
    text : str
        Description of the result, with the number and what was expected.
    remedy : str
        What to do; "" if nothing.
    """

    name: str
    verdict: Grade
    value: float
    text: str
    remedy: str


def examine(frames: list[Frame], spec: SensorSpec, detector: DetectorSpec | None = None, *, progress: Step = unheard) -> list[Finding]:
    """Check a sensor by frames of one form, with or without contact.

    Parameters
    ----------
    frames : list of Frame
    spec : SensorSpec
        The specification that the frames are compared with.
    detector : DetectorSpec, optional
        Parameters that ``twin tune`` found for the method ``twin``; by default those of the specification.

    Raises
    ------
    FrameError
        A frame does not belong to this sensor.
    """
    form = frames[0].form
    detector = detector or shipped_detector(spec, form)
    tuned = with_detector(spec, detector)
    pipeline = Pipeline(tuned, form)
    if known_sizes(tuned) != known_sizes(spec):  # tuned for another size: the calibrated pins are those of the view scaled to it
        spec = tuned.alter(pipeline={str(form): blob_spec(tuned.pipeline, form).alter(rest_px=())})
    seen = [pipeline(frame) for frame in report_each(frames, progress)]
    nominal = nominal_reference(spec, form)
    findings = [
        _layout(frames, spec, pipeline.blob_spec.polarity),
        _pins(frames, seen, pipeline),
        _spots(seen, pipeline),
        *_place(seen, nominal, spec),
        *_twin(spec, form, nominal),
    ]
    return findings if form == Form.PROCESSED else [*_light(frames, seen, spec.pipeline.usual_caps or rest_caps(spec), pipeline), *findings]


@dataclass(frozen=True)
class Drift:
    """The similarity that maps the calibrated rim of pins to the observed one.

    Attributes
    ----------
    shift_px : (2,) float
        Shift of the rim's centre.
    turn_deg : float
        Turn from x towards y.
    scale : float
    contact : float
        Rms motion of the pins without the similarity, relative to the rim's mean radius. It measures how much a contact deforms the skin.
    bulge : float
        Relative growth of the rim by a contact, divided by ``contact``.
    """

    shift_px: np.ndarray
    turn_deg: float
    scale: float
    contact: float
    bulge: float

    @property
    def scale_at_rest(self) -> float:
        """The scale without the effect of a contact. The gel keeps its volume, so it bulges at the rim when it is pressed in the middle."""
        return self.scale / (1 + self.bulge * self.contact)


def drift_of(pins_px: np.ndarray, rest_px: np.ndarray, outmost: np.ndarray, *, bulge: float = BULGE) -> Drift | None:
    """Drift by least squares over the outermost pins (m,) of pins (N, 2), which are NaN if lost. None if too few are found.

    With complex coordinates about the means, the similarity is ``a = sum conj(r) p / sum |r|^2`` (Horn 1987, in the plane).
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
    return Drift(np.array([shift.real, shift.imag]), float(np.degrees(np.angle(a))), float(abs(a)), float(contact), bulge)


def _verdict(value: float, degraded: float, failed: float) -> Grade:
    """Grade of a value by two limits. If ``failed`` is larger than ``degraded``, large values have failed, else small ones. So has NaN."""
    sign = 1 if failed > degraded else -1
    if not np.isfinite(value) or sign * value > sign * failed:
        return Grade.FAILED
    return Grade.DEGRADED if sign * value > sign * degraded else Grade.HEALTHY


def _finding(name: str, value: float, text: str, remedy: str = "") -> Finding:
    """A finding with its verdict by the limits of ``CHECKS``. If the verdict is good, there is no remedy."""
    degraded, failed, usual = CHECKS[name]
    verdict = _verdict(value, degraded, failed)
    return Finding(name, verdict, float(value), text, "" if verdict is Grade.HEALTHY else remedy or usual)


def _layout(frames: list[Frame], spec: SensorSpec, polarity: Polarity) -> Finding:
    """Finding about the layout: whether the frames show the specification's layout, independent of the camera's place."""
    images = [pin_levels(frames[k].image, polarity) for k in spread_indices(len(frames), LAYOUT_JUDGED)]
    layout = score_layout(spec.pins, images)
    share = 0.0 if layout is None else layout.explained
    doubts = [f"the frames do not show {spec.pins.in_words()}"] if layout is None else other_layout(layout, images)
    text = f"of the pins in view and the pin-like spots, {100 * share:.1f} % belong together" + (f"; {doubts[0]}" if doubts else "")
    wrong = bool(doubts) and "rather than" in doubts[0]
    return _finding("layout", 0.0 if wrong else share, text)


def lost_in_view(seen: list[Observation], pipeline: Pipeline) -> tuple[np.ndarray, np.ndarray]:
    """Pins (M, N) bool that are lost in M frames but not cut off by the frame's border, and all pins that it does not cut off."""
    in_view = ~np.stack([pipeline.out_of_view(o) for o in seen])
    return np.isnan(np.stack([o.pins_px[:, 0] for o in seen])) & in_view, in_view


def _pins(frames: list[Frame], seen: list[Observation], pipeline: Pipeline) -> Finding:
    """Finding about lost pins, with the frames that can't be used and the pins that are lost in most frames.

    Pins that the frame's border cuts off do not count as lost.
    """
    lost, in_view = lost_in_view(seen, pipeline)
    share = float(lost.sum() / max(in_view.sum(), 1))
    steady = np.flatnonzero(lost.mean(axis=0) >= STEADY)
    outside = int(np.median((~in_view).sum(axis=1)))
    text = f"{100 * share:.2f} % of the pins in view lost; {sum(o.valid for o in seen)} of {format_count(len(seen), 'frames')} are valid"
    bad = [f.name or f"number {k}" for k, (f, o) in enumerate(zip(frames, seen, strict=True), 1) if not o.valid]
    if 0 < len(bad) < len(seen):
        text += f"; not {', '.join(bad[:LISTED])}{', ...' if len(bad) > LISTED else ''}"
    if 0 < len(steady) < lost.shape[1] / 2:
        text += f"; steadily lost: pin {', '.join(map(str, steady[:LISTED]))}{', ...' if len(steady) > LISTED else ''}"
    if outside:
        text += f"; {outside} of {lost.shape[1]} pins lie outside the picture"
    unusable = next((o.reason for o in seen if not o.valid), "")
    return _finding("pins", share, text, f"{unusable}; run 'twin tune' on these frames" if unusable else "")


def _spots(seen: list[Observation], pipeline: Pipeline) -> Finding:
    """Finding about spots among the pins that are not pins and are at the same place in most frames."""
    within = SAME_SPOT * float(np.mean(pipeline.reference.spacing_px))
    radius = np.linalg.norm(pipeline.reference.pins_px - pipeline.reference.pins_px[0], axis=1).max()
    places = [o.extra_px[np.linalg.norm(o.extra_px - pipeline.reference.pins_px[0], axis=1) < radius] for o in seen]
    steady = 0
    if len(places[0]):
        hits = np.array([[len(p) and cKDTree(p).query(spot)[0] < within for p in places] for spot in places[0]], float)
        steady = int((hits.mean(axis=1) >= STEADY).sum())
    kind = pipeline.blob_spec.polarity
    return _finding("specks", steady / len(pipeline.reference.pins_px), f"steady {kind} spots among the pins: {steady}")


def _place(seen: list[Observation], nominal: Reference, spec: SensorSpec) -> list[Finding]:
    """Findings about the camera's place: in the frames with the least contact, the pins are compared with the ``nominal`` ones."""
    pitch, bulge = float(np.mean(nominal.spacing_px)), BULGE if spec.skin.shape == "cap" else 0.0
    drifts = [(d, o) for o in seen if o.valid and (d := drift_of(o.pins_px, nominal.pins_px, nominal.outmost, bulge=bulge))]
    if not drifts:
        return [_finding("place", np.nan, "the camera's place can't be determined: too few pins at the rim")]
    drifts = sorted(drifts, key=lambda each: each[0].contact)[: max(round(LEAST_DEFORMED * len(drifts)), 1)]
    found = [d for d, _ in drifts]
    with np.errstate(invalid="ignore"):
        pins_px = np.stack([o.pins_px for _, o in drifts])
        known = np.asarray(np.isfinite(pins_px).any(axis=(0, 2)))
        pins_px = np.where(known[:, None], np.nanmedian(np.where(known[:, None], pins_px, 0.0), axis=0), np.nan)
    view = view_of(pins_px, nominal, spec.pins)
    shift = np.median(np.stack([d.shift_px for d in found]), axis=0)
    turn, scale, seen_scale = (float(np.median([getattr(d, name) for d in found])) for name in ("turn_deg", "scale_at_rest", "scale"))
    turn = view.turn_deg if view.sure else turn
    grown = f" ({seen_scale:.3f} with the bulge of the contact)" if seen_scale - scale > TOLD_BULGE else ""
    away = float(np.linalg.norm(shift))
    mirror = _finding("mirror", float(view.mirrored), f"the picture is {'' if view.mirrored else 'not '}mirrored")
    return [
        _finding("shift", away / pitch, f"displaced by ({shift[0]:.1f}, {shift[1]:.1f}) px, {away / pitch:.2f} pitches"),
        _finding("turn", abs(turn), f"turned by {turn:.2f} deg"),
        _finding("scale", abs(scale - 1), f"{scale:.3f} times its calibrated size{grown}"),
        _finding("stretch", view.stretch, f"stretched by {100 * view.stretch:.1f} %"),
        mirror if view.mirrored or view.sure else Finding("mirror", Grade.UNSURE, np.nan, UNDECIDED, DECIDES),
    ]


def _twin(spec: SensorSpec, form: Form, nominal: Reference) -> list[Finding]:
    """Finding about the specification alone: whether its camera sees the pins at rest where they were measured. None if they were not.

    Pins are found from where they were measured; the twin draws them where lengths and camera put them. Therefore both can be wrong
    apart from each other.
    """
    blob = spec.pipeline.raw if form == Form.RAW else spec.pipeline.processed
    if blob is None or not blob.rest_px:
        return []
    off_px = nominal.pins_px - project_rest(spec, form)
    rms, pitch = float(np.sqrt(np.mean(np.sum(off_px**2, axis=1)))), float(np.mean(nominal.spacing_px))
    text = f"the specification's camera sees its pins at rest {rms:.1f} px (rms), {rms / pitch:.2f} pitches, from where they were measured"
    return [_finding("twin", rms / pitch, text)]


def _around_pins(pipeline: Pipeline) -> np.ndarray:
    """The mask's disc (h, w) uint8 without what is more than a spacing outside the outermost pins: there lies a pad's housing."""
    reference, (rows, columns) = pipeline.reference, pipeline.mask.window
    rim = reference.pins_px[reference.outmost] - (columns.start, rows.start)
    around = cv2.fillConvexPoly(np.zeros_like(pipeline.mask.disc), cv2.convexHull(np.rint(rim).astype(np.int32)), 1)
    width = 2 * int(np.ceil(np.mean(reference.spacing_px))) + 1
    within: np.ndarray = cv2.dilate(around, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width)))
    return np.where(pipeline.mask.disc > 0, within, 0)


def _light(frames: list[Frame], seen: list[Observation], expected: UsualCapsSpec | None, pipeline: Pipeline) -> list[Finding]:
    """Findings about brightness, saturation, focus and glare of raw frames around the pins, compared with the ``expected`` caps."""
    looked = list(zip(frames, seen, strict=True))[:: -(-len(frames) // CAPS_MEASURED)]
    polarity = pipeline.blob_spec.polarity
    caps = [measure_caps(gray_levels(f.image), o.pins_px, polarity=polarity) for f, o in looked if np.isfinite(o.pins_px).any()]
    windows, disc = [gray_levels(np.ascontiguousarray(f.image[pipeline.mask.window])) for f in frames], _around_pins(pipeline)
    brightest = float(np.median([np.percentile(w[disc > 0], BRIGHT_PERCENTILE) for w in windows]))
    level, contrast, edge, diameter = (
        float(np.nanmedian([np.nanmedian(getattr(c, name)) for c in caps])) if caps else np.nan
        for name in ("level", "contrast", "edge_px", "diameter_px")
    )
    promised, sharp, uneven = (expected.contrast, expected.edge_px, expected.unevenness) if expected else (np.nan, np.nan, 0.0)
    cap_px2 = np.pi / 4 * (diameter if np.isfinite(diameter) else USUAL_CAP_PX) ** 2
    stray, where = _stray(caps, [o for _, o in looked if np.isfinite(o.pins_px).any()], contrast)
    usual = uneven / promised
    glare = float(np.median([_glare(w, disc, cap_px2) for w in windows]))
    white, part = _white(caps, polarity), "caps" if polarity == "bright" else "skin around the caps"
    dark = (
        f"caps {level:.0f} gray levels, {contrast:.0f} {'above' if polarity == 'bright' else 'below'} the skin ({promised:.0f} expected)"
        if caps
        else f"brightest percent at {brightest:.0f} gray levels"
    )
    return [
        _finding("brightness", contrast / promised, dark),
        _finding("saturation", white, f"{100 * white:.1f} % of the {part} white"),
        _finding("focus", edge / sharp, f"caps' edges {edge:.2f} px wide ({sharp:.2f} px expected)"),
        _finding("glare", glare, f"{100 * glare:.2f} % of the area of the pins in white patches larger than caps"),
        _finding(
            "stray light",
            stray - usual,
            f"skin brighter by {100 * stray:.0f} % of the caps' contrast{where} ({100 * usual:.0f} % expected)",
        ),
    ]


def usual_caps(caps: list[Caps]) -> UsualCapsSpec | None:
    """Light and focus of the caps in some frames, medians over the frames; None if no cap can be measured."""
    measured = [
        (np.nanmedian(c.contrast), np.nanmedian(c.edge_px), _unevenness(c))
        for c in caps
        if np.isfinite([c.contrast, c.edge_px]).any(axis=1).all()
    ]
    contrast, edge_px, unevenness = np.median(measured, axis=0).tolist() if measured else (0.0, 0.0, 0.0)
    return UsualCapsSpec(contrast=contrast, edge_px=edge_px, unevenness=max(unevenness, 0.0)) if min(contrast, edge_px) > 0 else None


@lru_cache(maxsize=2)
def rest_caps(spec: SensorSpec) -> UsualCapsSpec | None:
    """The caps measured in the twin's frame at rest; None if that frame shows none."""
    twin = expose(Preview(spec).render(), spec.capture)
    pins_px = Pipeline(spec, Form.RAW)(Frame(twin, Form.RAW)).pins_px
    return usual_caps([measure_caps(gray_levels(twin), pins_px, polarity=spec.pipeline.raw.polarity)])


def _white(caps: list[Caps], polarity: Polarity) -> float:
    """Share of the caps that are saturated; of dark caps, of those with saturated skin around them."""
    levels = [c.level if polarity == "bright" else c.skin for c in caps]
    return float(np.mean(np.concatenate(levels) >= SATURATED_LEVEL)) if caps else 0.0


def _unevenness(caps: Caps) -> float:
    """How much brighter the skin is in its brightest part than in most of it, gray levels."""
    return float(np.nanpercentile(caps.skin, STRAY_PERCENTILE) - np.nanmedian(caps.skin)) if np.isfinite(caps.skin).any() else 0.0


def _stray(caps: list[Caps], seen: list[Observation], contrast: float) -> tuple[float, str]:
    """Unevenness of the skin relative to the caps' contrast, median over frames, and in words where the skin is brightest."""
    if not caps or not contrast > 0:
        return 0.0, ""
    brightest = int(np.argmax([_unevenness(each) for each in caps]))
    skin = caps[brightest].skin
    if not np.isfinite(skin).any():
        return 0.0, ""
    x, y = seen[brightest].pins_px[skin >= np.nanpercentile(skin, STRAY_PERCENTILE)].mean(axis=0)
    return float(np.median([_unevenness(each) for each in caps])) / contrast, f" near ({x:.0f}, {y:.0f}) px"


def _glare(window: np.ndarray, disc: np.ndarray, cap_px2: float) -> float:
    """Share of the disc in saturated patches larger than ``GLARE_CAPS`` caps of ``cap_px2``."""
    white = ((window >= SATURATED_LEVEL) & (disc > 0)).astype(np.uint8)
    area = cv2.connectedComponentsWithStats(white)[2][1:, cv2.CC_STAT_AREA]
    return float(area[area > GLARE_CAPS * cap_px2].sum() / (disc > 0).sum())
