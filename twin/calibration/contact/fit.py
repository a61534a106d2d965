"""Fit of the contact to labelled frames when it is unknown whether each frame's move was executed: parameters, simulation, search.

d_k1 and d_k0 are the mean squared pin errors of frame k after the move and after the tap alone, s^2 the median squared error, w the share
of executed moves, and theta the parameters with their prior:

    E-step:  p_k = w exp(-n d_k1 / 2 s^2) / (w exp(-n d_k1 / 2 s^2) + (1 - w) exp(-n d_k0 / 2 s^2))
    M-step:  theta minimises sum_k c_k n (p_k d_k1 + (1 - p_k) d_k0) / s^2 + sum ((theta - theta_0) / prior)^2

n is the number of independent observations in a frame. It is smaller than the number of pins, because the model's errors are common to all
pins. c_k is smaller for frames that neither hypothesis (move executed, or not) fits. The M-step is one Gauss-Newton step with difference
quotients. The uncertainty is the inverse of its matrix at the end.

If no frame shows the pins at rest, their places are fitted, too. For every theta, they are the mean over the frames of measured places
minus simulated displacements. Therefore errors and slopes are taken relative to their means over the frames.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError

from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.calibration.size import of_radius
from twin.errors import ContactError, FrameError
from twin.evaluation.labelled.model import ContactModel, MeasuredFrames
from twin.frames.forms import blob_spec
from twin.progress import Step, unheard
from twin.rig.kinematics import TURNING, rig_of
from twin.rig.labels import ArmLabel
from twin.store import Item, find_arrays, inputs_digest, keep_arrays
from twin.types import Form
from twin.workers import in_processes

LEAST = 1e-3
"""Least number of which a logarithm is computed; for a Poisson's ratio nu the least 1 - 2 nu."""

DETERMINED = 0.5
"""Least share of a parameter's prior variance that the data must remove for it to count as determined."""
Z90 = 1.645
"""Half a 90 % interval of the normal distribution, in standard deviations."""
SIZE = "skin.outer_radius_mm"
"""Key of the radius of a dome. If it is fitted, all lengths of the sensor and its rig are scaled with it (see ``of_radius``) before the
other parameters are set."""
INDEPENDENT = 6.0
"""n above: the number of modes that contain nearly all of the displacement."""
ROUNDS = 3
"""Most rounds of E-step and M-step."""
SHORTEST = 1 / 8
"""Least share of a Gauss-Newton step. A step that does not lower the cost is halved until this share, then the search ends."""
DISTRUST = 9.0
"""Ratio of a frame's squared error to the median (3 standard deviations) above which the frame has a smaller weight."""
EXPECT_ROUNDS = 20
"""Rounds of the E-step, in which the share of executed moves and the variance are found alternately. Fewer rounds are enough."""
START_FRAMES = 3
"""Number of frames with the largest turns, and of frames with the largest moves, by which the signs at the start are chosen."""
TURNS_DEG = (0.0, 90.0, 180.0, 270.0)
"""Turns of the image, deg, that are tried at the start."""
FEWEST = 4
"""Fewest frames to which a contact is fitted."""
LEAST_PX2 = 0.01
"""Least variance of a pin's place, px^2: the precision of the measurement."""
SMALLEST_SHARE, LARGEST_SHARE = 0.05, 0.95
"""Bounds of the share of executed moves, so that its logarithm stays finite."""


@dataclass(frozen=True)
class FittedParameter:
    """One number of a sensor's specification that is fitted.

    Attributes
    ----------
    name : str
        Dotted key. Of ``rig.turn_offset_deg`` only the turn in the plane of approach and across is fitted.
    prior : float
        Prior standard deviation of the fitted quantity around its start.
    step : float
        Step of the fitted quantity for difference quotients.
    scale : {"plain", "log", "volume"}
        The fitted quantity: the number itself, its logarithm, or, for a Poisson's ratio nu, log(1 - 2 nu), which measures how
        compressible the volume is.
    least : float
        Smallest meaningful number. If the fitted quantity is below it, the number is ``least``.
    """

    name: str
    prior: float
    step: float
    scale: Literal["plain", "log", "volume"] = "plain"
    least: float = -np.inf

    def fitted_quantity(self, number: float) -> float:
        """The fitted quantity that belongs to a number of the specification."""
        if self.scale == "plain":
            return number
        return float(np.log(max(number if self.scale == "log" else 1 - 2 * number, LEAST)))

    def number(self, fitted: float) -> float:
        """The number of the specification that belongs to a fitted quantity."""
        if self.scale == "plain":
            return max(float(fitted), self.least)
        return float(np.exp(fitted) if self.scale == "log" else (1 - np.exp(fitted)) / 2)

    def slope(self, fitted: float) -> float:
        """Absolute change of the number for a change of the fitted quantity by 1."""
        return 1.0 if self.scale == "plain" else float(np.exp(fitted)) / (1 if self.scale == "log" else 2)


PARAMETERS = (
    FittedParameter("rig.contact_offset_mm", 0.5, 0.05),
    FittedParameter("rig.tcp_to_dome_mm", 10.0, 0.5),
    FittedParameter("rig.tcp_lateral_mm", 2.0, 0.2),
    FittedParameter("rig.turn_offset_deg", 3.0, 0.3),
    FittedParameter("rig.plate_tilt_deg", 2.0, 0.3),
    FittedParameter("rig.image_turn_deg", 10.0, 1.0),
    FittedParameter("rig.friction", 0.7, 0.15, "log"),
    FittedParameter("rig.compliance_mm_per_n", 0.1, 0.02, least=0.0),
    FittedParameter("rig.turn_compliance_deg_per_n", 0.3, 0.1),
    FittedParameter("gel.young_modulus_mpa", 0.7, 0.15, "log"),
    FittedParameter("gel.poisson_ratio", 0.7, 0.3, "volume"),
    FittedParameter("skin.thickness_mm", 0.2, 0.05),
    FittedParameter("pins.length_mm", 0.3, 0.1, "log"),
)


@dataclass(frozen=True)
class FittedContacts:
    """What all contacts of a fit have in common.

    Attributes
    ----------
    sensor : SensorSpec
        The sensor at the start of the fit.
    experiment : ExperimentSpec
        The experiment that the contacts were recorded with.
    obj : ObjectSpec
    across : int
        Elements along each side of the skin's grid.
    workers : int
        Number of processes.
    parameters : tuple of FittedParameter
        The fitted parameters.
    """

    sensor: SensorSpec
    experiment: ExperimentSpec
    obj: ObjectSpec
    across: int
    workers: int = field(default=1, kw_only=True)
    parameters: tuple[FittedParameter, ...] = field(default=PARAMETERS, kw_only=True)

    @property
    def quantities(self) -> np.ndarray:
        """Fitted quantities (P,) of the sensor's parameters."""
        plain = self.sensor.model_dump(include={"gel", "skin", "pins"}) | {"rig": rig_of(self.sensor).model_dump()}
        turning = TURNING[self.experiment.approach] - 3
        out = []
        for parameter in self.parameters:
            section, key = parameter.name.split(".")
            value = plain[section][key]
            out.append(parameter.fitted_quantity(value[turning] if key == "turn_offset_deg" else value))
        return np.array(out)

    def sensor_with(self, quantities: np.ndarray, turn_sign: int) -> SensorSpec:
        """The sensor with other fitted quantities (P,) of the parameters.

        Raises
        ------
        ValidationError
            The quantities do not make a valid sensor.
        """
        sensor, pairs = self.sensor, list(zip(self.parameters, quantities, strict=True))
        for parameter, value in pairs:
            if parameter.name == SIZE:
                sensor = of_radius(sensor.alter(rig=rig_of(sensor)), parameter.number(value))
        plain = sensor.model_dump(mode="json") | {"rig": rig_of(sensor).model_dump(mode="json")}
        plain["rig"]["turn_sign"] = int(turn_sign)
        for parameter, value in pairs:
            section, key = parameter.name.split(".")
            if key == "turn_offset_deg":
                plain[section][key][TURNING[self.experiment.approach] - 3] = parameter.number(value)
            else:
                plain[section][key] = parameter.number(value)
        return SensorSpec.model_validate(plain)


@dataclass(frozen=True)
class CalibrationSetup(FittedContacts):
    """The contacts of a calibration. Each is stored on disk as soon as it is simulated.

    Attributes
    ----------
    form : Form
        Form of the frames, in whose px the displacements are.
    folder : Path
        Folder for the simulated contacts.
    """

    form: Form
    folder: Path

    def displacements(self, jobs: list[tuple], labels: list[ArmLabel], progress: Step = unheard) -> np.ndarray:
        """(J, 2, N, 2) px after tap and after move, for jobs of (values (P,), turn_sign, row of ``labels``); NaN if the contact failed."""
        shared = inputs_digest(replace(self, folder=Path(), workers=1))
        moves = [ArmLabel(label.pose, label.move) for label in labels]  # as if they had been executed
        tasks = [(k, np.asarray(values, float), int(sign), moves[row]) for k, (values, sign, row) in enumerate(jobs)]
        items = [Item("contact", (__name__,), [shared, *task[1:]]) for task in tasks]
        found = {k: kept["displacements_px"] for k, item in enumerate(items) if (kept := find_arrays(self.folder, item)) is not None}
        todo = [task for task in tasks if task[0] not in found]
        for k, both in in_processes(partial, (_contact, self), todo, processes=self.workers):
            keep_arrays(self.folder, items[k], {"displacements_px": both})
            found[k] = both
            progress(len(found), len(items))
        return np.stack([found[k] for k in range(len(items))])

    def simulate(self, measured: MeasuredFrames, values: list, sign: int, progress: Step = unheard) -> np.ndarray:
        """(V, M, 2, N, 2) px of measured frames for V vectors of values."""
        jobs = [(each, sign, row) for each in values for row in range(len(measured))]
        return self.displacements(jobs, measured.labels, progress).reshape(len(values), len(measured), 2, -1, 2)

    def slopes(self, measured: MeasuredFrames, value: np.ndarray, sign: int, moved: np.ndarray, progress: Step) -> np.ndarray:
        """Derivatives (P, M, 2, N, 2) of the displacements by each fitted quantity, px; 0 for a failed contact."""
        steps = np.diag([p.step for p in self.parameters])
        there = self.simulate(measured, [value + step for step in steps], sign, progress)
        return np.nan_to_num((there - moved) / np.diag(steps)[:, None, None, None, None])


def _contact(setup: CalibrationSetup, task: tuple[int, np.ndarray, int, ArmLabel]) -> tuple[int, np.ndarray]:
    number, values, sign, label = task
    try:
        return number, np.stack(_model(setup, tuple(values.tolist()), sign).displacements_px(label))
    except (ContactError, ValidationError):
        return number, np.full((2, setup.sensor.pins.count, 2), np.nan)


@lru_cache(maxsize=4)
def _model(setup: CalibrationSetup, values: tuple[float, ...], sign: int) -> ContactModel:
    return ContactModel(setup.sensor_with(np.array(values), sign), setup.experiment, setup.obj, setup.form, across=setup.across)


@dataclass(frozen=True)
class Weights:
    """The E-step's result for M frames."""

    executed: np.ndarray
    trust: np.ndarray
    share: float
    variance_px2: float

    def cost(self, squared_px2: np.ndarray) -> float:
        """Cost of squared errors (M, 2), after tap and after move. A failed contact (NaN) has no cost."""
        squared = np.nan_to_num(squared_px2)
        each = (1 - self.executed) * squared[:, 0] + self.executed * squared[:, 1]
        return float(INDEPENDENT / self.variance_px2 * self.trust @ each)


@dataclass(frozen=True)
class ContactFit:
    """The result of a calibration.

    Attributes
    ----------
    sensor : SensorSpec
    start, value, sd : (P,) float
        Fitted quantities of the parameters (see ``FittedParameter.scale``) at the start and at the end, and their standard deviations.
    determined : (P,) float
        Share of the prior's variance that the frames removed: 1 if the frames determine the parameter, 0 if it stayed at its start.
    correlation : (P, P) float
    executed : (M,) float
        Probability that each frame's move was executed.
    trust : (M,) float
        1 for a frame that one of the two hypotheses explains; near 0 for a frame that neither explains.
    before_px, after_px : (M,) float
        Mean pin error of each frame for the hypothesis that fits it better.
    share : float
        Share of the moves that were executed.
    rest_px : (N, 2) float
        Pins at rest, from which displacements are computed. If no frame shows them, they are fitted, and ``sensor`` contains them.
    """

    sensor: SensorSpec
    start: np.ndarray
    value: np.ndarray
    sd: np.ndarray
    determined: np.ndarray
    correlation: np.ndarray
    executed: np.ndarray
    trust: np.ndarray
    before_px: np.ndarray
    after_px: np.ndarray
    share: float
    rest_px: np.ndarray


def fit_contact(setup: CalibrationSetup, measured: MeasuredFrames, *, progress: Step = unheard) -> ContactFit:
    """Fit the setup's parameters and the sign of the turns.

    Raises
    ------
    FrameError
        There are too few frames, or none of their contacts can be simulated.
    """
    if len(measured) < FEWEST:
        raise FrameError(f"too few frames with pins ({len(measured)}); give `num_labelled` {FEWEST} or more")
    target = measured.pins_px - measured.no_contact_px
    start, sign = _start(setup, measured, target, progress)
    prior = np.array([p.prior for p in setup.parameters])
    value, moved, weights = _search_values(setup, measured, target, start, sign, progress)
    slopes = setup.slopes(measured, value, sign, moved, progress)
    seen_at_rest = measured.at_rest_seen
    shift = np.zeros_like(measured.no_contact_px) if seen_at_rest else _mean(target[:, None] - moved, weights)
    matrix, _ = _normal(slopes, target[:, None] - moved, weights, seen_at_rest)
    covariance = np.linalg.inv(matrix + np.diag(prior**-2))
    sd = np.sqrt(np.diag(covariance))
    shipped = setup.quantities
    first = setup.simulate(measured, [shipped], rig_of(setup.sensor).turn_sign, progress)[0]
    sensor, rest_px = setup.sensor_with(value, sign), measured.no_contact_px + shift
    sensor = sensor if seen_at_rest else at_rest(sensor, measured.form, rest_px)
    determined, correlation = 1 - (sd / prior) ** 2, covariance / np.outer(sd, sd)
    before_px, after_px = likelier_px(first, target), likelier_px(moved, target - shift)
    executed, trust, share = weights.executed, weights.trust, weights.share
    return ContactFit(sensor, shipped, value, sd, determined, correlation, executed, trust, before_px, after_px, share, rest_px)


def _search_values(
    setup: CalibrationSetup, measured: MeasuredFrames, target: np.ndarray, start: np.ndarray, sign: int, progress: Step
) -> tuple[np.ndarray, np.ndarray, Weights]:
    """The values (P,) with the least cost, their displacements (M, 2, N, 2) px, and the weights of the E-step for them."""
    prior = np.array([p.prior for p in setup.parameters])
    value = start.copy()
    seen_at_rest = measured.at_rest_seen
    moved = setup.simulate(measured, [value], sign, progress)[0]
    weights = expect(mean_squared(moved, target if seen_at_rest else target - np.nanmedian(target - moved[:, 1], axis=0)))

    def squared_of(displacements: np.ndarray) -> np.ndarray:
        shift = 0.0 if seen_at_rest else _mean(target[:, None] - displacements, weights)
        return mean_squared(displacements, target - shift)

    def cost(tried: np.ndarray, weights: Weights, solved: int) -> tuple[float, np.ndarray]:
        there = setup.simulate(measured, [tried], sign, progress)[0]
        squared = squared_of(there)
        fewer = np.isfinite(squared).sum() < solved
        return np.inf if fewer else weights.cost(squared) + float(np.sum(((tried - start) / prior) ** 2)), there

    for _ in range(ROUNDS):
        slopes = setup.slopes(measured, value, sign, moved, progress)
        matrix, force = _normal(slopes, target[:, None] - moved, weights, seen_at_rest)
        step = np.linalg.solve(matrix + np.diag(prior**-2), force + (start - value) / prior**2)
        squared = squared_of(moved)
        now, solved = weights.cost(squared) + np.sum(((value - start) / prior) ** 2), np.isfinite(squared).sum()
        found = shorten_step(value, step, now, partial(cost, weights=weights, solved=solved))
        if found:
            value, _, moved = found
        weights = expect(squared_of(moved))
        if not found:
            break
    return value, moved, weights


def shorten_step(
    value: np.ndarray, step: np.ndarray, now: float, cost: Callable[[np.ndarray], tuple[float, np.ndarray]]
) -> tuple[np.ndarray, float, np.ndarray] | None:
    """The values (P,) after a step that is halved until the cost is below ``now``, with their cost and what else ``cost`` returns."""
    length = 1.0
    while length >= SHORTEST:
        tried = value + length * step
        there, state = cost(tried)
        if there < now:
            return tried, there, state
        length /= 2
    return None


def held_out_px(setup: CalibrationSetup, fit: ContactFit, measured: MeasuredFrames, *, progress: Step = unheard) -> tuple[float, float]:
    """Mean pin error, before and after, on held-out frames. Each frame's error is that of the hypothesis that fits it better."""
    before, after = before_and_after(setup, fit, measured, progress)
    target = measured.pins_px - measured.no_contact_px
    errors = likelier_px(before, target), likelier_px(after, target - (fit.rest_px - measured.no_contact_px))
    return float(np.nanmean(errors[0])), float(np.nanmean(errors[1]))


def before_and_after(setup: CalibrationSetup, fit: ContactFit, measured: MeasuredFrames, progress: Step = unheard) -> np.ndarray:
    """(2, M, 2, N, 2) px with the values at the start and at the end of a fit."""
    ends = ((fit.start, rig_of(setup.sensor).turn_sign), (fit.value, rig_of(fit.sensor).turn_sign))
    return np.stack([setup.simulate(measured, [values], sign, progress)[0] for values, sign in ends])


def likelier_px(moved: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(M,) mean pin error of displacements (M, 2, N, 2) from (M, N, 2), for the hypothesis with the smaller one."""
    seen = np.isfinite(target[:, None, :, 0])
    each = np.where(seen, np.linalg.norm(moved - target[:, None], axis=-1), 0.0)
    return np.fmin(*(each.sum(axis=-1) / np.maximum(seen.sum(axis=-1), 1)).T)


def expect(squared_px2: np.ndarray) -> Weights:
    """The E-step from squared errors (M, 2) after tap and after move. Share and variance are found alternately until they converge."""
    failed = ~np.isfinite(squared_px2).all(axis=1)
    squared = np.where(failed[:, None], 0.0, squared_px2)
    best, share = squared.min(axis=1), 0.5
    variance = max(float(np.median(best[~failed])), LEAST_PX2) if (~failed).any() else LEAST_PX2
    for _ in range(EXPECT_ROUNDS):
        odds = INDEPENDENT * (squared[:, 0] - squared[:, 1]) / (2 * variance) + np.log(share / (1 - share))
        executed = 1 / (1 + np.exp(-np.clip(odds, -50, 50)))
        trust = np.where(failed, 0.0, np.minimum(1.0, DISTRUST * variance / np.maximum(best, 1e-12)) ** 2)
        each = (1 - executed) * squared[:, 0] + executed * squared[:, 1]
        if trust.sum() == 0:
            break
        variance = max(float(np.median(each[~failed])), LEAST_PX2)  # the median, because frames that nothing fits do not change it
        share = float(np.clip(trust @ executed / trust.sum(), SMALLEST_SHARE, LARGEST_SHARE))
    return Weights(executed, trust, share, variance)


def _start(setup: CalibrationSetup, measured: MeasuredFrames, target: np.ndarray, progress: Step) -> tuple[np.ndarray, int]:
    """Values (P,) and sign of the turns at the start: the best fit among both signs and all quarter turns of the image."""
    value = setup.quantities
    by_turn = np.argsort([-np.abs(label.pose[3:] - label.move[3:]).max() for label in measured.labels])[:START_FRAMES]
    by_move = np.argsort([-np.abs(label.move[:3]).max() for label in measured.labels])[:START_FRAMES]
    telling = np.union1d(by_turn, by_move)
    turns = np.array([p.name == "rig.image_turn_deg" for p in setup.parameters])
    own, turns_deg = rig_of(setup.sensor).turn_sign, TURNS_DEG if turns.any() else (0.0,)
    tries = [(value + degrees * turns, sign * own) for degrees, sign in product(turns_deg, (1, -1))]
    jobs = [(tried, sign, int(row)) for tried, sign in tries for row in telling]
    moved = setup.displacements(jobs, measured.labels, progress).reshape(len(tries), len(telling), 2, -1, 2)
    errors = [np.mean(likelier_px(each, target[telling])) for each in moved]
    if not np.isfinite(errors).any():
        raise FrameError("none of the first contacts can be simulated; are `experiment` and `sensor` those of the frames?")
    return tries[int(np.nanargmin(errors))]


def mean_squared(moved: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(M, 2) mean squared pin error, px^2, of displacements (M, 2, N, 2). Lost pins are left out; a failed contact gives NaN."""
    seen = np.isfinite(target[:, None, :, 0])
    each = np.sum((moved - target[:, None]) ** 2, axis=-1)
    return np.where(seen, each, 0.0).sum(axis=-1) / np.maximum(seen.sum(axis=-1), 1)


def at_rest(sensor: SensorSpec, form: Form, pins_px: np.ndarray) -> SensorSpec:
    """The sensor with these places (N, 2) of its pins at rest in frames of a form."""
    blob = blob_spec(sensor.pipeline, form).alter(rest_px=tuple(map(tuple, pins_px.round(3).tolist())))
    return sensor.alter(pipeline={str(form): blob})


def _shares(weights: Weights) -> np.ndarray:
    """(M, 2) weight of each frame's two hypotheses."""
    return np.stack([1 - weights.executed, weights.executed], axis=1) * weights.trust[:, None]


def _mean(missing: np.ndarray, weights: Weights) -> np.ndarray:
    """(..., N, 2) mean over frames and hypotheses of (..., M, 2, N, 2); NaN values are left out."""
    share = _shares(weights)[..., None, None] * np.isfinite(missing)
    mean: np.ndarray = (share * np.nan_to_num(missing)).sum(axis=(-4, -3)) / np.maximum(share.sum(axis=(-4, -3)), 1e-12)
    return mean


def _normal(slopes: np.ndarray, missing: np.ndarray, weights: Weights, seen_at_rest: bool) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (P, P) and right-hand side (P,) of the Gauss-Newton step. Lost pins are left out."""
    seen = np.isfinite(missing)
    share = _shares(weights)
    if not seen_at_rest:
        missing = missing - _mean(missing, weights)
        slopes = slopes - _mean(np.where(seen, slopes, np.nan), weights)[:, None, None]
    pins = np.maximum(seen[..., 0].sum(axis=-1), 1)
    each = (INDEPENDENT / weights.variance_px2 * share / pins)[..., None, None] * seen
    weighted = slopes * each
    rows = slopes.reshape(len(slopes), -1)
    return weighted.reshape(len(slopes), -1) @ rows.T, weighted.reshape(len(slopes), -1) @ np.nan_to_num(missing).ravel()
