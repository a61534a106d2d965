"""The twin's forces against a table of poses and forces alone: a fit to some of its rows, an evaluation on the others, and a page.

For the force f of the sensor on the object, the force sensor's reading is ``r = offset + gain * Rz(-turn) f`` (``ForceSensorSpec``). The
sign of the arm's angles, the axes, signs and turn of the readings are determined before the fit, unless the specification has a force
sensor. With the error e = NOISE_N + NOISE_SHARE |force|, the parameters theta

    minimise  sum ((r(theta) - measured) / e)^2 / s^2 + sum ((theta - start) / prior)^2

by Gauss-Newton steps with difference quotients. s is the root mean square of the errors relative to e before each step. A parameter of
whose prior variance the rows leave more than half returns to its start, and the others are fitted again without it. With s at the end,
and P parameters fitted to M rows, the 90 % interval of a force is ``t(M - P / 3) s e sqrt(1 + P / 3 M)`` to each side, t being the quantile
of Student's distribution.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from scenes.rig import ForceSensorSpec
from scenes.sensor import SensorSpec
from twin.calibration.contact.fit import DETERMINED, PARAMETERS, SIZE, FittedContacts, FittedParameter, shorten_step
from twin.calibration.contact.newtons import COVERED, compare_forces
from twin.calibration.contact.report import add_parameters, describe_parameters
from twin.errors import ContactError, FrameError, OptionError
from twin.frames.tables import called_here, numbers, read_columns, unlikely_units
from twin.geometry.solid import Resolution
from twin.mechanics.solver import SkinSolver
from twin.progress import Progress, Step, stage, unheard
from twin.report.charts import new_figure, write_chart
from twin.report.page import Column, Page, PagePicture, write_rows
from twin.rig.contact import RigContact
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel, poses_and_moves
from twin.store import made_by, write_json
from twin.types import ReadableResult
from twin.workers import in_processes

OF_PINS = ("rig.contact_offset_mm", "rig.tcp_to_dome_mm", "rig.friction", "gel.young_modulus_mpa")
FORCE_PARAMETERS = (
    *(parameter for parameter in PARAMETERS if parameter.name in OF_PINS),
    FittedParameter("gel.poisson_ratio", 1.5, 0.3, "volume"),
    FittedParameter("skin.young_modulus_mpa", 0.5, 0.1, "log"),
    FittedParameter(SIZE, 0.3, 0.03, "log"),
)
"""Parameters of the sensor and its rig on which forces depend. The others move pins, and hardly change forces."""
CELL = (
    *(FittedParameter(f"rig.force_sensor.offset_n[{axis}]", 0.1, 0.1) for axis in range(3)),
    FittedParameter("rig.force_sensor.turn_deg", 10.0, 1.0),
)
"""The force sensor's own parameters, which come last in every vector of values."""
FILES = ("index.html", "forces.json", "rows.csv", "forces.png", "forces-dark.png")
"""Files of a comparison of forces."""
POSES = tuple(f"{kind}_{axis}" for kind in ("pose", "move") for axis in range(1, 7))
FACTOR = r"^(?:([-+]?\d*\.?\d+(?:e[-+]?\d+)?)\*|(-))?(.*)"
"""A column's name with a factor or a minus sign before it."""
FEWEST_ROWS = 8
NOISE_N, NOISE_SHARE = 0.05, 0.05
"""Error of a force: a constant, and a share of the force."""
SLIDING = 0.99
"""Share of the normal force that slips from which a contact counts as sliding."""
LEAST_VARIANCE = 1e-4
"""Least square of s, because exact forces have errors, too."""
ROUNDS, ENOUGH = 8, 0.02
"""Most Gauss-Newton steps, and the relative decrease of the cost below which the fit ends."""
UNLIKE, CLEARER = 0.6, 1.1
"""Largest share of the forces' variance that the twin may leave unexplained before any fit, up to a factor and a turn. The sign of the
angles counts as determined if the other sign leaves ``CLEARER`` times as much."""
LARGEST_SCALE, UNTARED, SIDEWAYS = 8.0, 0.5, 0.05
"""Largest ratio of measured to simulated forces in newtons; least reading without contact, relative to the range of the
forces, that is not left to the fit; least ratio of side force to normal force at which the turn of the force sensor can be determined."""


@dataclass(frozen=True, repr=False)
class ForceComparison(ReadableResult):
    """Measured and simulated forces of a table, and the fit to some of its rows.

    Attributes
    ----------
    sensor : SensorSpec
        With the fitted parameters, and the table's conventions in ``rig.force_sensor``.
    summary : dict
        Content of ``forces.json``.
    rows : list of dict
        Labels, measured and simulated force, half the 90 % interval and slip of each contact (``rows.csv``).
    written : list of Path
    """

    sensor: SensorSpec
    summary: dict[str, Any]
    rows: list[dict[str, Any]]
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text: errors, conventions, parameters with their 90 % intervals."""
        lines = []
        for part, of in self.summary["parts"].items():
            errors = " -> ".join(", ".join(f"{each:.3f}" for each in of[key]) for key in ("before_n", "error_n"))
            lines.append(
                f"{of['rows']} rows {part}: mean absolute error of Fx, Fy, Fz {errors} N; {of['inside']:.0%} in the 90 % intervals"
            )
        lines += [f"note: {each}" for each in self.summary["notes"]]
        for p in self.summary["parameters"]:
            doubt = f"{p['low']:.3g} to {p['high']:.3g}" if p["known"] else "left at its start: these rows do not determine it"
            lines.append(f"{p['name']:30s} {p['start']:9.4g} -> {p['value']:9.4g}  {doubt}")
        return lines


@dataclass(frozen=True)
class ForceSetup(FittedContacts):
    """The contacts of a table of forces."""

    parameters: tuple[FittedParameter, ...] = field(default=FORCE_PARAMETERS, kw_only=True)

    @property
    def reads(self) -> ForceSensorSpec:
        """The force sensor: the rig's own, or one that reads the force on the object in the work frame."""
        return rig_of(self.sensor).force_sensor or ForceSensorSpec()

    @property
    def start(self) -> np.ndarray:
        """Values (P + 4,) of the parameters and of ``CELL`` at the start."""
        return np.array([*self.quantities, *self.reads.offset_n, self.reads.turn_deg])

    def with_rig(self, **changes: Any) -> "ForceSetup":
        """The setup with other values of the rig."""
        rig = rig_of(self.sensor, self.obj.name).alter(**changes)
        return replace(self, sensor=self.sensor.alter(rig=rig))

    def sensor_of(self, values: np.ndarray) -> SensorSpec:
        """The sensor with other values (P + 4,)."""
        cell = {"offset_n": tuple(values[-4:-1].round(4).tolist()), "turn_deg": round(float(values[-1]), 2)}
        sensor = self.sensor_with(values[:-4], rig_of(self.sensor).turn_sign)
        return replace(self, sensor=sensor).with_rig(force_sensor=self.reads.alter(**cell)).sensor

    def forces(self, values: Sequence[np.ndarray], labels: Sequence[ArmLabel], step: Step = unheard) -> np.ndarray:
        """(V, M, 7) for V vectors of values and M labels; a contact that fails is NaN.

        Force on the object in the axes of the work frame and in those of the tool, N, and the share of the normal force that slips.
        """
        found = np.empty((len(values) * len(labels), 7))
        tasks = list(enumerate(product(values, labels)))
        for done, (k, each) in enumerate(in_processes(partial, (_force, self), tasks, processes=self.workers), 1):
            found[k] = each
            step(done, len(found))
        return found.reshape(len(values), len(labels), 7)

    def readings(self, forces: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Readings (M, 3) of the force sensor with these values, for ``forces`` (M, 7)."""
        of = forces[:, :3] if self.reads.frame == "work" else forces[:, 3:6]
        reading: np.ndarray = values[-4:-1] + np.array(self.reads.gain) * Rotation.from_euler("z", -values[-1], degrees=True).apply(of)
        return reading


def _force(setup: ForceSetup, task: tuple[int, tuple[np.ndarray, ArmLabel]]) -> tuple[int, np.ndarray]:
    number, (values, label) = task
    try:
        sensor = setup.sensor_of(values)
        rig = rig_of(sensor, setup.obj.name)
        state = RigContact(SkinSolver(sensor, resolution=Resolution(setup.across)), setup.experiment, setup.obj, rig=rig).end(label)
    except (ContactError, ValidationError):
        return number, np.full(7, np.nan)
    stands = Rotation.from_euler("zy", [rig.object_turn_deg, -rig.plate_tilt_deg], degrees=True)
    work = stands.apply(state.T_sensor_object[:3, :3].T @ state.force_n)
    tool = Rotation.from_euler("z", -rig.image_turn_deg, degrees=True).apply(state.force_n)
    return number, np.array([*work, *tool, state.normal_n @ state.slipping / max(state.normal_n.sum(), 1e-12)])


def noise_of(force_n: np.ndarray) -> np.ndarray:
    """NOISE_N + NOISE_SHARE of the force, (M, 1), for forces (M, 3)."""
    return np.asarray(NOISE_N + NOISE_SHARE * np.linalg.norm(force_n, axis=1, keepdims=True))


def is_table(frames: Path) -> bool:
    """Whether a path is a table, and not a recording."""
    return frames.suffix.casefold() in (".csv", ".tsv") and frames.is_file()


def read_forces(path: Path, setup: ForceSetup, columns: Mapping[str, str]) -> tuple[list[ArmLabel], np.ndarray, list[str]]:
    """Labels of a table's rows, forces (M, 3), N, and doubts about units. Poses and moves without a column count as zero.

    ``columns`` maps the names that are used here to the table's own, with a sign or a factor before them: ``-z``, ``0.001*Fz_mN``.

    Raises
    ------
    FrameError
        The approach is not along z, a column is missing or constant, or a cell is no number.
    """
    if setup.experiment.approach != "z":
        raise FrameError(f"experiment {setup.experiment.name}: a table of forces needs an approach along z; give such an experiment")
    table, forces, factors = called_here(read_columns(path)), setup.reads.columns, {}
    if unknown := [key for key in columns if key not in (*POSES, *forces)]:
        raise OptionError(f"`column` {unknown[0]}: no such key; known: {', '.join((*POSES, *forces))}")
    names = {key: columns.get(key, key) for key in (*POSES, *forces) if key in ("pose_3", *forces, *columns) or key in table}
    for key, name in names.items():
        number, minus, own = (None, None, name) if name in table else re.findall(FACTOR, name)[0]
        if own not in table:
            raise FrameError(f"{path}: no column {own}; name it by `column` ({key}=NAME); the table has {', '.join(table)}")
        names[key], factors[key] = own, float(number or 1) * (-1 if minus else 1)
    values = {key: factors[key] * numbers(table[own]) for key, own in names.items()}
    count = len(values["pose_3"])
    for key, cells in values.items():
        if not (known := np.isfinite(cells)).all():
            raise FrameError(f"{path}: column {names[key]}, row {np.argmin(known) + 1}: no number; repair or remove the row")
        if key in ("pose_3", forces[2]) and (count < FEWEST_ROWS or not np.ptp(cells)):
            raise FrameError(f"{path}: column {names[key]} has {count} rows or is constant; give {FEWEST_ROWS} different presses or more")
    at = np.stack([values.get(key, np.zeros(count)) for key in POSES], axis=1)
    return [ArmLabel(row[:6], row[6:]) for row in at], np.stack([values[key] for key in forces], axis=1), unlikely_units(values)


def find_conventions(
    setup: ForceSetup, labels: Sequence[ArmLabel], measured: np.ndarray, step: Step = unheard
) -> tuple[ForceSetup, list[str]]:
    """The setup with the sign of the arm's angles and the force sensor's axes, and these in words. Those of the specification come first.

    Raises
    ------
    FrameError
        Most contacts do not touch in the simulation, or the measured forces do not follow the simulated ones, up to a factor and a turn.
    """
    rig, columns, tried = rig_of(setup.sensor), setup.reads.columns, []
    for sign in (rig.turn_sign,) if rig.force_sensor else (1, -1):
        there = setup.with_rig(turn_sign=sign)
        found = there.forces([there.start], labels, step)[0]
        touching = np.isfinite(found[:, 2]) & (found[:, 2] != 0)
        if touching.sum() <= len(labels) / 2:
            raise FrameError(
                f"pose_3: in the simulation {touching.sum()} of {len(labels)} contacts are possible and touch; it must be the depth "
                "past the first touch in mm: convert it by `column` (pose_3=-NAME, pose_3=1000*NAME), or set rig.contact_offset_mm"
            )
        for (frame, f), mirror in product((("work", found[touching, :3]), ("tool", found[touching, 3:6])), (1, -1)):
            flat, side, real = f[:, 0] + 1j * f[:, 1], measured[touching, 0] + 1j * mirror * measured[touching, 1], measured[touching, 2]
            turn, left, rest = _regress(flat, side) if flat.std() > SIDEWAYS * f[:, 2].std() else (1.0, 0.0, side.mean())
            scale, left_z, rest_z = _regress(f[:, 2], real)
            turn_deg = round(-float(np.degrees(np.angle(turn))), 1)
            gain, offset_n = (1.0, float(mirror), float(np.sign(scale.real))), np.array([rest.real, mirror * rest.imag, rest_z.real])
            tried.append((left + left_z, mirror < 0, sign, frame, left, left_z, scale.real, gain, turn_deg, offset_n))
    if rig.force_sensor:
        return setup, [f"given by rig.force_sensor: {describe_conventions(rig.force_sensor, rig.turn_sign)}"]
    total, _, sign, frame, left, left_z, scale, gain, turn_deg, offset_n = min(tried, key=lambda each: each[:2])
    if odd := columns[2] if left_z > UNLIKE else ", ".join(columns[:2]) if left > UNLIKE else "":
        raise FrameError(
            f"{odd}: does not follow the simulated force (share of the variance left: normal force {left_z:.0%}, side force {left:.0%}); "
            "is pose_3 the depth? Name the right columns by `column`, or state rig.turn_sign and rig.force_sensor"
        )
    if not 1 / LARGEST_SCALE < abs(scale) < LARGEST_SCALE:
        raise FrameError(
            f"{columns[2]}: {abs(scale):.2g} times the simulated force; if it is not in N, convert it by `column` "
            f"({columns[2]}=0.001*NAME for mN, 0.00981*NAME for g), or correct the stiffness of the specification"
        )
    offset_n = np.where(abs(offset_n) > UNTARED * np.ptp(measured, axis=0).max(), offset_n, 0.0).round(3)
    reads = ForceSensorSpec(columns=columns, frame=frame, gain=gain, turn_deg=turn_deg, offset_n=tuple(offset_n.tolist()))
    notes = [f"determined, as the specification has no rig.force_sensor: {describe_conventions(reads, sign)}"]
    if min(each[0] for each in tried if each[2] != sign) < CLEARER * total:
        notes.append("the rows hardly determine the sign of the angles: state rig.turn_sign and rig.force_sensor if you know them")
    return setup.with_rig(turn_sign=sign, force_sensor=reads), notes


def _regress(x: np.ndarray, y: np.ndarray) -> tuple[complex, float, complex]:
    """Slope, share of the variance that is left, and intercept of a straight line through (M,) real or complex numbers."""
    slope = np.vdot(x - x.mean(), y - y.mean()) / max(len(x) * x.var(), 1e-12)
    rest = y.mean() - slope * x.mean()
    return complex(slope), float((y - slope * x).var() / max(y.var(), 1e-12)), complex(rest)


def describe_conventions(reads: ForceSensorSpec, sign: int) -> str:
    """The conventions of a table in words."""
    hands, reversed_axes = ("right", "left")[::sign], [axis for axis, gain in zip("xyz", reads.gain, strict=True) if gain < 0]
    return (
        f"the sensor is pressed at pose - shear along z of the work frame, then moved to pose, by {hands[0]}-handed static xyz "
        f"angles (a plate can't distinguish this from a press at pose + shear by {hands[1]}-handed ones, with the force sensor turned by "
        f"180 deg more); {', '.join(reads.columns)} are the force on the object in N in the axes of the {reads.frame} frame, turned by "
        f"{reads.turn_deg:.1f} deg about z"
        + (f", then with {' and '.join(reversed_axes)} reversed" if reversed_axes else "")
        + (f"; without contact they are {', '.join(f'{each:.3g}' for each in reads.offset_n)} N" if any(reads.offset_n) else "")
    )


def fit_forces(setup: ForceSetup, labels: Sequence[ArmLabel], measured: np.ndarray, step: Step = unheard) -> tuple[np.ndarray, ...]:
    """Fit the setup's parameters and those of its force sensor to measured forces (M, 3). Without parameters nothing is fitted.

    Returns
    -------
    value, sd, determined : (P + 4,) float
        Fitted quantities, their standard deviations, and the shares of the priors' variances that the rows removed.
    spread : (3,) float
        s of each axis.
    """
    every, start = (*setup.parameters, *CELL), setup.start
    prior, by = np.array([p.prior for p in every]), np.array([p.step for p in every])

    def errors(values: np.ndarray) -> np.ndarray:
        """(V, 3 M) errors relative to ``noise_of`` for (V, P + 4); a contact that fails counts as one without force."""
        parts, of = np.unique(values * ([1.0] * len(setup.parameters) + [0.0] * 4), axis=0, return_inverse=True)
        forces = setup.forces(list(parts), labels, step)
        off = np.stack([setup.readings(forces[k], each) - measured for k, each in zip(of.ravel(), values, strict=True)])
        return (np.where(np.isfinite(off), off, -measured) / noise_of(measured)).reshape(len(values), -1)

    def cost(at: np.ndarray, variance: float) -> tuple[float, np.ndarray]:
        there = errors(at[None])[0]
        return float(there @ there / variance + np.sum(((at - start) / prior) ** 2)), there

    value, sd, determined, free = start.copy(), prior.copy(), np.zeros(len(start)), np.full(len(start), bool(setup.parameters))
    off = errors(value[None])[0]
    while free.any():
        for _ in range(ROUNDS):
            slopes = ((errors(value + np.diag(by)[free]) - off) / by[free, None]).T
            variance = max(off @ off / max(len(off) - free.sum(), 1), LEAST_VARIANCE)
            matrix, move = slopes.T @ slopes / variance + np.diag(prior[free] ** -2.0), np.zeros(len(value))
            move[free] = -np.linalg.solve(matrix, slopes.T @ off / variance + ((value - start) / prior**2)[free])
            now = float(off @ off / variance + np.sum(((value - start) / prior) ** 2))
            if (shorter := shorten_step(value, move, now, partial(cost, variance=variance))) is None:
                break
            value, lower, off = shorter
            if lower > (1 - ENOUGH) * now:
                break
        sd[free] = np.sqrt(np.diag(np.linalg.inv(matrix)))
        determined[free] = 1 - (sd[free] / prior[free]) ** 2
        if (determined[free] >= DETERMINED).all():
            break
        free &= determined >= DETERMINED
        value = np.where(free, value, start)
        off = errors(value[None])[0]
    return value, sd, determined, np.sqrt((off.reshape(-1, 3) ** 2).sum(axis=0) / max(len(labels) - free.sum() / 3, 1))


def compare_table(
    table: Path, setup: ForceSetup, folder: Path, columns: Mapping[str, str] | None, labels: int, seed: int, progress: Progress
) -> ForceComparison:
    """Fit to ``labels`` rows of a table, chosen at random, evaluate on the others, and write the page to an existing folder.

    Without ``labels`` nothing is fitted, and all rows are evaluated. See ``read_forces`` and ``find_conventions`` for columns and errors.
    """
    setup = replace(setup.with_rig(), parameters=setup.parameters if labels else ())
    arm, measured, doubts = read_forces(table, setup, columns or {})
    fitted = np.isin(np.arange(len(arm)), np.random.default_rng(seed).permutation(len(arm))[:labels])
    chosen = np.flatnonzero(fitted if labels else ~fitted)
    some = [arm[k] for k in chosen], measured[chosen]
    with stage(progress, "conventions") as step:
        setup, notes = find_conventions(setup, *some, step)
    with stage(progress, "forces") as step:
        value, sd, determined, spread = fit_forces(setup, *some, step)
        both = setup.forces([setup.start, value], arm, step)
    first, simulated = (setup.readings(f, of) for f, of in zip(both, (setup.start, value), strict=True))
    each_row, offset_n = int((determined >= DETERMINED).sum()) / 3, value[-4:-1]
    half = stdtrit(max(len(chosen) - each_row, 1), COVERED) * np.sqrt(1 + each_row / len(chosen)) * spread * noise_of(simulated)
    poses, moves = poses_and_moves(arm)
    of = {"depth": poses[:, 2:3], "tilt": poses[:, 3:5], "shear": moves[:, :2], "twist": moves[:, 5:], "slip": both[1, :, 6:]}
    by = {key: np.linalg.norm(each, axis=1) if key != "depth" else each[:, 0] for key, each in of.items()}
    error, solved, parts = simulated - measured, np.isfinite(simulated).all(axis=1), {}
    inside = abs(error) <= half
    for part, mine in (("fitted", fitted), ("evaluated", ~fitted)):
        if mine.any():
            before, after = (np.nanmean(abs(of - measured)[mine], axis=0).tolist() for of in (first, simulated))
            lines = [_regress(simulated[mine & solved, k], measured[mine & solved, k])[:2] for k in range(3)]
            parts[part] = {"rows": int(mine.sum()), "before_n": before, "error_n": after, "inside": float(inside[mine].mean())}
            parts[part] |= {"scale": [slope.real for slope, _ in lines], "correlation": [float(np.sqrt(1 - left)) for _, left in lines]}
    evaluated = ~fitted & solved if (~fitted & solved).sum() > FEWEST_ROWS else solved
    left = [
        {"force": f"F{axis}"} | {key: _share_explained(error[evaluated, k], np.column_stack([by[key], of[key]])[evaluated]) for key in of}
        for k, axis in enumerate("xyz")
    ]
    by["side_over_normal"] = np.hypot(*(measured - offset_n).T[:2]) / np.maximum(abs(measured - offset_n)[:, 2], NOISE_N)
    for key, forces in (("measured", measured), ("simulated", simulated), ("half", half)):
        by |= {f"{key}_{axis}": forces[:, k] for k, axis in enumerate("xyz")}
    slip = [
        {"group": group, "rows": int(mine.sum()), "ratio": float(np.median(by["side_over_normal"][mine])) if mine.any() else None}
        for group, mine in (("all of the contact", by["slip"] > SLIDING), ("less", by["slip"] <= SLIDING))
    ]
    rows = [{"row": k + 1, "fitted": bool(fitted[k])} | {key: float(each[k]) for key, each in by.items()} for k in range(len(arm))]
    notes += doubts + ([] if (~fitted).any() else ["no row is left to evaluate: give more rows, or a smaller `num_labelled`"])
    notes += [f"row {row + 1}: its contact can't be simulated" for row in np.flatnonzero(~solved)]
    parameters = describe_parameters((*setup.parameters, *CELL) if labels else (), setup.start, value, sd, determined)
    summary = {"sensor": setup.sensor.name, "notes": notes, "parameters": parameters, "parts": parts, "left": left, "slip": slip}
    sensor = setup.sensor_of(value)
    if labels:  # the stiffness is known as well as the mean ratio of measured to simulated normal forces
        factor = compare_forces((measured - offset_n)[chosen, 2], (simulated - offset_n)[chosen, 2], sensor).factor
        sensor = sensor.alter(skin={"stiffness_factor": factor})
    result = ForceComparison(sensor, summary, rows, [])
    return replace(result, written=[_write_page(folder, result)])


def _share_explained(error: np.ndarray, label: np.ndarray) -> float:
    """Share of the variance of errors (M,) that a linear function of a label (M, K) explains, adjusted for chance."""
    known = np.column_stack([np.ones(len(error)), label])
    fit, _, rank, _ = np.linalg.lstsq(known, error, rcond=None)
    left = (error - known @ fit).var() / max(error.var(), 1e-12)
    return max(0.0, float(1 - left * (len(error) - 1) / max(len(error) - rank, 1)))


def _write_page(folder: Path, result: ForceComparison) -> Path:
    summary, lead = result.summary, ". ".join(result.lines()[: len(result.summary["parts"])])
    command = f"twin {'calibrate contact' if summary['parameters'] else 'validate'}"
    page = Page(f"Forces of {summary['sensor']} against a force sensor", command, topic="TacTip twin: forces", lead=f"{lead}.")
    page.notice("Conventions of the table, and notes", summary["notes"])
    page.section("Measured and simulated")
    chart = write_chart(folder / "forces.png", partial(draw_forces, result.rows))
    page.figures(PagePicture(chart, "Simulated against measured forces, errors by depth, tilt and shear, and slip"))
    page.section("What remains", "Share of the variance of the errors that each label explains, in percent, adjusted for chance.")
    labels = [Column(key, key, "%", decimals=0, scale=100) for key in ("depth", "tilt", "shear", "twist", "slip")]
    page.table(summary["left"], [Column("force", "error of"), *labels])
    page.section("Slip", f"Where all of the contact slips, the ratio is the friction, {rig_of(result.sensor).friction:.2f} in the twin.")
    page.table(
        summary["slip"], [Column("group", "slips in the twin"), "rows", Column("ratio", "measured side force / normal force, median")]
    )
    if summary["parameters"]:
        page.section(
            "Parameters",
            "Low and high are the ends of the 90 % interval. A parameter that the rows do not determine (red) is at its start.",
        )
        add_parameters(page, summary["parameters"], "rows", low="low", high="high")
    page.download(write_json(folder / "forces.json", summary | {"made_by": made_by(__name__)}), "all figures of this page")
    page.download(write_rows(folder / "rows.csv", result.rows), "labels, forces and 90 % intervals of each contact")
    return page.write(folder / "index.html")


def draw_forces(rows: list[dict[str, Any]]) -> Figure:
    """Simulated against measured forces, errors by depth, tilt and shear, normal force by depth, and the measured friction by slip."""
    of = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    figure, axes = new_figure(4, 2, panel_inch=3.4)
    for axis, ax in zip("xyz", axes, strict=False):
        for part, mine in (("fitted", of["fitted"]), ("evaluated", ~of["fitted"])):
            if mine.any():
                ax.errorbar(*(of[f"{key}_{axis}"][mine] for key in ("measured", "simulated", "half")), fmt="o", ms=3, lw=0.6, label=part)
        ax.axline((0, 0), slope=1, lw=0.6)
        ax.set(xlabel=f"measured F{axis}, N", ylabel=f"simulated F{axis}, N")
        for below, (label, unit) in zip(axes[4:], (("depth", "mm"), ("tilt", "deg"), ("shear", "mm")), strict=False):
            below.plot(of[label], of[f"simulated_{axis}"] - of[f"measured_{axis}"], "o", ms=3, label=f"F{axis}")
            below.set(xlabel=f"{label}, {unit}", ylabel="simulated - measured, N")
    axes[3].plot(of["depth"], of["measured_z"], "o", ms=3, label="measured")
    axes[3].plot(of["depth"], of["simulated_z"], "x", ms=4, label="simulated")
    axes[3].set(xlabel="depth, mm", ylabel="Fz, N")
    axes[7].plot(of["slip"], of["side_over_normal"], "o", ms=3)
    axes[7].set(xlabel="share that slips in the twin", ylabel="measured side force / normal force", ylim=(0, None))
    for ax in axes[[0, 3, 4]]:
        ax.legend()
    return figure
