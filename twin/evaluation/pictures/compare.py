"""Comparison of real frames with their renders: aligned by their pins, or from their labels alone.

For the second the rig's kinematics give the contact of a label (``twin.rig``). Because the rig of a recording may not have been calibrated,
seven of its parameters are fitted to one part of the frames: contact offset, tool point in three directions, the image's turn, and the
offsets of the two turns that tilt the sensor. Both values of the robot's handedness (``turn_sign``) are tried. The twin's contact model is
then applied to all frames.

The pins of a tap are a smooth function of the indentation and the plate's normal in the sensor frame. While the rig is fitted, this
function is approximated by a cubic polynomial fitted to simulated taps. In a second round the polynomial's errors at the contacts of the
first round are corrected.

Pictures are compared over the lens disc. The figures are PSNR, SSIM (Wang et al. 2004, computed by scikit-image) and FLIP (Andersson et
al. 2020). FLIP is the difference, from 0 to 1, that is visible when both pictures alternate on a normal screen (67 px per degree). Outside
the disc both pictures are made equal, so that these pixels do not affect SSIM and FLIP near the disc's edge.

A part of what renders miss on the caps is a picture fixed to each cap (``fixed_share``), which a better relief could hold.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import cv2
import flip_evaluator
import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from skimage.metrics import structural_similarity

from scenes import load_experiment, load_object
from scenes.experiment import ExperimentSpec
from scenes.rig import RigSpec
from scenes.sensor import PinsSpec, Polarity, SensorSpec, ViewSpec
from twin.camera.capture import expose
from twin.camera.projection import Disc, project
from twin.errors import FrameError
from twin.evaluation.labelled.model import pin_errors
from twin.evaluation.pictures.aligned import RealFrame
from twin.evaluation.pictures.statistics import FrameStatistics, Statistics
from twin.frames.forms import gray_levels
from twin.mechanics.skin_fit import FittedPins, SkinFit
from twin.mechanics.solver import SkinSolver
from twin.optics.relief import SKIN_FROM, cap_planes
from twin.optics.render import Renderer
from twin.pins.pipeline import Pipeline
from twin.progress import Bar, Step, report_each
from twin.rig.contact import RigContact
from twin.rig.kinematics import object_pose, rig_of
from twin.rig.labels import ArmLabel
from twin.types import ContactState, FloatArray, Form, ImageArray, PinState, Quality

# Range of 8-bit gray levels.
LEVELS = 255.0
# Amplification of the difference picture.
CHANGE_GAIN = 2
# Places along the diameter of a cap and its edge at which a difference is read.
PLACES = 19
# Experiment of recordings whose labels are depth and two tilts.
EXPERIMENT = "surface-3d"
# Number of simulated taps: twice the 20 terms of the polynomial.
BANK_TAPS = 40
# Margins of the simulated taps' depths below and above the labelled depths, mm, because the fitted contact offset is added to these.
BANK_BELOW_MM, BANK_ABOVE_MM = 1.5, 2.5
# Least indentation of a simulated tap, mm.
LEAST_INDENT_MM = 0.3
# Margin of the simulated taps' tilts beyond the labelled tilts, deg.
BANK_MARGIN_DEG = 3.0
# Degree of the polynomial.
DEGREE = 3
# Rotations that are added to the rig's ``image_turn_deg`` at the starts of the fit, deg.
TURNS_DEG = (0.0, 90.0, 180.0, 270.0)
# Least number of frames to fit to.
FEWEST = 2
# Number of fitted parameters.
PARAMETERS = 7


@dataclass(frozen=True)
class ImageFigures:
    """Similarity of one pair: PSNR in dB (inf: identical), SSIM (1: identical), FLIP (0: identical); ``psnr_whole_db``: of whole frames."""

    psnr_db: float
    psnr_gray_db: float
    ssim: float
    ssim_gray: float
    flip: float
    psnr_whole_db: float


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
    pairs : list of Pair
    """

    rig: RigSpec
    fitted: np.ndarray
    pairs: list[Pair]


def pin_aligned(spec: SensorSpec, frames: list[RealFrame], disc: Disc, *, quality: Quality, progress: Step) -> list[Pair]:
    """Fit the skin to each frame's pins, render and capture it. This tests camera and light, but not the mechanics."""
    fitted = map(SkinFit(spec), (real.pins_px for real in report_each(frames, progress)))
    states = ((real, pins, float(np.nanmedian(pins.remainder_px))) for real, pins in zip(frames, fitted, strict=True))
    return _pairs(Renderer(spec, quality=quality), disc, states)


def pose_aligned(spec: SensorSpec, frames: list[RealFrame], disc: Disc, *, quality: Quality, bar: Bar) -> PoseAligned:
    """Render each frame from its label alone, which includes the mechanics. The arm's rig is fitted to one half of the frames.

    Raises
    ------
    FrameError
        The frames have no labels, or are too few.
    """
    experiment, apex_mm = load_experiment(EXPERIMENT), spec.skin.apex_mm
    labels, fitted = labels_of_rows([real.label for real in frames], experiment), halves(len(frames))
    learnt = [label for label, used in zip(labels, fitted, strict=True) if used]
    solver, start = SkinSolver(spec), rig_of(spec)
    taps = partial(plate_taps, solver, experiment)
    with bar("simulate taps to fit the arm's rig") as progress:
        spread = bank_labels(start, experiment, labels, apex_mm)
        bank = TapBank(contacts_of(start, experiment, spread, apex_mm), tapped_px(taps(start), spread, progress))
    with bar("fit the arm's rig") as progress:
        seen_px = np.stack([real.pins_px for real in frames])[fitted]
        rig = fit_rig(bank, start, experiment, learnt, seen_px, apex_mm, simulate=lambda tried: tapped_px(taps(tried), learnt, progress))
    contact = taps(rig)

    def press(progress: Step) -> Iterator[tuple[RealFrame, ContactState, float]]:
        """The frames, their labels' contacts, and the pins' errors."""
        for real, label in report_each(list(zip(frames, labels, strict=True)), progress):
            state = contact.end(label)
            yield real, state, float(pin_errors(project(spec.view, state.caps_mm), real.pins_px))

    with bar("press and render from the labels") as progress:
        return PoseAligned(rig, fitted, _pairs(Renderer(spec, quality=quality, mesh=solver.mesh), disc, press(progress)))


def statistics(pairs: list[Pair], disc: Disc, polarity: Polarity, *, progress: Step) -> Statistics:
    """Compare real frames with pin-aligned renders: caps, skin, noise, spectrum, spots."""
    sets: tuple[list[FrameStatistics], list[FrameStatistics]] = ([], [])
    for pair in report_each(pairs, progress):
        for measured, image in zip(sets, (pair.real.frame.image, pair.image), strict=True):
            measured.append(FrameStatistics(gray_levels(image), pair.real.pins_px, disc, polarity=polarity))
    return Statistics(*sets)


def fixed_residual(spec: SensorSpec, pairs: list[Pair]) -> dict[str, float] | None:
    """What pin-aligned renders miss on the caps: ``levels``, its rms in gray levels, and ``share``, by ``fixed_share``.

    None if there is one pair only, or nothing is missed.
    """
    patches = np.stack([cap_patches(spec.view, spec.pins, pair.state, pair.real.like(pair.image), pair.image) for pair in pairs])
    share = fixed_share(patches)
    return {"levels": float(np.sqrt(np.mean(patches**2))), "share": share} if np.isfinite(share) else None


def _pairs(renderer: Renderer, disc: Disc, states: Iterable[tuple[RealFrame, FittedPins | ContactState, float]]) -> list[Pair]:
    """Renders of states, compared with their real frames. A state's remainder in px follows it."""
    spec, pipeline, pairs = renderer.spec, Pipeline(renderer.spec, Form.RAW), []
    for seed, (real, state, remainder_px) in enumerate(states):
        image = expose(renderer.render(state, seed=seed), spec.capture, np.random.default_rng(seed))
        seen = pipeline(replace(real.frame, image=image))
        pairs.append(Pair(real, state, image, compare_images(real.like(image), image, disc.inside), remainder_px, seen.complete))
    return pairs


def label_columns(experiment: ExperimentSpec) -> tuple[str, ...]:
    """The columns that an experiment's labels must have: the coordinates of the pose that the experiment varies."""
    return tuple(name for name, (low, high) in experiment.ranges().items() if name.startswith("pose") and low != high)


def labels_of_rows(rows: list[dict[str, float]], experiment: ExperimentSpec) -> list[ArmLabel]:
    """The arm's labels from frames' rows. A coordinate that the experiment does not vary is 0 if the table does not have it.

    Raises
    ------
    FrameError
        A frame lacks a column that the experiment varies.
    """
    missing = [name for name in label_columns(experiment) if any(not np.isfinite(row.get(name, np.nan)) for row in rows)]
    if missing:
        raise FrameError(f"targets.csv: no number in column {', '.join(missing)} for some frames; without it leave out `pose_aligned`")
    poses, moves = (np.array([[row.get(f"{kind}_{k}", 0.0) for k in range(1, 7)] for row in rows]) for kind in ("pose", "move"))
    return [ArmLabel(pose, move) for pose, move in zip(poses, moves, strict=True)]


def contacts_of(rig: RigSpec, experiment: ExperimentSpec, labels: list[ArmLabel], radius_mm: float) -> np.ndarray:
    """Commanded indentation of a flat plate in mm, and n_x and n_y of its normal in the sensor frame, (m, 3)."""
    poses = np.stack([object_pose(rig, experiment, label.pose, radius_mm) for label in labels])
    normal = poses[:, :3, 2]
    return np.column_stack([radius_mm - np.einsum("mi,mi->m", normal, poses[:, :3, 3]), normal[:, :2]])


def plate_taps(solver: SkinSolver, experiment: ExperimentSpec, rig: RigSpec) -> RigContact:
    """The contact model of taps on a flat plate with a rig, including the rig's friction and compliances."""
    return RigContact(solver, experiment, load_object("plane"), rig=rig)


def tapped_px(taps: RigContact, labels: list[ArmLabel], progress: Step) -> np.ndarray:
    """Pins (m, N, 2) px of the labels' taps."""
    return np.array([project(taps.solver.spec.view, taps.end(label).caps_mm) for label in report_each(labels, progress)])


class TapBank:
    """Pins of taps as a polynomial of indentation and normal, fitted to simulated taps.

    Parameters
    ----------
    contacts : (k, 3) float
        Contacts as ``contacts_of`` gives them.
    pins_px : (k, N, 2) float
        Their pins.
    """

    def __init__(self, contacts: np.ndarray, pins_px: np.ndarray) -> None:
        self._scale = np.abs(contacts).max(axis=0)
        self._coefficients = np.linalg.lstsq(self._terms(contacts), pins_px.reshape(len(pins_px), -1), rcond=None)[0]

    def pins_px(self, contacts: np.ndarray) -> np.ndarray:
        """Pins (m, N, 2) px of contacts (m, 3)."""
        return (self._terms(contacts) @ self._coefficients).reshape(len(contacts), -1, 2)

    def _terms(self, contacts: np.ndarray) -> np.ndarray:
        powers = [p for p in product(range(DEGREE + 1), repeat=3) if sum(p) <= DEGREE]
        return np.prod((contacts / self._scale)[:, None] ** np.array(powers), axis=2)


def bank_labels(rig: RigSpec, experiment: ExperimentSpec, labels: list[ArmLabel], radius_mm: float) -> list[ArmLabel]:
    """Labels that cover the range of contacts which the given labels may have with any fitted rig."""
    from scipy.stats.qmc import Sobol

    axis, turns = experiment.axis, tilts_of(experiment)
    depth = np.array([label.pose[axis] for label in labels]) + experiment.zero_mm
    steepest_deg = np.hypot(*np.array([label.pose[turns] for label in labels]).T).max() + BANK_MARGIN_DEG
    shallowest, deepest = max(depth.min() - BANK_BELOW_MM, LEAST_INDENT_MM), depth.max() + BANK_ABOVE_MM
    out = []
    for share, radial, angle in Sobol(3, seed=0).random_base2(int(np.ceil(np.log2(BANK_TAPS))))[:BANK_TAPS]:
        tilt = steepest_deg * np.sqrt(radial) * np.exp(2j * np.pi * angle)
        pose = np.zeros(6)
        pose[turns] = np.array([tilt.real, tilt.imag]) - np.array(rig.turn_offset_deg)[np.array(turns) - 3]
        wanted_mm = shallowest + (deepest - shallowest) * share
        for _ in range(2):  # without the plate's tilt the indentation is linear in the label, so that two rounds are enough
            pose[axis] += wanted_mm - contacts_of(rig, experiment, [ArmLabel(pose, np.zeros(6))], radius_mm)[0, 0]
        out.append(ArmLabel(pose, np.zeros(6)))
    return out


def tilts_of(experiment: ExperimentSpec) -> list[int]:
    """Indices in a pose of the two turns that tilt the sensor against the plate."""
    return [3 + k for k in range(3) if k != experiment.axis]


def fit_rig(
    bank: TapBank,
    start: RigSpec,
    experiment: ExperimentSpec,
    labels: list[ArmLabel],
    pins_px: np.ndarray,
    radius_mm: float,
    *,
    simulate: Callable[[RigSpec], np.ndarray] | None = None,
) -> RigSpec:
    """Fit the rig to the pins (m, N, 2) px of labelled frames by least squares.

    Parameters
    ----------
    start : RigSpec
        The rig at the start. Its friction, compliances and plate tilt are not changed.
    simulate : callable, optional
        Returns the simulated pins (m, N, 2) px of the labels with a rig. If it is given, there is a second round.

    Raises
    ------
    FrameError
        There are too few frames.
    """
    if len(labels) < FEWEST:
        raise FrameError(
            f"too few labelled frames ({len(labels)}) to fit the arm's rig to; give at least {2 * FEWEST}, half are for the test"
        )
    seen = np.isfinite(pins_px)

    def solve(rig: RigSpec, wanted_px: np.ndarray) -> OptimizeResult:
        def residuals(x: np.ndarray) -> np.ndarray:
            contacts = contacts_of(_with_parameters(rig, experiment, x), experiment, labels, radius_mm)
            return (bank.pins_px(contacts) - wanted_px)[seen]

        return least_squares(residuals, np.zeros(PARAMETERS))

    views = product(TURNS_DEG, (start.turn_sign, -start.turn_sign))
    tries = [start.alter(turn_sign=sign, image_turn_deg=start.image_turn_deg + turn) for turn, sign in views]
    found = [solve(rig, pins_px) for rig in tries]
    best = int(np.argmin([each.cost for each in found]))
    rig = _with_parameters(tries[best], experiment, found[best].x)
    if simulate is None:
        return rig
    missed_px = simulate(rig) - bank.pins_px(contacts_of(rig, experiment, labels, radius_mm))
    return _with_parameters(rig, experiment, solve(rig, pins_px - missed_px).x)


def _with_parameters(rig: RigSpec, experiment: ExperimentSpec, x: np.ndarray) -> RigSpec:
    """The rig with its fitted parameters changed by ``x`` (PARAMETERS,), each in a unit in which the change is of order 1."""
    offsets = np.array(rig.turn_offset_deg)
    offsets[np.array(tilts_of(experiment)) - 3] += 10 * x[5:]
    return rig.alter(
        contact_offset_mm=rig.contact_offset_mm + float(x[0]),
        tcp_to_dome_mm=rig.tcp_to_dome_mm + 10 * float(x[1]),
        tcp_lateral_mm=rig.tcp_lateral_mm + float(x[2]),
        tcp_binormal_mm=rig.tcp_binormal_mm + float(x[3]),
        image_turn_deg=(rig.image_turn_deg + 90 * float(x[4])) % 360,
        turn_offset_deg=tuple(offsets.tolist()),
    )


def halves(count: int, seed: int = 0) -> np.ndarray:
    """(count,) bool: a random half to fit to. The other half is for the test."""
    fitting = np.zeros(count, bool)
    fitting[np.random.default_rng(seed).permutation(count)[: count // 2]] = True
    return fitting


def compare_images(real: np.ndarray, rendered: np.ndarray, inside: np.ndarray) -> ImageFigures:
    """Figures of a pair of 8-bit frames, (H, W) or (H, W, 3), over the pixels ``inside`` (H, W) bool.

    Raises
    ------
    FrameError
        The frames differ in shape or are not 8-bit.
    """
    if real.shape != rendered.shape or real.dtype != np.uint8 or rendered.dtype != np.uint8:
        raise FrameError(
            f"can't compare {rendered.dtype} {rendered.shape} with {real.dtype} {real.shape}; give two 8-bit frames of one sensor"
        )
    masked = np.where(inside if real.ndim == 2 else inside[..., None], rendered, real)
    gray, masked_gray = gray_levels(real), gray_levels(masked)
    return ImageFigures(
        psnr_db=_psnr_db(real[inside], masked[inside]),
        psnr_gray_db=_psnr_db(gray[inside], masked_gray[inside]),
        ssim=_ssim(real, masked, inside),
        ssim_gray=_ssim(gray, masked_gray, inside),
        flip=float(flip_map(real, masked)[inside].mean()),
        psnr_whole_db=_psnr_db(real, rendered),
    )


def flip_map(real: np.ndarray, rendered: np.ndarray) -> np.ndarray:
    """(H, W) FLIP of two 8-bit frames."""
    pair = (np.repeat(a[..., None], 3, axis=2) if a.ndim == 2 else a for a in (real, rendered))
    reference, test = (np.ascontiguousarray(a, np.float32) / np.float32(LEVELS) for a in pair)
    return flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False, computeMeanError=False)[0][..., 0]


def difference_picture(real: np.ndarray, rendered: np.ndarray) -> np.ndarray:
    """Difference picture (uint8), amplified twice: above middle gray the render is brighter than the real frame, below it is darker."""
    return np.clip(127.5 + CHANGE_GAIN * (rendered.astype(float) - real), 0, 255).astype(np.uint8)


def _psnr_db(real: np.ndarray, rendered: np.ndarray) -> float:
    mean_square = np.mean((real.astype(float) - rendered) ** 2)
    return float("inf") if mean_square == 0 else float(10 * np.log10(LEVELS**2 / mean_square))


def _ssim(real: np.ndarray, rendered: np.ndarray, inside: np.ndarray) -> float:
    axis = 2 if real.ndim == 3 else None
    _, local = structural_similarity(real, rendered, data_range=LEVELS, channel_axis=axis, full=True)
    return float(local[inside].mean())


def cap_patches(view: ViewSpec, pins: PinsSpec, state: PinState, real: ImageArray, rendered: ImageArray) -> FloatArray:
    """Real less rendered gray levels (N, k) at the same places of all caps' planes, up to ``SKIN_FROM`` cap radii from their middles.

    Parameters
    ----------
    real, rendered : (H, W) or (H, W, C) uint8
        Of the same state. Of C channels the levels at the k / C places follow one another.
    """
    side = np.linspace(-SKIN_FROM, SKIN_FROM, PLACES)
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    places = places[np.linalg.norm(places, axis=1) <= SKIN_FROM]
    middle, plane = cap_planes(view, pins, state)
    at = (middle[:, None] + np.einsum("nij,pj->npi", plane, places)).astype(np.float32)
    difference = real.astype(np.float32) - rendered.astype(np.float32)
    read = cv2.remap(difference, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(read, np.float32).reshape(len(middle), -1)


def fixed_share(patches: FloatArray) -> float:
    """Share of the power of patches (M, N, k) that is the same for a cap in all M frames; without bias, so that it may be below 0.

    The mean over pairs of different frames of the product of their patches, relative to the mean square. A mean over the frames alone
    would count 1 / M of what changes from frame to frame. NaN if there is one frame, or nothing is missed.
    """
    count, values = len(patches), np.asarray(patches, float)
    power = float(np.sum(values**2))
    if count < 2 or power == 0:
        return np.nan
    return float((np.sum(values.sum(axis=0) ** 2) - power) / (count - 1) / power)
