"""Contacts on a surrogate: many sensors at once, each with its own object and friction memory."""

from functools import lru_cache

import numpy as np

from scenes.sensor import SensorSpec
from training.surrogate.contact import LinearContacts, motion_mm
from training.surrogate.model import Surrogate, by_row, features, outside, rest_of, unlike_parts
from training.surrogate.paths import unlike_drawn
from training.surrogate.reading import ContactReading, EpisodeContact
from twin.geometry.pins import PinRest
from twin.objects import build_field
from twin.objects.analytic import CompiledSolid
from twin.rig.contact import ArmTurning
from twin.types import FloatArray, IntArray

LARGEST_MOVE_MM = 30.0
"""Largest motion between two poses. Beyond it the path between them is unknown, and the contact begins again."""
CLEAR_MM = 0.5
"""Distance between dome and object at which a contact begins."""
_field = lru_cache(maxsize=64)(build_field)


class SurrogateContacts:
    """A ``Backend`` (see ``training.surrogate.reading``) on a surrogate.

    Parameters
    ----------
    surrogate : Surrogate
    sensor : SensorSpec
        A sensor with the surrogate's mechanics. ``felt`` begins with its pins at rest.
    count : int
        Number of sensors.
    friction_history : bool
        False: at every pose the contact begins again.
    """

    def __init__(self, surrogate: Surrogate, sensor: SensorSpec, count: int, *, friction_history: bool = True) -> None:
        self._surrogate, self._sensor, self._memory = surrogate, sensor, friction_history
        self._rest = rest_of(sensor)
        self._cap_mm = sensor.pins.length_mm + sensor.pins.cap_height_mm / 2
        modes = surrogate.modes
        flat = len(modes), -1
        x, y, z = surrogate.node_mm.T
        turns = np.zeros((len(x), 3, 6))  # of a force at each node: the force and the torque on the object
        turns[:, range(3), range(3)] = -1.0
        turns[:, 0, 4:], turns[:, 1, 3], turns[:, 1, 5] = np.stack([-z, y], axis=1), z, -x
        turns[:, 2, 3:5] = np.stack([-y, x], axis=1)
        self._turns = turns.reshape(-1, 6)
        self._cap_modes = np.ascontiguousarray((modes[:, :, 0] + self._cap_mm * modes[:, :, 1]).reshape(flat), np.float32)
        self._caps_rest = self._rest[:, 0] + self._cap_mm * self._rest[:, 1]
        self._linear = LinearContacts(surrogate.node_mm, surrogate.answer, count, bending=surrogate.bending.kernel(surrogate.read))
        self._before = np.tile(np.eye(4), (count, 1, 1))  # the poses commanded last
        self._known = np.zeros(count, bool)
        self._gap = np.full((count, len(surrogate.node_mm)), np.inf)
        self._parts = np.zeros((count, len(modes)), np.float32)
        self._domain = surrogate.domain
        self.felt = ContactReading.at_rest(count, self._caps_rest)

    def require(self, contact: EpisodeContact) -> None:
        """See ``Backend``: it takes objects of the sampled family, with one coefficient of friction."""
        touched, friction = contact.obj, contact.law.friction
        unlike = unlike_drawn(touched)
        if unlike:
            raise outside(unlike)
        if friction.kinetic != friction.static or np.isfinite(friction.shear_strength_mpa):
            raise outside(f"{touched.name} has a kinetic friction of its own or a shear strength")
        if not (contact.law.given_way is None or isinstance(contact.law.given_way, ArmTurning)):
            raise outside(f"the arm has another compliance for {touched.name}")
        if friction.static > self._domain["friction"]:
            raise outside(f"a friction of {friction.static:g}, at most {self._domain['friction']:g} was trained")
        if contact.sensor is not self._sensor and unlike_parts(self._surrogate.about["mechanics"], contact.sensor):
            raise outside(
                "the skin, gel, lens or pins of the sensor are sampled again; randomise only friction, camera and noise ('moves')"
            )

    def begin(self, row: int, contact: EpisodeContact) -> None:
        """See ``Backend``."""
        self.require(contact)
        law, thing = contact.law, _field(contact.obj)
        assert isinstance(thing, CompiledSolid)  # required
        assert law.given_way is None or isinstance(law.given_way, ArmTurning)
        self.begin_solid(row, thing, law.friction.static, compliance_mm_per_n=law.compliance_mm_per_n, turning=law.given_way)

    def begin_solid(
        self, row: int, thing: CompiledSolid, friction: float, *, compliance_mm_per_n: float = 0.0, turning: ArmTurning | None = None
    ) -> None:
        """As ``begin``, for a solid that is not checked against the domain."""
        self._linear.begin(row, thing, friction, compliance_mm_per_n=compliance_mm_per_n, turning=turning)
        self.rest(row)

    def rest(self, row: int) -> None:
        """End a sensor's contact."""
        self._linear.free(row)
        self._known[row] = False
        self._gap[row] = np.inf
        self._parts[row] = 0.0
        self.felt.rest(row, self._caps_rest)

    def move(self, rows: IntArray, T_sensor_object: FloatArray, time_s: FloatArray) -> None:
        """See ``Backend``."""
        gap, centre = self._linear.distances(rows, T_sensor_object)
        depth = self._linear.radius_mm - centre[:, 0]
        polar = np.degrees(np.arccos(np.clip(centre[:, 1], -1.0, 1.0)))
        inside = (depth <= 0) | ((depth <= self._domain["depth_mm"]) & (polar <= self._domain["polar_deg"]))
        for place, row in enumerate(rows.tolist()):
            self.felt.lost[row] = "" if inside[place] else self._outside(depth[place], polar[place])
        if not inside.all():
            self._clear_history(rows[~inside])
            rows, T_sensor_object, gap = rows[inside], T_sensor_object[inside], gap[inside]
        rows = self._bring(rows, T_sensor_object, gap)
        if len(rows):
            self._answer(rows)

    def attitude(self, row: int) -> PinRest:
        """See ``Backend``."""
        moved = np.tensordot(self._parts[row], self._surrogate.modes, axes=1)
        axis = self._rest[:, 1] + moved[:, 1]
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        return PinRest(self._rest[:, 0] + moved[:, 0], axis, self.felt.caps_mm[row].copy())

    @property
    def caps_at_rest_mm(self) -> FloatArray:
        """Centres (N, 3) of the pins' caps at rest."""
        return self._caps_rest

    @property
    def domain(self) -> dict[str, float]:
        """As of ``Surrogate``."""
        return self._domain

    @property
    def radius_mm(self) -> float:
        """Radius of the dome."""
        return self._linear.radius_mm

    @property
    def depth_mm(self) -> FloatArray:
        """Depths (B,) of the objects inside the undeformed domes."""
        return np.maximum(-self._gap.min(axis=1), 0.0)

    def _clear_history(self, rows: IntArray) -> None:
        self._linear.free(rows)
        self._known[rows] = False

    def _bring(self, rows: IntArray, T: FloatArray, gap: FloatArray) -> IntArray:
        """Solve the motions of some rows (R,) to commanded poses (R, 4, 4), at which the nodes at rest have distances (R, M).

        Returns the rows that were not there before.
        """
        linear = self._linear
        deepest = gap.argmin(axis=1)
        depth = -gap[np.arange(len(rows)), deepest]
        clear = (depth <= 0) & ~linear.held[rows].any(axis=1)
        if not self._memory:
            self._known[rows] = False
        new = ~(self._known[rows] & (self._before[rows] == T).all(axis=(1, 2)))
        changed = rows[new]
        if clear.any():
            away = rows[clear]
            linear.free(away)
            self._before[away] = T[clear]
            self._known[away], self._gap[away] = True, np.inf
        moves = new & ~clear
        if not moves.any():
            return changed
        if not moves.all():
            rows, T, depth, deepest = rows[moves], T[moves], depth[moves], deepest[moves]
        way = motion_mm(self._before[rows], T, linear.radius_mm)
        new = ~self._known[rows] | (way >= LARGEST_MOVE_MM)
        if new.any():
            linear.free(rows[new])
            before = T[new]
            slope = np.maximum(linear.node_mm[deepest[new], 2] / linear.radius_mm, 0.5)
            before[:, 2, 3] += np.maximum(depth[new], 0.0) / slope + CLEAR_MM
            self._before[rows[new]] = before
        linear.move(rows, self._before[rows], T)
        self._before[rows], self._known[rows] = T, True
        there = linear.taken[rows]
        there[:, 2, 3] += linear.compliance_mm_per_n[rows] * self._force(rows)[:, 2]
        self._gap[rows] = linear.distances(rows, there)[0]
        return changed

    def _force(self, rows: IntArray) -> FloatArray:
        """Forces (R, 3) of the nodes on the objects."""
        return -self._linear.force_n[rows].sum(axis=1)

    def _outside(self, depth_mm: float, polar_deg: float) -> str:
        """The reason why a contact is too deep or too far from the apex."""
        depth, polar = self._domain["depth_mm"], self._domain["polar_deg"]
        if depth_mm > depth:
            return str(outside(f"the object is {depth_mm:.1f} mm inside the dome, at most {depth:.1f} is taken"))
        return str(outside(f"the contact is {polar_deg:.0f} deg from the dome's apex, at most {polar:.0f} was trained"))

    def _answer(self, rows: IntArray) -> None:
        """Write to ``felt`` what the sensors feel, from the linear skin and the network."""
        felt, linear, surrogate = self.felt, self._linear, self._surrogate
        force = linear.force_n[rows]
        wrench = by_row(force.reshape(len(rows), -1), self._turns)
        held, slides = linear.held[rows].sum(axis=1), linear.slides[rows].sum(axis=1)
        slip = slides / np.maximum(held, 1)
        gap = self._gap[rows]
        depth = np.maximum(-gap.min(axis=1), 0.0)
        beside = features(depth, linear.friction[rows], held, slip, linear.used[rows], wrench)
        parts, added = surrogate.correct(force, beside, gap, depth)
        self._parts[rows] = parts
        felt.caps_mm[rows] = self._caps_rest + by_row(parts, self._cap_modes).reshape(len(rows), -1, 3)
        felt.force_n[rows] = wrench[:, :3] + added[:, :3]
        felt.torque_nmm[rows] = wrench[:, 3:] + added[:, 3:6]
        felt.area_mm2[rows] = np.maximum(added[:, 6], 0.0) * 100.0
        felt.slip[rows] = np.clip(slip + added[:, 7], 0.0, 1.0)
