"""The surrogate's contacts: many sensors at once, each with its object and all that friction remembers."""

from functools import lru_cache
from math import acos, atan2, ceil, sqrt

import numpy as np

from scenes.sensor import SensorSpec
from training.surrogate.contact import LinearContacts
from training.surrogate.felt import Contact, Felt
from training.surrogate.model import Surrogate, features, mechanics_of, outside, rest_of
from training.surrogate.paths import unlike_drawn
from twin.errors import ContactError
from twin.geometry.pins import PinRest
from twin.objects import ObjectField, build_field
from twin.types import FloatArray, IntArray

STEP_MM = 1.2
"""Largest motion across the dome in one solution, as of the finite elements' ``Follower``."""
LARGEST_MOVE_MM = 30.0
"""Largest motion between two poses; beyond it the way between them is unknown, and the contact begins anew."""
CLEAR_MM = 0.5
"""A contact begins this far in front of the object."""
NO_TURN = 1e-9
"""Sine of an angle that is none."""
SETTLED_MM = 0.02
"""Most that the dome still has to move where an arm has given way."""
MOST_SETTLING = 3
"""Solutions until an arm that gives way stands."""


class SurrogateContacts:
    """A ``Backend`` (see ``training.surrogate.felt``) on a surrogate.

    Parameters
    ----------
    surrogate : Surrogate
    sensor : SensorSpec
        Of the same mechanics; its pins at rest are those of ``felt``.
    count : int
    friction_memory : bool
        False: at every pose the contact begins anew.
    """

    def __init__(self, surrogate: Surrogate, sensor: SensorSpec, count: int, *, friction_memory: bool = True) -> None:
        self._surrogate, self._sensor, self._memory = surrogate, sensor, friction_memory
        self._rest = rest_of(sensor)
        self._cap_mm = sensor.pins.length_mm + sensor.pins.cap_height_mm / 2
        modes = surrogate.modes
        flat = len(modes), -1
        self._cap_modes = np.ascontiguousarray((modes[:, :, 0] + self._cap_mm * modes[:, :, 1]).reshape(flat), np.float32)
        self._caps_rest = self._rest[:, 0] + self._cap_mm * self._rest[:, 1]
        self._linear = LinearContacts.at_rest(surrogate.node_mm, surrogate.answer, count)
        self._contacts: list[Contact | None] = [None] * count
        self._fields: list[ObjectField | None] = [None] * count
        self._field = lru_cache(maxsize=64)(build_field)
        self._before: list[FloatArray | None] = [None] * count
        self._depth, self._friction, self._compliance = np.zeros((3, count))
        self._parts = np.zeros((count, len(modes)), np.float32)
        self._radius = float(np.linalg.norm(surrogate.node_mm[0]))
        self._domain = surrogate.domain
        self.felt = Felt.at_rest(count, self._caps_rest)

    def require(self, contact: Contact) -> None:
        """See ``Backend``: objects of the drawn family, with one coefficient of friction."""
        touched, friction = contact.touched, contact.law.friction
        unlike = unlike_drawn(touched)
        if unlike:
            raise outside(unlike)
        if friction.kinetic != friction.static or np.isfinite(friction.shear_strength_mpa):
            raise outside(f"{touched.name} has a kinetic friction of its own or a shear strength")
        if friction.static > self._domain["friction"]:
            low, high = self._surrogate.about["trained_friction"]
            raise outside(
                f"a friction of {friction.static:g}, at most {self._domain['friction']:g} is taken ({low:g} to {high:g} was trained)"
            )
        if contact.sensor is not self._sensor and mechanics_of(contact.sensor) != self._surrogate.about["mechanics"]:
            raise outside("the skin, gel, lens or pins of the sensor are drawn anew; randomise friction, camera and noise only ('moves')")

    def begin(self, row: int, contact: Contact) -> None:
        """See ``Backend``."""
        self.require(contact)
        self._contacts[row], self._fields[row] = contact, self._field(contact.touched)
        self._friction[row] = contact.law.friction.static
        self._compliance[row] = contact.law.compliance_mm_per_n * self._surrogate.stiffness
        self._forget(row)
        self._depth[row] = 0.0
        self._parts[row] = 0.0
        self.felt.rest(row, self._caps_rest)

    def move(self, rows: IntArray, T_sensor_object: FloatArray, time_s: FloatArray) -> None:
        """See ``Backend``."""
        known = []
        for row, T in zip(rows.tolist(), T_sensor_object, strict=True):
            try:
                self._bring(row, T)
                self.felt.lost[row] = ""
                known.append(row)
            except ContactError as error:
                self.felt.lost[row] = str(error)
                self._forget(row)
        if known:
            self._answer(np.array(known))

    def attitude(self, row: int) -> PinRest:
        """See ``Backend``."""
        moved = np.tensordot(self._parts[row], self._surrogate.modes, axes=1)
        axis = self._rest[:, 1] + moved[:, 1]
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        return PinRest(self._rest[:, 0] + moved[:, 0], axis, self.felt.caps_mm[row].copy())

    @property
    def caps_at_rest_mm(self) -> FloatArray:
        """(N, 3) centres of the pins' caps at rest."""
        return self._caps_rest

    @property
    def depth_mm(self) -> FloatArray:
        """(B,) how deep the objects are inside the undeformed domes."""
        return self._depth

    def _forget(self, row: int) -> None:
        self._linear.free(row)
        self._before[row] = None

    def _bring(self, row: int, T: FloatArray) -> None:
        """Solve the way to a commanded pose."""
        contact, field = self._contacts[row], self._fields[row]
        assert contact is not None and field is not None, "begin first"
        self._require_inside(field, T)
        gaps = field.distance((self._surrogate.node_mm - T[:3, 3]) @ T[:3, :3])
        deepest = int(gaps.argmin())
        depth = -float(gaps[deepest])
        if depth <= 0 and not self._linear.held[row].any():
            self._linear.free(row)
            self._before[row], self._depth[row] = T.copy(), 0.0
            return
        before = self._before[row] if self._memory else None
        if before is not None and np.array_equal(before, T):
            return
        way = LARGEST_MOVE_MM if before is None else self._moved(before, T)
        if before is None or way >= LARGEST_MOVE_MM:
            self._linear.free(row)
            before = T.copy()
            before[2, 3] += max(depth, 0.0) / max(self._surrogate.node_mm[deepest, 2] / self._radius, 0.5) + CLEAR_MM
            way = self._moved(before, T)
        law, force = contact.law, self._force(row)
        for here in _way(before, T, max(ceil(way / STEP_MM), 1)):
            settled = law.pose(here, force)
            for _ in range(MOST_SETTLING):
                there = settled
                self._linear.move(row, field, there, self._friction[row], self._compliance[row])
                force = self._force(row)
                settled = law.pose(here, force)
                if law.given_way is None or self._moved(there, settled) <= SETTLED_MM:
                    break
        self._before[row] = T.copy()
        yielded = np.array([0.0, 0.0, law.compliance_mm_per_n * force[2]])
        self._depth[row] = -float(field.distance((self._surrogate.node_mm - there[:3, 3] - yielded) @ there[:3, :3]).min())

    def _force(self, row: int) -> FloatArray:
        """Force (3,) of the linear skin on the object, at the true skin's stiffness."""
        return -self._surrogate.stiffness * self._linear.force_n[row].sum(axis=0)

    def _require_inside(self, field: ObjectField, T: FloatArray) -> None:
        """Raise ``ContactError`` for a contact of the dome that is too deep, or too far from the apex.

        The object's distance and direction from the dome's centre tell both exactly, for places between and beyond the nodes too.
        """
        domain = self._domain
        distance, outward, _ = field.probe(-T[:3, 3][None] @ T[:3, :3])
        depth = self._radius - float(distance[0])
        if depth <= 0:
            return
        if depth > domain["depth_mm"]:
            raise outside(f"the object is {depth:.1f} mm inside the dome, at most {domain['depth_mm']:.1f} is taken")
        polar = float(np.degrees(np.arccos(np.clip(-T[2, :3] @ outward[0], -1.0, 1.0))))
        if polar > domain["polar_deg"]:
            raise outside(f"the contact is {polar:.0f} deg from the dome's apex, at most {domain['polar_deg']:.0f} was trained")

    def _moved(self, start: FloatArray, stop: FloatArray) -> float:
        """How far the object moves at most over the dome."""
        turn = stop[:3, :3] @ start[:3, :3].T
        cosine = (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1) / 2
        off = stop[:3, 3] - turn @ start[:3, 3]
        return sqrt(off @ off) + acos(min(max(cosine, -1.0), 1.0)) * self._radius

    def _answer(self, rows: IntArray) -> None:
        """What the sensors feel, from the linear skin and the network."""
        felt, linear, surrogate = self.felt, self._linear, self._surrogate
        force = linear.force_n[rows]
        wrench = -np.concatenate([force.sum(axis=1), np.cross(surrogate.node_mm, force).sum(axis=1)], axis=1)
        held, slides = linear.held[rows].sum(axis=1), linear.slides[rows].sum(axis=1)
        slip = slides / np.maximum(held, 1)
        beside = features(self._depth[rows], self._friction[rows], held, slip, wrench)
        parts, added = surrogate.correct(force, beside, self._depth[rows])
        self._parts[rows] = parts
        felt.caps_mm[rows] = self._caps_rest + (parts @ self._cap_modes).reshape(len(rows), -1, 3)
        felt.force_n[rows] = surrogate.stiffness * wrench[:, :3] + added[:, :3]
        felt.torque_nmm[rows] = surrogate.stiffness * wrench[:, 3:] + added[:, 3:6]
        felt.area_mm2[rows] = np.maximum(added[:, 6], 0.0) * 100.0
        felt.slip[rows] = slip


def _way(start: FloatArray, stop: FloatArray, steps: int) -> list[FloatArray]:
    """Poses (4, 4) after each of some equal steps of a way: the origin goes straight, the object turns about a fixed axis."""
    if steps == 1:
        return [stop]
    left = 1 - np.arange(1, steps + 1)[:, None] / steps
    T = np.empty((steps, 4, 4))
    T[:] = stop
    T[:, :3, 3] += left * (start[:3, 3] - stop[:3, 3])
    turn = start[:3, :3] @ stop[:3, :3].T
    cross = (turn - turn.T) / 2  # with the axis, times the sine of the angle (less than a right one)
    sine = sqrt(cross[2, 1] ** 2 + cross[0, 2] ** 2 + cross[1, 0] ** 2)
    if sine > NO_TURN:
        angle = (atan2(sine, (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1) / 2) * left)[..., None]
        cross = cross / sine
        T[:, :3, :3] += (np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)) @ stop[:3, :3]  # Rodrigues' formula
    return list(T)
