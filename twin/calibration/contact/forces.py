"""The twin's forces against a table of poses and forces alone: a fit to some of its rows, an evaluation on the others, and a page.

For the force f of the sensor on the object, the force sensor's reading is ``r = offset + gain * Rz(-turn) f`` (``ForceSensorSpec``). The
sign of the arm's angles, the axes and the turn of the readings are found before the fit, unless the specification has a force sensor.
With the error e = NOISE_N + NOISE_SHARE |force|, the parameters theta

    minimise  sum ((r(theta) - measured) / e)^2 / s^2 + sum ((theta - start) / prior)^2

by Gauss-Newton steps with difference quotients, s being the root mean square of the errors relative to e before each step. A parameter of
whose prior variance the rows leave more than half goes back to its start, and the others are fitted again without it. With s at the end,
and P parameters fitted to M rows, the 90 % interval of a force is ``t(M - P / 3) s e sqrt(1 + P / 3 M)`` to each side, t being the quantile
of Student's distribution.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.rig import ForceSensorSpec
from scenes.sensor import SensorSpec
from twin.calibration.contact.parameters import PARAMETERS, SIZE, FittedParameter, values_of, with_quantities
from twin.errors import ContactError, FrameError
from twin.frames.tables import called_here, numbers, read_columns
from twin.geometry.solid import Resolution
from twin.mechanics.solver import SkinSolver
from twin.progress import Progress, Step, stage
from twin.report.charts import new_figure, write_chart
from twin.report.page import Page, PagePicture
from twin.report.table import write_rows
from twin.rig.contact import RigContact
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel
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
"""Parameters of the sensor and its rig on which forces depend. The others move pins, and change forces little."""
TURN = FittedParameter("rig.force_sensor.turn_deg", 10.0, 1.0)
CELL = (*(FittedParameter(f"rig.force_sensor.offset_n[{axis}]", 0.1, 0.1) for axis in range(3)), TURN)
"""The force sensor's own parameters, which come last in every vector of values."""
FILES = ("index.html", "forces.json", "rows.csv", "forces.png", "forces-dark.png")
"""Files of a comparison of forces."""
FEWEST_ROWS = 8
NOISE_N, NOISE_SHARE = 0.05, 0.05
"""Error of a force: a constant, and a share of the force."""
LEAST_VARIANCE = 1e-4
"""Least square of s: exact forces have errors, too."""
TOLD = 0.5
"""Least share of a parameter's prior variance that the rows must remove for it to count as determined."""
ROUNDS, SHORTEST, ENOUGH = 8, 1 / 8, 0.02
"""Most Gauss-Newton steps, the least share of one, and the relative decrease of the cost below which the fit ends."""
UNLIKE, CLEARER = 0.6, 1.1
"""Largest share of the forces' square that the twin may leave unexplained before any fit, up to a factor and a turn. The sign of the angles
counts as found if the other sign leaves ``CLEARER`` times as much."""
Z90 = 1.645
"""Half a 90 % interval of the normal distribution, in standard deviations."""


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
        lines += [f"convention: {each}" for each in self.summary["conventions"]]
        for p in self.summary["parameters"]:
            doubt = f"{p['low']:.3g} to {p['high']:.3g}" if p["known"] else "left at its start: these rows do not determine it"
            lines.append(f"{p['name']:30s} {p['start']:9.4g} -> {p['value']:9.4g}  {doubt}")
        return lines


@dataclass(frozen=True)
class ForceSetup:
    """What all contacts of a table have in common (see ``CalibrationSetup``). The sensor is that of the start of a fit."""

    sensor: SensorSpec
    experiment: ExperimentSpec
    obj: ObjectSpec
    across: int
    workers: int = 1
    parameters: tuple[FittedParameter, ...] = FORCE_PARAMETERS

    @property
    def reads(self) -> ForceSensorSpec:
        """The force sensor: the rig's own, or one that reads the force on the object in the work frame."""
        return rig_of(self.sensor).force_sensor or ForceSensorSpec()

    @property
    def start(self) -> np.ndarray:
        """Values (P + 4,) of the parameters and of ``CELL`` at the start."""
        return np.array([*values_of(self.sensor, self.experiment, self.parameters), *self.reads.offset_n, self.reads.turn_deg])

    def sensor_of(self, values: np.ndarray) -> SensorSpec:
        """The sensor with other values (P + 4,)."""
        cell = {"offset_n": tuple(values[-4:-1].round(4).tolist()), "turn_deg": round(float(values[-1]), 2)}
        sensor = with_quantities(self.sensor, self.experiment, values[:-4], rig_of(self.sensor).turn_sign, self.parameters)
        return sensor.model_copy(update={"rig": rig_of(sensor).model_copy(update={"force_sensor": self.reads.model_copy(update=cell)})})

    def forces(self, values: Sequence[np.ndarray], labels: Sequence[ArmLabel], step: Step | None = None) -> np.ndarray:
        """(V, M, 7) for V vectors of values and M labels; a contact that fails is NaN.

        Force on the object in the axes of the work frame and in those of the tool, N, and the share of the normal force that slips.
        """
        found = np.empty((len(values) * len(labels), 7))
        tasks = [(each, label) for each in values for label in labels]
        for done, (k, each) in enumerate(in_processes(partial, (_force, self), list(enumerate(tasks)), processes=self.workers), 1):
            found[k] = each
            if step:
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
    return cast(np.ndarray, NOISE_N + NOISE_SHARE * np.linalg.norm(force_n, axis=1, keepdims=True))


def is_table(frames: Path) -> bool:
    """Whether a path names a table, and no frames."""
    return frames.suffix.casefold() in (".csv", ".tsv") and frames.is_file()


def read_forces(path: Path, setup: ForceSetup, columns: Mapping[str, str]) -> tuple[list[ArmLabel], np.ndarray]:
    """Labels of a table's rows, and forces (M, 3), N. Poses and moves without a column (see ``called_here``) count as zero.

    ``columns`` maps the names that are used here to the table's own.

    Raises
    ------
    FrameError
        The approach is not along z, a column is missing or constant, or a cell is no number.
    """
    if setup.experiment.approach != "z":
        raise FrameError(
            f"experiment {setup.experiment.name}: a table of forces has its depth along z; give one that has, too (surface-3d)"
        )
    table, forces = read_columns(path), setup.reads.columns
    known = called_here(table | {key: table[name] for key, name in columns.items() if name in table})
    if missing := [key for key in ("pose_3", *forces, *columns) if key not in known or columns.get(key, key) not in known]:
        own = columns.get(missing[0], missing[0])
        raise FrameError(f"{path}: no column {own}; name it by `column` ({missing[0]}=NAME); the table has {', '.join(table)}")
    used = [f"{kind}_{axis}" for kind in ("pose", "move") for axis in range(1, 7)]
    values = {key: numbers(known[key]) for key in (*used, *forces) if key in known}
    count = len(values["pose_3"])
    for key, cells in values.items():
        known_cells, own = np.isfinite(cells), columns.get(key, key)
        if not known_cells.all():
            raise FrameError(f"{path}: column {own}, row {np.argmin(known_cells) + 1}: no number; repair or remove the row")
        if key in ("pose_3", forces[2]) and (count < FEWEST_ROWS or not np.ptp(cells)):
            raise FrameError(f"{path}: column {own} has {count} rows or is constant; give {FEWEST_ROWS} presses or more that differ")
    labels = np.stack([values.get(key, np.zeros(count)) for key in used], axis=1)
    return [ArmLabel(row[:6], row[6:]) for row in labels], np.stack([values[key] for key in forces], axis=1)


def find_conventions(
    setup: ForceSetup, labels: Sequence[ArmLabel], measured: np.ndarray, step: Step | None = None
) -> tuple[ForceSetup, list[str]]:
    """The setup with the sign of the arm's angles and the force sensor's axes, and these in words. Those of the specification come first.

    Raises
    ------
    FrameError
        The measured forces do not follow the simulated ones, up to a factor and a turn.
    """
    rig, side, columns, tried = rig_of(setup.sensor), measured[:, 0] + 1j * measured[:, 1], setup.reads.columns, []
    if rig.force_sensor:
        return setup, [f"given by rig.force_sensor: {_in_words(rig.force_sensor, rig.turn_sign)}"]
    for sign in (1, -1):
        there = replace(setup, sensor=setup.sensor.model_copy(update={"rig": rig.model_copy(update={"turn_sign": sign})}))
        found = np.nan_to_num(there.forces([there.start], labels, step)[0])
        for frame, f in (("work", found[:, :3]), ("tool", found[:, 3:6])):
            flat, r = f[:, 0] + 1j * f[:, 1], float(np.corrcoef(f[:, 2], measured[:, 2])[0, 1])
            turn = np.vdot(flat, side) / max(np.vdot(flat, flat).real, 1e-12)
            left = float(np.sum(abs(side - turn * flat) ** 2) / max(np.sum(abs(side) ** 2), 1e-12))
            tried.append((left + 1 - r**2, left, r, sign, frame, round(-float(np.degrees(np.angle(turn))), 1)))
    total, left, r, sign, frame, turn_deg = min(tried)
    if odd := columns[2] if 1 - r**2 > UNLIKE else ", ".join(columns[:2]) if left > UNLIKE else "":
        raise FrameError(
            f"{odd}: does not follow the simulated force (correlation of the normal force {r:.2f}, {left:.0%} of the side force left); "
            "is it newtons, and pose_3 the depth? Name the right columns by `column`, or state rig.turn_sign and rig.force_sensor"
        )
    reads = ForceSensorSpec.model_validate(
        {"columns": columns, "frame": frame, "gain": (1.0, 1.0, float(np.sign(r))), "turn_deg": turn_deg}
    )
    notes = [f"found, as the specification has no rig.force_sensor: {_in_words(reads, sign)}"]
    if min(each[0] for each in tried if each[3] != sign) < CLEARER * total:
        notes.append("the rows hardly show the sign of the angles: state rig.turn_sign and rig.force_sensor if you know them")
    rig = rig.model_copy(update={"turn_sign": sign, "force_sensor": reads})
    return replace(setup, sensor=setup.sensor.model_copy(update={"rig": rig})), notes


def _in_words(reads: ForceSensorSpec, sign: int) -> str:
    hands, z = ("right", "left")[::sign], "" if reads.gain[2] > 0 else ", with z reversed"
    return (
        f"the sensor is pressed at pose - shear along z of the work frame, then moved to pose, by {hands[0]}-handed static xyz "
        f"angles (a plate can't tell this from a press at pose + shear by {hands[1]}-handed ones, with the force sensor turned by 180 deg "
        f"more); {', '.join(reads.columns)} are the force on the object in the axes of the {reads.frame} frame, turned by "
        f"{reads.turn_deg:.1f} deg about z{z}"
    )


def fit_forces(setup: ForceSetup, labels: Sequence[ArmLabel], measured: np.ndarray, step: Step | None = None) -> tuple[np.ndarray, ...]:
    """Fit the setup's parameters and those of its force sensor to measured forces (M, 3). Without parameters nothing is fitted.

    Returns
    -------
    value, sd, told : (P + 4,) float
        Fitted quantities, their standard deviations, and the shares of the priors' variances that the rows removed.
    spread : (3,) float
        s of each axis.
    """
    every, start = (*setup.parameters, *CELL), setup.start
    prior, by = np.array([p.prior for p in every]), np.array([p.step for p in every])
    least = np.array([p.least if p.scale == "plain" else -np.inf for p in every])

    def errors(values: np.ndarray) -> np.ndarray:
        """(V, 3 M) errors relative to ``noise_of`` for (V, P + 4); a contact that fails counts as one without force."""
        parts, of = np.unique(values * ([1.0] * len(setup.parameters) + [0.0] * 4), axis=0, return_inverse=True)
        forces = setup.forces(list(parts), labels, step)
        off = np.stack([setup.readings(forces[k], each) - measured for k, each in zip(of.ravel(), values, strict=True)])
        return (np.where(np.isfinite(off), off, -measured) / noise_of(measured)).reshape(len(values), -1)

    def cost(off: np.ndarray, at: np.ndarray, variance: float) -> float:
        return float(off @ off / variance + np.sum(((at - start) / prior) ** 2))

    value, sd, told, free = start.copy(), prior.copy(), np.zeros(len(start)), np.full(len(start), bool(setup.parameters))
    off = errors(value[None])[0]
    while free.any():
        for _ in range(ROUNDS):
            slopes = ((errors(value + np.diag(by)[free]) - off) / by[free, None]).T
            variance = max(off @ off / max(len(off) - free.sum(), 1), LEAST_VARIANCE)
            matrix, move, share = slopes.T @ slopes / variance + np.diag(prior[free] ** -2.0), np.zeros(len(value)), 1.0
            move[free] = -np.linalg.solve(matrix, slopes.T @ off / variance + ((value - start) / prior**2)[free])
            before = now = cost(off, value, variance)
            while share >= SHORTEST and now >= before:
                tried, share = np.maximum(value + share * move, least), share / 2
                there = errors(tried[None])[0]
                now = cost(there, tried, variance)
            if now < before:
                value, off = tried, there
            if now > (1 - ENOUGH) * before:
                break
        sd[free] = np.sqrt(np.diag(np.linalg.inv(matrix)))
        told[free] = 1 - (sd[free] / prior[free]) ** 2
        if (told[free] >= TOLD).all():
            break
        free &= told >= TOLD
        value = np.where(free, value, start)
        off = errors(value[None])[0]
    return value, sd, told, np.sqrt((off.reshape(-1, 3) ** 2).sum(axis=0) / max(len(labels) - free.sum() / 3, 1))


def compare_table(
    table: Path, setup: ForceSetup, folder: Path, columns: Mapping[str, str] | None, labels: int, seed: int, progress: Progress
) -> ForceComparison:
    """Fit to ``labels`` rows of a table, chosen at random, evaluate on the others, and write the page to an existing folder.

    Without ``labels`` nothing is fitted, and all rows are evaluated. See ``read_forces`` and ``find_conventions`` for columns and errors.
    """
    own = setup.sensor.model_copy(update={"rig": rig_of(setup.sensor, setup.obj.name)})
    setup = replace(setup, sensor=own, parameters=setup.parameters if labels else ())
    arm, measured = read_forces(table, setup, columns or {})
    fitted = np.isin(np.arange(len(arm)), np.random.default_rng(seed).permutation(len(arm))[:labels])
    chosen = np.flatnonzero(fitted if labels else ~fitted)
    seen = [arm[k] for k in chosen], measured[chosen]
    with stage(progress, "conventions") as step:
        setup, conventions = find_conventions(setup, *seen, step)
    with stage(progress, "forces") as step:
        value, sd, told, spread = fit_forces(setup, *seen, step)
        both = setup.forces([setup.start, value], arm, step)
    first, simulated = (setup.readings(f, of) for f, of in zip(both, (setup.start, value), strict=True))
    each_row = int((told >= TOLD).sum()) / 3
    wider = student.ppf(0.95, max(len(chosen) - each_row, 1)) * np.sqrt(1 + each_row / len(chosen))
    half, at = wider * spread * noise_of(simulated), np.array([[*label.pose, *label.move] for label in arm])
    by = {"depth": at[:, 2], "tilt": np.hypot(*at.T[3:5]), "shear": np.hypot(*at.T[6:8]), "twist": abs(at[:, 11]), "slip": both[1, :, 6]}
    left = [
        {"force": f"F{axis}"} | {key: _correlation(of, (simulated - measured)[:, k]) for key, of in by.items()}
        for k, axis in enumerate("xyz")
    ]
    by["side_over_normal"] = np.hypot(*(measured - value[-4:-1]).T[:2]) / np.maximum(abs(measured[:, 2]), 1e-9)
    for key, of in (("measured", measured), ("simulated", simulated), ("half", half)):
        by |= {f"{key}_{axis}": of[:, k] for k, axis in enumerate("xyz")}
    parts: dict[str, dict[str, Any]] = {}
    for part, mine in (("fitted", fitted), ("evaluated", ~fitted)):
        if mine.any():
            errors = {
                key: np.nanmean(abs(of - measured)[mine], axis=0).tolist() for key, of in (("before_n", first), ("error_n", simulated))
            }
            parts[part] = errors | {"rows": int(mine.sum()), "inside": float((abs(simulated - measured) <= half)[mine].mean())}
    parameters = []
    for k, p in enumerate((*setup.parameters, *CELL) if labels else ()):
        low, high = sorted(p.number(value[k] + z * sd[k]) for z in (-Z90, Z90))
        ends = {"low": low, "high": high, "told": float(told[k]), "known": bool(told[k] >= TOLD)}
        parameters.append({"name": p.name, "start": p.number(setup.start[k]), "value": p.number(value[k])} | ends)
    summary = {"sensor": setup.sensor.name, "conventions": conventions, "parameters": parameters, "parts": parts, "left": left}
    rows = [{"row": k + 1, "fitted": bool(fitted[k])} | {key: float(each[k]) for key, each in by.items()} for k in range(len(arm))]
    result = ForceComparison(setup.sensor_of(value), summary, rows, [])
    return replace(result, written=[_write_page(folder, result)])


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Correlation of two columns (M,) where both are known; 0 if one is constant."""
    known = np.isfinite(x) & np.isfinite(y)
    return float(np.corrcoef(x[known], y[known])[0, 1]) if np.ptp(x[known]) and np.ptp(y[known]) else 0.0


def _write_page(folder: Path, result: ForceComparison) -> Path:
    summary, lead = result.summary, ". ".join(result.lines()[: len(result.summary["parts"])])
    command = f"twin {'calibrate contact' if summary['parameters'] else 'validate'}"
    page = Page(f"Forces of {summary['sensor']} against a load cell", command, lead=lead)
    page.notice("Conventions of the table", summary["conventions"])
    page.section("Measured and simulated", "What is left correlates with the labels and the slip as follows.")
    page.table(summary["left"], ["force", "depth", "tilt", "shear", "twist", "slip"])
    page.figures(
        PagePicture(write_chart(folder / "forces.png", lambda: draw_forces(result.rows)), "Simulated and measured forces; errors; slip")
    )
    if summary["parameters"]:
        page.section("Parameters", "What the rows do not determine is left at its start. Low and high are the ends of 90 % intervals.")
        page.table(summary["parameters"], ["name", "start", "value", "low", "high", "known"])
    page.download(write_json(folder / "forces.json", summary | {"made_by": made_by(__name__)}), "all figures of this page")
    page.download(write_rows(folder / "rows.csv", result.rows), "labels, forces and 90 % intervals of each contact")
    return page.write(folder / "index.html")


def draw_forces(rows: list[dict[str, Any]]) -> Figure:
    """Simulated against measured force, errors by depth, tilt and shear, and the measured ratio of side force to normal force by slip."""
    of = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    figure, axes = new_figure(4, 2, panel_inch=3.2)
    for axis, ax, below, (label, unit) in zip("xyz", axes[:3], axes[4:7], (("depth", "mm"), ("tilt", "deg"), ("shear", "mm")), strict=True):
        for part, mine in (("fitted", of["fitted"]), ("evaluated", ~of["fitted"])):
            ax.errorbar(*(of[f"{key}_{axis}"][mine] for key in ("measured", "simulated", "half")), fmt="o", ms=3, lw=0.6, label=part)
            below.plot(of[label][mine], (of["simulated_z"] - of["measured_z"])[mine], "o", ms=3)
        ax.axline((0, 0), slope=1, lw=0.6)
        ax.set(xlabel=f"measured F{axis}, N", ylabel=f"simulated F{axis}, N")
        below.set(xlabel=f"{label}, {unit}", ylabel="simulated - measured Fz, N")
    axes[0].legend()
    axes[3].plot(of["slip"], of["side_over_normal"], "o", ms=3)
    axes[3].set(xlabel="share that slips in the twin", ylabel="measured side force over normal force")
    axes[7].set_axis_off()
    return figure
