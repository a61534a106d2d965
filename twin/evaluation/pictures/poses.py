"""Contacts from labels alone: the arm's rig is fitted to one part of the frames, and the twin's contact model is applied to all.

The rig's kinematics give the contact of a label (``twin.rig``). Because the rig of a recording may not have been calibrated, seven of its
parameters are fitted: contact offset, tool point in three directions, the image's turn, and the offsets of the two turns that tilt the
sensor. Both values of the robot's handedness (``turn_sign``) are tried.

The pins of a tap are a smooth function of the indentation and the plate's normal in the sensor frame. While the rig is fitted, this
function is approximated by a cubic polynomial fitted to simulated taps. In a second round the polynomial's errors at the contacts of the
first round are corrected.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from scenes import load_object
from scenes.experiment import ExperimentSpec
from scenes.rig import RigSpec
from twin.camera.projection import project
from twin.errors import FrameError
from twin.mechanics.solver import SkinSolver
from twin.progress import Step, report_each, unheard
from twin.rig.contact import RigContact
from twin.rig.kinematics import object_pose
from twin.rig.labels import ArmLabel

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


class PlateTaps:
    """Pins of taps on a flat plate, simulated by the twin's contact model.

    Parameters
    ----------
    solver : SkinSolver
    experiment : ExperimentSpec
    """

    def __init__(self, solver: SkinSolver, experiment: ExperimentSpec) -> None:
        self.solver, self.experiment, self._plate = solver, experiment, load_object("plane")

    def contact(self, rig: RigSpec) -> RigContact:
        """The contact model with a rig, including the rig's friction and compliances."""
        return RigContact(self.solver, self.experiment, self._plate, rig=rig)

    def pins_px(self, rig: RigSpec, labels: list[ArmLabel], progress: Step = unheard) -> np.ndarray:
        """Pins (m, N, 2) px of the labels' contacts."""
        contact = self.contact(rig)
        return np.array([project(self.solver.spec.view, contact.end(label).caps_mm) for label in report_each(labels, progress)])


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

    tries = [
        start.alter(turn_sign=sign, image_turn_deg=start.image_turn_deg + turn)
        for turn, sign in product(TURNS_DEG, (start.turn_sign, -start.turn_sign))
    ]
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
