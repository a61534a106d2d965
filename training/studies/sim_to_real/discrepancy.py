"""The discrepancy between a calibrated twin's pins and real ones, fitted to a few labelled frames (Kennedy & O'Hagan 2001).

A frame's residual is the real displacement minus the simulated one. It is divided by the rms of the simulated displacement, because
without displacement there is no residual. The scaled residuals are decomposed into their principal modes. Each mode's amplitude a is a
Gaussian process of the label l,

    a(l) ~ GP(0, c^2 + s^2 exp(-sum_i (l_i - l'_i)^2 / 2 w_i^2) + n^2 [same frame])

(Higdon et al. 2008). c, s, w and n maximise the marginal likelihood; l is the pose of the tap and the executed move, and of a direction
on the whole circle the pose after the move, with its cosine and sine. For each
simulated contact one function is sampled from the posterior and added to the pins. So a model is trained with the twin's known
discrepancy, and with a wide spread of discrepancies where no labelled frame is near.
"""

from dataclasses import dataclass, replace

import numpy as np

from scenes.randomisation import FrictionSpread
from training.data.audit import LabelColumns
from training.errors import TrainingError
from training.runs.gaussian_process import CONSTANT_AND_SMOOTH, Kernel, Points, Posterior, likeliest
from twin.calibration.contact.fit import expect, mean_squared, simulate
from twin.calibration.contact.parameters import PARAMETERS
from twin.calibration.contact.simulate import CalibrationSetup
from twin.evaluation.labelled.model import MeasuredFrames
from twin.progress import Step, unheard
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel

FRICTION = next(parameter for parameter in PARAMETERS if parameter.name == "rig.friction")
# Coefficients of friction that every labelled frame is simulated with. With the last one the object sticks.
FRICTIONS = (0.05, 0.15, 0.25, 0.35, 0.5, 0.8, 3.0)
# Least rms change of the pins' places in px, by a change of 1 in the logarithm of friction, at which a frame's friction can be estimated.
PLAIN_PX = 0.5
# Quantiles of the frames' frictions between which friction is drawn.
USUAL = (0.05, 0.95)
# Factor by which the range of sampled frictions is extended at both ends.
WIDER = 1.25
# Least number of labelled frames that the twin must be able to simulate and explain.
FEWEST = 8
# Least rms displacement in px by which a frame's residuals are divided.
LEAST_PX = 0.5
# Least standard deviation in mm or deg of an axis of the label; an axis that varies less is left out.
VARIES = 1e-6
# Share of the residuals' variance that the modes contain.
MODES_SHARE = 0.97
# Bounds of w, in standard deviations of the label.
LENGTHS = (1.0, 30.0)
# Bounds of c and s, relative to the rms of the amplitude.
SIZES = (1e-3, 10.0)
# Bounds of n^2, relative to the variance of the amplitude. With less noise the many lengths would overfit some tens of frames.
NOISES = (0.05, 1.0)
# Least ``Weights.trust`` of a frame whose residuals are used.
TRUSTED = 0.5


@dataclass(frozen=True)
class Residuals:
    """Residuals of a twin on K frames with N pins.

    Attributes
    ----------
    axes : (K, 12) float
        See ``label_axes``.
    moved_px : (K, N, 2) float
        Simulated displacements.
    missing_px : (K, N, 2) float
        Real minus simulated displacements; 0 for lost pins.
    friction : (K,) float
        Estimated friction of each frame; NaN if no move was executed, because only a move shows the friction.
    friction_px : (K,) float
        Rms change of the pins' places by a change of 1 in the logarithm of friction. If it is small, the friction is uncertain.
    """

    axes: np.ndarray
    moved_px: np.ndarray
    missing_px: np.ndarray
    friction: np.ndarray
    friction_px: np.ndarray

    @property
    def error_px(self) -> float:
        """Mean distance of a real pin from its simulated place."""
        return float(np.linalg.norm(self.missing_px, axis=-1).mean())

    def friction_spread(self) -> FrictionSpread | None:
        """Range in which friction is sampled for simulated contacts; None if too few executed moves show it.

        A frame in which the object slides, or sticks, with every friction does not show its friction and is left out. All other frames
        have the same weight.
        """
        shown = self.friction[np.isfinite(self.friction) & (self.friction_px >= PLAIN_PX)]
        if len(shown) < FEWEST:
            return None
        low, high = np.quantile(shown, USUAL)
        return FrictionSpread(low=float(max(low / WIDER, FRICTIONS[0])), high=float(min(high * WIDER, FRICTIONS[-1])))


def label_axes(labels: list[ArmLabel]) -> np.ndarray:
    """(K, 12) the pose of the tap, and the move (0 if it was not executed), in mm and deg."""
    return np.stack([np.concatenate([label.pose - label.move, label.move * label.executed]) for label in labels])


def measure_residuals(
    setup: CalibrationSetup, measured: MeasuredFrames, progress: Step = unheard, *, frictions: tuple = FRICTIONS
) -> Residuals:
    """Simulate labelled frames with several frictions, and compare each frame with the simulated state that is most like it.

    The states after the tap and after the move are compared. Between two frictions the pins' places are interpolated linearly in the
    logarithm of friction. Friction differs from frame to frame, and simulated data sets draw it. Therefore each frame is compared at its
    best friction: otherwise the residuals would include the effect of friction, and it would be simulated twice.

    Frames of taps alone are simulated with the rig's friction only.

    Raises
    ------
    TrainingError
        The twin can simulate and explain fewer than ``FEWEST`` frames.
    """
    labels, real_px = measured.labels, measured.pins_px - measured.no_contact_px
    setup = replace(setup, parameters=(FRICTION,))
    if not any(label.move.any() for label in labels):
        frictions = (rig_of(setup.sensor).friction,)
    moved = simulate(setup, measured, [[np.log(friction)] for friction in frictions], rig_of(setup.sensor).turn_sign, progress)
    moved, friction, friction_px = _likeliest(moved, real_px, frictions)
    weights = expect(mean_squared(moved, real_px))
    good = np.flatnonzero(np.isfinite(moved).all(axis=(1, 2, 3)) & (weights.trust > TRUSTED))
    if len(good) < FEWEST:
        raise TrainingError(
            f"{len(good)} of {len(labels)} labelled frames fit the twin, at least {FEWEST} are needed; give a larger "
            f"`num_labelled`, or `calibrate`"
        )
    executed = weights.executed[good] > 0.5
    told = [replace(labels[k], executed=bool(done)) for k, done in zip(good, executed, strict=True)]
    simulated = moved[good, executed.astype(int)]
    friction = np.where(executed, friction[good, 1], np.nan)
    return Residuals(label_axes(told), simulated, np.nan_to_num(real_px[good] - simulated), friction, friction_px[good, 1])


def _likeliest(moved: np.ndarray, real_px: np.ndarray, frictions: tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The simulated displacements (M, 2, N, 2) nearest to the real ones (M, N, 2), from those with F frictions (F, M, 2, N, 2).

    Also returned are their frictions (M, 2), and the rms change of the pins in px by a change of 1 in the logarithm of friction (M, 2).
    All are NaN if the contact can't be simulated with any friction.
    """
    seen, target = np.isfinite(real_px)[:, None], np.nan_to_num(real_px)[:, None]
    best, least = np.full(moved.shape[1:], np.nan), np.full(moved.shape[1:3], np.inf)
    friction, told_px = np.full(moved.shape[1:3], np.nan), np.zeros(moved.shape[1:3])
    log = np.log(frictions)
    for k in range(len(frictions)):
        after = min(k + 1, len(frictions) - 1)
        start, way, step = moved[k], moved[after] - moved[k], log[after] - log[k]
        way = np.where(np.isfinite(way), way, 0.0)  # if the simulation with the next friction failed, this friction is used alone
        along, length = ((part * way * seen).sum(axis=(-2, -1)) for part in (target - start, way))
        share = np.clip(along / np.maximum(length, 1e-12), 0, 1)
        there = start + share[..., None, None] * way
        squared = (((target - there) * seen) ** 2).sum(axis=(-2, -1))
        nearer = squared < least  # false for simulations that failed, because their distance is NaN
        best[nearer], least[nearer] = there[nearer], squared[nearer]
        friction[nearer] = np.exp(log[k] + share * step)[nearer]
        told_px[nearer] = np.sqrt(length / way.shape[-2])[nearer] / max(step, 1e-12)
    return best, friction, told_px


class Discrepancy:
    """Gaussian processes of the amplitudes of the residuals' modes.

    Parameters
    ----------
    residuals : Residuals
    """

    def __init__(self, residuals: Residuals) -> None:
        axes = residuals.axes
        self.columns = LabelColumns.of(axes[:, :6] + axes[:, 6:], axes[:, 6:])
        told = self._known_labels(axes)
        self.used = told.std(axis=0) > VARIES
        self.middle, self.spread = told[:, self.used].mean(axis=0), told[:, self.used].std(axis=0)
        relative = residuals.missing_px.reshape(len(axes), -1) / _rms_px(residuals.moved_px)[:, None]
        left, sizes, self.modes = np.linalg.svd(relative, full_matrices=False)
        kept = np.searchsorted(np.cumsum(sizes**2) / (sizes**2).sum(), MODES_SHARE) + 1
        amplitudes = left * sizes
        self.rest = amplitudes[:, kept:] @ self.modes[kept:] / np.sqrt(len(axes))  # ``draw_px`` adds random combinations of these rows
        self.modes = self.modes[:kept]
        self.sizes = np.sqrt((amplitudes[:, :kept] ** 2).mean(axis=0))
        self.processes = [_process(self._scale_axes(axes), column) for column in (amplitudes[:, :kept] / self.sizes).T]

    def draw_px(self, labels: list[ArmLabel], moved_px: np.ndarray, contact: np.ndarray, seed: int) -> np.ndarray:
        """(S, N, 2) random discrepancy of S simulated displacements, px. One function is sampled for all states of a contact (S,)."""
        scaled = self._scale_axes(label_axes(labels))
        amplitudes = np.empty((len(scaled), len(self.modes)))
        shares = np.empty((len(scaled), len(self.rest)))
        for number in np.unique(contact):
            rows = np.flatnonzero(contact == number)
            rng = np.random.default_rng([seed, int(number)])
            for k, process in enumerate(self.processes):
                own = process.kernel.noises[0] * rng.normal()  # noise of a frame; all states of a contact have the same
                amplitudes[rows, k] = process.draw(Points.of(scaled[rows]), rng) + own
            shares[rows] = rng.normal(size=len(self.rest))
        return self._fields(amplitudes, moved_px, shares @ self.rest)

    def summary(self) -> list[dict]:
        """For each mode: its share of the residuals' variance, and the part of the mode's variance that the label explains."""
        share = self.sizes**2 / ((self.sizes**2).sum() + (self.rest**2).sum())
        noise = [process.kernel.noises[0] ** 2 for process in self.processes]
        return [{"share": float(a), "told": float(max(0.0, 1 - n))} for a, n in zip(share, noise, strict=True)]

    def _known_labels(self, axes: np.ndarray) -> np.ndarray:
        """The labels (K, A) that the processes know: as ``label_axes``, but a direction by its cosine and sine (``LabelColumns``)."""
        if self.columns.direction is None:
            return axes
        return self.columns.columns(axes[:, :6] + axes[:, 6:], axes[:, 6:])

    def _scale_axes(self, axes: np.ndarray) -> np.ndarray:
        return (self._known_labels(axes)[:, self.used] - self.middle) / self.spread

    def _fields(self, amplitudes: np.ndarray, moved_px: np.ndarray, rest: np.ndarray) -> np.ndarray:
        relative = (amplitudes * self.sizes) @ self.modes + rest
        return (relative * _rms_px(moved_px)[:, None]).reshape(moved_px.shape)


def _process(axes: np.ndarray, amplitude: np.ndarray) -> Posterior:
    """The process with the largest likelihood of an amplitude (K,) by labels (K, A), both scaled to about 1, within the bounds above."""

    def kernel(length: float, size: float, variance: float) -> Kernel:
        return Kernel(CONSTANT_AND_SMOOTH, np.full(axes.shape[1], length), np.full(2, size), np.sqrt([variance]))

    points = Points.of(axes)
    least, most = (kernel(LENGTHS[k], SIZES[k], NOISES[k]) for k in (0, 1))
    found = likeliest(kernel(2.0, np.sqrt(0.5), 0.3), points, amplitude, least=least, most=most)
    return Posterior(found, points, amplitude)


def _rms_px(moved_px: np.ndarray) -> np.ndarray:
    """(S,) rms of displacements (S, N, 2), at least ``LEAST_PX``."""
    return np.maximum(np.sqrt((moved_px**2).sum(axis=-1).mean(axis=-1)), LEAST_PX)
