"""Audit of a recording: do its labels agree with its pins?

The pins are a smooth function of the labels that vary: pose p after the move, and move m. Polynomials of these are fitted to the leading
modes of the recording's own displacements. Then each frame is compared with several explanations ("stories") of what the arm did:

- executed: ``(p, m)``
- not executed, if the frame was taken before the move: ``(p - m, 0)``
- sign errors: executed, with the opposite sign of the angles or of the moves.

Of a direction c that goes round the whole circle (an edge's) the polynomials take cos c and sin c, the other labels also times these two,
and the moves as the tool sees them, which is turned by c.

Fitting the polynomials and choosing each frame's story alternate until no choice changes. Only pins and ``targets.csv`` are read.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.spatial.transform import Rotation

from training.label_code import HALF_CIRCLE_DEG
from training.pins import PinTable

MODES = 14  # leading modes of the displacement that the labels are fitted to
DEGREE = 4  # of the polynomials, if the frames are enough for it
FEW = 4  # labels of which the polynomials always have this degree; those of more labels have a lower one where frames are few
LOWEST = 2  # degree of the polynomials
# Frames in contact for each polynomial that is fitted to them. With 300 frames of the published 127-pin recording 95 % of the verdicts on
# large moves are those of all its 3763 frames, with 200 frames 92 %; 70 frames are fitted exactly, so that every move looks executed.
FRAMES_A_TERM = 4
ROUNDS = 30  # most turns of fit and choice
MOST_LEFT_OUT = 0.02  # part of the frames, the worst ones, that the fit leaves out
FLAG_CHI2 = 60.0  # chi^2 by which a sign error must fit better than both other stories
ODD_CHI2 = 12.0  # usual chi^2; a frame with more of it fits no story
STILL = 0.16  # usual displacement; less of it is no contact (the shallowest taps of the published recordings have 0.19)
STORIES = ("executed", "not executed", "angle's sign", "shear's sign")


@dataclass(frozen=True)
class Audit:
    """Findings about M rows of labels.

    Attributes
    ----------
    executed : (M,) float
        Probability that the move was executed; 1 for a frame without a move.
    chi2 : (M, 4) float
        Misfit of each frame to each of ``STORIES``; NaN for frames without contact.
    no_contact, odd, wrong_sign : (M,) bool
        Frames in which no pin has moved; frames that fit no story; frames that a sign error fits far better than the label.
    twins : (M,) int
        Index of the first frame with exactly the same pins; the frame's own index if there is none before it.
    depth_per_move : float
        Change of depth in mm for each mm of ``move_1`` over frames whose move was not executed. It shows the plate's tilt. The depth is
        the last of ``pose_1..3`` that varies.
    drift : dict
        Part of the row number's variance (R^2) that the pins tell beyond the labels, and the drift in px from the first to the last row.
    untold : str
        Why the frames can't be asked which story they fit: they are too few. Then ``executed``, ``chi2`` and ``depth_per_move`` are NaN,
        ``odd`` and ``wrong_sign`` false, and ``drift`` is empty. "" where they are enough.
    """

    executed: np.ndarray
    chi2: np.ndarray
    no_contact: np.ndarray
    odd: np.ndarray
    wrong_sign: np.ndarray
    twins: np.ndarray
    depth_per_move: float
    drift: dict
    untold: str = ""


def audit_labels(pins: PinTable, pose: np.ndarray, move: np.ndarray) -> Audit:
    """Ask every frame which story it fits; where the frames are too few to tell, the answer is that they are (``Audit.untold``).

    Parameters
    ----------
    pins : PinTable
        M valid frames.
    pose, move : (M, 6) float
        ``pose_1..6`` and ``move_1..6`` as in the table, mm and deg; 0 where it has none.
    """
    moved = (pins.nodes_px - pins.reference.pins_px).reshape(len(pins), -1)
    size = np.linalg.norm(moved, axis=1)
    no_contact = size < STILL * np.median(size)
    labels = LabelColumns.of(pose, move)
    degree, untold = labels.degree(int((~no_contact).sum()))
    if untold:
        nowhere = np.zeros(len(pins), bool)
        unknown, twins = np.full((len(pins), len(STORIES)), np.nan), _twins(pins.nodes_px)
        return Audit(unknown[:, 0], unknown, no_contact, nowhere, nowhere, twins, np.nan, {}, untold)
    modes = _modes(moved, ~no_contact)
    angles = np.array([1, 1, 1, -1, -1, -1])
    told = [(pose, move), (pose - move, 0 * move), (pose * angles, move), (pose, -move)]
    stories = np.stack([labels.columns(*each) for each in told])
    shift, scale = stories[0].mean(axis=0), np.ptp(stories[0], axis=0) / 2 + 1e-9
    shift[stories.shape[2] - len(labels.moved) :] = 0
    stories = (stories - shift) / scale
    still = np.abs(move[:, labels.moved]).max(axis=1, initial=0.0) == 0
    done, tilt, used = np.ones(len(pins), bool), 0.0, ~no_contact
    for _ in range(ROUNDS):
        terms = np.stack([polynomials(story, degree) for story in stories])
        chosen = terms[np.where(done, 0, 1), np.arange(len(pins))]
        weight = np.linalg.lstsq(chosen[used], modes[used], rcond=None)[0]
        residual = modes[used] - chosen[used] @ weight
        precision = np.linalg.inv(np.cov(residual.T) + 1e-9 * np.eye(modes.shape[1]))
        chi2 = np.stack([_misfit(modes - part @ weight, precision) for part in terms], axis=1)
        best = chi2[:, :2].min(axis=1)
        now = chi2[:, 0] <= chi2[:, 1]
        used = ~no_contact & (best <= np.quantile(best[~no_contact], 1 - MOST_LEFT_OUT))
        if (now == done).all():
            break
        done = now
    if labels.depth is not None:
        depth = labels.depth, degree, scale[labels.depth]
        tilt = _depth_per_move(terms[1], modes, weight, precision, stories[1], move[:, 0], used & ~done, *depth)
    usual = np.median(best[~no_contact])
    # The polynomials are an approximation, so the misfits are larger than noise alone would make them. Their unit is the usual misfit.
    odds = np.clip((chi2[:, 1] - chi2[:, 0]) / (2 * max(usual / modes.shape[1], 1.0)), -50, 50)
    chi2[no_contact] = np.nan
    return Audit(
        executed=np.where(no_contact | still, 1.0, 1 / (1 + np.exp(-odds))),
        chi2=chi2,
        no_contact=no_contact,
        odd=~no_contact & (best > ODD_CHI2 * usual),
        wrong_sign=~no_contact & (np.nan_to_num(chi2[:, 2:], nan=np.inf).min(axis=1) < best - FLAG_CHI2),
        twins=_twins(pins.nodes_px),
        depth_per_move=tilt,
        drift=_drift(pins, terms[np.where(done, 0, 1), np.arange(len(pins))], used, stories.shape[2]),
    )


@dataclass(frozen=True)
class LabelColumns:
    """Which labels of a recording vary.

    Attributes
    ----------
    posed, moved : (P,), (Q,) int
        Those of the pose, without the direction, and those of the move.
    direction : int or None
        The one of the pose that goes round the whole circle.
    """

    posed: np.ndarray
    moved: np.ndarray
    direction: int | None

    @classmethod
    def of(cls, pose: np.ndarray, move: np.ndarray) -> "LabelColumns":
        turning = [k for k in range(3, 6) if np.ptp(pose[:, k]) > HALF_CIRCLE_DEG]
        direction = turning[-1] if turning else None
        posed = np.array([k for k in range(6) if np.ptp(pose[:, k]) > 0 and k != direction], int)
        return cls(posed, np.flatnonzero(np.ptp(move, axis=0) > 0), direction)

    @property
    def depth(self) -> int | None:
        """The column of the depth in ``columns``."""
        places = np.flatnonzero(self.posed < 3)
        return int(places[-1]) if len(places) else None

    def columns(self, pose: np.ndarray, move: np.ndarray) -> np.ndarray:
        """Pose and move (M, 6) as the columns of which the polynomials are made; the moves come last."""
        parts, moves = [pose[:, self.posed]], move
        if self.direction is not None:
            turn = Rotation.from_rotvec(np.radians(pose[:, self.direction])[:, None] * np.eye(3)[self.direction - 3])
            along = np.radians(pose[:, self.direction])[:, None]
            parts += [np.cos(along), np.sin(along), parts[0] * np.cos(along), parts[0] * np.sin(along)]
            moves = np.hstack([turn.inv().apply(part) for part in (move[:, :3], move[:, 3:])])
        return np.hstack([*parts, moves[:, self.moved]])

    def degree(self, touching: int) -> tuple[int, str]:
        """Degree of the polynomials for so many frames in contact, and why these can't tell which moves were executed; "" if they can."""
        some = np.zeros((1, 6))
        count = max(self.columns(some, some).shape[1], FEW)
        lowest = DEGREE if count <= FEW else LOWEST
        needed = {degree: FRAMES_A_TERM * polynomials(np.zeros((1, count)), degree).shape[1] for degree in range(lowest, DEGREE + 1)}
        fitting = [degree for degree, frames in needed.items() if frames <= touching]
        if fitting:
            return fitting[-1], ""
        return lowest, (
            f"{touching} frames in contact are too few to tell which moves were executed: a map that is fitted to so few follows every "
            f"label, right or wrong; {needed[lowest]} are needed"
        )


def _modes(moved: np.ndarray, used: np.ndarray) -> np.ndarray:
    mean = moved[used].mean(axis=0)
    _, _, directions = np.linalg.svd(moved[used] - mean, full_matrices=False)
    return (moved - mean) @ directions[: min(MODES, len(directions))].T


def polynomials(story: np.ndarray, highest: int) -> np.ndarray:
    """All products (M, P) of up to ``highest`` columns of labels (M, C), the constant one first."""
    columns = [np.ones(len(story))]
    for degree in range(1, highest + 1):
        columns += [story[:, list(which)].prod(axis=1) for which in combinations_with_replacement(range(story.shape[1]), degree)]
    return np.column_stack(columns)


def _misfit(residual: np.ndarray, precision: np.ndarray) -> np.ndarray:
    return np.einsum("mi,ij,mj->m", residual, precision, residual, optimize=True)


def _depth_per_move(
    terms: np.ndarray,
    modes: np.ndarray,
    weight: np.ndarray,
    precision: np.ndarray,
    story: np.ndarray,
    shear_mm: np.ndarray,
    rows: np.ndarray,
    depth: int,
    degree: int,
    depth_scale: float,
) -> float:
    """Slope in mm per mm of the depth that the pins show beyond the label, by the move, over frames whose move was not executed.

    Parameters
    ----------
    terms : (M, P) float
        Polynomials of the story "not executed".
    modes : (M, D) float
        Amplitudes of the displacement's modes.
    weight : (P, D) float
        Coefficients of the fit, from polynomials to modes.
    precision : (D, D) float
        Inverse covariance of the fit's residuals.
    story : (M, C) float
        The scaled labels of the story.
    shear_mm : (M,) float
        ``move_1`` of the table.
    rows : (M,) bool
        Frames whose move was not executed.
    depth : int
        Column of the depth in ``story``.
    degree : int
        Of the polynomials.
    depth_scale : float
        Depth in mm that the value 1 stands for in ``story``.
    """
    if rows.sum() < 20 or np.ptp(shear_mm[rows]) < 1:
        return 0.0
    step = 1e-3
    nudged = story.copy()
    nudged[:, depth] += step
    along = (polynomials(nudged, degree) - terms) @ weight / step
    residual = modes - terms @ weight
    steep = np.einsum("mi,ij,mj->m", along, precision, along, optimize=True)
    beyond = depth_scale * np.einsum("mi,ij,mj->m", along, precision, residual, optimize=True) / np.maximum(steep, 1e-12)
    return float(np.polyfit(shear_mm[rows], beyond[rows], 1)[0])


def _twins(nodes_px: np.ndarray) -> np.ndarray:
    first: dict[bytes, int] = {}
    return np.array([first.setdefault(np.round(frame, 6).tobytes(), k) for k, frame in enumerate(nodes_px)])


def _drift(pins: PinTable, terms: np.ndarray, used: np.ndarray, columns: int) -> dict:
    """Drift of the outermost pins' mean place and spread over the rows of the table, after what the labels explain is subtracted.

    The first terms (M, P) after the constant one are the ``columns`` of the labels.
    """
    rim = pins.nodes_px[:, pins.reference.outmost]
    middle = rim.mean(axis=1)
    spread = np.linalg.norm(rim - middle[:, None], axis=2).mean(axis=1)
    signals = np.column_stack([middle, spread])
    left = signals - terms @ np.linalg.lstsq(terms[used], signals[used], rcond=None)[0]
    row = np.linspace(-0.5, 0.5, len(pins))
    own = row - terms @ np.linalg.lstsq(terms[used], row[used], rcond=None)[0]
    slopes = [float(np.polyfit(own[used], left[used, k], 1)[0]) for k in range(3)]
    told = left[used] @ np.linalg.lstsq(left[used], own[used], rcond=None)[0]
    return {
        "r2_of_row_number_beyond_labels": float(1 - np.var(own[used] - told) / max(np.var(own[used]), 1e-300)),
        "px_first_to_last": dict(zip(("x", "y", "spread"), slopes, strict=True)),
        "correlation_of_row_with_label": [
            float(np.corrcoef(row, terms[:, 1 + k])[0, 1]) if np.ptp(terms[:, 1 + k]) else 0.0 for k in range(columns)
        ],
    }
