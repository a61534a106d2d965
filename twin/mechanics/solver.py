"""From a sensor, an object and a path to converged contact states."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import lru_cache
from itertools import pairwise

import numpy as np
from threadpoolctl import ThreadpoolController

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import ContactError
from twin.geometry.chart import Focus
from twin.geometry.mesh import NodeView, build_mesh
from twin.geometry.solid import Resolution, build_solid, pin_pose
from twin.mechanics.balance import Body, Friction
from twin.mechanics.contact import contact_points
from twin.mechanics.elements import Elements
from twin.mechanics.law import ContactLaw
from twin.mechanics.linear import FrontalSolver
from twin.mechanics.material import law_coefficients
from twin.mechanics.newton import LoadStepper
from twin.mechanics.ongoing import OngoingContact, Setting
from twin.mechanics.path import ContactPath, ContactPose, carried, deepest_mm, dome_directions, plan_path
from twin.objects import ObjectField, build_field
from twin.types import ContactState, FloatArray

_STEP_MM = 0.4
"""Largest motion of the object, seen from any pressed place of the dome, in one load step."""
_LOOK_MM = 2.0
"""Largest motion between two poses of the path at which the solver looks where the object will press."""
_FOCUS_POINTS = 2000
"""Directions on the whole sphere in which the solver looks where the object will press."""
_FOCUS_POLAR_DEG = 5.0
"""The focus's polar angle is rounded to multiples of this, so that similar contacts share a solid."""
_FOCUS_AZIMUTH_DEG = 15.0
"""The focus's azimuth is rounded to multiples of this."""
_MARGIN_RAD = np.radians(15.0)
"""Skin within this angle of a direction that the rigid object would pass through may come to touch it."""
_START_INSIDE_MM = 0.05
"""A path may begin with the object this deep inside the undeformed dome: rounding of a first touch."""


class SkinSolver:
    """Presses one sensor; what depends on the sensor alone is computed once.

    Parameters
    ----------
    spec : SensorSpec
    resolution : Resolution, optional
    keep : bool
        Whether what depends on the geometry is kept on disk; not for geometries that are used once.
    """

    def __init__(self, spec: SensorSpec, *, resolution: Resolution | None = None, keep: bool = True) -> None:
        self.spec, self.resolution, self._keep = spec, resolution or Resolution(), keep
        self.mesh = build_mesh(spec.geometry)
        self._blas = ThreadpoolController()
        self._setting = lru_cache(maxsize=32)(self._set_up)

    def rest(self, *, T_sensor_object: FloatArray | None = None) -> ContactState:
        """The undeformed sensor."""
        with self._one_thread():
            setting = self._setting(Focus())
        base, axis, caps = pin_pose(setting.solid, setting.solid.control_mm)
        return ContactState.untouched(self.mesh.nodes_mm, base, axis, caps, T_sensor_object=T_sensor_object)

    def press(
        self,
        touched: ObjectField | ObjectSpec,
        pose: ContactPose | ContactPath,
        *,
        law: ContactLaw | None = None,
        friction: float | Friction | None = None,
        compliance_mm_per_n: float | None = None,
        progress: Callable[[float, ContactState], object] | None = None,
    ) -> ContactState:
        """The state at the end of a contact; arguments and errors as ``path``."""
        for at, state in self.path(touched, pose, law=law, friction=friction, compliance_mm_per_n=compliance_mm_per_n):
            if progress is not None:
                progress(at, state)
        return state

    def path(
        self,
        touched: ObjectField | ObjectSpec,
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
        touched : ObjectField or ObjectSpec
        law : ContactLaw, optional
            By default the object's own friction and compliance (``ContactLaw.of_object``), and none of a bare ``ObjectField``. For a
            contact that an arm makes it comes from ``twin.rig.contact``. ``law.given_way`` gets the force of the load step before.
        friction, compliance_mm_per_n : optional
            Override the law's.
        release : bool
            Afterwards lift the object off again, the way it came.
        step_mm : float
            Largest motion across the contact in one load step.

        Yields
        ------
        fraction : float
            Of the path done, rising to 1.
        state : ContactState

        Raises
        ------
        ContactError
            Pose out of range, object out of reach or starting inside the skin, or no convergence: names the
            step and the residual.
        """
        spec, field = (touched, build_field(touched)) if isinstance(touched, ObjectSpec) else (None, touched)
        if law is None:
            law = ContactLaw.of_object(spec) if spec else ContactLaw()
        law = law.override(friction=friction, compliance_mm_per_n=compliance_mm_per_n)
        plan = pose if isinstance(pose, ContactPath) else plan_path(self.spec.geometry, field, pose)
        if release:
            plan = plan.there_and_back()
        if isinstance(pose, ContactPose) and pose.indent_mm <= 0:
            yield 1.0, self.rest(T_sensor_object=plan.at(1.0))
            return
        reached = self._reached(field, plan)
        contact = self.begin(field, law, reached, plan.at(0.0), focus=_focus(reached))
        stops = _stops(plan, reached, self.spec.skin.outer_radius_mm, step_mm)
        force_n: FloatArray = np.zeros(3)

        def pose_at(progress: float) -> FloatArray:
            return law.pose(plan.at(progress), force_n)

        for number, (start, stop) in enumerate(pairwise(stops), 1):
            where = f"load step {number} of {len(stops) - 1} ({stop / stops[-1]:.0%} of the path)"
            for at, state in contact.advance(pose_at, start, stop, plan.time_s, where):
                force_n = state.force_n
                yield float(at / stops[-1]), state

    def begin(self, field: ObjectField, law: ContactLaw, reached: FloatArray, T: FloatArray, *, focus: Focus) -> OngoingContact:
        """A contact at its start, the object at ``T`` and free of the skin.

        Parameters
        ----------
        reached : (k, 3) float
            Directions of the dome that the object may come to press, and ``focus``: where the solid is fine.
        """
        with self._one_thread():
            setting = self._setting(focus)
        contact = OngoingContact(setting, T, self._one_thread)
        self.reach(contact, field, law, reached)
        return contact

    def reach(self, contact: OngoingContact, field: ObjectField, law: ContactLaw, reached: FloatArray) -> None:
        """Prepare the contact for an object that comes to press other directions (k, 3) of the dome than before."""
        with self._one_thread():
            frontal = self._frontal(contact.setting, reached)
            contact.stepper = LoadStepper(contact.setting.body, frontal, field, law.friction, law.compliance_mm_per_n)

    def _one_thread(self) -> AbstractContextManager[object]:
        """BLAS on one thread: the matrices are small, and the result must not depend on the number of cores."""
        return self._blas.limit(limits=1, user_api="blas")

    def _set_up(self, focus: Focus) -> Setting:
        spec = self.spec
        solid = build_solid(spec.geometry, resolution=self.resolution, focus=focus, keep=self._keep)
        gel = law_coefficients(spec.gel, layer=False)
        kinds = (
            Elements(solid.skin, law_coefficients(spec.skin, layer=True), layer=True),
            Elements(solid.gel_top, gel),
            Elements(solid.gel_deep, gel),
        )
        points = contact_points(solid, spec.skin.outer_radius_mm)
        body = Body(kinds, points, ~solid.fixed, spec.gel.sealed)
        relaxation = spec.skin.relaxation, spec.gel.relaxation, spec.gel.relaxation
        return Setting(solid, body, NodeView.of(self.mesh, solid), relaxation)

    def _frontal(self, setting: Setting, reached: FloatArray) -> FrontalSolver:
        """Elimination of all but the outer controls that may be touched: those that carry points around the reached directions."""
        solid, points = setting.solid, setting.body.points
        directions = points.positions(solid.control_mm) / self.spec.skin.outer_radius_mm
        near = (directions @ reached.T).max(axis=1) > np.cos(_MARGIN_RAD)
        keep = np.zeros(len(solid.fixed), bool)
        keep[points.controls[near]] = True
        groups = [kind.cells.controls for kind in setting.body.kinds]
        return FrontalSolver(groups, list(solid.boxes), solid.fixed, keep & ~solid.fixed)

    def _reached(self, field: ObjectField, plan: ContactPath) -> FloatArray:
        """Directions (k, 3) of the dome that the object would pass through on its path; ContactError if the path makes no sense."""
        radius = self.spec.skin.outer_radius_mm
        directions = dome_directions(self.spec.skin, _FOCUS_POINTS)
        deepest = np.full(len(directions), np.inf)
        limit = deepest_mm(self.spec.geometry)
        for at in _stops(plan, directions, radius, _LOOK_MM):
            T = plan.at(at)
            gap = field.distance((radius * directions - T[:3, 3]) @ T[:3, :3])
            if at == 0 and gap.min() < -_START_INSIDE_MM:
                raise ContactError(f"the object starts {-gap.min():.2f} mm inside the skin; begin the path clear of it")
            if -gap.min() > limit:
                raise ContactError(
                    f"the path goes {-gap.min():.1f} mm into the dome about its pose {at:.2g}, more than {limit:.1f} (half the gel's depth)"
                )
            deepest = np.minimum(deepest, gap)
        pressed = deepest < 0
        return directions[pressed] if pressed.any() else directions[[deepest.argmin()]]


def _focus(reached: FloatArray) -> Focus:
    """Where the object presses, rounded, so that similar contacts share a solid."""
    middle = reached.mean(axis=0)
    polar = np.degrees(np.arctan2(np.hypot(middle[0], middle[1]), middle[2]))
    polar = _FOCUS_POLAR_DEG * np.round(polar / _FOCUS_POLAR_DEG)
    azimuth = _FOCUS_AZIMUTH_DEG * np.round(np.degrees(np.arctan2(middle[1], middle[0])) / _FOCUS_AZIMUTH_DEG) if polar else 0.0
    return Focus(float(np.radians(polar)), float(np.radians(azimuth)))


def _stops(plan: ContactPath, directions: FloatArray, radius_mm: float, step_mm: float) -> FloatArray:
    """Progress at regular load steps: the poses, and between them no point of the dome in these directions sees the object move farther."""
    out = [np.zeros(1)]
    for leg in range(len(plan.poses) - 1):
        start, stop = plan.poses[leg], plan.poses[leg + 1]
        moved = carried(radius_mm * directions, start, stop)
        count = max(1, int(np.ceil(np.linalg.norm(moved, axis=1).max() / step_mm)))
        out.append(leg + np.arange(1, count + 1) / count)
    return np.concatenate(out)
