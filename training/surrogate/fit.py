"""Fit of a surrogate: the linear skin from the solver's own elements, and networks trained on solved paths."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from training.surrogate.compliance import NODE_RINGS, Compliance, compliance_of, interpolation_matrix
from training.surrogate.contact import LinearContacts
from training.surrogate.contacts import SurrogateContacts
from training.surrogate.model import SHIPPED, SUFFIX, Bending, Surrogate, ample, features, gate, load_surrogate, mechanics_of, within
from training.surrogate.paths import DEEPEST_MM, STICKING
from training.surrogate.reading import EpisodeContact
from training.surrogate.samples import PIN_RINGS, SolvedPath, lattice_sensor, solve_paths
from training.surrogate.symmetry import Symmetry, about_z, ring_directions, symmetries
from twin.camera.projection import project_in_form
from twin.errors import OptionError
from twin.geometry.pins import rest_pins
from twin.mechanics import Friction
from twin.mechanics.law import ContactLaw
from twin.objects import build_field
from twin.objects.analytic import CompiledSolid
from twin.progress import Progress, silent, stage
from twin.store import Layers, writes_file
from twin.types import FloatArray, Form, ReadableResult

FAMILY = "mg400-331"
"""Sensor of the shipped surrogate whose networks are the start of the training for every other sensor."""
PATHS = 120
"""Default number of solved paths to train a surrogate on: about 5000 states."""
RADII_MM = (15.0, 25.0)
"""Smallest and largest radius of a dome. In this range the sampled indentations, of up to 5 mm, are usual ones."""
LEAST_PATHS = 10
"""Smallest number of paths to train on."""
JUDGED = 5
"""Every path whose number is a multiple of this is kept out of the training and used to measure the errors."""
TURNS = 2
"""Number of turns about the sensor's axis at which each solved path is used: its contacts then lie elsewhere between the nodes."""
AXIS_MM = 0.9
"""Length that converts changes of a pin's axis to motion, for the modes: about the length of a pin of the shipped sensors."""
LIGHT = 0.01
"""Mean square of the bending network's inputs below which all states have the same weight in the regression of its linear part."""
STEADY = 1e-3
"""Ridge regularisation of the regression of the bending network's linear part."""
LOST = 0.02
"""Largest share of a state's force that may lie beyond the nodes, for the state to be used for the skin's bending."""
EPOCHS = 36
BATCH = 512
RATE = 1e-3
"""Largest learning rate of Adam in its cycle."""
DECAY = 0.005
"""Weight decay."""
DEEPEST_TAKEN_MM = DEEPEST_MM + 0.5
"""Largest indentation of the surrogate's domain."""
POLAR_DEG = 48.0
"""Largest angle of a contact's deepest place from the apex. Paths begin within 35 deg and move on from there."""
LEAST_MOVED_MM = 1.0
"""Softening of the states' weights in the loss, 1 / (LEAST_MOVED_MM^2 + m^2), where m is a state's largest motion of a pin or node."""
TOUCHES_MM = 0.05
"""Smallest depth of a contact that is used."""
LARGE_PX = 2.0
"""Smallest displacement of a state's largest moved pin for the quantile of errors relative to that displacement."""
MEASURED = ("error", "largest", "share", "depth_mm", "object", "force", "force_error", "slip", "shear_mm")
"""What the errors are computed from, for each state."""
BINS = {"depth_mm": (0.0, 1.5, 3.0, 6.0), "shear_mm": (0.0, 0.5, 1.5, 20.0)}
"""Ends of the ranges in which errors are reported. The shear is the largest sideways motion of a cap."""


@dataclass(frozen=True, repr=False)
class Distilled(ReadableResult):
    """A fitted surrogate with its errors on paths that it was not trained on, and the files that were written."""

    surrogate: Surrogate
    size_bytes: int
    written: list[Path] = field(default_factory=list)

    def lines(self) -> list[str]:
        """The result as lines of text."""
        found = self.surrogate.about["errors"]
        every = found["all"]
        lines = [
            f"{self.surrogate.about['states']} states of {self.surrogate.about['paths']} paths, {self.size_bytes / 1e3:.0f} kB",
            f"on {found['paths']} unseen paths: pins {every['pins_px']:.2f} px on average, "
            f"{every['pins_share_95']:.1%} of the largest displacement at the 95 % quantile, force {every['force_share']:.1%}, "
            f"slip share {every['slip']:.3f}",
        ]
        for kind, parts in found["by"].items():
            each = (f"{name} {told['pins_px']:.2f} px, {told['force_share']:.0%}" for name, told in parts.items())
            lines.append(f"by {kind}: {', '.join(each)}")
        return lines


@dataclass(frozen=True)
class _Samples:
    """S training states on the lattices: the linear skin's answer, and the truth."""

    force: FloatArray  # (S, M, 3) float32, nodal forces of the linear skin
    beside: FloatArray  # (S, FEATURES), see ``features``
    depth: FloatArray  # (S,)
    within: FloatArray  # (S, M) float32, see ``within``
    linear: FloatArray  # (S, 6), the linear skin's wrench on the object
    pins: FloatArray  # (S, 2, P, 3), displacements of feet and changes of axes
    wrench: FloatArray  # (S, 6)
    area: FloatArray  # (S,)
    slip: FloatArray  # (S,), true sliding share minus the linear skin's share of sliding nodes


@writes_file("out")
def distil(
    sensor: SensorSpec, out: Path, *, paths: int = PATHS, processes: int = 1, seed: int = 0, progress: Progress = silent
) -> Distilled:
    """Make the surrogate of a sensor and write it to ``out``.

    Parameters
    ----------
    paths : int
        Number of paths to solve with finite elements. Each takes some seconds on one core.
    processes : int
        Number of processes that solve paths.
    seed : int
        Another seed draws other paths.

    Raises
    ------
    OptionError
        There are too few paths, or ``require_dome`` refuses the sensor.
    """
    require_dome(sensor)
    if paths < LEAST_PATHS:
        raise OptionError(f"`paths` {paths}: expected at least {LEAST_PATHS}")
    with stage(progress, f"contacts of {sensor.name}") as step:
        solved = solve_paths(sensor, range(seed * 100_000, seed * 100_000 + paths), processes=processes, progress=step)
    with stage(progress, "network") as step:
        surrogate = fit(sensor, solved, load_surrogate(SHIPPED / f"{FAMILY}{SUFFIX}"), progress=step)
    return Distilled(surrogate, surrogate.save(out), [out])


def require_dome(sensor: SensorSpec) -> None:
    """Raise ``OptionError`` for a sensor that a surrogate cannot replace."""
    low, high = RADII_MM
    if sensor.skin.shape != "cap" or sensor.skin.rim_z_mm != 0 or not low <= sensor.skin.outer_radius_mm <= high:
        raise OptionError(
            f"{sensor.name}: a surrogate is of a half sphere of {low:g} to {high:g} mm radius, whose contacts and symmetries it is trained "
            "on; use backend='fem'"
        )
    for part in ("skin", "gel"):
        if getattr(sensor, part).relaxation:
            raise OptionError(f"{sensor.name}: its {part} relaxes, and a surrogate has no history in time; use backend='fem'")
    if sensor.gel.sealed:
        raise OptionError(f"{sensor.name}: its gel is sealed, which a surrogate does not model; use backend='fem'")


def fit(sensor: SensorSpec, solved: Sequence[SolvedPath], start: Surrogate, *, progress: Any) -> Surrogate:
    """Fit a surrogate to solved paths of the sensor's lattice.

    Every fifth path of ``solved`` is used only to measure the errors. ``start`` is a surrogate of a sensor whose pins are the lattice. Its
    modes and scales are used, and the training continues from its networks: the corrections of sensors of one family are similar.
    """
    torch.set_num_threads(1)
    solved = [cut(path, sensor.skin.outer_radius_mm) for path in solved]
    seen = [path for number, path in enumerate(solved) if number % JUDGED]
    kept = [path for number, path in enumerate(solved) if not number % JUDGED]
    skin = compliance_of(lattice_sensor(sensor))
    answer = average_compliance(skin.nodes, sensor.pins.phase_deg)
    weights = np.array([1.0, AXIS_MM], np.float32)[:, None, None]
    linear_pins = np.stack([skin.base, skin.axis]).astype(np.float32) * weights[..., None, None]  # (2, P, 3, M, 3)
    flat = linear_pins.reshape(linear_pins.shape[0] * linear_pins.shape[1] * 3, -1)
    group = symmetries(sensor.pins.phase_deg)
    moved, force = _truths(seen)
    moves = force.reshape(len(force), -1) @ answer.transpose(0, 3, 1, 2).reshape(3 * len(answer), -1)
    softness = float((moves * moved.reshape(moves.shape)).sum() / (moves**2).sum())
    answer, flat = softness * answer, softness * flat
    turned = [(g.move_vectors(moved, NODE_RINGS), g.move_vectors(force, NODE_RINGS)) for g in group]
    modes = _carry_modes(start, sensor, weights)
    read = modes @ flat
    bending = _bending(turned, answer, read, start.bending, progress)
    kernel = bending.kernel(read)
    rng = np.random.default_rng(0)
    turns = rng.uniform(0.0, np.pi / 3, (len(seen), TURNS))
    turns[:, 0] = 0.0
    places = [(path, turn) for path, angles in zip(seen, turns, strict=True) for turn in angles]
    rows = _join_samples([sample_states(sensor, skin, answer, path, kernel, turn) for path, turn in places])
    rows = replace(rows, pins=rows.pins * weights)
    inputs, outputs = [], []
    for g in group:
        part = _turn_states(rows, g)
        seen_by = [part.force.reshape(len(part.force), -1) @ read.T, part.beside, part.within @ start.view.T]
        inputs.append(np.concatenate(seen_by, axis=1).astype(np.float32))
        lacks = (part.pins.reshape(len(part.pins), -1) - part.force.reshape(len(part.force), -1) @ flat.T) @ modes.T
        others = np.column_stack([part.area / 100.0, part.slip])
        outputs.append(np.concatenate([lacks, part.wrench - part.linear, others], axis=1).astype(np.float32))
    x, y = np.concatenate(inputs), np.concatenate(outputs)
    largest = np.linalg.norm(rows.pins[:, 0], axis=2).max(axis=1)
    counts = np.tile(1.0 / (LEAST_MOVED_MM**2 + largest**2), len(group))
    gates = np.tile(gate(rows.depth), len(group))
    given = (x - start.mean) / start.scale, y / start.out_scale, gates.astype(np.float32), (counts / counts.mean()).astype(np.float32)
    layers = _train_network(*given, start.layers, progress)
    onto = _interpolation(sensor)
    on_pins = np.einsum("np,kcpi->knci", onto, modes.reshape(len(modes), 2, -1, 3) / weights[None], optimize=True)
    domain = {"depth_mm": DEEPEST_TAKEN_MM, "polar_deg": POLAR_DEG, "friction": STICKING}
    about = {"sensor": sensor.name, "mechanics": mechanics_of(sensor), "domain": domain, "paths": len(solved)}
    about |= {"states": int(sum(len(path.T) for path in solved))}
    answer, on_pins, read = (values.astype(np.float32) for values in (answer, on_pins, read))
    made = replace(start, about=about, node_mm=skin.node_mm, answer=answer, modes=on_pins, read=read, bending=bending, layers=layers)
    made = made.as_kept()  # so that the errors are those of the file, which rounds the arrays
    about["errors"] = measure_errors(made, sensor, kept)
    return made


def cut(path: SolvedPath, radius_mm: float) -> SolvedPath:
    """A path up to where it leaves the domain on a dome of this radius: later states, which may be very large, are not trained on."""
    obj = build_field(ObjectSpec(name="drawn", description="", shape=path.shape))
    inside = len(path.T)
    for number, T in enumerate(path.T):
        distance, outward, _ = obj.probe(-T[:3, 3][None] @ T[:3, :3])
        depth = radius_mm - float(distance[0])
        if depth > DEEPEST_TAKEN_MM or (depth > 0 and -T[2, :3] @ outward[0] < np.cos(np.radians(POLAR_DEG))):
            inside = number
            break
    names = ("T", "base_mm", "axis", "force_n", "torque_nmm", "area_mm2", "slip", "node_mm", "node_n")
    states = {name: getattr(path, name)[:inside] for name in names}
    return replace(path, **states)


def average_compliance(nodes: FloatArray, phase_deg: float) -> FloatArray:
    """Compliance (M, M, 3, 3), force node first, averaged over the symmetries: the mesh of squares breaks them slightly."""
    answer = nodes.transpose(2, 0, 1, 3)
    total = np.zeros_like(answer)
    group = symmetries(phase_deg)
    for g in group:
        places = g.places(NODE_RINGS)
        total[np.ix_(places, places)] += np.einsum("pr,ijrs,qs->ijpq", g.matrix, answer, g.matrix, optimize=True)
    return np.ascontiguousarray(total / len(group))


def sample_states(
    sensor: SensorSpec, skin: Compliance, answer: FloatArray, path: SolvedPath, bending: tuple[FloatArray, ...], turn_rad: float = 0.0
) -> _Samples:
    """States of the linear skin along a solved path, and the true states, both turned about the sensor's axis.

    ``bending`` is that of ``LinearContacts``.
    """
    about = np.eye(4)
    about[:3, :3] = turn = about_z(turn_rad)
    poses = about @ path.T
    obj = build_field(ObjectSpec(name="drawn", description="", shape=path.shape))
    assert isinstance(obj, CompiledSolid)
    linear, row = LinearContacts(skin.node_mm, answer.astype(np.float32), 1, bending=bending), np.zeros(1, int)
    linear.begin(0, obj, path.friction)
    rest = rest_pins(lattice_sensor(sensor).geometry)
    states = []
    for before, T in zip(poses[[0, *range(len(poses) - 1)]], poses, strict=True):
        linear.move(row, before[None], T[None])
        held = linear.held[0].sum()
        slip = linear.slides[0].sum() / max(held, 1)
        gap = linear.distances(row, T[None])[0][0]
        states.append((linear.force_n[0].astype(np.float32), max(-float(gap.min()), 0.0), within(gap), held, slip, linear.used[0]))
    forces, deep, near, holding, slips, used = (np.array(column) for column in zip(*states, strict=True))
    wrench = -np.concatenate([forces.sum(axis=1), np.cross(skin.node_mm, forces).sum(axis=1)], axis=1)
    beside = features(deep, np.full(len(deep), path.friction), holding, slips, used, wrench)
    pins = np.stack([path.base_mm - rest.base_mm, path.axis - rest.axis], axis=1)
    if turn_rad:
        pins = interpolation_matrix(-rest.axis @ turn.T, -rest.axis) @ (pins @ turn.T)
    truth = np.concatenate([path.force_n @ turn.T, path.torque_nmm @ turn.T], axis=1)
    return _Samples(forces, beside, deep, near, wrench, pins.astype(np.float32), truth, path.area_mm2, path.slip - slips)


def _carry_modes(start: Surrogate, sensor: SensorSpec, weights: FloatArray) -> FloatArray:
    """The modes (MODES, 6 P) of ``start``, a surrogate of another sensor of the family, on this sensor's lattice."""
    turn = about_z(np.radians(sensor.pins.phase_deg - start.phase_deg)).astype(np.float32)
    modes = (start.modes @ turn.T).transpose(0, 2, 1, 3) * weights
    return np.ascontiguousarray(modes.reshape(len(modes), -1))


def _truths(solved: Sequence[SolvedPath]) -> tuple[FloatArray, FloatArray]:
    """Displacements of and forces on the nodes (S, M, 3) float32 in the pressed states of solved paths whose force lies within the nodes,
    up to the share ``LOST``."""
    moved, force = [], []
    for path in solved:
        lost = np.linalg.norm(path.node_n.sum(axis=1) + path.force_n, axis=1)
        whole = lost < LOST * np.linalg.norm(path.force_n, axis=1)
        moved.append(path.node_mm[whole])
        force.append(path.node_n[whole])
    return np.concatenate(moved).astype(np.float32), np.concatenate(force).astype(np.float32)


def _bending(turned: Sequence[tuple[FloatArray, ...]], answer: FloatArray, read: FloatArray, start: Bending, progress: Any) -> Bending:
    """Fit the bending: the true displacements minus those of the linear skin under the same forces.

    ``turned`` holds the displacements and forces of ``_truths`` under each symmetry, the identity first.
    """
    compliance = answer.transpose(0, 3, 1, 2).reshape(3 * len(answer), -1).astype(np.float32)
    forces = [force.reshape(len(force), -1) for _, force in turned]
    lacks = [moved.reshape(len(moved), -1) - force @ compliance for (moved, _), force in zip(turned, forces, strict=True)]
    modes = start.modes.reshape(-1, len(compliance))
    x, y = np.concatenate([force @ read.T for force in forces]), np.concatenate([part @ modes.T for part in lacks])
    x = x / start.scale
    counts = np.tile(1.0 / (LEAST_MOVED_MM**2 + (turned[0][0] ** 2).sum(axis=2).max(axis=1)), len(turned))
    light = (1.0 / (LIGHT + (x**2).mean(axis=1)))[:, None]  # the linear part is for light contacts, so they weigh most
    straight = np.linalg.solve((x * light).T @ x + STEADY * len(x) * np.eye(x.shape[1]), (x * light).T @ y).T
    layers = _train_network(x, y - x @ straight.T, ample(x), (counts / counts.mean()).astype(np.float32), start.layers, progress)
    return Bending(start.scale, straight.astype(np.float32), layers, start.modes)


def measure_errors(surrogate: Surrogate, sensor: SensorSpec, solved: Sequence[SolvedPath]) -> dict[str, Any]:
    """Errors on solved paths: pins in px of the sensor's frames, force, sliding share; for all states and by kind of contact."""
    lattice, form = lattice_sensor(sensor), Form.PROCESSED if sensor.recording else Form.RAW
    onto, cap_mm = _interpolation(sensor), sensor.pins.length_mm + sensor.pins.cap_height_mm / 2
    rest, lattice_rest = rest_pins(sensor.geometry), rest_pins(lattice.geometry)
    px = partial(project_in_form, sensor, form)
    rest_px = px(rest.caps_mm)
    states: list[tuple[Any, ...]] = []
    for path in solved:
        obj = ObjectSpec(name="drawn", description="", shape=path.shape)
        contacts = SurrogateContacts(surrogate, sensor, 1)
        contacts.begin(0, EpisodeContact(sensor, obj, ContactLaw(Friction(path.friction, path.friction))))
        for number, T in enumerate(path.T):
            contacts.move(np.zeros(1, int), T[None], np.zeros(1))
            depth = float(contacts.depth_mm[0])
            if contacts.felt.lost[0] or depth < TOUCHES_MM:
                continue
            moved = (path.base_mm[number] - lattice_rest.base_mm) + cap_mm * (path.axis[number] - lattice_rest.axis)
            true_px = px(rest.caps_mm + onto @ moved)
            off = np.linalg.norm(px(contacts.felt.caps_mm[0]) - true_px, axis=1)
            largest = float(np.linalg.norm(true_px - rest_px, axis=1).max())
            true_n, slip = path.force_n[number], abs(float(contacts.felt.slip[0]) - path.slip[number])
            force, force_error = (float(np.linalg.norm(value)) for value in (true_n, contacts.felt.force_n[0] - true_n))
            shear_mm = float(np.linalg.norm(moved[:, :2], axis=1).max())
            states.append((off, largest, off / max(largest, 1e-9), depth, path.shape.kind, force, force_error, slip, shear_mm))
    values = {key: np.array([state[k] for state in states]) for k, key in enumerate(MEASURED)}
    large = values["largest"] >= LARGE_PX

    def summarise(rows: Any) -> dict[str, float]:
        return {
            "states": int(np.sum(rows)),
            "pins_px": round(float(values["error"][rows].mean()), 4),
            "pins_share_95": round(float(np.quantile(values["share"][rows & large], 0.95)), 4) if (rows & large).any() else 0.0,
            "force_share": round(float(values["force_error"][rows].mean() / values["force"][rows].mean()), 4),
            "slip": round(float(values["slip"][rows].mean()), 4),
        }

    groups = {"object": {kind: values["object"] == kind for kind in sorted(set(values["object"].tolist()))}}
    for key, ends in BINS.items():
        groups[key] = {f"{low:g} to {high:g}": (values[key] >= low) & (values[key] < high) for low, high in pairwise(ends)}
    by = {key: {name: summarise(rows) for name, rows in parts.items() if rows.any()} for key, parts in groups.items()}
    return {"paths": len(solved), "all": summarise(np.ones(len(values["force"]), bool)), "by": by}


def _join_samples(parts: Sequence[_Samples]) -> _Samples:
    every = _Samples(*(np.concatenate([getattr(part, name) for part in parts]) for name in _Samples.__dataclass_fields__))
    rows = every.depth > TOUCHES_MM
    return _Samples(*(getattr(every, name)[rows] for name in _Samples.__dataclass_fields__))


def _turn_states(rows: _Samples, g: Symmetry) -> _Samples:
    """The same states, turned or mirrored."""
    wrench, linear, beside = (_turned_wrench(values, g) for values in (rows.wrench, rows.linear, rows.beside))
    pins = np.stack([g.move_vectors(rows.pins[:, part], PIN_RINGS) for part in range(2)], axis=1)
    near = np.empty_like(rows.within)
    near[:, g.places(NODE_RINGS)] = rows.within
    return replace(rows, force=g.move_vectors(rows.force, NODE_RINGS), beside=beside, within=near, linear=linear, pins=pins, wrench=wrench)


def _turned_wrench(values: FloatArray, g: Symmetry) -> FloatArray:
    """Turn or mirror rows whose last six columns are a force and a torque."""
    out = values.copy()
    out[:, -6:-3] = values[:, -6:-3] @ g.matrix.T
    out[:, -3:] = g.parity * (values[:, -3:] @ g.matrix.T)
    return out


def _train_network(x: FloatArray, y: FloatArray, gates: FloatArray, counts: FloatArray, start: Layers, progress: Any) -> Layers:
    """Train a network whose output, times the gates (S,), estimates y (S, o) from x (S, i); return its weights and offsets.

    ``counts`` (S,) are the states' weights in the loss. Training starts from the weights and offsets of ``start``.
    """
    linear = [torch.nn.Linear(weight.shape[1], len(weight)) for weight, _ in start]
    net = torch.nn.Sequential(linear[0], torch.nn.SiLU(), linear[1], torch.nn.SiLU(), linear[2])
    inputs, wanted, share, count = (torch.from_numpy(np.ascontiguousarray(values)) for values in (x, y, gates[:, None], counts))
    batches = max(len(x) // BATCH, 1)
    with torch.no_grad():
        for layer, (weight, offset) in zip(linear, start, strict=True):
            layer.weight.copy_(torch.from_numpy(weight))
            layer.bias.copy_(torch.from_numpy(offset))
    optimiser = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=DECAY)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=EPOCHS * batches)
    generator = torch.Generator().manual_seed(0)
    for epoch in range(EPOCHS):
        order = torch.randperm(len(x), generator=generator)
        for batch in order[: batches * BATCH].tensor_split(batches):
            loss = (((net(inputs[batch]) * share[batch] - wanted[batch]) ** 2).sum(dim=1) * count[batch]).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            cycle.step()
        progress(epoch + 1, EPOCHS, f"loss {loss.item():.3f}")
    return tuple((layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy()) for layer in linear)


def _interpolation(sensor: SensorSpec) -> FloatArray:
    """Matrix (N, P) that interpolates motions on the lattice to the sensor's pins."""
    lattice = ring_directions(PIN_RINGS, sensor.pins.max_polar_deg, sensor.pins.phase_deg)
    places = -rest_pins(sensor.geometry).axis
    if places.shape == lattice.shape and np.allclose(places, lattice, atol=1e-9):
        return np.eye(len(lattice))
    return interpolation_matrix(lattice, places)
