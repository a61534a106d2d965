"""The steps of the comparison: read, align, render, measure."""

from dataclasses import dataclass, replace

import numpy as np

from scenes import load_experiment
from scenes.rig import RigSpec
from scenes.sensor import Polarity, SensorSpec
from twin.camera.capture import expose
from twin.camera.projection import Disc, project
from twin.evaluation.labelled.compare import pin_errors
from twin.evaluation.pictures import poses
from twin.evaluation.pictures.fixed import cap_patches, fixed_share
from twin.evaluation.pictures.frames import RealFrame
from twin.evaluation.pictures.images import ImageFigures, compare_images
from twin.evaluation.pictures.statistics import FrameStatistics, Statistics, compare_statistics, measure_frame
from twin.frames.forms import gray_levels
from twin.geometry.mesh import SensorMesh
from twin.mechanics.skin_fit import FittedPins, SkinFit
from twin.mechanics.solver import SkinSolver
from twin.optics.render import Renderer
from twin.pins.pipeline import Pipeline
from twin.progress import Bar, Step, report_each
from twin.rig.kinematics import rig_of
from twin.types import ContactState, Form, Quality


@dataclass(frozen=True)
class Pair:
    """A real frame and its render.

    Attributes
    ----------
    real : RealFrame
    state : FittedPins or ContactState
        What was rendered.
    image : (H, W) or (H, W, 3) uint8
        The rendered frame.
    figures : ImageFigures
    remainder_px : float
        Median distance between the fitted skin's pins and the real ones (pin-aligned), or mean error of the pins (pose-aligned).
    exact : bool
        Whether the detector finds exactly all pins in the render.
    """

    real: RealFrame
    state: FittedPins | ContactState
    image: np.ndarray
    figures: ImageFigures
    remainder_px: float
    exact: bool


@dataclass(frozen=True)
class PoseAligned:
    """Renders from the labels alone.

    Attributes
    ----------
    rig : RigSpec
        The fitted rig.
    fitted : (M,) bool
        The frames that the rig was fitted to.
    contacts : (M, 3) float
        Indentation in mm, n_x and n_y of each frame's contact.
    pairs : list of Pair
    """

    rig: RigSpec
    fitted: np.ndarray
    contacts: np.ndarray
    pairs: list[Pair]


def pin_aligned(spec: SensorSpec, frames: list[RealFrame], disc: Disc, *, quality: Quality, progress: Step) -> list[Pair]:
    """Fit the skin to each frame's pins, render and capture it. This tests camera and light, but not the mechanics."""
    fit, shoot, pairs = SkinFit(spec), _Shooter(spec, disc, quality), []
    for number, real in enumerate(report_each(frames, progress)):
        pins = fit(real.pins_px)
        pairs.append(shoot(real, pins, float(np.nanmedian(pins.remainder_px)), seed=number))
    return pairs


def pose_aligned(spec: SensorSpec, frames: list[RealFrame], disc: Disc, *, quality: Quality, bar: Bar) -> PoseAligned:
    """Render each frame from its label alone, which includes the mechanics. The arm's rig is fitted to one half of the frames.

    Raises
    ------
    FrameError
        The frames have no labels, or are too few.
    """
    experiment, apex_mm = load_experiment(poses.EXPERIMENT), spec.skin.apex_mm
    labels, fitted = poses.labels_of_rows([real.label for real in frames], experiment), poses.halves(len(frames))
    learnt = [label for label, used in zip(labels, fitted, strict=True) if used]
    solver, start = SkinSolver(spec), rig_of(spec)
    taps = poses.PlateTaps(solver, experiment)
    with bar("simulate taps to fit the arm's rig") as progress:
        spread = poses.bank_labels(start, experiment, labels, apex_mm)
        bank = poses.TapBank(poses.contacts_of(start, experiment, spread, apex_mm), taps.pins_px(start, spread, progress))
    with bar("fit the arm's rig") as progress:
        seen_px = np.stack([real.pins_px for real in frames])[fitted]
        rig = poses.fit_rig(bank, start, experiment, learnt, seen_px, apex_mm, simulate=lambda tried: taps.pins_px(tried, learnt, progress))
    contact, shoot, pairs = taps.contact(rig), _Shooter(spec, disc, quality, mesh=solver.mesh), []
    with bar("press and render from the labels") as progress:
        for number, (real, label) in enumerate(report_each(list(zip(frames, labels, strict=True)), progress)):
            state = contact.end(label)
            error_px = pin_errors(project(spec.view, state.caps_mm), real.pins_px)
            pairs.append(shoot(real, state, float(error_px), seed=number))
    return PoseAligned(rig, fitted, poses.contacts_of(rig, experiment, labels, apex_mm), pairs)


def statistics(pairs: list[Pair], disc: Disc, polarity: Polarity, *, progress: Step) -> Statistics:
    """Compare real frames with pin-aligned renders: caps, skin, noise, spectrum, spots."""
    sets: tuple[list[FrameStatistics], list[FrameStatistics]] = ([], [])
    for pair in report_each(pairs, progress):
        for measured, image in zip(sets, (pair.real.frame.image, pair.image), strict=True):
            measured.append(measure_frame(gray_levels(image), pair.real.pins_px, disc, polarity=polarity))
    return compare_statistics(*sets)


def fixed_residual(spec: SensorSpec, pairs: list[Pair]) -> dict[str, float] | None:
    """What pin-aligned renders miss on the caps: ``levels``, its rms in gray levels, and ``share``, by ``fixed_share``.

    None if there is one pair only, or nothing is missed.
    """
    patches = np.stack([cap_patches(spec.view, spec.pins, pair.state, pair.real.like(pair.image), pair.image) for pair in pairs])
    share = fixed_share(patches)
    return {"levels": float(np.sqrt(np.mean(patches**2))), "share": share} if np.isfinite(share) else None


class _Shooter:
    """Renders states and compares the renders with real frames."""

    def __init__(self, spec: SensorSpec, disc: Disc, quality: Quality, mesh: SensorMesh | None = None):
        self._spec, self._disc = spec, disc
        self._renderer = Renderer(spec, quality=quality, mesh=mesh)
        self._pipeline = Pipeline(spec, Form.RAW)

    def __call__(self, real: RealFrame, state: FittedPins | ContactState, remainder_px: float, *, seed: int) -> Pair:
        image = expose(self._renderer.render(state, seed=seed), self._spec.capture, np.random.default_rng(seed))
        seen = self._pipeline(replace(real.frame, image=image))
        return Pair(real, state, image, compare_images(real.like(image), image, self._disc.inside), remainder_px, seen.complete)
