"""From a sensor, an object and a pose to converged contact states."""

from collections.abc import Callable, Iterator

import numpy as np
from threadpoolctl import ThreadpoolController

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import ContactError
from twin.geometry.mesh import SKIN, Resolution, build_mesh, pin_pose
from twin.mechanics.contact import ContactForces, contact_points, no_anchors, spread_forces
from twin.mechanics.elements import element_table, lame_constants
from twin.mechanics.linear import FrontalSolver
from twin.mechanics.newton import RESIDUAL_TOLERANCE, Balance, Body, LoadState, LoadStepper, NoConvergence
from twin.mechanics.path import ContactPath, ContactPose, plan_path
from twin.stimulus import Stimulus, build_stimulus
from twin.types import ContactState

_PENALTY_MPA_MM = 30.0
_STEP_MM, _STEP_DEG = 0.75, 8.0
_SMALLEST_STRIDE = 1 / 64  # of a regular load step


class SkinSolver:
    """Presses one sensor; the mesh and everything derived from it are computed once.

    Parameters
    ----------
    spec : SensorSpec
    resolution : Resolution, optional
    """

    def __init__(self, spec: SensorSpec, *, resolution: Resolution | None = None):
        self.spec = spec
        self.mesh = build_mesh(spec, resolution=resolution)
        skin, gel = (lame_constants(m.young_modulus_mpa, m.poisson_ratio) for m in (spec.skin, spec.gel))
        is_skin = self.mesh.material == SKIN
        table = element_table(self.mesh.nodes_mm, self.mesh.hexes, np.where(is_skin, skin[0], gel[0]), np.where(is_skin, skin[1], gel[1]))
        points = contact_points(self.mesh, spec.skin.outer_radius_mm)
        self.body = Body(table, points, FrontalSolver(self.mesh.hexes, self.mesh.fixed, self.mesh.grid), ~self.mesh.fixed)
        self._blas = ThreadpoolController()  # the fronts are small: more BLAS threads only wait for each other

    def rest(self, *, T_sensor_object: np.ndarray | None = None) -> ContactState:
        """The undeformed sensor."""
        none = np.zeros((0, 3))
        base, axis, caps = pin_pose(self.mesh, self.mesh.nodes_mm)
        pose = np.eye(4) if T_sensor_object is None else T_sensor_object
        zero = np.zeros(3)
        return ContactState(self.mesh.nodes_mm, base, axis, caps, zero, zero.copy(), 0.0, np.zeros(0, int), none, pose, 0.0)

    def press(
        self,
        stimulus: Stimulus | ObjectSpec,
        pose: ContactPose,
        *,
        friction: float | None = None,
        compliance_mm_per_n: float | None = None,
        progress: Callable[[float, ContactState], None] | None = None,
    ) -> ContactState:
        """The state at the end of a contact; arguments and errors as ``path``."""
        for at, state in self.path(stimulus, pose, friction=friction, compliance_mm_per_n=compliance_mm_per_n):
            if progress is not None:
                progress(at, state)
        return state

    def path(
        self,
        stimulus: Stimulus | ObjectSpec,
        pose: ContactPose,
        *,
        friction: float | None = None,
        compliance_mm_per_n: float | None = None,
        release: bool = False,
    ) -> Iterator[tuple[float, ContactState]]:
        """Every converged state of a contact, in order.

        Parameters
        ----------
        stimulus : Stimulus or ObjectSpec
            With a bare ``Stimulus``, friction and compliance default to 0.
        friction, compliance_mm_per_n : float, optional
            Override the object's.
        release : bool
            Afterwards lift the object off again, the way it came.

        Yields
        ------
        fraction : float
            Of the path done, rising to 1.
        state : ContactState

        Raises
        ------
        ContactError
            Pose out of range, object out of reach, or no convergence: names the step and the residual.
        """
        spec = stimulus if isinstance(stimulus, ObjectSpec) else None
        field = build_stimulus(spec) if spec else stimulus
        mu = friction if friction is not None else (spec.friction if spec else 0.0)
        compliance = compliance_mm_per_n if compliance_mm_per_n is not None else (spec.compliance_mm_per_n if spec else 0.0)
        plan = plan_path(self.spec, field, pose)
        if pose.indent_mm <= 0:
            yield 1.0, self.rest(T_sensor_object=plan.at(1.0))
            return
        stops = _stops(plan, release)
        stepper = LoadStepper(self.body, field, mu, compliance)
        start = no_anchors(self.body.points)
        state = LoadState(self.mesh.nodes_mm, 0.0, start, np.zeros(len(start.held)), _PENALTY_MPA_MM, plan.at(0.0))
        for number in range(1, len(stops)):
            done, stride = 0.0, 1.0
            while done < 1:
                stride = min(stride, 1 - done)
                at = stops[number - 1] + (done + stride) * (stops[number] - stops[number - 1])
                T = plan.at(min(at, 2 * plan.end - at))
                try:
                    with self._blas.limit(limits=1, user_api="blas"):
                        state, balance = stepper.step(state, T)
                except NoConvergence as failure:
                    stride /= 2
                    if stride >= _SMALLEST_STRIDE:
                        continue
                    raise ContactError(
                        f"no convergence in load step {number} of {len(stops) - 1} ({at / stops[-1]:.0%} of the path): relative residual "
                        f"{failure.relative:.1e}, needed {RESIDUAL_TOLERANCE:.0e}; try less indentation, shear or friction, "
                        f"a rounder object, or another resolution"
                    ) from None
                done += stride
                stride = min(2 * stride, 1.0)
                yield float(at / stops[-1]), self._contact_state(state, balance)

    def _contact_state(self, state: LoadState, balance: Balance) -> ContactState:
        traction = np.zeros_like(state.nodes_mm)
        spread_forces(self.body.points.nodes, self.body.points.weights, -balance.point_force_n, traction)
        touched = np.flatnonzero((traction != 0).any(axis=1))
        base, axis, caps = pin_pose(self.mesh, state.nodes_mm)
        pose = state.T.copy()
        pose[2, 3] += state.yield_mm
        return ContactState(
            nodes_mm=state.nodes_mm,
            base_mm=base,
            axis=axis,
            caps_mm=caps,
            force_n=traction.sum(axis=0),
            torque_nmm=np.cross(state.nodes_mm, traction).sum(axis=0),
            area_mm2=self._contact_area(state.nodes_mm, balance.contact),
            contact_nodes=touched,
            traction_n=traction[touched],
            T_sensor_object=pose,
            residual=balance.relative,
        )

    def _contact_area(self, nodes_mm: np.ndarray, contact: ContactForces) -> float:
        """Deformed area of the Gauss points in contact: their rest area times their quad's change of area."""
        quads = self.mesh.outer_quads

        def areas(nodes):
            return np.linalg.norm(np.cross(nodes[quads[:, 2]] - nodes[quads[:, 0]], nodes[quads[:, 3]] - nodes[quads[:, 1]]), axis=1) / 2

        growth = areas(nodes_mm) / areas(self.mesh.nodes_mm)
        counted = self.body.points.counted & (contact.penetration_mm > 0)
        return float((self.body.points.area_mm2 * growth[self.body.points.element])[counted].sum())


def _stops(plan: ContactPath, release: bool) -> np.ndarray:
    """Progress at the regular load steps (beyond ``plan.end``: the way back)."""
    pose = plan.pose
    press = int(np.ceil(pose.indent_mm / _STEP_MM))
    stops = [np.linspace(0, 1, press + 1)]
    if plan.end > 1:
        slide = int(np.ceil(max(np.hypot(*pose.shear_mm) / _STEP_MM, abs(pose.twist_deg) / _STEP_DEG)))
        stops.append(np.linspace(1, 2, slide + 1)[1:])
    there = np.concatenate(stops)
    return np.concatenate([there, 2 * plan.end - there[-2::-1]]) if release else there
