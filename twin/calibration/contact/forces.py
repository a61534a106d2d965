"""The twin's forces against a table of poses and forces alone: a fit to some of its rows, a judgement by the others, and a page.

For the force f of the sensor on the object, the force sensor's reading is ``r = offset + gain * Rz(-turn) f`` (``ForceSensorSpec``). The
sign of the arm's angles, the axes and the turn of the readings are found before the fit, unless the specification has a force sensor.
With the error e = NOISE_N + NOISE_SHARE |force|, the parameters theta

    minimise  sum ((r(theta) - measured) / e)^2 / s^2 + sum ((theta - start) / prior)^2

by Gauss-Newton steps with difference quotients, s being the root mean square of the errors relative to e before each step. A parameter of whose prior variance the rows leave more than half goes back to its start,
and the others are fitted again without it. With s at the end, and P parameters fitted to M rows, the 90 % interval of a force is ``t(M - P / 3) s e sqrt(1 + P / 3 M)`` to each side, t being the quantile of Student's distribution.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.rig import ForceSensorSpec
from scenes.sensor import SensorSpec
from twin.calibration.contact.parameters import PARAMETERS, FittedParameter, values_of, with_quantities
from twin.errors import ContactError, FrameError
from twin.frames.tables import called_here, numbers, read_columns
from twin.geometry.solid import Resolution
from twin.mechanics.solver import SkinSolver
from twin.progress import Progress, Step, stage
from twin.report.charts import muted_colour, new_figure, write_chart
from twin.report.page import Page, PagePicture
from twin.report.table import write_rows
from twin.rig.contact import RigContact
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel
from twin.store import made_by, write_json
from twin.types import ReadableResult
from twin.workers import outcomes

OF_PINS = ("rig.contact_offset_mm", "rig.tcp_to_dome_mm", "rig.friction", "gel.young_modulus_mpa", "gel.poisson_ratio")
FORCE_PARAMETERS = (
    *(parameter for parameter in PARAMETERS if parameter.name in OF_PINS),
    FittedParameter("skin.young_modulus_mpa", 0.5, 0.1, "log"),
    FittedParameter("rig.compliance_mm_per_n", 0.1, 0.05, least=0.0),
    FittedParameter("rig.side_compliance_mm_per_n", 0.5, 0.1, least=0.0),
)
"""Parameters of the sensor and its rig on which forces depend. The others move pins, and change forces little."""

CELL = (
    *(FittedParameter(f"rig.force_sensor.offset_n[{axis}]", 0.1, 0.1) for axis in range(3)),
    FittedParameter("rig.force_sensor.turn_deg", 10.0, 1.0),
)
"""The force sensor's own parameters, which are fitted last in every vector of values."""
FILES = ("index.html", "forces.json", "rows.csv", "forces.png", "forces-dark.png")
"""Files of a comparison of forces."""
FEWEST_ROWS = 8
NOISE_N, NOISE_SHARE = 0.05, 0.05
"""Error of a force: a constant, and a share of the force."""
TOLD = 0.5
"""Least share of a parameter's prior variance that the rows must remove for it to count as determined."""
LEAST_VARIANCE = 1e-4
"""Least variance of the errors relative to ``noise_of``: exact forces have some, too."""
ROUNDS, SHORTEST, ENOUGH = 5, 1 / 8, 0.01
"""Most Gauss-Newton steps, the least share of one, and the relative decrease of the cost below which the fit ends."""
UNLIKE, CLEARER = 0.6, 1.1
"""Largest share of the forces' square that the twin may leave unexplained before any fit, up to a factor and a turn. The sign of the angles
counts as found if the other sign leaves ``CLEARER`` times as much."""
SIDE90, Z90 = 0.95, 1.645
"""Quantile at each end of a 90 % interval; that of the normal distribution."""


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
    def start(self) -> np.ndarray:
        """Values (P,) of the parameters at the start."""
        return values_of(self.sensor, self.experiment, self.parameters)

    def forces(self, jobs: Sequence[tuple[np.ndarray, int]], labels: Sequence[ArmLabel], step: Step | None = None) -> np.ndarray:
        """(J, M, 7) for J pairs of values (P,) and a sign of the angles, and M labels.

        Force on the object in the axes of the work frame and in those of the tool, N, and the share of the normal force that slips. A
        contact that fails is NaN.
        """
        fixed = [each.model_dump(mode="json") for each in (self.sensor, self.experiment, self.obj)]
        names, every = [parameter.name for parameter in self.parameters], [[*label.pose, *label.move] for label in labels]
        text = json.dumps([*fixed, self.across, names, [[[*values], int(sign)] for values, sign in jobs], every])
        found = np.empty((len(jobs) * len(labels), 7))
        for done, (k, each) in enumerate(outcomes(_force, text, list(range(len(found))), workers=self.workers, scheduler=""), 1):
            found[k] = each
            if step:
                step(done, len(found))
        return found.reshape(len(jobs), len(labels), 7)


_content = lru_cache(maxsize=1)(json.loads)


@lru_cache(maxsize=2)
def _contact(text: str, job: int) -> RigContact:
    sensor, experiment, obj, across, names, jobs, _ = _content(text)
    arm, thing = ExperimentSpec.model_validate(experiment), ObjectSpec.model_validate(obj)
    parameters = tuple(p for p in FORCE_PARAMETERS if p.name in names)
    spec = with_quantities(SensorSpec.model_validate(sensor), arm, np.array(jobs[job][0]), jobs[job][1], parameters)
    return RigContact(SkinSolver(spec, resolution=Resolution(across)), arm, thing, rig=rig_of(spec, thing.name))


def _force(text: str, index: int) -> tuple[int, np.ndarray]:
    job, row = divmod(index, len(_content(text)[-1]))
    try:
        contact = _contact(text, job)
        state = contact.end(ArmLabel(*np.array(_content(text)[-1][row]).reshape(2, 6)))
    except (ContactError, ValidationError):
        return index, np.full(7, np.nan)
    stands = Rotation.from_euler("zy", [contact.rig.object_turn_deg, -contact.rig.plate_tilt_deg], degrees=True)
    work = stands.apply(state.T_sensor_object[:3, :3].T @ state.force_n)
    tool = Rotation.from_euler("z", -contact.rig.image_turn_deg, degrees=True).apply(state.force_n)
    return index, np.array([*work, *tool, state.normal_n @ state.slipping / max(state.normal_n.sum(), 1e-12)])


def read_by(reads: ForceSensorSpec, forces: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Readings (M, 3) of a force sensor for ``forces`` (M, 7), with its readings without contact and its turn in ``cell`` (4,)."""
    turned = Rotation.from_euler("z", -cell[3], degrees=True).apply(forces[:, :3] if reads.frame == "work" else forces[:, 3:6])
    reading: np.ndarray = cell[:3] + np.asarray(reads.gain) * turned
    return reading


def noise_of(force_n: np.ndarray) -> np.ndarray:
    """NOISE_N + NOISE_SHARE of the force, (M, 1), for forces (M, 3)."""
    noise: np.ndarray = NOISE_N + NOISE_SHARE * np.linalg.norm(force_n, axis=1, keepdims=True)
    return noise


def is_table(frames: Path) -> bool:
    """Whether a path names a table, and no frames."""
    return frames.suffix.casefold() in (".csv", ".tsv") and frames.is_file()


def read_forces(
    path: Path, experiment: ExperimentSpec, columns: Mapping[str, str], forces: Sequence[str]
) -> tuple[list[ArmLabel], np.ndarray]:
    """Labels of a table's rows, and forces (M, 3), N. Poses and moves without a column (see ``called_here``) count as zero.

    ``columns`` maps the names that are used here to the table's own.

    Raises
    ------
    FrameError
        The approach is not along z, a column is missing or constant, or a cell is no number.
    """
    if experiment.approach != "z":
        raise FrameError(f"experiment {experiment.name}: a table of forces has its depth along z; give one with that approach (surface-3d)")
    table = read_columns(path)
    known = called_here(table | {key: table[name] for key, name in columns.items() if name in table})
    if missing := [key for key in ("pose_3", *forces, *columns) if key not in known or columns.get(key, key) not in known]:
        own = columns.get(missing[0], missing[0])
        raise FrameError(f"{path}: no column {own}; name it by `column` ({missing[0]}=NAME); the table has {', '.join(table)}")
    used = [f"{kind}_{axis}" for kind in ("pose", "move") for axis in range(1, 7)]
    values = {key: numbers(known[key]) for key in (*used, *forces) if key in known}
    count, own_names = len(values["pose_3"]), {key: columns.get(key, key) for key in values}
    for key, cells in values.items():
        if not np.isfinite(cells).all():
            raise FrameError(
                f"{path}: column {own_names[key]}, row {np.argmin(np.isfinite(cells)) + 1}: no number; repair or remove the row"
            )
    for key in ("pose_3", forces[2]):
        if count < FEWEST_ROWS or not np.ptp(values[key]):
            raise FrameError(
                f"{path}: column {own_names[key]} has {count} rows or is constant; give {FEWEST_ROWS} presses or more that differ"
            )
    labels = np.stack([values.get(key, np.zeros(count)) for key in used], axis=1)
    return [ArmLabel(row[:6], row[6:]) for row in labels], np.stack([values[key] for key in forces], axis=1)


def find_conventions(
    setup: ForceSetup, labels: Sequence[ArmLabel], measured: np.ndarray, columns: tuple[str, str, str], step: Step | None = None
) -> tuple[ForceSetup, list[str]]:
    """The setup with the sign of the arm's angles and the force sensor's axes, and these in words. Those of the specification come first.

    Raises
    ------
    FrameError
        The measured forces do not follow the simulated ones, up to a factor and a turn.
    """
    rig, side = rig_of(setup.sensor), measured[:, 0] + 1j * measured[:, 1]
    if rig.force_sensor:
        return setup, ["given by the specification's rig.force_sensor", *_in_words(rig.force_sensor, rig.turn_sign)]
    signs, tried = (rig.turn_sign, -rig.turn_sign), []
    for sign, found in zip(signs, np.nan_to_num(setup.forces([(setup.start, sign) for sign in signs], labels, step)), strict=True):
        for frame, f in (("work", found[:, :3]), ("tool", found[:, 3:6])):
            flat, r = f[:, 0] + 1j * f[:, 1], float(np.corrcoef(f[:, 2], measured[:, 2])[0, 1])
            turn = np.vdot(flat, side) / max(np.vdot(flat, flat).real, 1e-12)
            left = float(np.sum(abs(side - turn * flat) ** 2) / max(np.sum(abs(side) ** 2), 1e-12))
            tried.append((left + 1 - r**2, left, r, sign, frame, float(np.degrees(np.angle(turn)))))
    total, left, r, sign, frame, turn_deg = min(tried)
    for odd, what in ((1 - r**2 > UNLIKE, columns[2]), (left > UNLIKE, f"{columns[0]}, {columns[1]}")):
        if odd:
            raise FrameError(
                f"{what}: does not follow the simulated force (correlation of the normal force {r:.2f}, {left:.0%} of the side force left); "
                "is it newtons, and pose_3 the depth? Name the right columns by `column`, or state rig.turn_sign and rig.force_sensor"
            )
    reads = ForceSensorSpec(columns=columns, frame=frame, gain=(1.0, 1.0, float(np.sign(r))), turn_deg=round(-turn_deg, 1))
    notes = ["found from the rows, as the specification has no rig.force_sensor", *_in_words(reads, sign)]
    if min(each[0] for each in tried if each[3] != sign) < CLEARER * total:
        notes.append("the rows hardly show the sign of the angles: state rig.turn_sign and rig.force_sensor if you know them")
    there = rig.model_copy(update={"turn_sign": sign, "force_sensor": reads})
    return replace(setup, sensor=setup.sensor.model_copy(update={"rig": there})), notes


def _in_words(reads: ForceSensorSpec, sign: int) -> list[str]:
    hands = ("right", "left")[::sign]
    return [
        f"the sensor is pressed at pose - shear along the work frame's z, then moved to pose; angles are {hands[0]}-handed, static xyz (a "
        f"plate can't tell this from {hands[1]}-handed angles and a press at pose + shear, with the force sensor turned by another 180 deg)",
        f"{', '.join(reads.columns)} are the force on the object in the axes of the {reads.frame} frame turned by {reads.turn_deg:.1f} deg "
        f"about z{'' if reads.gain[2] > 0 else ', with z reversed'}",
    ]


@dataclass(frozen=True)
class ForceFit:
    """A fit to forces. Quantities (P + 4,) are those of the setup's parameters (see ``FittedParameter``), then those of ``CELL``.

    Attributes
    ----------
    sensor : SensorSpec
    start, value, sd, told : (P + 4,) float
        ``told`` is the share of the prior's variance that the rows removed. What they do not determine has its start.
    spread : (3,) float
        Error of single forces relative to ``noise_of`` them.
    free : int
        Number of parameters that the rows determine.
    """

    sensor: SensorSpec
    start: np.ndarray
    value: np.ndarray
    sd: np.ndarray
    told: np.ndarray
    spread: np.ndarray
    free: int


def fit_forces(
    setup: ForceSetup, labels: Sequence[ArmLabel], measured: np.ndarray, step: Step | None = None, *, fixed: bool = False
) -> ForceFit:
    """Fit the setup's parameters and those of its force sensor to measured forces (M, 3). If ``fixed``, nothing is fitted."""
    rig, count, every = rig_of(setup.sensor), len(setup.parameters), (*setup.parameters, *CELL)
    reads = rig.force_sensor
    assert reads is not None
    start, prior = np.array([*setup.start, *reads.offset_n, reads.turn_deg]), np.array([p.prior for p in every])
    units, least = np.diag([p.step for p in every]), np.array([p.least if p.scale == "plain" else -np.inf for p in every])

    def errors(vectors: list[np.ndarray]) -> np.ndarray:
        """(V, 3 M) errors relative to ``noise_of``; a contact that fails counts as one without force."""
        parts = np.unique([each[:count] for each in vectors], axis=0)
        forces = dict(zip(map(tuple, parts), setup.forces([(part, rig.turn_sign) for part in parts], labels, step), strict=True))
        off = [read_by(reads, forces[tuple(each[:count])], each[count:]) - measured for each in vectors]
        return (np.where(np.isfinite(off), off, -measured) / noise_of(measured)).reshape(len(vectors), -1)

    def cost(off: np.ndarray, at: np.ndarray) -> float:
        return float(off @ off / variance + np.sum(((at - start) / prior) ** 2))

    value, sd, told, free = start.copy(), prior.copy(), np.zeros(len(start)), np.full(len(start), not fixed)
    off = errors([value])[0]
    while free.any():
        for _ in range(ROUNDS):
            slopes = ((errors([value + unit for unit in units[free]]) - off) / units.sum(axis=0)[free, None]).T
            variance = max(off @ off / max(len(off) - free.sum(), 1), LEAST_VARIANCE)
            matrix, share, before, move = (
                slopes.T @ slopes / variance + np.diag(prior[free] ** -2.0),
                1.0,
                cost(off, value),
                np.zeros(len(value)),
            )
            move[free] = -np.linalg.solve(matrix, slopes.T @ off / variance + (value - start)[free] / prior[free] ** 2)
            while share >= SHORTEST:
                tried = np.maximum(value + share * move, least)
                now, share = errors([tried])[0], share / 2
                if cost(now, tried) < before:
                    value, off = tried, now
                    break
            if cost(off, value) > (1 - ENOUGH) * before:
                break
        variance = max(off @ off / max(len(off) - free.sum(), 1), LEAST_VARIANCE)
        sd[free] = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes / variance + np.diag(prior[free] ** -2.0))))
        told[free] = 1 - (sd[free] / prior[free]) ** 2
        known, free = free, free & (told >= TOLD)
        if (known == free).all():
            break
        value = np.where(free, value, start)
        off = errors([value])[0]
    spread = np.sqrt((off.reshape(-1, 3) ** 2).sum(axis=0) / max(len(labels) - free.sum() / 3, 1))
    cell = {"offset_n": tuple(value[count:-1].round(4).tolist()), "turn_deg": round(float(value[-1]), 2)}
    fitted = with_quantities(setup.sensor, setup.experiment, value[:count], rig.turn_sign, setup.parameters)
    there = rig_of(fitted).model_copy(update={"force_sensor": reads.model_copy(update=cell)})
    return ForceFit(fitted.model_copy(update={"rig": there}), start, value, sd, told, spread, int(free.sum()))


def compare_table(
    table: Path, setup: ForceSetup, folder: Path, columns: Mapping[str, str] | None, labels: int, seed: int, progress: Progress
) -> ForceComparison:
    """Fit to ``labels`` rows of a table, chosen at random, judge by the others, and write the page to an existing folder.

    Without ``labels`` nothing is fitted, and all rows judge. For ``columns`` and errors see ``read_forces`` and ``find_conventions``.
    """
    rig = rig_of(setup.sensor, setup.obj.name)
    names = (rig.force_sensor or ForceSensorSpec()).columns
    arm, measured = read_forces(table, setup.experiment, columns or {}, names)
    fitted = np.isin(np.arange(len(arm)), np.random.default_rng(seed).permutation(len(arm))[:labels])
    chosen = np.flatnonzero(fitted if labels else ~fitted)
    seen, setup = ([arm[k] for k in chosen], measured[chosen]), replace(setup, sensor=setup.sensor.model_copy(update={"rig": rig}))
    with stage(progress, "conventions") as step:
        setup, conventions = find_conventions(setup, *seen, names, step)
    with stage(progress, "forces") as step:
        fit = fit_forces(setup, *seen, step, fixed=not labels)
        count, rig = len(setup.parameters), rig_of(setup.sensor)
        before, forces = setup.forces([(each[:count], rig.turn_sign) for each in (fit.start, fit.value)], arm, step)
    assert rig.force_sensor is not None
    first, simulated = (read_by(rig.force_sensor, f, of[count:]) for f, of in ((before, fit.start), (forces, fit.value)))
    wider = student.ppf(SIDE90, max(len(chosen) - fit.free / 3, 1)) * np.sqrt(1 + fit.free / (3 * len(chosen)))
    half, at = wider * fit.spread * noise_of(simulated), np.array([[*label.pose, *label.move] for label in arm])
    side = np.hypot(*(measured - fit.value[count:-1]).T[:2]) / np.maximum(abs(measured[:, 2]), 1e-9)
    by = {"depth": at[:, 2], "tilt": np.hypot(*at.T[3:5]), "shear": np.hypot(*at.T[6:8]), "twist": abs(at[:, 11]), "slip": forces[:, 6]}
    left = {f"F{a}": {key: _correlation(of, (simulated - measured)[:, k]) for key, of in by.items()} for k, a in enumerate("xyz")}
    every = {"measured": measured, "simulated": simulated, "half": half}
    by |= {"side_over_normal": side} | {f"{key}_{axis}": of[:, k] for key, of in every.items() for k, axis in enumerate("xyz")}
    parts = {}
    for part, mine in (("fitted", fitted), ("judged", ~fitted)):
        if mine.any():
            errors = {
                key: np.nanmean(abs(of - measured)[mine], axis=0).tolist() for key, of in (("before_n", first), ("error_n", simulated))
            }
            parts[part] = errors | {"rows": int(mine.sum()), "inside": float((abs(simulated - measured) <= half)[mine].mean())}
    parameters = []
    for k, p in enumerate((*setup.parameters, *CELL) if labels else ()):
        low, high = sorted(p.number(fit.value[k] + z * fit.sd[k]) for z in (-Z90, Z90))
        value = {"name": p.name, "start": p.number(fit.start[k]), "value": p.number(fit.value[k]), "low": low, "high": high}
        parameters.append(value | {"told": float(fit.told[k]), "known": bool(fit.told[k] >= TOLD)})
    summary = {"sensor": setup.sensor.name, "conventions": conventions, "parameters": parameters, "parts": parts, "left": left}
    rows = [{"row": k + 1, "fitted": bool(fitted[k])} | {key: float(each[k]) for key, each in by.items()} for k in range(len(arm))]
    result = ForceComparison(fit.sensor, summary, rows, [])
    return replace(result, written=[_write_page(folder, result)])


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Correlation of two columns (M,) where both are known; 0 if one is constant."""
    known = np.isfinite(x) & np.isfinite(y)
    return float(np.corrcoef(x[known], y[known])[0, 1]) if np.ptp(x[known]) and np.ptp(y[known]) else 0.0


def _write_page(folder: Path, result: ForceComparison) -> Path:
    summary, fitted = result.summary, bool(result.summary["parameters"])
    lead = ". ".join(result.lines()[: len(summary["parts"])])
    page = Page(f"Forces of {summary['sensor']} against a load cell", f"twin {'calibrate contact' if fitted else 'validate'}", lead=lead)
    page.notice("Conventions of the table", summary["conventions"])
    page.section("Measured and simulated", "What is left correlates with the labels and the slip as follows.")
    page.table([{"force": key} | of for key, of in summary["left"].items()], ["force", "depth", "tilt", "shear", "twist", "slip"])
    page.figures(
        PagePicture(write_chart(folder / "forces.png", lambda: draw_forces(result.rows)), "Simulated and measured forces; errors; slip")
    )
    if fitted:
        page.section("Parameters", "What the rows do not determine is left at its start. Low and high are the ends of 90 % intervals.")
        page.table(summary["parameters"], ["name", "start", "value", "low", "high", "known"])
    page.download(write_json(folder / "forces.json", summary | {"made_by": made_by(__name__)}), "all figures of this page")
    page.download(write_rows(folder / "rows.csv", result.rows), "labels, forces and 90 % intervals of each contact")
    return page.write(folder / "index.html")


def draw_forces(rows: list[dict[str, Any]]) -> Figure:
    """Simulated against measured force, errors by depth, tilt and shear, and the measured ratio of side force to normal force by slip."""
    of = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    figure, axes = new_figure(4, 2, panel_inch=3.2)
    for axis, ax, below, label in zip("xyz", axes[:3], axes[4:7], ("depth", "tilt", "shear"), strict=True):
        for part, mine in (("fitted", of["fitted"]), ("judged", ~of["fitted"])):
            x, y, half = (of[f"{key}_{axis}"][mine] for key in ("measured", "simulated", "half"))
            ax.errorbar(x, y, half, fmt="o", ms=3, lw=0.6, label=part)
        ax.plot(*[[of[f"measured_{axis}"].min(), of[f"measured_{axis}"].max()]] * 2, color=muted_colour())
        ax.set(xlabel=f"measured F{axis}, N", ylabel=f"simulated F{axis}, N")
        for each in "xyz":
            below.plot(of[label], of[f"simulated_{each}"] - of[f"measured_{each}"], "o", ms=3, label=f"F{each}")
        below.set(xlabel=f"{label}, {'deg' if label == 'tilt' else 'mm'}", ylabel="simulated - measured, N")
    axes[3].plot(of["slip"], of["side_over_normal"], "o", ms=3)
    axes[3].set(xlabel="share that slips in the twin", ylabel="measured side force over normal force")
    axes[7].set_axis_off()
    for ax in axes[[0, 4]]:
        ax.legend()
    return figure
