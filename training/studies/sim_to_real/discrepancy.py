"""What a calibrated twin's pins still miss on a real sensor, learnt from a few labelled frames (Kennedy & O'Hagan 2001).

A frame's residual, real less simulated displacement, is divided by the rms of the simulated displacement (where nothing
moves, nothing is missed) and written in the residuals' own modes; each mode's amplitude is a Gaussian process of the label,

    a(l) ~ GP(0, c^2 + s^2 exp(-sum_i (l_i - l'_i)^2 / 2 w_i^2) + n^2 [same frame])

(Higdon et al. 2008). c, s, w and n maximise the marginal likelihood; l is the pose of the tap and the move as far as it was
executed. Drawn for simulated contacts, one function of the posterior for each, it teaches a model what the twin is known to
miss, and how little it is to be trusted where the frames don't tell.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scenes.randomisation import FrictionSpread
from training.gaussian_process import CONSTANT_AND_SMOOTH, Kernel, Points, Posterior, likeliest
from training.recipes import TrainingError
from twin.fit.contact.fit import expect, mean_squared, simulate
from twin.fit.contact.parameters import PARAMETERS
from twin.fit.contact.simulate import Setup
from twin.judge.labelled.model import MeasuredFrames
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel

FRICTION = next(parameter for parameter in PARAMETERS if parameter.name == "rig.friction")
FRICTIONS = (0.05, 0.15, 0.25, 0.35, 0.5, 0.8, 3.0)  # tried on every labelled frame; with the last one the object sticks
PLAIN_PX = 0.5  # change of the pins with the logarithm of friction, from which on a frame shows its friction
USUAL = (0.05, 0.95)  # quantiles of the frames' frictions between which friction is drawn
WIDER = 1.25  # factor by which the range of drawn frictions is wider at both ends
FEWEST = 8  # frames that the twin must be able to simulate and explain
LEAST_PX = 0.5  # least rms displacement that a frame's residuals are divided by
VARIES = 1e-6  # mm or deg; an axis of the label with a smaller standard deviation is left out
MODES_SHARE = 0.97  # part of the residuals' variance that the modes hold
LENGTHS = (1.0, 30.0)  # bounds of w, in standard deviations of the label
SIZES = (1e-3, 10.0)  # bounds of c and s, in rms of the amplitude
NOISES = (0.05, 1.0)  # bounds of n^2; with less noise so many lengths would explain some tens of frames exactly
TRUSTED = 0.5  # least ``Weights.trust`` of a frame whose residuals are used


@dataclass(frozen=True)
class Residuals:
    """What a twin misses on K frames with N pins.

    Attributes
    ----------
    axes : (K, 12) float
        See ``label_axes``.
    moved_px : (K, N, 2) float
        Simulated displacements.
    missing_px : (K, N, 2) float
        Real less simulated; 0 for lost pins.
    friction : (K,) float
        The likeliest friction of each frame; NaN where no move was executed, because only a move shows it.
    friction_px : (K,) float
        How plainly each frame shows its friction: rms change of the pins' places with its logarithm.
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
        """What friction to draw for simulated contacts; None where too few moves were executed to tell.

        A frame that slides or sticks with every friction shows nothing and is left out. All frames that show their friction count alike.
        """
        shown = self.friction[np.isfinite(self.friction) & (self.friction_px >= PLAIN_PX)]
        if len(shown) < FEWEST:
            return None
        low, high = np.quantile(shown, USUAL)
        return FrictionSpread(low=float(max(low / WIDER, FRICTIONS[0])), high=float(min(high * WIDER, FRICTIONS[-1])))


def label_axes(labels: list[ArmLabel]) -> np.ndarray:
    """(K, 12) the pose that was tapped at, and the move as far as it was executed: mm and deg."""
    return np.stack([np.concatenate([label.pose - label.move, label.move * label.executed]) for label in labels])


def measure_residuals(
    setup: Setup, measured: MeasuredFrames, progress: Callable | None = None, *, frictions: tuple = FRICTIONS
) -> Residuals:
    """Simulate labelled frames after the tap and after the move, with several frictions, and compare the likeliest story of each frame.

    Between two frictions pins are assumed to move evenly with the logarithm of friction. Friction differs from frame to frame, and
    simulated data sets draw it. So the best friction of each frame is taken: else the residuals would hold the friction a second time.

    Raises
    ------
    TrainingError
        The twin can simulate and explain too few frames.
    """
    labels, real_px = measured.labels, measured.pins_px - measured.no_contact_px
    setup = replace(setup, parameters=(FRICTION,))
    moved = simulate(setup, measured, [[np.log(friction)] for friction in frictions], rig_of(setup.sensor).turn_sign, progress)
    moved, friction, friction_px = _likeliest(moved, real_px, frictions)
    weights = expect(mean_squared(moved, real_px))
    good = np.flatnonzero(np.isfinite(moved).all(axis=(1, 2, 3)) & (weights.trust > TRUSTED))
    if len(good) < FEWEST:
        raise TrainingError(
            f"{len(good)} of {len(labels)} labelled frames fit the twin, at least {FEWEST} are needed; give more --labels, or --calibrate"
        )
    executed = weights.executed[good] > 0.5
    told = [replace(labels[k], executed=bool(done)) for k, done in zip(good, executed, strict=True)]
    simulated = moved[good, executed.astype(int)]
    friction = np.where(executed, friction[good, 1], np.nan)
    return Residuals(label_axes(told), simulated, np.nan_to_num(real_px[good] - simulated), friction, friction_px[good, 1])


def _likeliest(moved: np.ndarray, real_px: np.ndarray, frictions: tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The displacements (M, 2, N, 2) nearest to the real ones (M, N, 2), from those with F frictions (F, M, 2, N, 2).

    Also returned are their frictions (M, 2), and the rms change of the pins with the logarithm of friction (M, 2), px. All are NaN where
    the contact failed with every friction.
    """
    seen, target = np.isfinite(real_px)[:, None], np.nan_to_num(real_px)[:, None]
    best, least = np.full(moved.shape[1:], np.nan), np.full(moved.shape[1:3], np.inf)
    friction, told_px = np.full(moved.shape[1:3], np.nan), np.zeros(moved.shape[1:3])
    log = np.log(frictions)
    for k in range(len(frictions)):
        after = min(k + 1, len(frictions) - 1)
        start, way, step = moved[k], moved[after] - moved[k], log[after] - log[k]
        way = np.where(np.isfinite(way), way, 0.0)  # the next one failed: this one alone
        along, length = ((part * way * seen).sum(axis=(-2, -1)) for part in (target - start, way))
        share = np.clip(along / np.maximum(length, 1e-12), 0, 1)
        there = start + share[..., None, None] * way
        squared = (((target - there) * seen) ** 2).sum(axis=(-2, -1))
        nearer = squared < least  # never where it failed
        best[nearer], least[nearer] = there[nearer], squared[nearer]
        friction[nearer] = np.exp(log[k] + share * step)[nearer]
        told_px[nearer] = np.sqrt(length / way.shape[-2])[nearer] / max(step, 1e-12)
    return best, friction, told_px


class Discrepancy:
    """Gaussian processes of the residuals' modes.

    Parameters
    ----------
    residuals : Residuals
    """

    def __init__(self, residuals: Residuals) -> None:
        axes = residuals.axes
        self.used = axes.std(axis=0) > VARIES
        self.middle, self.spread = axes[:, self.used].mean(axis=0), axes[:, self.used].std(axis=0)
        relative = residuals.missing_px.reshape(len(axes), -1) / _rms_px(residuals.moved_px)[:, None]
        left, sizes, self.modes = np.linalg.svd(relative, full_matrices=False)
        kept = np.searchsorted(np.cumsum(sizes**2) / (sizes**2).sum(), MODES_SHARE) + 1
        amplitudes = left * sizes
        self.rest = amplitudes[:, kept:] @ self.modes[kept:] / np.sqrt(len(axes))  # random combinations of what the modes leave
        self.modes = self.modes[:kept]
        self.sizes = np.sqrt((amplitudes[:, :kept] ** 2).mean(axis=0))
        self.processes = [_process(self._scaled(axes), column) for column in (amplitudes[:, :kept] / self.sizes).T]

    def mean_px(self, labels: list[ArmLabel], moved_px: np.ndarray) -> np.ndarray:
        """(S, N, 2) what S simulated displacements (S, N, 2) are expected to miss."""
        scaled = self._scaled(label_axes(labels))
        amplitudes = np.stack([process.mean(Points.of(scaled)) for process in self.processes], axis=1)
        return self._fields(amplitudes, moved_px)

    def draw_px(self, labels: list[ArmLabel], moved_px: np.ndarray, contact: np.ndarray, seed: int) -> np.ndarray:
        """(S, N, 2) what S simulated displacements may miss: for the states of each contact (S,) one function of the posterior."""
        scaled = self._scaled(label_axes(labels))
        amplitudes = np.empty((len(scaled), len(self.modes)))
        shares = np.empty((len(scaled), len(self.rest)))
        for number in np.unique(contact):
            rows = np.flatnonzero(contact == number)
            rng = np.random.default_rng([seed, int(number)])
            for k, process in enumerate(self.processes):
                own = process.kernel.noises[0] * rng.normal()  # of the frame, the same for all states of a contact
                amplitudes[rows, k] = process.draw(Points.of(scaled[rows]), rng) + own
            shares[rows] = rng.normal(size=len(self.rest))
        return self._fields(amplitudes, moved_px, shares @ self.rest)

    def summary(self) -> list[dict]:
        """Of each mode: its share of the residuals, and of its variance the part that the label tells."""
        share = self.sizes**2 / ((self.sizes**2).sum() + (self.rest**2).sum())
        noise = [process.kernel.noises[0] ** 2 for process in self.processes]
        return [{"share": float(a), "told": float(max(0.0, 1 - n))} for a, n in zip(share, noise, strict=True)]

    def _scaled(self, axes: np.ndarray) -> np.ndarray:
        return (axes[:, self.used] - self.middle) / self.spread

    def _fields(self, amplitudes: np.ndarray, moved_px: np.ndarray, rest: np.ndarray | float = 0.0) -> np.ndarray:
        relative = (amplitudes * self.sizes) @ self.modes + rest
        return (relative * _rms_px(moved_px)[:, None]).reshape(moved_px.shape)


def _process(axes: np.ndarray, amplitude: np.ndarray) -> Posterior:
    """The likeliest process of an amplitude (K,) of labels (K, A), both of about unit size, within the bounds above."""

    def kernel(length: float, size: float, variance: float) -> Kernel:
        return Kernel(CONSTANT_AND_SMOOTH, np.full(axes.shape[1], length), np.full(2, size), np.sqrt([variance]))

    points = Points.of(axes)
    least, most = (kernel(LENGTHS[k], SIZES[k], NOISES[k]) for k in (0, 1))
    found = likeliest(kernel(2.0, np.sqrt(0.5), 0.3), points, amplitude, least=least, most=most)
    return Posterior(found, points, amplitude)


def _rms_px(moved_px: np.ndarray) -> np.ndarray:
    """(S,) of displacements (S, N, 2), with a floor."""
    return np.maximum(np.sqrt((moved_px**2).sum(axis=-1).mean(axis=-1)), LEAST_PX)
