"""The sensor's state while an object is moved about it, pose by pose, as it comes: with a memory, and without an end."""

import numpy as np

from scenes.object import ObjectSpec
from twin.errors import ContactError
from twin.geometry.chart import Focus
from twin.mechanics.ongoing import OngoingContact
from twin.mechanics.path import ContactPath, carried, deepest_mm, dome_directions
from twin.mechanics.solver import SkinSolver, friction_of
from twin.stimulus import build_field
from twin.types import ContactState

STEP_MM = 1.2  # largest motion across the contact in one load step
FINE_STEP_MM = 0.6  # beside features as fine as wires: a longer one carries skin past a wire's middle, where it then hooks
LARGEST_MOVE_MM = 30.0  # from one pose to the next in contact: farther, the way between them isn't known
_DIRECTIONS = 2000  # on the sphere, to see where the object presses
_KNOWN_RAD = np.radians(7.0)  # a pressed direction is provided for if one this near was
_BACK_MM = 1.0  # stride when a free pose is looked for


class Follower:
    """Follows one object with one sensor.

    Where the object comes to press the skin a contact begins; it goes on, with all that friction remembers, until the
    object has left the undeformed dome. A contact that can't be carried on is begun anew from the object's retreat along
    the sensor's axis (``restarts`` counts these).

    Parameters
    ----------
    solver : SkinSolver
    stimulus : ObjectSpec
    step_mm : float, optional
        Largest motion across the contact in one load step; by default what the object's features allow.
    """

    def __init__(self, solver: SkinSolver, stimulus: ObjectSpec, *, step_mm: float | None = None):
        self._solver, self._step_mm = solver, step_mm or _step_of(stimulus)
        self._field = build_field(stimulus)
        rig = solver.spec.rig
        self._law, self._compliance = friction_of(stimulus), stimulus.compliance_mm_per_n + (rig.compliance_mm_per_n if rig else 0.0)
        self._radius_mm = solver.spec.skin.outer_radius_mm
        self._dome_mm = self._radius_mm * dome_directions(solver.spec.skin, _DIRECTIONS)
        self._rest = solver.rest()
        self._contact: OngoingContact | None = None
        self._reached = np.zeros((0, 3))
        self._T: np.ndarray | None = None
        self._time_s = 0.0
        self._state = self._rest
        self.restarts = 0

    def move(self, T: np.ndarray, time_s: float) -> ContactState:
        """The sensor's state once the object has come to ``T_sensor_object`` (4, 4) at a time (s).

        Raises
        ------
        ContactError
            Too deep, or no convergence even when begun anew; the follower has then let go of the contact.
        """
        gap = self.gap_mm(T)
        if gap > 0:
            self._contact, self._state = None, self._free(T)
        elif self._T is None or not np.array_equal(T, self._T) or self._relaxes:
            try:
                self._press(T, time_s)
            except ContactError:
                self._contact = self._T = None  # wherever the skin stands now, no pose belongs to it
                raise
        self._T, self._time_s = T.copy(), time_s
        return self._state

    def warm_up(self) -> None:
        """Press once, shallowly, and forget it: compiled code is loaded, so that a first contact takes no longer than others."""
        T = np.eye(4)
        for depth_mm in (-_BACK_MM, _BACK_MM / 2):
            T[2, 3] = self._radius_mm - depth_mm
            self.move(T, self._time_s)
        self._contact = self._T = None

    def gap_mm(self, T: np.ndarray) -> float:
        """Smallest distance of the object at ``T`` to the undeformed dome, negative inside."""
        return float(self._gaps(T).min())

    @property
    def _relaxes(self) -> bool:
        return bool(self._solver.spec.skin.relaxation or self._solver.spec.gel.relaxation)

    def _gaps(self, T: np.ndarray) -> np.ndarray:
        return self._field.distance((self._dome_mm - T[:3, 3]) @ T[:3, :3])

    def _free(self, T: np.ndarray) -> ContactState:
        rest = self._rest
        return ContactState.untouched(rest.nodes_mm, rest.base_mm, rest.axis, rest.caps_mm, T_sensor_object=T)

    def _press(self, T: np.ndarray, time_s: float) -> None:
        limit = deepest_mm(self._solver.spec.geometry)
        if (deep := -self.gap_mm(T)) > limit:
            raise ContactError(f"the object is {deep:.1f} mm inside the dome, more than {limit:.1f} (half the gel's depth); move away")
        near = self._T is not None and np.linalg.norm(carried(self._dome_mm, self._T, T), axis=1).max() < LARGEST_MOVE_MM
        if near and (self._contact is not None or self.gap_mm(self._T) > 0):
            try:
                self._go(self._T, T, self._time_s, time_s)
                return
            except ContactError:
                self.restarts += 1
        self._contact = None
        self._go(self._retreat(T), T, time_s - 1.0, time_s)

    def _retreat(self, T: np.ndarray) -> np.ndarray:
        """The object moved away along the sensor's axis until it is free."""
        free = T.copy()
        for _ in range(int(4 * self._radius_mm / _BACK_MM)):
            free[2, 3] += _BACK_MM
            if self.gap_mm(free) > 0:
                return free
        raise ContactError("the object reaches around the dome: no way out along the sensor's axis; move away sideways")

    def _go(self, start: np.ndarray, stop: np.ndarray, start_s: float, stop_s: float) -> None:
        way = ContactPath(np.stack([start, stop]), np.array([start_s, max(stop_s, start_s + 1e-3)]))
        pressed = self._gaps(stop) < 0
        if self._contact is None:
            self._reached = self._dome_mm[pressed] / self._radius_mm
            self._contact = self._solver.begin(self._field, self._law, self._compliance, self._reached, start, focus=Focus())
        elif not self._provided(self._dome_mm[pressed]):
            self._reached = self._dome_mm[pressed] / self._radius_mm
            self._solver.reach(self._contact, self._field, self._law, self._compliance, self._reached)
        moved = np.linalg.norm(carried(self._dome_mm[pressed], start, stop), axis=1).max()
        count = max(1, int(np.ceil(moved / self._step_mm)))
        stops = np.linspace(0, 1, count + 1)
        for before, after in zip(stops[:-1], stops[1:], strict=True):
            for _, state in self._contact.advance(way.at, before, after, way.time_s, "following the object"):
                self._state = state

    def _provided(self, pressed_mm: np.ndarray) -> bool:
        return bool((((pressed_mm / self._radius_mm) @ self._reached.T).max(axis=1) > np.cos(_KNOWN_RAD)).all())


def _step_of(stimulus: ObjectSpec) -> float:
    if stimulus.texture is not None:
        return FINE_STEP_MM * min(1.0, stimulus.texture.wire_diameter_mm)
    return FINE_STEP_MM if stimulus.shape.kind == "mesh" else STEP_MM
