"""Contacts on a surrogate: many sensors at once, each with its own object and friction memory."""

from functools import lru_cache
from typing import Any

import numpy as np

from scenes.sensor import SensorSpec
from training.surrogate.contact import LinearContacts, moved_mm
from training.surrogate.model import Surrogate, answer_each, by_row, features, outside, rest_of, unlike_parts
from training.surrogate.paths import unlike_drawn
from training.surrogate.reading import ContactReading, EpisodeContact
from twin.compiled import compiled
from twin.geometry.pins import PinRest
from twin.objects import build_field
from twin.objects.analytic import CompiledSolid
from twin.rig.contact import ArmTurning
from twin.types import FloatArray, IntArray

LARGEST_MOVE_MM = 30.0
"""Largest motion between two poses. Beyond it the path between them is unknown, and the contact begins again."""
CLEAR_MM = 0.5
"""Distance between dome and object at which a contact begins."""
OUTSIDE, SAME, CLEAR, FRESH, FOLLOW = range(5)
"""What a pose asks for: it is outside the domain, it is the last one, it is clear of the skin, a contact begins, or it goes on."""
STILL_MM = 2e-4
"""Change of the bending, with ``few``, up to which it is evaluated once at each pose."""
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
    few : bool
        A few sensors that move in very small steps: as accurate, and faster. Then ``felt.caps_mm`` is old; use ``caps_mm``.
    """

    def __init__(self, surrogate: Surrogate, sensor: SensorSpec, count: int, *, friction_history: bool = True, few: bool = False) -> None:
        self._surrogate, self._sensor, self._memory = surrogate, sensor, friction_history
        self._rest = rest_of(sensor)
        self._cap_mm = sensor.pins.length_mm + sensor.pins.cap_height_mm / 2
        modes = surrogate.modes
        force = np.tile(-np.eye(3), (len(surrogate.node_mm), 1))  # on the object, by a unit force at each node along each axis
        self._turns = np.concatenate([force, np.cross(surrogate.node_mm.repeat(3, axis=0), force) + 0.0], axis=1)
        self._cap_modes = np.ascontiguousarray((modes[:, :, 0] + self._cap_mm * modes[:, :, 1]).reshape(len(modes), -1), np.float32)
        self._caps_rest = self._rest[:, 0] + self._cap_mm * self._rest[:, 1]
        bending, still = surrogate.bending.kernel(surrogate.read), STILL_MM if few else 0.0
        self._linear = LinearContacts(surrogate.node_mm, surrogate.answer, count, bending=bending, still_mm=still)
        self._network = surrogate.kernel() if few else None
        self._found = np.zeros((count, len(surrogate.out_scale)), np.float32)
        self._before = np.tile(np.eye(4), (count, 1, 1))  # the poses commanded last
        self._known = np.zeros(count, bool)
        self._gap = np.full((count, len(surrogate.node_mm)), np.inf)
        self.domain, self.radius_mm = surrogate.domain, self._linear.radius_mm
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
        if friction.static > self.domain["friction"]:
            raise outside(f"a friction of {friction.static:g}, at most {self.domain['friction']:g} was trained")
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
        self._found[row] = 0.0
        self.felt.rest(row, self._caps_rest)

    def move(self, rows: IntArray, T_sensor_object: FloatArray, time_s: FloatArray) -> None:
        """See ``Backend``."""
        linear, T = self._linear, np.ascontiguousarray(T_sensor_object)
        gap, centre = linear.distances(rows, T)
        most = self.domain["depth_mm"], self.domain["polar_deg"], self._memory
        state = linear.held, self._known, self._before, self._gap
        todo = _plan(rows, (T, gap, centre), (linear.node_mm, linear.radius_mm), most, state)
        for number, row in enumerate(rows.tolist()):
            self.felt.lost[row] = "" if todo[number] != OUTSIDE else self._outside(linear.radius_mm - centre[number, 0], centre[number, 1])
        free = (todo != SAME) & (todo != FOLLOW)
        if free.any():
            linear.free(rows[free])
        moves = todo >= FRESH
        if moves.any():
            there, T, gap = (rows, T, gap) if moves.all() else (rows[moves], T[moves], gap[moves])
            linear.move(there, self._before[there], T)
            self._before[there] = T
            if linear.compliance_mm_per_n.any() or linear.turning.any():
                T = linear.taken[there]
                T[:, 2, 3] += linear.compliance_mm_per_n[there] * -linear.force_n[there].sum(axis=1)[:, 2]
                gap = linear.distances(there, T)[0]
            self._gap[there] = gap
        changed = todo >= CLEAR
        if changed.any():
            self._answer(rows[changed])

    def attitude(self, row: int) -> PinRest:
        """See ``Backend``."""
        moved = np.tensordot(self._parts[row], self._surrogate.modes, axes=1)
        axis = self._rest[:, 1] + moved[:, 1]
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        return PinRest(self._rest[:, 0] + moved[:, 0], axis, self.caps_mm(row).copy())

    def caps_mm(self, row: int) -> FloatArray:
        """Centres (N, 3) of one sensor's pins' caps."""
        if self._network is not None:
            self.felt.caps_mm[row] = self._caps_rest + (self._parts[row] @ self._cap_modes).reshape(-1, 3)
        return self.felt.caps_mm[row]

    @property
    def _parts(self) -> FloatArray:
        return self._found[:, : len(self._surrogate.modes)]

    @property
    def depth_mm(self) -> FloatArray:
        """Depths (B,) of the objects inside the undeformed domes."""
        return np.maximum(-self._gap.min(axis=1), 0.0)

    def _outside(self, depth_mm: float, cosine: float) -> str:
        """The reason why a contact is too deep or too far from the apex."""
        depth, polar = self.domain["depth_mm"], self.domain["polar_deg"]
        angle = np.degrees(np.arccos(min(cosine, 1.0)))
        if depth_mm > depth:
            return str(outside(f"the object is {depth_mm:.1f} mm inside the dome, at most {depth:.1f} is taken"))
        return str(outside(f"the contact is {angle:.0f} deg from the dome's apex, at most {polar:.0f} was trained"))

    def _answer(self, rows: IntArray) -> None:
        """Write to ``felt`` what the sensors feel, from the linear skin and the network."""
        felt, linear = self.felt, self._linear
        wrench: FloatArray
        if self._network is not None:
            state = linear.force_n, linear.held, linear.slides, linear.friction, linear.used, self._gap
            answer_each(rows, state, self._turns, self._network, self._found)
            wrench, slip, added = np.zeros((1, 6)), np.zeros(1), self._found[rows, self._parts.shape[1] :]
        else:
            force, gap = linear.force_n[rows], self._gap[rows]
            wrench = by_row(force.reshape(len(rows), -1), self._turns)
            held, slides = linear.held[rows].sum(axis=1), linear.slides[rows].sum(axis=1)
            slip = slides / np.maximum(held, 1)
            depth = np.maximum(-gap.min(axis=1), 0.0)
            beside = features(depth, linear.friction[rows], held, slip, linear.used[rows], wrench)
            parts, added = self._surrogate.correct(force, beside, gap, depth)
            self._parts[rows] = parts
            felt.caps_mm[rows] = self._caps_rest + by_row(parts, self._cap_modes).reshape(len(rows), -1, 3)
        felt.force_n[rows] = wrench[:, :3] + added[:, :3]
        felt.torque_nmm[rows] = wrench[:, 3:] + added[:, 3:6]
        felt.area_mm2[rows] = np.maximum(added[:, 6], 0.0) * 100.0
        felt.slip[rows] = np.clip(slip + added[:, 7], 0.0, 1.0)


@compiled()
def _plan(
    rows: IntArray, poses: tuple[FloatArray, ...], skin: tuple[FloatArray, float], most: tuple[float, float, bool], state: tuple[Any, ...]
) -> IntArray:
    """What there is to do for some rows (R,) at commanded poses (R, 4, 4), at which the nodes at rest have distances ``gap`` (R, M).

    It writes ``known``, where a motion begins (``before``), and the distances ``last`` of objects that are clear of the skin.
    """
    (T, gap, centre), (node, radius_mm), (depth_mm, polar_deg, memory), (held, known, before, last) = poses, skin, most, state
    todo = np.empty(len(rows), np.int64)
    for r in range(len(rows)):
        row, deepest = rows[r], gap[r].argmin()
        inside = radius_mm - centre[r, 0]
        if inside > 0 and (inside > depth_mm or np.degrees(np.arccos(min(max(centre[r, 1], -1.0), 1.0))) > polar_deg):
            todo[r], known[row] = OUTSIDE, False
            continue
        depth, known[row] = -gap[r, deepest], known[row] and memory
        same = known[row] and (before[row] == T[r]).all()
        if depth <= 0 and not held[row].any():
            todo[r] = SAME if same else CLEAR
            before[row] = T[r]
            last[row] = np.inf
        elif same:
            todo[r] = SAME
        elif known[row] and moved_mm(before[row], T[r], radius_mm) < LARGEST_MOVE_MM:
            todo[r] = FOLLOW
        else:
            todo[r] = FRESH
            before[row] = T[r]
            before[row, 2, 3] += max(depth, 0.0) / max(node[deepest, 2] / radius_mm, 0.5) + CLEAR_MM
        known[row] = True
    return todo
