"""Makes a specification from the frames of an unknown sensor: layout, pins at rest, camera and pin detection."""

from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial import Delaunay

from scenes.layouts.base import LatticeLayout
from scenes.pins import PinsSpec
from scenes.sensor import AppearanceSpec, BlobSpec, CameraSpec, PipelineSpec, Polarity, SensorSpec
from twin.calibration.assumptions import AssumptionCost, cost_of_assumptions
from twin.calibration.camera_pose import FREE, LEAST_PINS, MODEL_PX, CameraReport, fit_camera
from twin.calibration.sensor_file import sibling_folder, write_sensor
from twin.calibration.size import of_radius, require_radius
from twin.errors import FrameError, format_count
from twin.frames import Recording, evenly_read, frames_at, open_recording, spread_indices
from twin.frames.forms import blob_spec, gray_levels, pin_levels
from twin.frames.images import write_image
from twin.geometry.pins import rest_pins, usual_spacing
from twin.optics.relief import cap_planes
from twin.pins.batch import draw_overlay
from twin.pins.check import CAPS_MEASURED, lost_in_view, usual_caps
from twin.pins.detectors.detector_spec import UNKNOWN_BLOCK_PX, UNKNOWN_OFFSET, DetectorSpec, camera_seeing, whole_recording, with_detector
from twin.pins.detectors.tune import Tuned, tune
from twin.pins.finding.caps import measure_caps
from twin.pins.labelling.identify import STEADY, SURE_AHEAD, SURE_EXPLAINED, Candidate, Identified, identify, score_layout, unnamed_spots
from twin.pins.labelling.rest import Rest, rest_of, turn_of
from twin.pins.pipeline import Pipeline
from twin.progress import Progress, silent, stage
from twin.report.page import Column, Page, PagePicture
from twin.store import output, write_text, writes_file
from twin.types import Form, Frame

DARK_CAPS = AppearanceSpec(skin_albedo=(0.4, 0.4, 0.4), pin_albedo=(0.4, 0.4, 0.4), cap_albedo=(0.03, 0.03, 0.03))
"""Assumed reflectances of a sensor with dark caps. With the default LEDs and exposure the skin is bright, but not white."""
LIMIT = 40
"""Number of frames, evenly spread, from which the specification is made: enough contacts to estimate the pins at rest."""
JUDGED = 40
"""Number of frames on which the result is evaluated."""
FOUND_PINS = "pins.csv"
"""Name of the file of the pins that were found, as a layout that the user can correct."""
SHOWN_FRAMES = 4
"""Most frames whose overlay pictures are shown."""
PINHOLE_MM, FISHEYE_MM = 45.0, 7.5
"""Distance of the pupil from the centre of a dome of 20 mm, mm, at the start of a fit. The values are those of two TacTip cameras, without
and with a wide-angle lens."""
FITTED = {"perspective": FREE, "fisheye": (*FREE, "k2")}
"""Parameters that pins at rest may determine (see ``twin.calibration.camera_pose``), by the lens: the distortion of a fisheye has a second
coefficient."""
UNTUNED_OFFSET = -12.0
"""Threshold, gray levels above the local mean, for raw frames if only thresholded frames of the sensor were given."""
BETTER = 0.85
"""Largest ratio of misfits at which a more complex camera model replaces a simpler one."""
SIZE_SD = 0.05
"""Standard deviation of a cap's diameter from the model's, as a share. It covers uneven prints, uneven light and contact."""
MADE_SD = 0.1
"""Standard deviation, in spacings, of rest positions that were estimated from contacts (see ``Rest.line``)."""
FAIR_SHARE = 0.9
"""Least share of frames with all pins. If the share is smaller, the report advises to improve light, focus or exposure."""
STEADILY_LOST = 0.5
"""Least share of the frames in which a pin that should be in view is missing, for the pin to count as steadily lost."""
GIVEN_SHOWN = 0.9
"""Least share of the pins and pin-like spots in the frames that a given layout must explain. With a smaller share the layout is doubted."""
LEAST_SHOWN = 0.6
"""Least share of the pins and pin-like spots in the frames that a given layout must explain. A smaller share is an error."""
FEW_FRAMES = 20
"""Least number of frames from which the camera's model and the pins at rest are known well enough to give no warning."""
MOST_AWAY = 0.2
"""Rms distance, in spacings, between projected and found pins at rest above which the camera does not fit. Frames stretched in one
direction cause such a distance, because no lens model describes them."""
USUALLY_AWAY = 0.1
"""Rms distance, in spacings, above which a camera is doubted that was fitted to a frame without contact. Usual: 0.02 to 0.05."""


@dataclass(frozen=True)
class Health:
    """How well the new specification finds pins in frames.

    Attributes
    ----------
    frames : int
    all_pins : float
        Share of the frames in which every pin in view is found.
    found : float
        Mean share of the pins in view that are found.
    valid : float
        Share of valid frames.
    steadily_lost : tuple of int
        Pins that are lost in at least half of the frames although they should be in view.
    reasons : tuple of str
        Reasons why frames cannot be used, one example of each kind.
    """

    frames: int
    all_pins: float
    found: float
    valid: float
    steadily_lost: tuple[int, ...]
    reasons: tuple[str, ...]

    def lines(self) -> list[str]:
        """The same as lines of text."""
        lines = [
            f"all pins in view found in {100 * self.all_pins:.1f} % of {format_count(self.frames, 'frames')}, "
            f"{100 * self.found:.2f} % of all pins; {100 * self.valid:.0f} % of the frames are valid"
        ]
        if self.steadily_lost:
            lost = format_count(len(self.steadily_lost), f"pins lost in most frames: {', '.join(map(str, self.steadily_lost))}")
            lines.append(f"{lost}; look for dirt, reflections or missing caps there")
        return lines + [f"not usable, for example: {reason}" for reason in self.reasons]


@dataclass(frozen=True)
class NewSensor:
    """A specification made from frames, and how certain it is.

    Attributes
    ----------
    sensor : SensorSpec
    identified : Identified
        The layout; other candidates come after it.
    rest : Rest
    camera : CameraReport
    tuned : Tuned
    health : Health
    size : str
        Where the size of the tip comes from, which frames do not determine.
    known, assumed, next_steps : tuple of str
        What the frames determine, what is assumed instead, and how to find out more.
    costs : tuple of AssumptionCost
        How far estimates move if an assumed number is wrong; the largest first.
    odd : tuple of str
        Irregularities of the recording.
    written : list of Path
    """

    sensor: SensorSpec
    identified: Identified
    rest: Rest
    camera: CameraReport
    tuned: Tuned
    health: Health
    size: str
    known: tuple[str, ...]
    assumed: tuple[str, ...]
    next_steps: tuple[str, ...]
    costs: tuple[AssumptionCost, ...]
    odd: tuple[str, ...]
    written: list[Path]

    def lines(self) -> list[str]:
        """The results and the doubts about them, as lines of text."""
        lines = [f"layout {'sure' if self.identified.sure else 'unsure'}: {self.identified.best.line()}"]
        lines += [f"doubt: {doubt}" for doubt in self.identified.doubts]
        if not self.identified.sure:
            lines += [f"or: {other.line()}" for other in self.identified.candidates[1:2]]
        lines += [self.rest.line(), *self.known[2:], *self.health.lines(), self.size]
        lines += [f"measure first: {cost.line()}" for cost in self.costs[:1]]
        return lines + [f"next: {step}" for step in self.next_steps] + [f"note: {note}" for note in self.odd]


@writes_file(".*.csv", ".*.uri")
def new_sensor(
    frames: Path,
    out: Path,
    *,
    layout: PinsSpec | None = None,
    radius_mm: float | None = None,
    no_contact: Path | None = None,
    table: Path | None = None,
    form: Form | None = None,
    limit: int = LIMIT,
    progress: Progress = silent,
) -> NewSensor:
    """Make a specification from frames of an unknown sensor, and write it.

    A folder ``NAME-new`` beside the specification gets the overlay pictures and the page.

    Parameters
    ----------
    frames : Path
        Anything ``open_recording`` takes: frames of any one size, colour, gray or thresholded, in contact or not.
    out : Path
        The ``.toml`` file to write.
    layout : PinsSpec, optional
        The layout, if it is known. Otherwise it is identified.
    radius_mm : float, optional
        Radius of the tip's dome. By default that of a printed TacTip, 20 mm. All other lengths are in proportion to it (`of_radius`).
    no_contact : Path, optional
        A frame without contact. By default a file ``init_*`` beside the frames, else a frame that shows no contact, else an estimate from
        the contacts.
    table : Path, optional
        A table of labels that also gives the frames' order.
    form : Form, optional
        Thresholded (processed) or not (raw); recognised by the frames' content if not given.
    limit : int
        Most frames from which the specification is made.

    Raises
    ------
    FrameError
        There are no frames, they show no layout, or ``out`` is not the name of a ``.toml`` file.
    OptionError
        No dome has this radius.
    """
    if radius_mm is not None:
        require_radius(radius_mm)
    folder = sibling_folder(out, "new")
    with output(folder, "index.html", "overlay-*.png", FOUND_PINS):
        recording = open_recording(frames_at(frames, table, no_contact), None, form)
        looked = evenly_read(recording, limit)
        odd = recording.notes()
        images = [gray_levels(frame.image) for frame in looked]
        with stage(progress, "layout") as step:
            found = identify(images, progress=step) if layout is None else _compare_layout(layout, images)
        best, polarity = found.best, found.polarity
        images = [pin_levels(image, polarity) for image in images]
        if (enough := int((best.there >= STEADY).sum())) < LEAST_PINS:
            raise FrameError(
                f"most frames show too few pins ({enough}, as {best.pins.in_words()}) to fit a camera, which needs {LEAST_PINS}; "
                "give frames in which more pins are visible, and do not threshold them if the light fades towards the rim"
            )
        given, names = recording.reference, [frame.name for frame in looked]
        known_name, known_gray = (given.name, pin_levels(given.image, polarity)) if given is not None else ("", None)
        try:
            rest = rest_of(best, names, known_gray, known_name)
        except FrameError as error:
            if found.sure:
                raise
            raise FrameError(
                f"the layout is not recognised: the likeliest is {best.line()}, but {known_name} does not show it. If {known_name} shows "
                "no contact, give the layout with `layout`; if it is of no known kind, as `layout` positions:FILE.csv"
            ) from error
        start = _start_specification(out.stem, looked[0], best.pins, rest, frames.name, polarity)
        start = start if radius_mm is None else of_radius(start, radius_mm)
        start = start.alter(layout_unsure=not found.sure)
        with stage(progress, "camera"):
            sizes_px = _sizes(best, images) if looked[0].form == Form.RAW else None
            fitted, camera, others = _camera(start, np.where((best.there >= STEADY)[:, None], rest.pins_px, np.nan), rest.source, sizes_px)
        with stage(progress, "pins") as step:
            tuned = tune(looked, fitted, known=best, rest=rest, progress=step)
        sensor = _with_usual_caps(_with_pipeline(fitted, tuned.detector), looked)
        judged = looked if limit >= min(JUDGED, len(recording)) else evenly_read(recording, JUDGED)
        odd = list(dict.fromkeys([*odd, *recording.notes(), *_doubtful(camera, rest, len(looked))]))
        health, pictures = _health(sensor, looked[0].form, judged, folder)
        known, assumed = _list_known(sensor, found, rest, camera, others, tuned), _list_assumed(sensor, found, camera)
        steps, size = _list_steps(sensor, found, rest, health, recording, out), _size(sensor, given=radius_mm is not None)
        known, assumed = ((*known, size), assumed) if radius_mm is not None else (known, (size, *assumed))
        write_sensor(out, sensor, _comment(frames.name, found, rest), _notes(found, rest, camera))
        _write_pins(folder / FOUND_PINS, best, (sensor.camera.cx_px, sensor.camera.cy_px))
        with stage(progress, "assumptions") as step:
            costs = tuple(cost_of_assumptions(sensor, progress=step))
        files = [out, folder / "index.html"]
        made = NewSensor(sensor, found, rest, camera, tuned, health, size, known, assumed, steps, costs, tuple(odd), files)
        _write_page(files[1], made, pictures)
        return made


def _compare_layout(layout: PinsSpec, images: list[np.ndarray]) -> Identified:
    """The user's layout, compared with the frames."""
    alone = not isinstance(layout.shape, LatticeLayout)  # none of those that are searched for in frames
    if alone and Delaunay(layout.shape.places()).find_simplex(np.zeros(2)) < 0:
        raise FrameError(
            f"the sensor's axis, 0,0, lies outside of the {layout.in_words()} that were given; x,y count from the axis: "
            "subtract the place of the middle pin, or of the middle of all pins"
        )
    polarity: Polarity = "bright"
    shown = score_layout(layout, images)
    if shown is None or shown.explained < GIVEN_SHOWN:
        dark = score_layout(layout, [pin_levels(image, "dark") for image in images])
        if dark is not None and (shown is None or dark.explained > shown.explained):
            shown, polarity = dark, "dark"
    other: Candidate | None = None
    if shown is None or shown.explained < (GIVEN_SHOWN if alone else SURE_EXPLAINED):
        with suppress(FrameError):
            other = identify(images).best
    if shown is not None and shown.explained >= GIVEN_SHOWN and (other is None or other.explained <= shown.explained + SURE_AHEAD):
        missing = f"px is none of the {layout.in_words()}: is its position missing in the file?"
        forgotten = unnamed_spots(shown.rest_px, shown.seen) if alone else []
        doubts = tuple(f"a pin-like spot at ({x:.0f}, {y:.0f}) {missing}" for x, y in forgotten)
        return Identified((shown,), not doubts, doubts, 0.0, polarity)
    if shown is None or shown.explained < LEAST_SHOWN:
        instead = f"; they show {other.pins.in_words()}" if other is not None else ""
        places = (
            "compare the places with the picture: one that is missing or wrong hides the others"
            if alone
            else "give each pin's place, `layout` positions:FILE.csv"
        )
        given = format_count(len(images), "frames")
        raise FrameError(f"none of {given} shows {layout.in_words()}{instead}; leave `layout` out to identify it, or {places}")
    doubt = f"{layout.in_words()} were given, but explain only {100 * shown.explained:.1f} % of the spots: {shown.differences()}"
    if other is None or other.explained <= shown.explained:
        return Identified((shown,), False, (f"{doubt}; check in the overlay whether these are all pins",), 0.0, polarity)
    doubt += f"; {other.pins.in_words()} explain {100 * other.explained:.1f} %: {other.differences()}"
    return Identified((shown, other), False, (doubt,), 0.0, polarity)


def _start_specification(name: str, frame: Frame, pins: PinsSpec, rest: Rest, source: str, polarity: Polarity) -> SensorSpec:
    """A specification with the right layout and frame size, and with a camera that sees the pins at about the right places."""
    height, width = frame.image.shape[:2]
    color = frame.image.ndim == 3 and frame.image.shape[2] == 3 and bool(np.ptp(frame.image.astype(int), axis=2).max() > 0)
    seen = rest.pins_px[np.isfinite(rest.pins_px[:, 0])]
    x, y = ((seen.max(axis=0) + seen.min(axis=0)) / 2).tolist()
    radius = float(np.linalg.norm(seen - [x, y], axis=1).max())
    f = radius * PINHOLE_MM / 17.0  # the outermost caps of a TacTip are about 17 mm from the axis
    camera = CameraSpec(
        width_px=width, height_px=height, channels="color" if color else "mono", fx_px=f, fy_px=f, cx_px=x, cy_px=y, distance_mm=PINHOLE_MM
    )
    anywhere = BlobSpec(
        polarity=polarity, threshold=UNKNOWN_OFFSET, threshold_block_px=UNKNOWN_BLOCK_PX, mask_center_px=(x, y), mask_radius_px=1.1 * radius
    )
    thresholded = frame.form == Form.PROCESSED
    return SensorSpec(
        name=name,
        description=f"Made by 'twin new' from frames of {source}",
        source="Layout, camera and pin detection: the frames. All else: the defaults of a printed TacTip",
        pins=pins.alter(phase_deg=round(turn_of(pins, rest.pins_px), 2)),
        camera=camera,
        appearance=DARK_CAPS if polarity == "dark" else AppearanceSpec(),
        recording=whole_recording((width, height), (width, height), polarity) if thresholded else None,
        pipeline=PipelineSpec(raw=anywhere, processed=anywhere if thresholded else None),
    )


def _sizes(layout: Candidate, images: list[np.ndarray]) -> np.ndarray:
    """Diameters (N,) px of the caps: the median over some of the raw frames; NaN for a cap that is never measured."""
    chosen = spread_indices(len(images), CAPS_MEASURED)
    found = np.stack([measure_caps(images[k], layout.seen[k].pins_px).diameter_px for k in chosen])
    some = np.isfinite(found).any(axis=0)
    return np.where(some, np.nanmedian(np.where(some, found, 0.0), axis=0), np.nan)


def _camera(
    start: SensorSpec, pins_px: np.ndarray, source: str, sizes_px: np.ndarray | None
) -> tuple[SensorSpec, CameraReport, tuple[str, ...]]:
    """The camera model and the pin spacing that explain the pins at rest and the caps' sizes best.

    Pinhole and fisheye lenses and both spacings are tried, and a simpler model is preferred (see ``BETTER``). Pins at rest alone hardly
    distinguish rings evenly spaced on the dome from rings evenly spaced in plan under another lens. The two differ in how the size of the
    caps changes from the middle to the rim. The caps' diameter in mm follows from their median size.

    Parameters
    ----------
    pins_px : (N, 2) float
        Pins at rest, NaN where unknown.
    source : str
        Origin of these pins: ``Rest.source``.
    sizes_px : (N,) float, optional
        Diameters of the caps, NaN where unknown.

    Returns
    -------
    fitted : SensorSpec
    report : CameraReport
    others : tuple of str
        Other cameras that explain the pins about as well, in words.
    """
    sd_px = MODEL_PX if source != "made" else max(MODEL_PX, MADE_SD * usual_spacing(pins_px))
    tried: list[tuple[float, SensorSpec, CameraReport]] = []
    best = 0
    for (projection, free), spacing in product(FITTED.items(), ("polar", "plan")):
        trial = start.alter(pins={"spacing": spacing}, camera={"projection": projection})
        if projection == "fisheye":
            nearer = {key: getattr(start.camera, key) * FISHEYE_MM / PINHOLE_MM for key in ("fx_px", "fy_px", "distance_mm")}
            trial = trial.alter(camera=nearer)
        trial = trial.alter(camera=camera_seeing(trial, pins_px, np.flatnonzero(np.isfinite(pins_px[:, 0]))))
        fitted, report = fit_camera(trial, pins_px, free=free)
        fitted, uneven = _with_sizes(fitted, sizes_px)
        misfit = float(np.hypot(report.rms_px / sd_px, uneven / SIZE_SD))
        tried.append((misfit, fitted, report))
        if misfit < BETTER * tried[best][0]:
            best = len(tried) - 1
    least = min(misfit for misfit, _, _ in tried)
    others = [each for k, (misfit, each, _) in enumerate(tried) if k != best and misfit * BETTER <= least]
    return tried[best][1], tried[best][2], tuple(_camera_words(each) for each in others)


def _camera_words(sensor: SensorSpec) -> str:
    """Kind of lens and focal length of a sensor's camera."""
    lens = "fisheye" if sensor.camera.projection == "fisheye" else "pinhole"
    return f"{lens}, focal length {sensor.camera.fx_px:.0f} px"


def _with_sizes(sensor: SensorSpec, sizes_px: np.ndarray | None) -> tuple[SensorSpec, float]:
    """The sensor with caps and pins scaled to the median measured size, and the relative spread of the measured sizes about the model's."""
    if sizes_px is None:
        return sensor, 0.0
    _, plane = cap_planes(sensor.view, sensor.pins, rest_pins(sensor.geometry))
    share = sizes_px / (2 * np.sqrt(np.abs(np.linalg.det(plane))))
    known = np.log(share[np.isfinite(share)])
    if len(known) < LEAST_PINS:
        return sensor, 0.0
    scale = float(np.exp(np.median(known)))
    cap_mm, pin_mm = (round(scale * value, 3) for value in (sensor.pins.cap_diameter_mm, sensor.pins.diameter_mm))
    return sensor.alter(pins={"cap_diameter_mm": cap_mm, "diameter_mm": pin_mm}), float(np.std(known))


def _with_pipeline(sensor: SensorSpec, detector: DetectorSpec) -> SensorSpec:
    """The specification with its pin detection. If only thresholded frames were given, raw frames get the threshold ``UNTUNED_OFFSET``."""
    tuned = with_detector(sensor, detector)
    if detector.form == Form.RAW:
        return tuned
    usual = detector.blob.alter(
        threshold=UNTUNED_OFFSET, threshold_block_px=UNKNOWN_BLOCK_PX, rest_px=(), rest_origin="measured", spot_sigma_px=0.0
    )
    return tuned.alter(pipeline={"raw": usual})


def _with_usual_caps(sensor: SensorSpec, frames: list[Frame]) -> SensorSpec:
    """The specification with the usual light and focus of its caps, measured in raw frames."""
    if frames[0].form != Form.RAW:
        return sensor
    pipeline = Pipeline(sensor, Form.RAW)
    seen = [(frame, pipeline(frame)) for frame in (frames[k] for k in spread_indices(len(frames), CAPS_MEASURED))]
    polarity = sensor.pipeline.raw.polarity
    usual = usual_caps([measure_caps(gray_levels(frame.image), o.pins_px, polarity=polarity) for frame, o in seen if o.valid])
    return sensor.alter(pipeline={"usual_caps": usual})


def _health(sensor: SensorSpec, form: Form, frames: list[Frame], folder: Path) -> tuple[Health, list[Path]]:
    """How well a specification finds pins in frames, and overlay pictures of some of them."""
    pipeline = Pipeline(sensor, form)
    seen = [pipeline(frame) for frame in frames]
    steadily = np.flatnonzero(lost_in_view(seen, pipeline)[0].mean(axis=0) >= STEADILY_LOST)
    reasons = list(dict.fromkeys(o.reason.split(":")[0] for o in seen if not o.valid))
    first = [next(f"{f.name}: {o.reason}" for f, o in zip(frames, seen, strict=True) if o.reason.startswith(r)) for r in reasons]
    found = [o.found / max(o.expected, 1) for o in seen]
    whole, mean, valid = (float(np.mean(share)) for share in ([o.complete for o in seen], found, [o.valid for o in seen]))
    worst = np.argsort(found, kind="stable")
    chosen = dict.fromkeys([int(worst[-1]), int(worst[0]), *worst[:: max(len(worst) // SHOWN_FRAMES, 1)].tolist()])
    scale = int(np.clip(round(900 / max(pipeline.size_px)), 1, 6))  # pins can be seen well
    pictures = [
        write_image(folder / f"overlay-{number}.png", draw_overlay(frames[k], seen[k], scale=scale, numbers=True))
        for number, k in enumerate(list(chosen)[:SHOWN_FRAMES], 1)
    ]
    return Health(len(seen), whole, mean, valid, tuple(steadily.tolist()), tuple(first[:3])), pictures


def _doubtful(camera: CameraReport, rest: Rest, frames: int) -> list[str]:
    """Doubts about a camera that was fitted to the pins at rest, and what to do."""
    notes = []
    seen = rest.pins_px[np.isfinite(rest.pins_px[:, 0])]
    away = camera.rms_px / usual_spacing(seen)
    if away > MOST_AWAY:
        notes.append(
            f"no camera fits this layout in these frames: the best one is off the pins at rest by {camera.rms_px:.1f} px (rms), "
            f"{away:.2f} of their spacing; if the frames were stretched, give them as the camera wrote them"
        )
    elif away > USUALLY_AWAY and rest.source == "given":
        notes.append(
            f"the camera is off the pins at rest by {camera.rms_px:.1f} px (rms), {away:.2f} of their spacing, which is much for a frame "
            "without contact: check the layout's positions, and whether that frame shows a contact"
        )
    if frames < FEW_FRAMES:
        notes.append(f"too few frames ({frames}): camera and focal length are unsure; give about {LIMIT}, of different contacts")
    return notes


def _list_known(
    sensor: SensorSpec, found: Identified, rest: Rest, camera: CameraReport, other_cameras: tuple[str, ...], tuned: Tuned
) -> tuple[str, ...]:
    """What the frames determine."""
    evidence, blob = tuned.detector.evidence, blob_spec(sensor.pipeline, tuned.detector.form)
    return (
        f"Layout: {found.best.line()}",
        rest.line(),
        *([] if found.polarity == "bright" else ["polarity: the pins are darker than the skin"]),
        f"camera: {_camera_words(sensor)}, middle ({sensor.camera.cx_px:.0f}, {sensor.camera.cy_px:.0f}) px; "
        f"it sees the {camera.pins} pins at rest within {camera.rms_px:.2f} px (rms)"
        + (f"; these fit about as well: {', or '.join(dict.fromkeys(other_cameras))}" if other_cameras else ""),
        f"pin detection: {evidence.sure if evidence else 'unsure'}; "
        + (
            f"spots of {blob.spot_sigma_px:g} px"
            if blob.spot_sigma_px
            else f"threshold {blob.threshold:g}, which may change by {evidence.threshold_slack if evidence else 0:g} gray levels"
        ),
    )


def _list_assumed(sensor: SensorSpec, found: Identified, camera: CameraReport) -> tuple[str, ...]:
    """What is assumed."""
    return (
        f"Outermost pins at {sensor.pins.max_polar_deg:g} deg from the axis, and the camera's distance {sensor.camera.distance_mm:.1f} mm: "
        "pins at rest fit many pairs of them.",
        "Stiffness of skin and gel: Shore A 26 to 30 rubber and a soft gel.",
        "Light, colours, noise: those of another TacTip, until 'twin calibrate optics' has fitted this sensor's."
        if found.polarity == "bright"
        else "Light, noise: those of another TacTip; a gray skin and black caps ([appearance]).",
        *camera.held.values(),
    )


def _list_steps(sensor: SensorSpec, found: Identified, rest: Rest, health: Health, recording: Recording, out: Path) -> tuple[str, ...]:
    """How to find out more. The specification is written to ``out``."""
    steps = []
    if not found.sure:
        layouts = ", or ".join(candidate.pins.in_words() for candidate in found.candidates[:2])
        copy = out.with_name(f"{out.stem}-{FOUND_PINS}")
        steps.append(
            f"decide whether the pins are {layouts}: look at the places above in the overlay. If not, copy "
            f"{sibling_folder(out, 'new') / FOUND_PINS} to {copy}, remove pins that do not exist, add those that lack, and run this "
            f"again with `layout` positions:{copy}"
        )
    if rest.source != "given":
        steps.append("record a frame without contact and run this again with `no_contact` FRAME")
    if health.all_pins < FAIR_SHARE:
        steps.append("look at the overlay pictures: better light, focus or exposure helps most; then run this again")
    files = f"--sensor {out} --frames {recording.path} --out {out.with_stem(f'{out.stem}-2')}"
    if any(name.startswith("pose_") for name in recording.labels):
        steps.append(f"fit the contact to the labels: twin calibrate contact {files}")
    else:
        made = f"twin dataset --experiment surface-2d --sensor {out} --count 200 --images none --randomise contact --out sim"
        trained = f"twin train --model vgnn --sensor {out} --data sim --out runs/mine"
        shown = "twin live --camera 0 --model runs/mine (with 1000 contacts it is more accurate)"
        steps.append(f"train a first model in the twin, without labels: {made}; {trained}; {shown}")
        steps.append("or record labelled contacts (a table targets.csv beside the frames), then 'twin calibrate contact' and 'twin train'")
    if sensor.camera.channels == "color" and recording.form is Form.RAW and found.polarity == "bright":
        steps.append(f"fit light and colours: twin calibrate optics {files}")
    return tuple(steps)


def _size(sensor: SensorSpec, *, given: bool) -> str:
    """Where the tip's size comes from."""
    size = f"tip of radius {sensor.skin.outer_radius_mm:g} mm, skin {sensor.skin.thickness_mm:g} mm"
    if given:
        return f"{size}: the radius as given, all other lengths in proportion to a printed TacTip's"
    return (
        f"assumed: {size}, as a printed TacTip. Frames do not determine lengths in mm. If your tip differs, give its radius (`radius_mm`): "
        "otherwise lengths, forces and poses are wrong"
    )


def _write_pins(path: Path, layout: Candidate, axis_px: tuple[float, float]) -> None:
    """Write the pins of a layout, and spots that are none of them, as positions that can be corrected and given as a layout."""
    lines = ["# x,y of each pin from the sensor's axis, px; y down. 'twin new' takes the file as --layout positions:FILE.csv"]
    spots = unnamed_spots(layout.rest_px, layout.seen)
    for k, (x, y) in enumerate([*layout.rest_px, *spots]):
        what = "a spot that is none of the pins"
        if k < layout.pins.count:
            what = f"pin {k}" + (", not seen in most frames" if layout.there[k] < STEADY else "")
        lines += [f"# {what}, at ({x:.0f}, {y:.0f}) px of the frame", f"{x - axis_px[0]:.2f},{y - axis_px[1]:.2f}"]
    write_text(path, "\n".join(lines) + "\n")


def _comment(source: str, found: Identified, rest: Rest) -> str:
    """Lines above the specification."""
    return (
        f"Made by 'twin new' from frames of {source}. Sections and keys that are not here have their defaults: a printed TacTip\n"
        "(docs/your-own-sensor.md). The page beside this file states what is known, what is assumed, and how to find out more.\n"
        f"Layout: {'sure' if found.sure else 'UNSURE'}. {rest.line()}."
    )


def _notes(found: Identified, rest: Rest, camera: CameraReport) -> dict[str, str]:
    """Comments behind the values of a specification."""
    sure = "seen in the frames" if found.sure else "unsure: see the page"
    met = f"fitted: pins at rest within {camera.rms_px:.2f} px"
    return {
        "pins.layout": sure,
        **{f"pins.{key}": sure for key in type(found.best.pins.shape).model_fields},
        "pins.missing": "not seen in any frame, though in view",
        "pins.phase_deg": "turn of the first pin of each ring",
        "pins.spacing": "decided by the caps' sizes",
        "pins.cap_diameter_mm": "seen: the caps' mean size, for a dome of this radius",
        "pins.diameter_mm": "assumed: as wide relative to the caps as a usual pin",
        "camera.fx_px": met,
        "camera.distance_mm": "assumed: pins at rest do not determine it",
        "recording.crop_px": "assumed: how the frames were made is not known",
        "recording.threshold_block_px": "assumed",
    }


def _write_page(path: Path, made: NewSensor, pictures: list[Path]) -> None:
    """Write the page: what is known, what is assumed, what to do; overlay pictures; candidates."""
    page = Page(f"New sensor {made.sensor.name}", "twin new", topic="TacTip twin: a new sensor", lead=" ".join(made.health.lines()[:1]))
    page.notice("Unsure", list(made.identified.doubts), tone="bad")
    page.notice("Noted", [*made.odd, *made.health.lines()[1:]])
    page.section("What is known")
    page.items(made.known)
    page.section("What is assumed")
    page.items(made.assumed)
    page.section(
        "What an assumption costs",
        "By simulation: how far an estimated depth, and an estimated tilt of 5 deg, move if one of the assumed numbers is wrong. The first "
        "number is the first to measure.",
    )
    depth = Column("depth_share", "depth", "%", decimals=0, signed=True, scale=100)
    tilt = Column("tilt_deg", "tilt", "deg", decimals=1, signed=True)
    page.table([vars(cost) for cost in made.costs], ["assumed", "change", depth, tilt])
    page.section("How to find out more")
    page.items(made.next_steps)
    page.section(
        "Pins in the frames", "Green: found, with the pin's number. Red: a lost pin's expected place. Yellow: spots that are no pins."
    )
    page.figures(*(PagePicture(path, f"Frame with its pins, {path.stem}", "", kind="photo") for path in pictures))
    page.section("Layouts that were considered")
    shares = [Column(key, key, "%", decimals=decimals, scale=100) for key, decimals in (("explained", 1), ("agreeing", 0))]
    page.table(
        [vars(candidate) | {"layout": candidate.pins.in_words()} for candidate in made.identified.candidates],
        ["layout", *shares, "not_seen", "left_over", Column("misfit", "misfit", digits=2)],
        caption="Explained: of the pins in view and the pin-like spots, the share that belong together (median). Misfit: distance of the "
        "pins at rest from a smooth view of the layout, in spacings.",
    )
    page.write(path)
