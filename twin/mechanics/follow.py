"""Simulation of a sensor that follows an object: one contact state for each new pose, continued from the state before."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from scenes.object import ObjectSpec
from twin.errors import ContactError
from twin.mechanics.law import ContactLaw
from twin.mechanics.path import ContactPath, carry_points, deepest_mm
from twin.mechanics.solver import OngoingContact, SkinSolver
from twin.objects import build_field
from twin.types import ContactState

STEP_MM = 0.45  # largest motion of the object at the pressed skin in one load step; longer steps often do not converge and are then halved
LARGEST_MOVE_MM = 30.0  # largest motion between two poses of one contact; the path between poses farther apart is unknown
SETTLED_MM = 0.005  # threshold for the motion of the object under the arm's compliance; it is 0.02 px in the shipped cameras
_MOST_SETTLING = 8  # largest number of load steps until the pose of a compliant arm converges; one or two are usual
_PLACES = 2000  # number of points on a whole sphere; the distance of the object is computed at the points on the skin
_BACK_MM = 1.0  # step of the search for a pose without contact
_WHERE = "following the object"  # name of the load step in error messages


class Follower:
    """Follows one object with one sensor.

    A contact begins when the object enters the undeformed skin, and ends when the object has left it. In between, the contact continues
    with the history of friction. If a load step does not converge, the contact starts again: the object moves from a pose without contact
    straight along the sensor's axis to the new pose (``restarts`` counts these cases).

    All poses are commanded poses. If the law contains the compliance of an arm (``given_way``), each move ends at the pose at which the
    contact force and the displacement of the arm are in balance.

    Parameters
    ----------
    solver : SkinSolver
    touched : ObjectSpec
    law : ContactLaw
        Friction and compliance. For a sensor on an arm, ``twin.rig.contact.contact_law`` makes it.
    """

    def __init__(self, solver: SkinSolver, obj: ObjectSpec, law: ContactLaw) -> None:
        self._solver, self._law, self._field = solver, law, build_field(obj)
        # with wires, a longer step would move skin past the middle of a wire, where it would catch
        self._step_mm = STEP_MM if obj.texture is None else STEP_MM * min(1.0, obj.texture.wire_diameter_mm)
        self._skin_mm = solver.shape.outside(solver.shape.even(_PLACES))
        self._rest = solver.rest()
        self._contact: OngoingContact | None = None
        self._T: np.ndarray | None = None
        self._time_s = 0.0
        self._state = self._rest
        self.restarts = 0

    def move(self, T: np.ndarray, time_s: float) -> ContactState:
        """The sensor's state after the object has moved to ``T_sensor_object`` (4, 4) at a time (s).

        Raises
        ------
        ContactError
            The object is too deep, or the contact does not converge even from a new start. The follower then has no contact any more.
        """
        gap = self.gap_mm(T)
        if gap >= 0:
            self._contact, self._state = None, replace(self._rest, T_sensor_object=T)
        elif self._T is None or not np.array_equal(T, self._T) or self._solver.relaxes:
            try:
                self._press(T, time_s)
            except ContactError:
                self._contact = self._T = None  # the skin's state belongs to no pose
                raise
        self._T, self._time_s = T.copy(), time_s
        return self._state

    def warm_up(self) -> None:
        """Make one shallow contact and discard it. This loads the compiled code, so that the first real contact is as fast as others."""
        T = np.eye(4)
        for depth_mm in (-_BACK_MM, _BACK_MM / 2):
            T[2, 3] = self._solver.spec.skin.apex_mm - depth_mm
            self.move(T, self._time_s)
        self._contact = self._T = None

    def gap_mm(self, T: np.ndarray) -> float:
        """Smallest distance of the object at ``T`` to the undeformed skin, negative inside."""
        return self.nearest(T)[0]

    def nearest(self, T: np.ndarray) -> tuple[float, np.ndarray]:
        """Smallest distance of the object at ``T`` to the undeformed skin (negative inside), and the nearest point (3,) of the skin."""
        gaps = self._gaps(T)
        place = int(gaps.argmin())
        return float(gaps[place]), self._skin_mm[place]

    def pressed_mm(self, T: np.ndarray) -> np.ndarray:
        """Points (k, 3) of the undeformed skin that lie inside the object at ``T``."""
        return self._skin_mm[self._gaps(T) < 0]

    def _gaps(self, T: np.ndarray) -> np.ndarray:
        return self._field.distance((self._skin_mm - T[:3, 3]) @ T[:3, :3])

    def _press(self, T: np.ndarray, time_s: float) -> None:
        limit = deepest_mm(self._solver.spec.geometry)
        if (deep := -self.gap_mm(T)) > limit:
            raise ContactError(f"the object is {deep:.1f} mm inside the skin, more than {limit:.1f} (half the gel's depth); move away")
        last = self._T
        near = last is not None and np.linalg.norm(carry_points(self._skin_mm, last, T), axis=1).max() < LARGEST_MOVE_MM
        if last is not None and near and (self._contact is not None or self.gap_mm(last) >= 0):
            try:
                self._go(last, T, self._time_s, time_s)
                return
            except ContactError:
                self.restarts += 1
        self._contact, self._state = None, self._rest
        self._go(self._retreat(T), T, time_s - 1.0, time_s)

    def _retreat(self, T: np.ndarray) -> np.ndarray:
        """Pose (4, 4) of the object after it has moved from ``T`` along the sensor's axis until there is no contact."""
        free = T.copy()
        for _ in range(int(4 * max(self._solver.spec.skin.half_size_mm) / _BACK_MM)):
            free[2, 3] += _BACK_MM
            if self.gap_mm(free) > 0:
                return free
        raise ContactError("the object reaches around the skin: no way out along the sensor's axis; move away sideways")

    def _go(self, start: np.ndarray, stop: np.ndarray, start_s: float, stop_s: float) -> None:
        way = ContactPath(np.stack([start, stop]), np.array([start_s, max(stop_s, start_s + 1e-3)]))
        pressed = self._gaps(stop) < 0
        if self._contact is None:
            self._contact = self._solver.begin(self._field, self._law, start, focus=self._solver.focus(self._field, way))
        moved = np.linalg.norm(carry_points(self._skin_mm[pressed], start, stop), axis=1).max()
        count = max(1, int(np.ceil(moved / self._step_mm)))

        def pose_at(progress: float) -> np.ndarray:
            return self._law.pose(way.at(progress), self._state.force_n)

        for before, after in pairwise(np.linspace(0, 1, count + 1)):
            for _, state in self._contact.advance(pose_at, before, after, way.time_s, _WHERE):
                self._state = state
        self._settle(self._contact, stop)

    def _settle(self, contact: OngoingContact, T: np.ndarray) -> None:
        """Move the object to the pose under the last contact force, until this pose converges; ``T`` (4, 4) is the commanded pose."""
        for _ in range(_MOST_SETTLING):
            there = self._law.pose(T, self._state.force_n)
            if np.linalg.norm(carry_points(self._skin_mm, contact.load.T, there), axis=1).max() <= SETTLED_MM:
                return
            way = ContactPath(np.stack([contact.load.T, there]))
            for _, state in contact.advance(way.at, 0.0, 1.0, lambda progress: 0.0, _WHERE):
                self._state = state
        raise ContactError("the arm gives way without an end under the contact's force; use less turn_compliance_deg_per_n or indentation")
