"""Solver of contacts: it computes converged states of a sensor along an object's path, of one contact or of many in parallel."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import ContactError, MeshError
from twin.geometry.mesh import NodeView, build_mesh
from twin.geometry.shapes import Focus, shape_of
from twin.geometry.solid import Resolution, Solid, build_solid, pin_pose
from twin.mechanics.balance import Balance, Body, LoadState, in_object
from twin.mechanics.body.elements import History, soft_body
from twin.mechanics.contact import contact_points, touching_mm2
from twin.mechanics.law import ContactLaw, Friction
from twin.mechanics.newton import RESIDUAL_TOLERANCE, LoadStepper, NoConvergence
from twin.mechanics.path import ContactPath, ContactPose, carry_points, deepest_mm, plan_path
from twin.objects import ObjectField, build_field
from twin.types import ContactState, FloatArray, IntArray
from twin.workers import in_processes

_STEP_MM = 0.4
"""Default of the largest motion of the object at any pressed point of the skin in one load step, mm."""
_LOOK_MM = 2.0
"""Largest motion of the object between two poses at which the solver computes where the object will press, mm."""
_FOCUS_POINTS = 2000
"""Number of points on a whole sphere. The gap to the object is computed at the points on the skin, to find where the object will press."""
_FOCUS_GAP_MM = 0.5
"""Decay length of the weights of the focus, mm. With the object at first touch, a direction with a gap g gets the weight exp(-g / this).
So the object's local shape determines the focus, and not the indentation."""

_KEPT_SOLIDS = 4
"""Number of solids in memory, about 8 MB each. Every other pose has its own focus, so only the same pose or the rest state needs a solid
again."""
_GRID_TURN_RAD = np.radians(30.0)
"""Rotation of the grid's rows relative to the object's x axis. If the rows were parallel to an edge, whole rows would reach it at once."""
_LEAST_FOCUS_RAD = np.radians(28.0)
"""Smallest angular radius of the fine part of the grid around the focus."""
_LARGEST_FOCUS_RAD = np.radians(50.0)
"""Largest angular radius of the fine part of the grid around the focus."""
_COARSE_FOCUS_RAD = np.radians(2.4)
"""On a grid with fewer than 16 elements across, the smallest angular radius grows by this for each missing element. Otherwise the elements
at the rim would turn inside out."""
_FOCUS_SPREADS = 1.5
"""The angular radius of the fine part is its smallest value plus this many root mean square angles of the weights."""
_TOUCH_MM = 1e-4
"""Tolerance of a first touch: largest distance between object and skin, mm."""
_MOST_LIFTS = 60
"""Largest number of steps in which the object is moved to its first touch; three are usual."""
_MISSED_MM = 0.5
"""Largest depth of an object's origin inside the skin at rest, mm, at which the skin's mesh may not yet have met the object."""
_START_INSIDE_MM = 0.05
"""Largest penetration of the undeformed skin at the start of a path, mm. It allows for the rounding of a first touch."""
_PENALTY_MPA_MM = 30.0
"""Penalty at the start of every contact, MPa per mm of penetration. With it, usual pressures give penetrations below
``newton.GAP_BOUND_MM``."""
_SMALLEST_STRIDE = 1 / 64
"""Smallest fraction of a regular load step. If a step of this length does not converge, the contact does not converge."""


@dataclass(frozen=True)
class Setting:
    """A solid and the quantities derived from it.

    Attributes
    ----------
    solid : Solid
    body : Body
    view : NodeView
    """

    solid: Solid
    body: Body
    view: NodeView


class OngoingContact:
    """One contact from its first touch on, with the history of friction and relaxation from step to step (see ``SkinSolver.begin``).

    Attributes
    ----------
    setting : Setting
    stepper : LoadStepper
    load : LoadState
        The last converged state.
    """

    def __init__(self, solver: "SkinSolver", field: ObjectField, law: ContactLaw, T: FloatArray, focus: Focus) -> None:
        self._one_thread = solver.one_thread
        with self._one_thread():
            setting = self.setting = solver.setting_of(focus)
        body, control_mm, border = setting.body, setting.solid.control_mm, np.zeros(2)
        self.stepper = LoadStepper(body, list(setting.solid.boxes), field, law)
        gap_mm = field.distance(in_object(body.points.positions(control_mm), T, border))
        none = np.zeros(len(gap_mm))
        self.load = LoadState(control_mm, border, np.zeros((len(none), 3)), none > 0, none, none, gap_mm, _PENALTY_MPA_MM, T)
        gel = solver.spec.gel.relaxation
        self._terms = solver.spec.skin.relaxation, gel, gel
        self._past = [History.at_rest(kind, term) for kind, term in zip(body.kinds, self._terms, strict=True)]

    def step(self, T: FloatArray, span_s: float) -> ContactState:
        """The converged state with the object at ``T`` (4, 4), ``span_s`` after the last one. ``NoConvergence`` changes nothing."""
        kinds = self.setting.body.kinds
        now = tuple(p.before(kind, term, span_s) for p, kind, term in zip(self._past, kinds, self._terms, strict=True))
        with self._one_thread():
            self.load, balance, looked = self.stepper.step(self.load, T, now)
            result = contact_state(self.setting, self.load, balance, looked)
        control_mm = self.load.control_mm
        self._past = [p.after(kind, term, span_s, control_mm) for p, kind, term in zip(self._past, kinds, self._terms, strict=True)]
        return result

    def advance(
        self, pose_at: Callable[[float], FloatArray], start: float, stop: float, time_at: Callable[[float], float], where: str
    ) -> Iterator[tuple[float, ContactState]]:
        """Compute one regular load step, or several shorter ones where it does not converge.

        Parameters
        ----------
        pose_at, time_at : callable
            Functions that return the object's pose (4, 4) and the time (s) at a progress from ``start`` to ``stop``.
        where : str
            Name of the load step, for the message of an error.

        Yields
        ------
        progress : float
        state : ContactState

        Raises
        ------
        ContactError
            If the smallest step does not converge.
        """
        done, stride = 0.0, 1.0
        while done < 1:
            stride = min(stride, 1 - done)
            before, at = start + done * (stop - start), start + (done + stride) * (stop - start)
            try:
                result = self.step(pose_at(at), time_at(at) - time_at(before))
            except NoConvergence as failure:
                stride /= 2
                if stride >= _SMALLEST_STRIDE:
                    continue
                raise ContactError(
                    f"no convergence in {where}: relative residual {failure.relative:.1e}, needed {RESIDUAL_TOLERANCE:.0e}; "
                    "try less indentation, shear or friction, a rounder object, or another resolution"
                ) from None
            done += stride
            stride = min(2 * stride, 1.0)
            yield at, result


def contact_state(setting: Setting, state: LoadState, balance: Balance, looked: IntArray) -> ContactState:
    """The public state of a converged load step; ``looked`` (q,) int are the indices of the contact points in ``balance``."""
    contact, points = balance.contact, setting.body.points
    touched = np.flatnonzero(contact.penetration_mm > 0)
    where = looked[touched]
    turn = state.T[:3, :3]
    at = points.positions(state.control_mm)[where]
    normal = contact.normal[touched] @ turn.T
    force = -balance.point_force_n[touched]
    normal_n = contact.normal_n[touched]
    pose = state.T.copy()
    pose[2, 3] += state.border[0]
    return ContactState(
        setting.view.nodes(state.control_mm),
        *pin_pose(setting.solid, state.control_mm),
        force_n=force.sum(axis=0),
        torque_nmm=np.cross(at, force).sum(axis=0),
        area_mm2=touching_mm2(points, state.gap_mm) if len(where) else 0.0,
        contact_mm=at,
        contact_place=points.place[where],
        normal=normal,
        normal_n=normal_n,
        tangential_n=force + normal_n[:, None] * normal,
        point_area_mm2=points.area_mm2[where],
        slipping=contact.slipping[touched],
        T_sensor_object=pose,
        elastic_nmm=state.elastic_nmm,
        dissipated_nmm=state.dissipated_nmm,
        residual=balance.relative,
    )


class SkinSolver:
    """Solver of the contacts of one sensor. Everything that depends on the sensor alone is computed once.

    Parameters
    ----------
    spec : SensorSpec
    resolution : Resolution, optional

    Attributes
    ----------
    mesh : SensorMesh
    shape : SkinShape
        Shape of the undeformed skin.
    relaxes : bool
        Whether skin or gel are viscoelastic.
    setting_of : callable
        Function that gives the ``Setting`` of a ``Focus``.
    """

    def __init__(self, spec: SensorSpec, *, resolution: Resolution | None = None) -> None:
        self.spec, self.resolution = spec, resolution or Resolution()
        self.mesh = build_mesh(spec.geometry)
        self.shape, self.relaxes = shape_of(spec.skin), bool(spec.skin.relaxation or spec.gel.relaxation)
        self._blas = ThreadpoolController()
        self.setting_of = lru_cache(maxsize=_KEPT_SOLIDS)(self._set_up)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as its specification: a copy computes the rest again."""
        return partial(SkinSolver, resolution=self.resolution), (self.spec,)

    def rest(self, *, T_sensor_object: FloatArray | None = None) -> ContactState:
        """The undeformed sensor."""
        with self.one_thread():
            setting = self.setting_of(Focus())
        pins = pin_pose(setting.solid, setting.solid.control_mm)
        return ContactState.undeformed(self.mesh.nodes_mm, *pins, T_sensor_object=T_sensor_object)

    def press(
        self,
        obj: ObjectField | ObjectSpec,
        pose: ContactPose | ContactPath,
        *,
        law: ContactLaw | None = None,
        friction: float | Friction | None = None,
        compliance_mm_per_n: float | None = None,
        progress: Callable[[float, ContactState], object] | None = None,
    ) -> ContactState:
        """The state at the end of a contact; arguments and errors as ``path``."""
        for at, state in self.path(obj, pose, law=law, friction=friction, compliance_mm_per_n=compliance_mm_per_n):
            if progress is not None:
                progress(at, state)
        return state

    def path(
        self,
        obj: ObjectField | ObjectSpec,
        pose: ContactPose | ContactPath,
        *,
        law: ContactLaw | None = None,
        friction: float | Friction | None = None,
        compliance_mm_per_n: float | None = None,
        release: bool = False,
        step_mm: float = _STEP_MM,
    ) -> Iterator[tuple[float, ContactState]]:
        """Every converged state of a contact, in order.

        Parameters
        ----------
        obj : ObjectField or ObjectSpec
        law : ContactLaw, optional
            Default: the object's own friction and compliance (``ContactLaw.of_object``); for an ``ObjectField`` no friction and no
            compliance. For a sensor on an arm, ``twin.rig.contact`` makes the law. ``law.given_way`` receives the contact force of the
            previous load step.
        friction, compliance_mm_per_n : optional
            Values that replace those of the law.
        release : bool
            Whether the object then moves back along the same path.
        step_mm : float
            Largest motion of the object at the pressed skin in one load step.

        Yields
        ------
        fraction : float
            Completed fraction of the path; it rises to 1.
        state : ContactState

        Raises
        ------
        ContactError
            If a pose is out of range, if the object does not reach the skin or starts inside it, or if a load step does not converge; the
            message then states the step and the residual.
        """
        spec, field = (obj, build_field(obj)) if isinstance(obj, ObjectSpec) else (None, obj)
        if law is None:
            law = ContactLaw.of_object(spec) if spec else ContactLaw()
        law = law.override(friction=friction, compliance_mm_per_n=compliance_mm_per_n)
        plan = pose if isinstance(pose, ContactPath) else plan_path(self.spec.geometry, field, pose)
        if release:
            plan = plan.there_and_back()
        if isinstance(pose, ContactPose) and pose.indent_mm <= 0:
            yield 1.0, self.rest(T_sensor_object=plan.at(1.0))
            return
        reached = self._find_reached_points(field, plan)
        contact = self.begin(field, law, plan.at(0.0), focus=self.focus(field, plan))
        stops = _stops(plan, reached, step_mm)
        force_n: FloatArray = np.zeros(3)

        def pose_at(progress: float) -> FloatArray:
            return law.pose(plan.at(progress), force_n)

        for number, (start, stop) in enumerate(pairwise(stops), 1):
            where = f"load step {number} of {len(stops) - 1} ({stop / stops[-1]:.0%} of the path)"
            for at, state in contact.advance(pose_at, start, stop, plan.time_s, where):
                force_n = state.force_n
                if at >= stops[-1]:
                    self._require_met(state)
                yield float(at / stops[-1]), state

    def begin(self, field: ObjectField, law: ContactLaw, T: FloatArray, *, focus: Focus) -> OngoingContact:
        """A new contact. The object is at ``T`` (4, 4), without contact; the grid of the solid is fine at ``focus``."""
        return OngoingContact(self, field, law, T, focus)

    def one_thread(self) -> AbstractContextManager[object]:
        """BLAS on one thread: the matrices are small, and the result must not depend on the number of cores."""
        return self._blas.limit(limits=1, user_api="blas")

    def _set_up(self, focus: Focus) -> Setting:
        spec = self.spec
        solid = build_solid(spec.geometry, resolution=self.resolution, focus=focus)
        points = contact_points(solid, self.shape)
        body = Body(soft_body(solid, spec.skin, spec.gel), points, ~solid.fixed, spec.gel.sealed)
        return Setting(solid, body, NodeView(self.mesh, solid))

    def _find_reached_points(self, field: ObjectField, plan: ContactPath) -> FloatArray:
        """Points (k, 3) of the undeformed skin inside the object at some pose of the path, or else the nearest point.

        Raises ContactError if the path goes too deep or starts inside the skin.
        """
        skin_mm = self.shape.outside(self.shape.even(_FOCUS_POINTS))
        deepest = np.full(len(skin_mm), np.inf)
        limit = deepest_mm(self.spec.geometry)
        for at in _stops(plan, skin_mm, _LOOK_MM):
            T = plan.at(at)
            gap = field.distance((skin_mm - T[:3, 3]) @ T[:3, :3])
            if at == 0 and gap.min() < -_START_INSIDE_MM:
                raise ContactError(f"the object starts {-gap.min():.2f} mm inside the skin; begin the path clear of it")
            if -gap.min() > limit:
                raise ContactError(
                    f"the path goes {-gap.min():.1f} mm into the skin about its pose {at:.2g}, more than {limit:.1f} (half the gel's depth)"
                )
            deepest = np.minimum(deepest, gap)
        pressed = deepest < 0
        return skin_mm[pressed] if pressed.any() else skin_mm[[deepest.argmin()]]

    def _require_met(self, state: ContactState) -> None:
        """Raise a ContactError if an object's origin is inside the skin at rest and none of the skin's contact points has met the object.

        A skin that relaxes may still have a dent where the object was.
        """
        if state.force_n.any() or self.relaxes:
            return
        tip_mm = state.T_sensor_object[None, :3, 3]
        above_mm = self.shape.on_outside(tip_mm)
        inside_mm = float(np.sum((above_mm - tip_mm) * self.shape.normals(above_mm)))
        if inside_mm > _MISSED_MM:
            raise ContactError(
                f"the object is {inside_mm:.1f} mm inside the skin, and no point of the skin's mesh has met it: "
                "it is too small for this mesh; give a larger object"
            )

    def focus(self, field: ObjectField, plan: ContactPath) -> Focus:
        """The fine part of the solid's grid for a path: the region that the object touches first.

        At several poses along the path, the object is moved along the sensor's z to its first touch. There a direction of the dome with a
        gap g gets the weight exp(-g / 0.5 mm) d / d_max, where d is the object's indentation at this pose and d_max the largest one of the
        path. The largest weight over the poses counts. The rows of the grid rotate with the object. Therefore the focus is a continuous
        function of the poses, it rotates with the scene, and it does not depend on the indentation at the end of the path.
        """
        turn = plan.poses[0][:3, :3]
        about_z = float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        places = self.shape.even(_FOCUS_POINTS, turn_rad=about_z)  # the points rotate with the object, too
        skin_mm, directions = self.shape.outside(places), self.shape.directions(places)
        depths, gaps = [], []
        for at in _stops(plan, skin_mm, _LOOK_MM):
            depth, gap = _gaps_at_touch(field, plan.at(at), skin_mm)
            depths.append(depth)
            gaps.append(gap)
        deepest = max(depths)
        share = np.maximum(depths, 0) / deepest if deepest > 0 else np.equal(depths, deepest)
        weights = (share[:, None] * np.exp(-np.array(gaps) / _FOCUS_GAP_MM)).max(axis=0)
        middle = weights @ directions
        middle /= np.linalg.norm(middle)
        spread = np.sqrt(weights @ np.sum((directions - middle) ** 2, axis=1) / weights.sum())
        least = _LEAST_FOCUS_RAD + _COARSE_FOCUS_RAD * max(16 - self.resolution.across, 0)
        radius_rad = float(max(least, min(_LEAST_FOCUS_RAD + _FOCUS_SPREADS * spread, _LARGEST_FOCUS_RAD)))
        polar, azimuth = float(np.arctan2(np.hypot(*middle[:2]), middle[2])), float(np.arctan2(middle[1], middle[0]))
        return Focus(polar, azimuth, radius_rad, _turn(turn, polar, azimuth) + _GRID_TURN_RAD)


def _gaps_at_touch(field: ObjectField, T: FloatArray, points_mm: FloatArray) -> tuple[float, FloatArray]:
    """Largest depth of the points (k, 3) inside the object at ``T``, and their gaps (k,) after it has moved along z to its first touch."""
    T = T.copy()
    first = gap = field.distance((points_mm - T[:3, 3]) @ T[:3, :3])
    for _ in range(_MOST_LIFTS):
        if abs(gap.min()) <= _TOUCH_MM:
            break
        T[2, 3] -= gap.min()
        gap = field.distance((points_mm - T[:3, 3]) @ T[:3, :3])
    return -float(first.min()), gap - gap.min()


def _turn(turn: FloatArray, polar: float, azimuth: float) -> float:
    """Angle of the object's x axis in the chart's disc, at a direction of the dome (``polar``, ``azimuth``, rad).

    The axis is projected along the object's z axis. ``turn`` (3, 3) is the rotation matrix of the object's pose.
    """
    to_rim = np.array([np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), -np.sin(polar)])
    around = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    stretch = polar / np.sin(polar) if polar > 0 else 1.0  # ratio of lengths along the disc's circles to lengths along its radii
    along_x, along_y = (axis @ to_rim + 1j * stretch * (axis @ around) for axis in turn.T[:2])
    return float(np.angle((along_x - 1j * along_y) * np.exp(1j * azimuth)))


def _stops(plan: ContactPath, points_mm: FloatArray, step_mm: float) -> FloatArray:
    """Progress values of the load steps: at each pose, and between poses so often that the object moves by at most ``step_mm`` per step.

    The motion is that of the object at the skin's points (k, 3).
    """
    out = [np.zeros(1)]
    for leg in range(len(plan.poses) - 1):
        start, stop = plan.poses[leg], plan.poses[leg + 1]
        moved = carry_points(points_mm, start, stop)
        count = max(1, int(np.ceil(np.linalg.norm(moved, axis=1).max() / step_mm)))
        out.append(leg + np.arange(1, count + 1) / count)
    return np.concatenate(out)


@dataclass(frozen=True)
class ContactJob:
    """One contact to solve (see ``SkinSolver.path``); ``every_state`` keeps the states of all load steps, not only the last one."""

    obj: ObjectSpec
    pose: ContactPose | ContactPath
    friction: float | Friction | None = None
    every_state: bool = False


@dataclass(frozen=True)
class ContactOutcome:
    """Result of a job.

    Attributes
    ----------
    number : int
        Index of the job.
    states : list of ContactState
        Converged states in the order of the path: all of them with ``every_state``, else the last one; none if the job failed.
    error : str
        Message of the failure, "" if the job succeeded.
    """

    number: int
    states: list[ContactState]
    error: str = ""


def press_many(
    spec: SensorSpec, jobs: Sequence[ContactJob], *, processes: int = 1, resolution: Resolution | None = None
) -> Iterator[ContactOutcome]:
    """Solve contacts and yield their outcomes as they finish; the states do not depend on the number of processes.

    A contact that fails does not stop the others: its outcome contains the message.

    Parameters
    ----------
    spec : SensorSpec
    jobs : sequence of ContactJob
    processes : int
        Number of processes (see ``in_processes``).

    Raises
    ------
    ValueError
        ``processes`` is less than 1.
    WorkersError
        Processes died repeatedly.
    """
    yield from in_processes(_begin, (spec, resolution), list(enumerate(jobs)), processes=processes)


def _begin(spec: SensorSpec, resolution: Resolution | None) -> Callable[[tuple[int, ContactJob]], ContactOutcome]:
    return partial(_solve, SkinSolver(spec, resolution=resolution))


def _solve(solver: SkinSolver, task: tuple[int, ContactJob]) -> ContactOutcome:
    number, job = task
    try:
        states = [state for _, state in solver.path(job.obj, job.pose, friction=job.friction)]
    except (ContactError, MeshError) as error:
        return ContactOutcome(number, [], str(error))
    return ContactOutcome(number, states if job.every_state else states[-1:])
