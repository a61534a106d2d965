"""From a tap's label to the contact: how the arm of a recording brings the sensor to the plate, fitted to a part of the frames.

The label of a tap on a flat plate is a depth along the plate's normal and two turns of the sensor. With n the plate's
normal in the sensor frame, pointing into the plate, and theta its angle to the sensor's axis,

    n = S R(turn) (sin b, -sin a cos b, cos a cos b),   a, b = label turns + tilt offsets
    indentation along n = depth + offset + lever (1 - cos theta) + lateral . (n_x, n_y)

S mirrors y or does not, R turns about z; ``lever`` and ``lateral`` say where the arm's tool point is relative to the
dome. The pins of a tap depend smoothly on indentation and normal: a cubic polynomial through simulated taps stands for
them while the map is fitted; a second round takes what the polynomial misses at the first round's contacts into account.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import qmc

from scenes import load_object
from twin.errors import FrameError
from twin.mechanics.path import ContactPath
from twin.mechanics.solver import SkinSolver
from twin.progress import Progress
from twin.projection import project
from twin.types import ContactState

COLUMNS = ("pose_3", "pose_4", "pose_5")  # depth in mm, turns about x and y in deg
BANK_TAPS = 40
BANK_MARGIN_MM = (1.5, 2.5)  # below and above the labelled depths; never less than the least indentation
LEAST_INDENT_MM = 0.3
BANK_MARGIN_DEG = 3.0
DEGREE = 3
TURNS_DEG = (0.0, 90.0, 180.0, 270.0)  # where the fit starts
PARAMETERS = 7
FEWEST = 2  # frames to fit to


@dataclass(frozen=True)
class TapMap:
    """The arm's way of tapping; see the module's equations."""

    offset_mm: float
    lever_mm: float
    lateral_mm: tuple[float, float]
    turn_deg: float
    tilt_offset_deg: tuple[float, float]
    mirrored: bool

    def contact(self, labels: np.ndarray) -> np.ndarray:
        """Indentation in mm, n_x and n_y (m, 3) of labels (m, 3): depth in mm, turns in deg."""
        a, b = np.radians(labels[:, 1:] + self.tilt_offset_deg).T
        x, y = np.sin(b), -np.sin(a) * np.cos(b)
        c, s = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        x, y = c * x - s * y, (s * x + c * y) * (-1 if self.mirrored else 1)
        along = labels[:, 0] + self.offset_mm + self.lever_mm * (1 - np.cos(a) * np.cos(b))
        return np.column_stack([along + self.lateral_mm[0] * x + self.lateral_mm[1] * y, x, y])


def tap_labels(rows: list[dict[str, float]]) -> np.ndarray:
    """(m, 3) depth in mm and two turns in deg of frames' labels.

    Raises
    ------
    FrameError
        A frame has none of them.
    """
    missing = [name for name in COLUMNS if any(not np.isfinite(row.get(name, np.nan)) for row in rows)]
    if missing:
        raise FrameError(f"targets.csv: no number in column {', '.join(missing)} for some frames; without it leave out --pose-aligned")
    return np.array([[row[name] for name in COLUMNS] for row in rows])


def tap(solver: SkinSolver, contact: np.ndarray) -> ContactState:
    """Press a plate along its normal: contact (3,) is indentation in mm, n_x, n_y."""
    indent, x, y = contact
    normal = np.array([x, y, np.sqrt(1 - x * x - y * y)])
    across = np.cross([0.0, 1.0, 0.0], normal)
    across /= np.linalg.norm(across)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, :3] = np.column_stack([across, np.cross(normal, across), normal])
    radius = solver.spec.skin.outer_radius_mm
    poses[:, :3, 3] = [radius * normal, (radius - indent) * normal]
    return solver.press(load_object("plane"), ContactPath(poses))


class TapBank:
    """Pins of taps as a polynomial of indentation and normal, through simulated ones.

    Parameters
    ----------
    solver : SkinSolver
    labels : (m, 3) float
        What has to be covered.
    progress : callable, optional
        ``progress(done, total)``.
    """

    def __init__(self, solver: SkinSolver, labels: np.ndarray, *, progress: Progress | None = None):
        deepest = labels[:, 0].max() + BANK_MARGIN_MM[1]
        shallowest = max(labels[:, 0].min() - BANK_MARGIN_MM[0], LEAST_INDENT_MM)
        steepest = np.sin(np.radians(np.hypot(*labels[:, 1:].T).max() + BANK_MARGIN_DEG))
        spread = qmc.Sobol(3, seed=0).random_base2(int(np.ceil(np.log2(BANK_TAPS))))[:BANK_TAPS]
        tilt = steepest * np.sqrt(spread[:, 1]) * np.exp(2j * np.pi * spread[:, 2])
        contacts = np.column_stack([shallowest + (deepest - shallowest) * spread[:, 0], tilt.real, tilt.imag])
        self._scale = np.array([deepest, steepest, steepest])
        pins = []
        for done, contact in enumerate(contacts):
            pins.append(project(solver.spec, tap(solver, contact).caps_mm).ravel())
            if progress:
                progress(done + 1, len(contacts))
        self._coefficients = np.linalg.lstsq(self._terms(contacts), np.array(pins), rcond=None)[0]

    def pins_px(self, contacts: np.ndarray) -> np.ndarray:
        """(m, N, 2) px of contacts (m, 3)."""
        return (self._terms(contacts) @ self._coefficients).reshape(len(contacts), -1, 2)

    def _terms(self, contacts: np.ndarray) -> np.ndarray:
        powers = [p for p in product(range(DEGREE + 1), repeat=3) if sum(p) <= DEGREE]
        return np.prod((contacts / self._scale)[:, None] ** np.array(powers), axis=2)


def fit_taps(
    bank: TapBank, labels: np.ndarray, pins_px: np.ndarray, *, simulate: Callable[[np.ndarray], np.ndarray] | None = None
) -> TapMap:
    """The map under which the pins (m, N, 2) px of labelled frames are best explained, by least squares.

    ``simulate`` gives the true pins (m, N, 2) px of contacts (m, 3): with it there is a second round.

    Raises
    ------
    FrameError
        Too few frames.
    """
    if len(labels) < FEWEST:
        raise FrameError(
            f"{len(labels)} labelled frames are too few to fit the arm's kinematics to; give at least {2 * FEWEST}, half are for the test"
        )
    best, values, best_mirrored = np.inf, np.zeros(PARAMETERS), False
    for turn, mirrored in product(TURNS_DEG, (False, True)):
        start = np.zeros(PARAMETERS)
        start[4] = turn / 90
        found = _least_squares(bank, labels, pins_px, start, mirrored)
        if found.cost < best:
            best, values, best_mirrored = found.cost, found.x, mirrored
    if simulate is not None:
        contacts = _tap_map(values, best_mirrored).contact(labels)
        missed_px = simulate(contacts) - bank.pins_px(contacts)
        values = _least_squares(bank, labels, pins_px - missed_px, values, best_mirrored).x
    return _tap_map(values, best_mirrored)


def _least_squares(bank: TapBank, labels: np.ndarray, pins_px: np.ndarray, start: np.ndarray, mirrored: bool) -> OptimizeResult:
    """The fit of the map's parameters to pins (m, N, 2), NaN where lost."""
    seen = np.isfinite(pins_px)
    return least_squares(lambda x: (bank.pins_px(_tap_map(x, mirrored).contact(labels)) - pins_px)[seen], start)


def _tap_map(x: np.ndarray, mirrored: bool) -> TapMap:
    """The map of parameters scaled to be of order 1."""
    offset, lever, across_x, across_y, turn, tilt_x, tilt_y = x.tolist()
    return TapMap(offset, 10 * lever, (across_x, across_y), 90 * turn, (10 * tilt_x, 10 * tilt_y), mirrored)


def halves(count: int, seed: int = 0) -> np.ndarray:
    """(count,) bool: a random half to fit to; the others are for the test."""
    fitting = np.zeros(count, bool)
    fitting[np.random.default_rng(seed).permutation(count)[: count // 2]] = True
    return fitting


def mean_pin_error_px(simulated_px: np.ndarray, seen_px: np.ndarray) -> np.ndarray:
    """Mean distance over the pins (..., N, 2), lost ones left out."""
    return np.nanmean(np.linalg.norm(simulated_px - seen_px, axis=-1), axis=-1)
