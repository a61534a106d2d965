"""Audit of a recording: a test of whether its labels agree with its pins.

The pins are a smooth function of the labels that vary: pose p after the move, and move m. Polynomials of these are fitted to the leading
modes of the recording's own displacements. Then each frame is compared with several hypotheses of what the arm did:

- executed: ``(p, m)``
- not executed, if the frame was taken before the move: ``(p - m, 0)``
- sign errors: executed, with the opposite sign of the angles or of the moves.

If a label is a direction c on the whole circle (an edge's direction), the polynomials use cos c and sin c, the products of the other labels
with these two, and the moves in the tool's frame, which is turned by c.

The fit of the polynomials and the choice of each frame's hypothesis alternate until no choice changes. Only pins and ``targets.csv`` are
read.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.spatial.transform import Rotation

from training.data.label_code import HALF_CIRCLE_DEG
from training.data.pins import PinTable

MODES = 14  # number of leading modes of the displacement to which the polynomials are fitted
DEGREE = 4  # degree of the polynomials, if there are enough frames for it
FEW = 4  # most labels for which the degree is always DEGREE; with more labels and few frames the degree is lower
LOWEST = 2  # lowest degree of the polynomials
# Least number of frames in contact per polynomial term. With 300 frames of the published 127-pin recording, 95 % of the verdicts on large
# moves agree with those from all its 3763 frames; with 200 frames 92 %. 70 frames are fitted exactly, so that every move looks executed.
FRAMES_A_TERM = 4
ROUNDS = 30  # most rounds of fit and choice
MOST_LEFT_OUT = 0.02  # share of the frames, those with the largest misfit, that the fit leaves out
FLAG_CHI2 = 60.0  # least difference of chi^2 by which a sign error must fit better than both other hypotheses
ODD_CHI2 = 12.0  # ratio of a frame's chi^2 to the median above which the frame fits no hypothesis
STILL = 0.16  # ratio to the median displacement below which there is no contact (published recordings: 0.19 in the shallowest taps)
FEWEST_UNDONE = 20  # least number of frames without an executed move, and the range of their moves, from which the tilt is determined
LEAST_SPAN_MM = 1.0
NUDGE = 1e-3  # change of the scaled depth by which the pins' derivative is computed
HYPOTHESES = ("executed", "not executed", "angle's sign", "shear's sign")


@dataclass(frozen=True)
class Audit:
    """Findings about M rows of labels.

    Attributes
    ----------
    executed : (M,) float
        Probability that the move was executed; 1 for a frame without a move.
    chi2 : (M, 4) float
        Misfit of each frame to each of ``HYPOTHESES``; NaN for frames without contact.
    no_contact, odd, wrong_sign : (M,) bool
        Frames in which no pin has moved; frames that fit no hypothesis; frames that a sign error fits far better than the label.
    duplicates : (M,) int
        Index of the first frame with exactly the same pins; the frame's own index if there is none before it.
    depth_per_move : float
        Change of depth, mm per mm of ``move_1``, over frames whose move was not executed. It shows the plate's tilt. The depth is the last
        of ``pose_1..3`` that varies.
    drift : dict
        Share of the row number's variance (R^2) that the pins explain beyond the labels, and the drift in px from the first to the last
        row.
    not_assessed : str
        Reason why the hypotheses can't be assessed: the frames are too few. Then ``executed``, ``chi2`` and ``depth_per_move`` are NaN,
        ``odd`` and ``wrong_sign`` are false, and ``drift`` is empty. "" if there are enough frames.
    """

    executed: np.ndarray
    chi2: np.ndarray
    no_contact: np.ndarray
    odd: np.ndarray
    wrong_sign: np.ndarray
    duplicates: np.ndarray
    depth_per_move: float
    drift: dict
    not_assessed: str = ""


def audit_labels(pins: PinTable, pose: np.ndarray, move: np.ndarray) -> Audit:
    """Find the hypothesis that fits each frame. If there are too few frames, none is evaluated, and ``Audit.not_assessed`` states this.

    Parameters
    ----------
    pins : PinTable
        M valid frames.
    pose, move : (M, 6) float
        ``pose_1..6`` and ``move_1..6`` as in the table, mm and deg; 0 for columns that the table does not have.
    """
    moved = (pins.nodes_px - pins.reference.pins_px).reshape(len(pins), -1)
    size = np.linalg.norm(moved, axis=1)
    no_contact = size < STILL * np.median(size)
    labels = LabelColumns.of(pose, move)
    degree, not_assessed = labels.degree(int((~no_contact).sum()))
    if not_assessed:
        nowhere = np.zeros(len(pins), bool)
        unknown, duplicates = np.full((len(pins), len(HYPOTHESES)), np.nan), _find_duplicates(pins.nodes_px)
        return Audit(unknown[:, 0], unknown, no_contact, nowhere, nowhere, duplicates, np.nan, {}, not_assessed)
    modes = _modes(moved, ~no_contact)
    angles = np.array([1, 1, 1, -1, -1, -1])
    told = [(pose, move), (pose - move, 0 * move), (pose * angles, move), (pose, -move)]
    hypotheses = np.stack([labels.columns(*each) for each in told])
    shift, scale = hypotheses[0].mean(axis=0), np.ptp(hypotheses[0], axis=0) / 2 + 1e-9
    shift[hypotheses.shape[2] - len(labels.moved) :] = 0
    hypotheses = (hypotheses - shift) / scale
    still = np.abs(move[:, labels.moved]).max(axis=1, initial=0.0) == 0
    done, tilt, used = np.ones(len(pins), bool), 0.0, ~no_contact
    for _ in range(ROUNDS):
        terms = np.stack([polynomials(story, degree) for story in hypotheses])
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
    undone = used & ~done
    if labels.depth is not None and undone.sum() >= FEWEST_UNDONE and np.ptp(move[undone, 0]) >= LEAST_SPAN_MM:
        nudged = hypotheses[1].copy()
        nudged[:, labels.depth] += NUDGE
        along = (polynomials(nudged, degree) - terms[1]) @ weight / NUDGE
        steep = np.einsum("mi,ij,mj->m", along, precision, along, optimize=True)
        beyond = np.einsum("mi,ij,mj->m", along, precision, modes - terms[1] @ weight, optimize=True)
        beyond_mm = scale[labels.depth] * beyond / np.maximum(steep, 1e-12)  # depth that the pins show beyond the label
        tilt = float(np.polyfit(move[undone, 0], beyond_mm[undone], 1)[0])
    usual = np.median(best[~no_contact])
    # The polynomials are an approximation, so the misfits are larger than from noise alone. They are divided by the usual misfit.
    odds = np.clip((chi2[:, 1] - chi2[:, 0]) / (2 * max(usual / modes.shape[1], 1.0)), -50, 50)
    chi2[no_contact] = np.nan
    return Audit(
        executed=np.where(no_contact | still, 1.0, 1 / (1 + np.exp(-odds))),
        chi2=chi2,
        no_contact=no_contact,
        odd=~no_contact & (best > ODD_CHI2 * usual),
        wrong_sign=~no_contact & (np.nan_to_num(chi2[:, 2:], nan=np.inf).min(axis=1) < best - FLAG_CHI2),
        duplicates=_find_duplicates(pins.nodes_px),
        depth_per_move=tilt,
        drift=_drift(pins, terms[np.where(done, 0, 1), np.arange(len(pins))], used, hypotheses.shape[2]),
    )


@dataclass(frozen=True)
class LabelColumns:
    """The varying labels of a recording.

    Attributes
    ----------
    posed, moved : (P,), (Q,) int
        Indices of the pose's varying labels, without the direction, and of the move's.
    direction : int or None
        Index of the pose's label that goes round the whole circle.
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
        """The columns from which the polynomials are made, from pose and move (M, 6). The moves come last."""
        parts, moves = [pose[:, self.posed]], move
        if self.direction is not None:
            turn = Rotation.from_rotvec(np.radians(pose[:, self.direction])[:, None] * np.eye(3)[self.direction - 3])
            along = np.radians(pose[:, self.direction])[:, None]
            parts += [np.cos(along), np.sin(along), parts[0] * np.cos(along), parts[0] * np.sin(along)]
            moves = np.hstack([turn.inv().apply(part) for part in (move[:, :3], move[:, 3:])])
        return np.hstack([*parts, moves[:, self.moved]])

    def degree(self, touching: int) -> tuple[int, str]:
        """Degree of the polynomials for a number of frames in contact, and the reason why these are too few; "" if they are enough."""
        some = np.zeros((1, 6))
        count = max(self.columns(some, some).shape[1], FEW)
        lowest = DEGREE if count <= FEW else LOWEST
        needed = {degree: FRAMES_A_TERM * polynomials(np.zeros((1, count)), degree).shape[1] for degree in range(lowest, DEGREE + 1)}
        fitting = [degree for degree, frames in needed.items() if frames <= touching]
        if fitting:
            return fitting[-1], ""
        return lowest, (
            f"too few frames in contact ({touching}) to find out which moves were executed: a map that is fitted to so few follows every "
            f"label, right or wrong; {needed[lowest]} are needed"
        )


def _modes(moved: np.ndarray, used: np.ndarray) -> np.ndarray:
    mean = moved[used].mean(axis=0)
    _, _, directions = np.linalg.svd(moved[used] - mean, full_matrices=False)
    return (moved - mean) @ directions[: min(MODES, len(directions))].T


def polynomials(hypothesis: np.ndarray, highest: int) -> np.ndarray:
    """All products (M, P) of up to ``highest`` columns of labels (M, C). The first column is constant."""
    columns = [np.ones(len(hypothesis))]
    for degree in range(1, highest + 1):
        columns += [hypothesis[:, list(which)].prod(axis=1) for which in combinations_with_replacement(range(hypothesis.shape[1]), degree)]
    return np.column_stack(columns)


def _misfit(residual: np.ndarray, precision: np.ndarray) -> np.ndarray:
    return np.einsum("mi,ij,mj->m", residual, precision, residual, optimize=True)


def _find_duplicates(nodes_px: np.ndarray) -> np.ndarray:
    first: dict[bytes, int] = {}
    return np.array([first.setdefault(np.round(frame, 6).tobytes(), k) for k, frame in enumerate(nodes_px)])


def _drift(pins: PinTable, terms: np.ndarray, used: np.ndarray, columns: int) -> dict:
    """Drift of the outermost pins' mean place and spread over the rows of the table, beyond the part that the labels explain.

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
