"""A whole calibration of camera and light: from a folder of frames to a specification and a page.

The calibration runs in stages. Each stage's result is kept, so that an interrupted run goes on where it was. The page shows renders
before and after the fit, what is left, and what changed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from scenes.sensor import SensorSpec
from twin.camera.capture import expose
from twin.camera.projection import lens_disc
from twin.errors import FrameError
from twin.fit.camera_pose import fit_camera
from twin.fit.caps import fit_caps
from twin.fit.photometry import fit_photometry
from twin.fit.response import fit_blur, fit_focus, fit_noise, fit_response, sharpness
from twin.fit.rim import fit_rim
from twin.fit.sensor_file import folder_beside, write_sensor
from twin.fit.surroundings import fit_surroundings
from twin.frames.images import read_image, write_image
from twin.judge.pictures.aligned import Aligned, read_frames, revised
from twin.judge.pictures.images import compare_images, difference_picture
from twin.judge.pictures.report import image_columns
from twin.mechanics.skin_fit import FittedPins, SkinFit
from twin.optics.render import Renderer
from twin.pins.pipeline import Pipeline
from twin.progress import Bar, Progress, Step, silent, stage
from twin.report.page import Page, Picture, code
from twin.report.table import Column
from twin.store import Item, inputs_digest, kept_arrays, kept_json
from twin.types import Form, Frame

FRAMES = 6
"""Number of frames that are fitted, evenly spread over the folder."""
SAMPLES = 16
"""Samples a pixel of the renders."""
CAP_ROUNDS = 2
"""Rounds of fitting caps and response in turn."""
HAZE_SIGMA_PX = 40.0
"""Width of the haze to start from, px, where the specification has none."""
LONGEST = 12
"""The page shows lists of at most this many numbers; it tells the length of longer ones."""
KINDS = {"real": "real", "before": "before", "after": "after", "residual": "what is left, twice amplified about middle gray"}
"""Kinds of pictures of a frame on the page, with their captions."""
ALWAYS = (
    "the response curve (gamma, black level): held; photograph a gray card at several exposures to know it",
    "LED power, exposure and reflectance: only their product is seen; the caps' brightest channel is taken as white resin",
    "the window's thickness and index, and the skin's thickness: held",
)
"""What no set of frames determines."""
Stage = Callable[[SensorSpec], SensorSpec]
"""One stage of the fit: from a specification to a better one."""


@dataclass(frozen=True)
class Calibration:
    """A fitted camera and light.

    Attributes
    ----------
    spec : SensorSpec
        The fitted specification.
    before, after : dict of str to float
        Image figures over the disc, mean of the frames: ``psnr_db``, ``ssim`` (colour) and so on.
    notes : list of str
        What the frames do not determine, and what was left out.
    frames : list of Aligned
        Frames to which it was fitted.
    first, last : list of (H, W[, 3]) uint8
        Renders under the specification at the start and at the end.
    """

    spec: SensorSpec
    before: dict[str, float]
    after: dict[str, float]
    notes: list[str]
    frames: list[Aligned]
    first: list[np.ndarray]
    last: list[np.ndarray]


@dataclass(frozen=True)
class OpticsCalibration:
    """A fitted specification and the files of it, the ``.toml`` file first."""

    found: Calibration
    written: list[Path]

    def lines(self) -> list[str]:
        """For people: what the frames could not tell, and how near the twin came."""
        before, after = self.found.before, self.found.after
        return [
            *(f"note: {note}" for note in self.found.notes),
            f"over the disc: PSNR {before['psnr_db']:.2f} -> {after['psnr_db']:.2f} dB, SSIM {before['ssim']:.3f} -> {after['ssim']:.3f}",
        ]


class _Studio:
    """Renders the states of frames under changing specifications."""

    def __init__(self, bar: Bar, samples: int = SAMPLES) -> None:
        self._bar, self._samples = bar, samples

    def light(self, spec: SensorSpec, frames: list[Aligned], title: str) -> list[np.ndarray]:
        """Linear light (H, W[, channels]) of every frame's state."""
        renderer, light = Renderer(spec, spp=self._samples), []
        with self._bar(title) as progress:
            for done, frame in enumerate(frames):
                light.append(renderer.render(frame.state, seed=done))
                progress(done + 1, len(frames))
        return light

    def shots(self, spec: SensorSpec, frames: list[Aligned], title: str) -> list[np.ndarray]:
        """Renders (H, W[, 3]) uint8 of every frame's state, captured without noise."""
        return [expose(light, spec.capture) for light in self.light(spec, frames, title)]


def calibrate_optics(
    frames: Path, sensor: SensorSpec, out: Path, *, limit: int = FRAMES, no_contact: Path | None = None, progress: Progress = silent
) -> OpticsCalibration:
    """Fit camera and light of a specification to a folder of raw frames, and write it.

    Beside the specification a folder ``NAME-calibration`` holds the page and the stages' results: an interrupted run goes on there.

    Parameters
    ----------
    sensor : SensorSpec
        Where the fit starts.
    out : Path
        The ``.toml`` file to write.
    limit, no_contact
        As ``fit_optics`` takes them.

    Raises
    ------
    FrameError
        No frame can be used, or ``out`` is no name of a ``.toml`` file.
    RenderError
        Nothing can be rendered, or differentiated, here.
    """
    folder = folder_beside(out, "calibration")
    found = fit_optics(frames, sensor, folder, limit=limit, no_contact=no_contact, progress=progress)
    write_sensor(out, found.spec, f"Fitted to {len(found.frames)} frames of {frames.name}, starting from {sensor.name}.")
    return OpticsCalibration(found, [out, write_page(folder, sensor, found, frames.name)])


def fit_optics(
    folder: Path,
    spec: SensorSpec,
    work: Path,
    *,
    limit: int = FRAMES,
    no_contact: Path | None = None,
    progress: Progress = silent,
) -> Calibration:
    """Fit a specification to raw frames of a sensor in contact.

    Parameters
    ----------
    folder : Path
        Folder of raw frames.
    spec : SensorSpec
        Where the fit starts: geometry and camera of the same kind of sensor.
    work : Path
        Folder for the stages' results. A second run with the same frames, start and code goes on from there.
    limit : int
        Number of frames to fit.
    no_contact : Path, optional
        A raw frame without contact, to which the camera is fitted first.
    progress : Progress

    Raises
    ------
    FrameError
        No frame can be used, or their sizes differ.
    RenderError
        Nothing can be rendered, or differentiated, here.
    """
    notes, bar = list(ALWAYS), partial(stage, progress)
    if no_contact is not None:
        spec, report = fit_camera(spec, _pins_at_rest(no_contact, spec))
        notes += [f"camera fitted to {report.pins} pins, {report.rms_px:.2f} px rms", *report.held.values()]
    with bar("read the frames, find their pins") as step:
        raw = read_frames(folder, spec, limit, step)
    log = _Log(work, spec, raw)
    with bar("fit the skin to the pins") as step:
        frames = log.aligned(spec, raw, step)
    inside, studio = lens_disc(spec).inside, _Studio(bar)
    first = studio.shots(spec, frames, "render the start")
    for number, fit in enumerate(_stages(frames, inside, studio, bar)):
        spec = log.stage(f"{number:02d}-{fit.__name__}", fit, spec)
    last = studio.shots(spec, frames, "render the result")
    before, after = (_mean_figures(frames, shots, inside) for shots in (first, last))
    return Calibration(spec, before, after, notes, frames, first, last)


def _stages(frames: list[Aligned], inside: np.ndarray, studio: _Studio, bar: Bar) -> list[Stage]:
    """The stages of a fit to frames, in their order; ``inside`` (H, W) bool: the lens disc. A stage's name names its kept result."""

    def surroundings(spec: SensorSpec) -> SensorSpec:
        with bar("fit the ring, the reflections, the specks") as step:
            found = fit_surroundings(spec, np.stack([f.image for f in frames]), np.stack([f.pins_px for f in frames]), progress=step)
        return found if found.gel.haze else revised(found, gel={"haze_sigma_px": HAZE_SIGMA_PX})

    def photometry(spec: SensorSpec) -> SensorSpec:
        with bar("fit lights and colours") as step:
            return fit_photometry(spec, frames, step).spec

    def defocus(spec: SensorSpec) -> SensorSpec:
        shots = studio.shots(spec, frames, "render for the sharpness")
        return fit_focus(spec, sharpness(spec, frames, shots))

    def response(spec: SensorSpec) -> SensorSpec:
        light = studio.light(spec, frames, "render for the response")
        return fit_blur(fit_response(spec, frames, light, inside), frames, light)

    def caps(spec: SensorSpec) -> SensorSpec:
        return fit_caps(spec, frames, lambda s, f: studio.shots(s, f, "render for the caps"))

    def rim(spec: SensorSpec) -> SensorSpec:
        return fit_rim(spec, frames, studio.light(spec, frames, "render for the rim"))

    def noise(spec: SensorSpec) -> SensorSpec:
        return fit_noise(spec, frames, studio.light(spec, frames, "render for the noise"))

    return [surroundings, photometry, caps, response, defocus, *[caps, response] * (CAP_ROUNDS - 1), rim, noise]


def _mean_figures(frames: list[Aligned], shots: list[np.ndarray], inside: np.ndarray) -> dict[str, float]:
    """Image figures of renders against the frames over the lens disc (H, W) bool, mean of the frames."""
    figures = [compare_images(frame.image, image, inside) for frame, image in zip(frames, shots, strict=True)]
    return {name: float(np.mean([getattr(each, name) for each in figures])) for name in vars(figures[0])}


def _pins_at_rest(path: Path, spec: SensorSpec) -> np.ndarray:
    """Pins (N, 2) of a raw frame without contact."""
    if not path.is_file():
        raise FrameError(f"{path}: no such frame")
    image, _ = read_image(path)
    observation = Pipeline(spec, Form.RAW)(Frame(image, Form.RAW, path.name))
    if not observation.valid:
        raise FrameError(f"{path.name}: {observation.reason}; give a raw frame without contact that shows every pin")
    return observation.pins_px


class _Log:
    """Results of the stages on disk, each under the digest of what it was made of."""

    def __init__(self, work: Path, spec: SensorSpec, raw: list[tuple[str, np.ndarray, np.ndarray]]) -> None:
        self._folder, self._inputs = work, inputs_digest(spec, raw)

    def aligned(self, spec: SensorSpec, raw: list[tuple[str, np.ndarray, np.ndarray]], progress: Step) -> list[Aligned]:
        """Frames with their fitted skin, from disk where it is there. ``raw``: names, images, and pins (N, 2) px."""
        fit: SkinFit | None = None
        frames = []

        def fitted(pins_px: np.ndarray) -> dict[str, np.ndarray]:
            nonlocal fit
            fit = fit or SkinFit(spec)  # it takes seconds to build, and is not needed where all frames are there
            return vars(fit(pins_px))

        for done, (name, image, pins_px) in enumerate(raw):
            item = Item(f"skin-{Path(name).stem}", (SkinFit,), [spec, pins_px])
            found = kept_arrays(self._folder, item, partial(fitted, pins_px))
            frames.append(Aligned(name, image, pins_px, FittedPins(**found)))
            progress(done + 1, len(raw))
        return frames

    def stage(self, name: str, run: Stage, spec: SensorSpec) -> SensorSpec:
        """The stage's result, from disk where it is there."""
        item = Item(name, (__name__,), [self._inputs, spec])
        return SensorSpec.model_validate(kept_json(self._folder, item, lambda: run(spec).model_dump(mode="json")))


def write_page(out: Path, start: SensorSpec, found: Calibration, source: str) -> Path:
    """Write ``index.html`` and its pictures into ``out``; the page's path."""
    rows = _write_pictures(out / "pictures", found)
    lead = (
        f"{len(rows)} frames of {source}. Figures are over the lens disc, of renders without noise, the skin fitted to each frame's pins."
    )
    page = Page(f"Calibration of {found.spec.name}", "twin calibrate", topic="TacTip twin: calibration", lead=lead)
    figures: list[dict[str, object]] = [{"of": "before", **found.before}, {"of": "after", **found.after}]
    page.table(figures, [Column("of", ""), *image_columns(mark_best=True)])
    if found.notes:
        page.section("What these frames do not determine")
        page.items(found.notes)
    page.section("Frames")
    for name, pictures in rows:
        shown = [Picture(pictures[k], f"{name}: {said}", f"{name}, {said}" if k == "real" else said, "frame") for k, said in KINDS.items()]
        page.figures(*shown, layout="row")
    page.section("What changed")
    changed = [{**change, "name": code(change["name"])} for change in _changes(start, found.spec)]
    page.table(changed, [Column("name", "value"), Column("before", "before"), Column("after", "after")])
    return page.write(out / "index.html")


def _write_pictures(folder: Path, found: Calibration) -> list[tuple[str, dict[str, Path]]]:
    """Write four pictures of each frame (see ``KINDS``); the frame's name, and the pictures' paths by kind."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for frame, before, after in zip(found.frames, found.first, found.last, strict=True):
        images = {"real": frame.image, "before": before, "after": after, "residual": difference_picture(frame.image, after)}
        stem = Path(frame.name).stem
        rows.append((frame.name, {kind: write_image(folder / f"{stem}-{kind}.png", image) for kind, image in images.items()}))
    return rows


def _changes(before: SensorSpec, after: SensorSpec) -> list[dict]:
    """Every value that differs: ``name`` as section.key, ``before`` and ``after`` as text."""
    old, new = before.model_dump(), after.model_dump()
    found = []
    for section, values in new.items():
        if isinstance(values, dict):
            found += [
                {"name": f"{section}.{key}", "before": _shown(old[section][key]), "after": _shown(value)}
                for key, value in values.items()
                if old[section] is not None and old[section][key] != value
            ]
    return found


def _shown(value: object) -> str:
    """A value of a specification as the page shows it."""
    if isinstance(value, tuple | list):
        if len(value) > LONGEST or (value and not isinstance(value[0], float)):
            return f"{len(value)} entries"
        return ", ".join(_shown(each) for each in value)
    return f"{value:.5g}" if isinstance(value, float) else str(value)
