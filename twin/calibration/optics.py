"""Calibration of camera and light from a folder of frames. It gives a specification and a page.

The calibration has stages. The result of each stage is stored, so that an interrupted run can be continued. The page shows renders before
and after the fit, the remaining differences, and the changed values.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from scenes.sensor import SensorSpec
from twin.calibration.camera_pose import fit_camera
from twin.calibration.details import fit_details, undetermined_tiles
from twin.calibration.light.caps import fit_caps
from twin.calibration.light.leds import fit_reflections, turn_leds
from twin.calibration.light.photometry import fit_photometry
from twin.calibration.light.response import fit_blur, fit_focus, fit_haze, fit_noise, fit_response, sharpness
from twin.calibration.light.ring import NoRing, fit_disc_edge, fit_rim, fit_ring
from twin.calibration.light.specks import fit_specks
from twin.calibration.light.still import Still, median_still
from twin.calibration.sensor_file import sibling_folder, write_sensor
from twin.camera.capture import expose
from twin.camera.projection import lens_disc
from twin.errors import FrameError, format_count
from twin.evaluation.pictures.aligned import Aligned, read_frames, with_changes
from twin.evaluation.pictures.compare import compare_images, difference_picture
from twin.evaluation.pictures.report import image_columns
from twin.frames import distinct_stems
from twin.frames.images import read_image, write_image
from twin.mechanics.skin_fit import FittedPins, SkinFit
from twin.optics.relief import DETAILS, without
from twin.optics.render import Renderer
from twin.pins.labelling.rest import require_even
from twin.pins.pipeline import Pipeline
from twin.progress import Bar, Progress, Step, report_each, silent, stage, unheard
from twin.report.page import Column, Page, PagePicture, code
from twin.store import KEPT, Item, inputs_digest, kept_arrays, kept_json, output, writes_file
from twin.types import Form, Frame, ReadableResult

FRAMES = 6
"""Number of frames that are fitted, spread evenly over the folder."""
SAMPLES = 16
"""Samples per pixel of the renders."""
CAP_ROUNDS = 2
"""Rounds of fitting caps and response alternately."""
DETAIL_ROUNDS = 3
"""Rounds in which the response is fitted to renders with details, and the details are fitted again."""
HAZE_SIGMA_PX = 40.0
"""Width of the haze, px, at the start of the fit if the specification has no haze."""
MOST_BINARY = 0.6
"""Share of pixels at exactly 0 or 255 above which frames count as thresholded. Raw frames are saturated only on the ring."""
MOST_STILL = 40
"""Most frames of which the still picture is the median, spread evenly. More frames do not improve it."""
LONGEST = 12
"""Length of the longest list whose numbers the page shows. Of longer lists it shows only the length."""
KINDS = {"real": "real", "before": "before", "after": "after", "residual": "what is left, twice amplified about middle gray"}
"""Kinds of pictures of a frame on the page, with their captions."""
JUDGED = {"psnr_db": "PSNR, dB,", "ssim": "SSIM"}
"""Image figures that a fit may not make worse without a warning, with their names."""
ALWAYS = (
    "the response curve (gamma, black level): kept; to determine it, photograph a gray card at several exposures",
    "LED power, exposure and reflectance: only their product is seen; the caps' brightest channel is taken as white resin",
    "the window's thickness and index, and the skin's thickness: kept",
    "caps' height and reflectance: only their product with the light is seen, which the relief's tiles hold; under lights from other "
    "directions a crest would look different",
)
"""Parameters that no set of frames determines."""
FEW_FRAMES_FITTED = 4
"""Least number of frames that separate the background from the relief of the caps."""
RING_HELD = "ring, LEDs' places and reflections: kept; the frames show no bright ring around the disc (a crop, or a sensor without one)"
"""Note for frames that show no ring."""
REST_MADE = (
    "the camera's kind, focal length and distance: kept as 'twin new' assumed them without a frame without contact; pictures of the same "
    "contact agree, but depths in mm may be wrong; give `no_contact` FRAME"
)
"""Note for a camera that was fitted to rest places estimated from contacts."""
Stage = Callable[[SensorSpec], SensorSpec]
"""One stage of the fit: a function from a specification to a better one."""


@dataclass(frozen=True)
class Calibration:
    """A fitted camera and light.

    Attributes
    ----------
    spec : SensorSpec
        The fitted specification.
    before, after : dict of str to float
        Image figures over the disc, mean over the frames: ``psnr_db``, ``ssim`` (colour) and others.
    notes : list of str
        Parameters that the frames do not determine, and what was left out.
    frames : list of Aligned
        The frames of the fit.
    first, last : list of (H, W[, 3]) uint8
        Renders with the specification at the start and at the end.
    """

    spec: SensorSpec
    before: dict[str, float]
    after: dict[str, float]
    notes: list[str]
    frames: list[Aligned]
    first: list[np.ndarray]
    last: list[np.ndarray]

    @property
    def warnings(self) -> list[str]:
        """The figures that are worse than before the fit; empty if none is."""
        return [
            f"the fit ended worse than it began: {name} {self.before[key]:.4g} -> {self.after[key]:.4g}; look at the page before you use it"
            for key, name in JUDGED.items()
            if not self.after[key] >= self.before[key]
        ]


@dataclass(frozen=True, repr=False)
class OpticsCalibration(ReadableResult):
    """A fitted specification and its files, the ``.toml`` file first."""

    found: Calibration
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text: what the frames did not determine, and the image figures before and after."""
        before, after = self.found.before, self.found.after
        return [
            *(f"note: {note}" for note in self.found.notes),
            *self.found.warnings,
            f"over the disc: PSNR {before['psnr_db']:.2f} -> {after['psnr_db']:.2f} dB, SSIM {before['ssim']:.3f} -> {after['ssim']:.3f}",
        ]


class _Studio:
    """Renders the states of frames with different specifications."""

    def __init__(self, frames: list[Aligned], bar: Bar) -> None:
        self._frames, self._bar = frames, bar

    def light(self, spec: SensorSpec, title: str) -> list[np.ndarray]:
        """Linear light (H, W[, channels]) of every frame's state."""
        renderer = Renderer(spec, spp=SAMPLES)
        with self._bar(title) as progress:
            return [renderer.render(frame.state, seed=seed) for seed, frame in enumerate(report_each(self._frames, progress))]

    def shots(self, spec: SensorSpec, title: str) -> list[np.ndarray]:
        """Renders (H, W[, 3]) uint8 of every frame's state, captured without noise."""
        return [expose(light, spec.capture) for light in self.light(spec, title)]


@writes_file(".*.csv", ".*.uri")
def calibrate_optics(
    frames: Path, sensor: SensorSpec, out: Path, *, limit: int = FRAMES, no_contact: Path | None = None, progress: Progress = silent
) -> OpticsCalibration:
    """Fit camera and light of a specification to a folder of raw frames, and write it.

    The folder ``NAME-calibration`` beside the specification holds the page and the results of the stages, so that an interrupted run can
    be continued.

    Parameters
    ----------
    sensor : SensorSpec
        The specification at the start of the fit.
    out : Path
        The ``.toml`` file to write.
    limit, no_contact
        As in ``fit_optics``.

    Raises
    ------
    FrameError
        No frame can be used, or ``out`` is not the name of a ``.toml`` file.
    RenderError
        The renderer, or its differentiation, does not work on this machine.
    """
    folder = sibling_folder(out, "calibration")
    with output(folder, "index.html", "pictures", KEPT):
        found = fit_optics(frames, sensor, folder, limit=limit, no_contact=no_contact, progress=progress)
        comment = [f"Fitted to {format_count(len(found.frames), 'frames')} of {frames.name}, starting from {sensor.name}.", *found.warnings]
        write_sensor(out, found.spec, "\n".join(comment))
        return OpticsCalibration(found, [out, write_page(folder, sensor, found, frames.name)])


def fit_optics(
    folder: Path, spec: SensorSpec, work: Path, *, limit: int = FRAMES, no_contact: Path | None = None, progress: Progress = silent
) -> Calibration:
    """Fit a specification to raw frames of a sensor in contact.

    Parameters
    ----------
    folder : Path
        Folder of raw frames.
    spec : SensorSpec
        The specification at the start of the fit: geometry and camera of the same type of sensor.
    work : Path
        Folder for the results of the stages. A second run with the same frames, start and code continues from them.
    limit : int
        Number of frames to fit.
    no_contact : Path, optional
        A raw frame without contact, to which the camera is fitted first.
    progress : Progress

    Raises
    ------
    FrameError
        No frame can be used, their sizes differ, or the sensor's caps are dark.
    RenderError
        The renderer, or its differentiation, does not work on this machine.
    """
    if spec.appearance.dark_caps:
        raise FrameError(
            f"light and colours are fitted to white caps, and those of {spec.name} are darker than the skin; set [appearance], [leds] and "
            "[response] by hand, and compare with 'twin realism'"
        )
    notes, bar = list(ALWAYS), partial(stage, progress)
    if no_contact is not None:
        spec, report = fit_camera(spec, _pins_at_rest(no_contact, spec))
        notes += [f"camera fitted to {report.pins} pins, {report.rms_px:.2f} px rms", *report.held.values()]
    with bar("read the frames, find their pins") as step:
        raw, refused = read_frames(folder, spec, limit, step)
    notes += [f"left out {each['image_name']}: {each['reason']}" for each in refused]
    log = _Log(work, spec, raw)
    with bar("fit the skin to the pins") as step:
        frames = log.align_frames(spec, raw, step)
    inside, studio = lens_disc(spec.view, spec.housing).inside, _Studio(frames, bar)
    if unseen := undetermined_tiles(spec, frames):
        notes.append(f"the relief of {unseen} of {spec.pins.count} caps: fewer than two frames show them; use more frames")
    if len(frames) < FEW_FRAMES_FITTED:
        notes.append(
            f"too few frames ({len(frames)}) to distinguish what moves with a cap and what does not; give {FRAMES} of different contacts"
        )
    if spec.pipeline.raw.rest_origin == "contacts":
        notes.append(REST_MADE)
    first = studio.shots(spec, "render the start")
    spec = with_changes(without(spec, DETAILS), response={"residual": None})  # the residual network was trained for the old calibration
    held = spec.housing
    for number, fit in enumerate(_stages(frames, inside, studio, bar)):
        spec = log.stage(f"{number:02d}-{fit.__name__}", fit, spec)
        if number == 0 and spec.housing == held:
            notes.append(RING_HELD)
    last = studio.shots(spec, "render the result")
    before, after = (_mean_figures(frames, shots, inside) for shots in (first, last))
    return Calibration(spec, before, after, notes, frames, first, last)


def _stages(frames: list[Aligned], inside: np.ndarray, studio: _Studio, bar: Bar) -> list[Stage]:
    """The stages of a fit to frames, in their order; ``inside`` (H, W) bool is the lens disc. A stage's stored result has its name."""

    def surroundings(spec: SensorSpec) -> SensorSpec:
        with bar("fit the ring, the reflections, the specks") as step:
            try:
                found = fit_surroundings(spec, np.stack([f.image for f in frames]), np.stack([f.pins_px for f in frames]), progress=step)
            except NoRing:  # a crop, or a sensor without a ring: everything else can still be fitted
                found = spec
        return found if found.gel.haze else with_changes(found, gel={"haze_sigma_px": HAZE_SIGMA_PX})

    def photometry(spec: SensorSpec) -> SensorSpec:
        with bar("fit lights and colours") as step:
            return fit_photometry(spec, frames, step)

    def defocus(spec: SensorSpec) -> SensorSpec:
        return fit_focus(spec, sharpness(spec, frames, studio.shots(spec, "render for the sharpness")))

    def response(spec: SensorSpec) -> SensorSpec:
        light = studio.light(spec, "render for the response")
        return fit_blur(fit_response(spec, frames, light, inside), frames, light)

    def caps(spec: SensorSpec) -> SensorSpec:
        return fit_caps(spec, frames, studio.shots(spec, "render for the caps"))

    def rim(spec: SensorSpec) -> SensorSpec:
        return fit_rim(spec, frames, studio.light(spec, "render for the rim"))

    def details(spec: SensorSpec) -> SensorSpec:
        return fit_details(spec, frames, studio.light(without(spec, DETAILS), "render for relief and background"))

    def detailed_response(spec: SensorSpec) -> SensorSpec:
        light = studio.light(spec, "render for the response to details")
        return fit_response(fit_haze(spec, frames, light, inside), frames, light, inside)

    def noise(spec: SensorSpec) -> SensorSpec:
        return fit_noise(spec, frames, studio.light(spec, "render for the noise"))

    smooth = [surroundings, photometry, caps, response, defocus, *[caps, response] * (CAP_ROUNDS - 1), rim]
    return [*smooth, details, *[detailed_response, details] * DETAIL_ROUNDS, noise]


def fit_surroundings(spec: SensorSpec, images: np.ndarray, pins_px: np.ndarray, progress: Step = unheard) -> SensorSpec:
    """The specification with all that contact does not change: disc edge, ring, LED places and reflections, and specks.

    They are fitted to the per-pixel median of the frames, whose gray levels are converted to light by the known response curve.

    Parameters
    ----------
    spec : SensorSpec
        Camera, response, ``leds.power``, ``leds.balance`` and ``gel.haze`` are known and not changed.
    images : (M, H, W, 3) or (M, H, W) uint8
        Raw frames with different contacts, RGB or gray.
    pins_px : (M, N, 2) float
        Pins in raw-frame px; NaN if not found.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    FrameError
        The frames are thresholded, or show no bright ring around the disc (`NoRing`).
    """
    if np.mean((images == 0) | (images == 255)) > MOST_BINARY:
        raise FrameError(
            f"the frames of {spec.name} are thresholded: they have no gray levels, from which the light of the surroundings could be "
            "fitted; give raw camera frames, or keep the specification's housing and leds"
        )
    chosen = np.unique(np.linspace(0, len(images) - 1, min(len(images), MOST_STILL)).astype(int))
    images, pins_px = images[chosen], pins_px[chosen]
    images = np.repeat(images[..., None], 3, axis=3) if images.ndim == 3 else images
    still = median_still(spec, images)
    specks = partial(fit_specks, images=images, pins_px=pins_px)
    fits: tuple[Callable[[SensorSpec, Still], SensorSpec], ...] = (fit_disc_edge, turn_leds, fit_reflections, fit_ring, specks)
    for fit in report_each(fits, progress):
        spec = fit(spec, still)
    return spec


def _mean_figures(frames: list[Aligned], shots: list[np.ndarray], inside: np.ndarray) -> dict[str, float]:
    """Image figures of renders compared with the frames over the lens disc (H, W) bool, mean over the frames."""
    figures = [compare_images(frame.image, image, inside) for frame, image in zip(frames, shots, strict=True)]
    return {name: float(np.mean([getattr(each, name) for each in figures])) for name in vars(figures[0])}


def _pins_at_rest(path: Path, spec: SensorSpec) -> np.ndarray:
    """Pins (N, 2) of a raw frame without contact."""
    image, _ = read_image(path)
    observation = Pipeline(spec, Form.RAW)(Frame(image, Form.RAW, path.name))
    if not observation.valid:
        raise FrameError(f"{path.name}: {observation.reason}; give a raw frame without contact that shows every pin")
    require_even(spec.pins, observation.pins_px, path.name)  # the camera is not yet that of the specification
    return observation.pins_px


class _Log:
    """Results of the stages on disk, each named with the digest of its inputs."""

    def __init__(self, work: Path, spec: SensorSpec, raw: list[tuple[str, np.ndarray, np.ndarray]]) -> None:
        self._folder, self._inputs = work, inputs_digest(spec, raw)

    def align_frames(self, spec: SensorSpec, raw: list[tuple[str, np.ndarray, np.ndarray]], progress: Step) -> list[Aligned]:
        """Frames with their fitted skin, read from disk if it was stored. ``raw`` holds names, images, and pins (N, 2) px."""
        skin, frames = cache(partial(SkinFit, spec)), []  # takes seconds to build, and is not needed if all frames were stored

        def fit_skin(pins_px: np.ndarray) -> dict[str, np.ndarray]:
            return vars(skin()(pins_px))

        for name, image, pins_px in report_each(raw, progress):
            item = Item(f"skin-{Path(name).stem}", (SkinFit,), [spec, pins_px])
            found = kept_arrays(self._folder, item, partial(fit_skin, pins_px))
            frames.append(Aligned(name, image, pins_px, FittedPins(**found)))
        return frames

    def stage(self, name: str, run: Stage, spec: SensorSpec) -> SensorSpec:
        """The result of a stage, read from disk if it was stored."""
        item = Item(name, (__name__,), [self._inputs, spec])
        return SensorSpec.model_validate(kept_json(self._folder, item, lambda: run(spec).model_dump(mode="json")))


def write_page(out: Path, start: SensorSpec, found: Calibration, source: str) -> Path:
    """Write ``index.html`` and its pictures (of each frame those of ``KINDS``) to the folder ``out``, and return the page's path."""
    count = format_count(len(found.frames), "frames")
    lead = f"{count} of {source}. Figures: over the lens disc, renders without noise, the skin fitted to the pins."
    page = Page(f"Calibration of {found.spec.name}", "twin calibrate", topic="TacTip twin: calibration", lead=lead)
    page.notice("Worse than before the fit", found.warnings, tone="bad")
    page.table([{"of": "before", **found.before}, {"of": "after", **found.after}], [Column("of", ""), *image_columns(mark_best=True)])
    if found.notes:
        page.section("What these frames do not determine")
        page.items(found.notes)
    page.section("Frames")
    (out / "pictures").mkdir(parents=True, exist_ok=True)
    stems = distinct_stems([frame.name for frame in found.frames])
    for stem, frame, before, after in zip(stems, found.frames, found.first, found.last, strict=True):
        shown = []
        for (kind, comment), image in zip(KINDS.items(), (frame.image, before, after, difference_picture(frame.image, after)), strict=True):
            path, caption = out / "pictures" / f"{stem}-{kind}.png", f"{frame.name}, {comment}" if kind == "real" else comment
            shown.append(PagePicture(write_image(path, image), f"{frame.name}: {comment}", caption, "frame"))
        page.figures(*shown, layout="row")
    page.section("What changed")
    changed = [{**change, "name": code(change["name"])} for change in _changes(start, found.spec)]
    page.table(changed, [Column("name", "value"), Column("before", "before"), Column("after", "after")])
    return page.write(out / "index.html")


def _changes(before: SensorSpec, after: SensorSpec) -> list[dict[str, str]]:
    """All values that differ: ``name`` is section.key, ``before`` and ``after`` are texts."""
    old, new = before.model_dump(), after.model_dump()
    return [
        {"name": f"{section}.{key}", "before": _format_value(old[section][key]), "after": _format_value(value)}
        for section, values in new.items()
        if isinstance(values, dict) and old[section] is not None
        for key, value in values.items()
        if old[section][key] != value
    ]


def _format_value(value: object) -> str:
    """A value of a specification as the page shows it."""
    if isinstance(value, tuple | list):
        if len(value) > LONGEST or (value and not isinstance(value[0], float)):
            return f"{len(value)} entries"
        return ", ".join(_format_value(each) for each in value)
    return f"{value:.5g}" if isinstance(value, float) else str(value)
