"""The comparison's order of work: read, align, render, measure."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scenes.sensor import SensorSpec
from twin.camera import expose
from twin.geometry.mesh import SensorMesh
from twin.geometry.skin_fit import FittedPins, SkinFit
from twin.mechanics.solver import SkinSolver
from twin.optics.render import Renderer
from twin.preprocess.pipeline import Pipeline
from twin.progress import Bar, Progress
from twin.projection import project
from twin.realism.disc import Disc
from twin.realism.frames import RealFrame
from twin.realism.images import ImageFigures, compare_images
from twin.realism.poses import TapBank, TapMap, fit_taps, halves, mean_pin_error_px, tap, tap_labels
from twin.realism.statistics import FrameStatistics, Statistics, compare_statistics, measure_frame
from twin.recordings.forms import gray_levels
from twin.types import ContactState, Form

Quality = Literal["preview", "standard", "high"]


@dataclass(frozen=True)
class Pair:
    """A real frame and its render.

    Attributes
    ----------
    real : RealFrame
    image : (H, W) or (H, W, 3) uint8
        The rendered frame.
    figures : ImageFigures
    remainder_px : float
        Median distance by which the fitted skin misses the pins (pin-aligned), or mean error of the pins (pose-aligned).
    exact : bool
        The detector finds exactly all pins in the render.
    """

    real: RealFrame
    image: np.ndarray
    figures: ImageFigures
    remainder_px: float
    exact: bool


@dataclass(frozen=True)
class PoseAligned:
    """Renders from the labels alone.

    Attributes
    ----------
    tap_map : TapMap
    fitted : (M,) bool
        The frames that the map was fitted to.
    contacts : (M, 3) float
        Indentation in mm, n_x and n_y of each.
    pairs : list of Pair
    """

    tap_map: TapMap
    fitted: np.ndarray
    contacts: np.ndarray
    pairs: list[Pair]


def pin_aligned(spec: SensorSpec, frames: list[RealFrame], disc: Disc, *, quality: Quality, progress: Progress) -> list[Pair]:
    """Fit the skin to each frame's pins, render and capture it: this tests camera and light, not the mechanics."""
    fit, shoot, pairs = SkinFit(spec), _Shooter(spec, disc, quality), []
    for number, real in enumerate(frames):
        pins = fit(real.pins_px)
        pairs.append(shoot(real, pins, float(np.nanmedian(pins.remainder_px)), seed=number))
        progress(number + 1, len(frames))
    return pairs


def pose_aligned(spec: SensorSpec, frames: list[RealFrame], disc: Disc, *, quality: Quality, bar: Bar) -> PoseAligned:
    """Render each frame from its label alone, mechanics included. The arm's kinematics is fitted to one half of the frames.

    Raises
    ------
    FrameError
        The frames have no labels, or are too few.
    """
    labels, fitted = tap_labels([real.label for real in frames]), halves(len(frames))
    solver = SkinSolver(spec)
    with bar("simulate taps to fit the arm's kinematics") as progress:
        bank = TapBank(solver, labels, progress=progress)
    with bar("fit the arm's kinematics") as progress:

        def simulate(contacts: np.ndarray) -> np.ndarray:
            pins = []
            for contact in contacts:
                pins.append(project(spec, tap(solver, contact).caps_mm))
                progress(len(pins), len(contacts))
            return np.array(pins)

        tap_map = fit_taps(bank, labels[fitted], np.stack([real.pins_px for real in frames])[fitted], simulate=simulate)
    contacts, shoot, pairs = tap_map.contact(labels), _Shooter(spec, disc, quality, mesh=solver.mesh), []
    with bar("press and render from the labels") as progress:
        for number, (real, contact) in enumerate(zip(frames, contacts, strict=True)):
            state = tap(solver, contact)
            error_px = mean_pin_error_px(project(spec, state.caps_mm), real.pins_px)
            pairs.append(shoot(real, state, float(error_px), seed=number))
            progress(number + 1, len(frames))
    return PoseAligned(tap_map, fitted, contacts, pairs)


def statistics(pairs: list[Pair], disc: Disc, *, progress: Progress) -> Statistics:
    """Real against pin-aligned renders: caps, skin, noise, spectrum, spots."""
    sets: tuple[list[FrameStatistics], list[FrameStatistics]] = ([], [])
    for number, pair in enumerate(pairs):
        for measured, image in zip(sets, (pair.real.frame.image, pair.image), strict=True):
            measured.append(measure_frame(gray_levels(image), pair.real.pins_px, disc))
        progress(number + 1, len(pairs))
    return compare_statistics(*sets)


class _Shooter:
    """Renders states beside real frames and compares them."""

    def __init__(self, spec: SensorSpec, disc: Disc, quality: Quality, mesh: SensorMesh | None = None):
        self._spec, self._disc = spec, disc
        self._renderer = Renderer(spec, quality=quality, mesh=mesh)
        self._pipeline = Pipeline(spec, Form.RAW)

    def __call__(self, real: RealFrame, state: FittedPins | ContactState, remainder_px: float, *, seed: int) -> Pair:
        image = expose(self._renderer.render(state, seed=seed), self._spec, np.random.default_rng(seed))
        seen = self._pipeline(replace(real.frame, image=image))
        exact = seen.valid and seen.found == len(seen.pins_px)
        recorded = real.frame.image if image.ndim == real.frame.image.ndim else real.gray
        return Pair(real, image, compare_images(recorded, image, self._disc.inside), remainder_px, exact)
