"""Paths solved with finite elements, to train a surrogate on and to measure its errors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from scenes.object import ObjectSpec, Shape
from scenes.pins import PinsSpec
from scenes.sensor import SensorSpec
from training.surrogate.compliance import AtNodes
from training.surrogate.paths import DrawnPath, draw_path
from twin.errors import ContactError
from twin.mechanics import Friction, SkinSolver
from twin.mechanics.law import ContactLaw
from twin.objects import build_field
from twin.progress import Step
from twin.types import FloatArray
from twin.workers import in_processes

PIN_RINGS = 10
"""Number of rings of the lattice on which the pins' motion is learnt."""
STEP_MM = 0.8
"""Largest motion across the contact in one load step: that of a step of a servo loop or an agent."""


@dataclass(frozen=True)
class SolvedPath:
    """The S converged states of one path. At the first state the object is clear of the skin.

    Attributes
    ----------
    shape : Shape
        Shape of the object.
    friction : float
        Coefficient of friction.
    T : (S, 4, 4) float
        The object's pose, sensor frame.
    base_mm, axis : (S, N, 3) float32
        Pins' feet and axes.
    force_n, torque_nmm : (S, 3) float
    area_mm2, slip : (S,) float
        Contact area, measured on the skin at rest, and the share of it that slides.
    node_mm, node_n : (S, M, 3) float32
        Displacements of the skin at the surrogate's nodes, and the forces on the skin, each shared among the nodes around its place.
    """

    shape: Shape
    friction: float
    T: FloatArray
    base_mm: FloatArray
    axis: FloatArray
    force_n: FloatArray
    torque_nmm: FloatArray
    area_mm2: FloatArray
    slip: FloatArray
    node_mm: FloatArray
    node_n: FloatArray


def lattice_sensor(sensor: SensorSpec) -> SensorSpec:
    """The sensor with its pins on a lattice of rings.

    Pins do not change the mechanics. The lattice has symmetries, and each of them gives a further training state.
    """
    kept = sensor.pins.model_dump(include=set(PinsSpec.model_fields) - {"missing"})
    pins = PinsSpec.model_validate({**kept, "layout": "rings", "rings": PIN_RINGS, "spacing": "polar"})
    return sensor.model_copy(update={"pins": pins})


def solve_path(solver: SkinSolver, nodes: AtNodes, drawn: DrawnPath, *, step_mm: float = STEP_MM) -> SolvedPath | None:
    """Solve a path with the finite elements as far as they converge; None if the first step does not converge."""
    field = build_field(ObjectSpec(name="drawn", description="", shape=drawn.shape))
    rest = solver.rest(T_sensor_object=drawn.path.at(0.0))
    states = [rest]
    try:
        law = ContactLaw(Friction(drawn.friction, drawn.friction))
        for _, state in solver.path(field, drawn.path, law=law, step_mm=step_mm):
            states.append(state)
    except ContactError:
        if len(states) == 1:
            return None
    rows = []
    for s in states:
        single = s.base_mm.astype(np.float32), s.axis.astype(np.float32)
        felt = s.force_n, s.torque_nmm, s.point_area_mm2.sum(), s.slip_share
        rows.append((s.T_sensor_object, *single, *felt, nodes.moved_mm(s), nodes.force_n(s)))
    return SolvedPath(drawn.shape, drawn.friction, *(np.array(column) for column in zip(*rows, strict=True)))


def solve_paths(sensor: SensorSpec, numbers: Sequence[int], *, processes: int, progress: Step) -> list[SolvedPath]:
    """Draw and solve the paths of these numbers. The same number always gives the same path."""
    found: dict[int, SolvedPath] = {}
    for done, (number, solved) in enumerate(in_processes(_begin, (lattice_sensor(sensor),), list(numbers), processes=processes), 1):
        if solved is not None:
            found[number] = solved
        progress(done, len(numbers))
    return [found[number] for number in sorted(found)]


def _begin(sensor: SensorSpec) -> Callable[[int], tuple[int, SolvedPath | None]]:
    solver = SkinSolver(sensor)
    return partial(_solve, sensor, solver, AtNodes.of(solver))


def _solve(sensor: SensorSpec, solver: SkinSolver, nodes: AtNodes, number: int) -> tuple[int, SolvedPath | None]:
    drawn = draw_path(sensor, np.random.default_rng((number, 26)))
    return number, solve_path(solver, nodes, drawn)
