"""Contact parameters beside the two shapes and the path: friction of the pair, and compliance of the arm."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scenes.object import ObjectSpec
from twin.mechanics.balance import Friction

FRICTIONLESS = Friction(0.0, 0.0)

GivenWay = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function from the commanded ``T_sensor_object`` (4, 4) and the force on the object (3,), N, sensor frame, to the reached pose."""


@dataclass(frozen=True)
class ContactLaw:
    """Friction between skin and object, and how far both give way under their force.

    Attributes
    ----------
    friction : Friction
    compliance_mm_per_n : float
        How far object and holder give way along the sensor's z, for each N. It is solved with the contact.
    given_way : callable, optional
        What else the force does to the object's pose (see ``GivenWay``).
    """

    friction: Friction = FRICTIONLESS
    compliance_mm_per_n: float = 0.0
    given_way: GivenWay | None = None

    @classmethod
    def of_object(cls, touched: ObjectSpec) -> "ContactLaw":
        """The object's own friction and compliance: the law of a contact that no arm makes."""
        return cls(friction_of(touched), touched.compliance_mm_per_n)

    def override(self, *, friction: float | Friction | None = None, compliance_mm_per_n: float | None = None) -> "ContactLaw":
        """The same law with what is given in place of its own; a number for ``friction`` is both coefficients."""
        law = self
        if friction is not None:
            law = replace(law, friction=friction if isinstance(friction, Friction) else Friction(friction, friction))
        if compliance_mm_per_n is not None:
            law = replace(law, compliance_mm_per_n=compliance_mm_per_n)
        return law

    def pose(self, T: np.ndarray, force_n: np.ndarray) -> np.ndarray:
        """``T_sensor_object`` (4, 4) that is taken under a force (3,) on the object where ``T`` (4, 4) was commanded.

        The compliance along z is not in it: the contact's equations have it as an unknown.
        """
        return T if self.given_way is None else self.given_way(T, force_n)


def friction_of(touched: ObjectSpec) -> Friction:
    """The friction that an object's specification states."""
    kinetic = touched.friction if touched.kinetic_friction is None else touched.kinetic_friction
    return Friction(touched.friction, kinetic, touched.slip_weakening_mm, touched.shear_strength_mpa or np.inf)
