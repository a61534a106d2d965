"""Contact parameters: friction between skin and object, and compliance of object and arm."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scenes.object import ObjectSpec
from twin.errors import ContactError
from twin.types import FloatArray


@dataclass(frozen=True)
class Friction:
    """Coulomb friction with slip weakening (Ida 1972).

    A point that has slid by s since it last stuck has the coefficient mu = kinetic + (static - kinetic) exp(-s / weakening_mm).
    The shear stress never exceeds ``shear_strength_mpa``.

    Attributes
    ----------
    static, kinetic : float
        Coefficients of a point that sticks, and of one that has slid far.
    weakening_mm : float
        Distance of sliding over which the coefficient falls.
    shear_strength_mpa : float
        Largest shear stress.

    Raises
    ------
    ContactError
        Not 0 <= kinetic <= static, or ``weakening_mm`` or ``shear_strength_mpa`` is not positive.
    """

    static: float
    kinetic: float
    weakening_mm: float = 0.1
    shear_strength_mpa: float = np.inf

    def __post_init__(self) -> None:
        if not (0 <= self.kinetic <= self.static < np.inf and self.weakening_mm > 0 and self.shear_strength_mpa > 0):
            raise ContactError(f"friction needs 0 <= kinetic <= static, weakening_mm > 0 and shear_strength_mpa > 0, got {self}")

    def after(self, slid_mm: FloatArray) -> FloatArray:
        """Coefficients of friction (q,) of points that have slid by ``slid_mm`` (q,) since they last stuck."""
        return self.kinetic + (self.static - self.kinetic) * np.exp(-slid_mm / self.weakening_mm)


GivenWay = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function that takes the commanded ``T_sensor_object`` (4, 4) and the force on the object (3,) in N, sensor frame, and returns the reached
``T_sensor_object`` (4, 4)."""


@dataclass(frozen=True)
class ContactLaw:
    """Friction between skin and object, and compliance of the object and of the arm that holds the sensor.

    Attributes
    ----------
    friction : Friction
    compliance_mm_per_n : float
        Displacement of the object along the sensor's z per N of contact force. The solver finds it together with the contact.
    given_way : callable, optional
        Any other effect of the contact force on the object's pose (see ``GivenWay``).
    """

    friction: Friction = Friction(0.0, 0.0)
    compliance_mm_per_n: float = 0.0
    given_way: GivenWay | None = None

    @classmethod
    def of_object(cls, obj: ObjectSpec) -> "ContactLaw":
        """The law with the object's own friction and compliance, for a contact without an arm."""
        return cls(friction_of(obj), obj.compliance_mm_per_n)

    def override(self, *, friction: float | Friction | None = None, compliance_mm_per_n: float | None = None) -> "ContactLaw":
        """The same law with the given values in place of its own. A number for ``friction`` sets the static and the kinetic coefficient."""
        both = friction if friction is None or isinstance(friction, Friction) else Friction(friction, friction)
        yields = self.compliance_mm_per_n if compliance_mm_per_n is None else compliance_mm_per_n
        return replace(self, friction=both or self.friction, compliance_mm_per_n=yields)

    def pose(self, T: np.ndarray, force_n: np.ndarray) -> np.ndarray:
        """Reached ``T_sensor_object`` (4, 4) under a force (3,) on the object, N, if ``T`` (4, 4) is commanded.

        It does not contain the displacement by ``compliance_mm_per_n``, which is an unknown of the contact's equations.
        """
        return T if self.given_way is None else self.given_way(T, force_n)


def friction_of(obj: ObjectSpec) -> Friction:
    """The friction that an object's specification states."""
    kinetic = obj.friction if obj.kinetic_friction is None else obj.kinetic_friction
    return Friction(obj.friction, kinetic, obj.slip_weakening_mm, obj.shear_strength_mpa or np.inf)
