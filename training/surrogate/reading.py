"""Solvers for the contacts of several environments at once: their protocol, and the one with finite elements."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import numpy as np

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import ContactError
from twin.geometry.pins import PinRest, rest_pins
from twin.mechanics.follow import Follower
from twin.mechanics.law import ContactLaw
from twin.mechanics.solver import SkinSolver
from twin.types import FloatArray, IntArray

_KEPT_SOLVERS = 4
"""Number of solvers kept in memory: one of the sensor as specified, the others of randomised sensors."""
_solver = lru_cache(maxsize=_KEPT_SOLVERS)(SkinSolver)


@dataclass(frozen=True)
class EpisodeContact:
    """One environment's contact: the sensor and object as sampled for the episode, and their friction and compliance."""

    sensor: SensorSpec
    obj: ObjectSpec
    law: ContactLaw


@dataclass
class ContactReading:
    """The sensors' states of B environments with N pins each (sensor frame).

    Attributes
    ----------
    caps_mm : (B, N, 3) float
        Centres of the pins' caps.
    force_n : (B, 3) float
        Force of the skin on the object.
    torque_nmm : (B, 3) float
        Torque of the skin on the object, about the sensor's origin.
    area_mm2 : (B,) float
        Contact area, measured on the skin at rest.
    slip : (B,) float
        Share of that area that slides.
    lost : list of str
        Why a contact could not be computed, or "". The row of such a contact keeps its last computed state.
    """

    caps_mm: FloatArray
    force_n: FloatArray
    torque_nmm: FloatArray
    area_mm2: FloatArray
    slip: FloatArray
    lost: list[str] = field(default_factory=list)

    @classmethod
    def at_rest(cls, count: int, caps_mm: FloatArray) -> "ContactReading":
        """``count`` sensors that touch nothing, with caps (N, 3)."""
        force, torque = np.zeros((2, count, 3))
        return cls(np.tile(caps_mm, (count, 1, 1)), force, torque, np.zeros(count), np.zeros(count), [""] * count)

    def rest(self, row: int, caps_mm: FloatArray) -> None:
        """Set one sensor to the state without contact."""
        self.caps_mm[row] = caps_mm
        for values in (self.force_n, self.torque_nmm, self.area_mm2, self.slip):
            values[row] = 0.0
        self.lost[row] = ""


class Backend(Protocol):
    """A solver of contacts, pose after pose, with the memory of each contact."""

    felt: ContactReading

    def require(self, contact: EpisodeContact) -> None:
        """Raise ``ContactError`` if the backend cannot solve contacts of this sensor and object with this law."""

    def begin(self, row: int, contact: EpisodeContact) -> None:
        """Begin an environment's episode, the sensor at rest.

        Raises
        ------
        ContactError
            For the same reasons as in ``require``.
        """

    def move(self, rows: IntArray, T_sensor_object: FloatArray, time_s: FloatArray) -> None:
        """Move the objects of some rows (R,) to poses (R, 4, 4) at times (R,), and update ``felt``."""

    def attitude(self, row: int) -> PinRest:
        """Feet, axes and caps of one sensor's pins."""


class FiniteElements:
    """The skin's finite elements, one ``Follower`` for each environment."""

    def __init__(self, sensor: SensorSpec, count: int) -> None:
        self._sensor = sensor
        self._rest = rest_pins(sensor.geometry)
        self.felt = ContactReading.at_rest(count, self._rest.caps_mm)
        self._pins = [self._rest] * count
        self._followers: list[Follower | None] = [None] * count

    def require(self, contact: EpisodeContact) -> None:
        """See ``Backend``: no contact is refused before it is solved."""

    def begin(self, row: int, contact: EpisodeContact) -> None:
        """See ``Backend``. A randomised sensor needs its own solver, which takes about a second to build."""
        self._followers[row] = Follower(_solver(contact.sensor), contact.obj, contact.law)
        self._pins[row] = self._rest if contact.sensor is self._sensor else rest_pins(contact.sensor.geometry)
        self.felt.rest(row, self._pins[row].caps_mm)

    def move(self, rows: IntArray, T_sensor_object: FloatArray, time_s: FloatArray) -> None:
        """See ``Backend``."""
        felt = self.felt
        for row, T, now_s in zip(rows.tolist(), T_sensor_object, time_s.tolist(), strict=True):
            follower = self._followers[row]
            assert follower is not None, "begin first"
            try:
                state = follower.move(T, now_s)
            except ContactError as error:
                felt.lost[row] = str(error)
                continue
            felt.lost[row] = ""
            self._pins[row] = PinRest(state.base_mm, state.axis, state.caps_mm)
            felt.caps_mm[row] = state.caps_mm
            felt.force_n[row], felt.torque_nmm[row] = state.force_n, state.torque_nmm
            felt.area_mm2[row] = float(state.point_area_mm2.sum())
            felt.slip[row] = state.slip_share

    def attitude(self, row: int) -> PinRest:
        """See ``Backend``."""
        return self._pins[row]
