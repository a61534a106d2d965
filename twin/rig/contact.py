"""The contact model of a sensor on an arm: the pose of the object under the contact force, and the friction.

All parts of the program take their contacts from this module: simulated data sets, the validation against labelled frames, the calibration
of contacts, renders from labels, and the twin in which a servo follows a surface.

When an arm presses a sensor against an object with the force F (on the object, sensor frame), the model contains three effects:

- Friction. A rig's coefficient of friction was fitted to frames of this sensor's skin, so it applies to every object that the rig's arm
  touches. An object's own friction applies if the sensor has no rig. A friction that the caller gives takes precedence over both.
- Displacement along the sensor's z by (object's + rig's ``compliance_mm_per_n``) F_z. The solver finds it together with the contact.
- Rotation of the arm about its tool point, in the plane of its approach and the direction across, by ``turn_compliance_deg_per_n`` times
  the force along the direction across (see ``ArmTurning``).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.rig import RigSpec
from twin.mechanics.law import ContactLaw, Friction, friction_of
from twin.mechanics.solver import SkinSolver
from twin.objects import build_field
from twin.rig.kinematics import ArmPath, Mounting, arm_path, rig_of
from twin.rig.labels import ArmLabel
from twin.types import ContactState


@dataclass(frozen=True)
class ArmTurning:
    """Rotation of an arm about its tool point under the force across; a ``GivenWay`` of ``ContactLaw``. Vectors are in the sensor frame.

    Attributes
    ----------
    across : (3,) float
        Unit vector of the direction across. The component of the force along it rotates the arm.
    axis : (3,) float
        Unit vector about which the tool rotates when the label of its angle increases.
    tool_mm : (3,) float
        The tool point.
    deg_per_n : float
        Rotation per N.
    """

    across: np.ndarray
    axis: np.ndarray
    tool_mm: np.ndarray
    deg_per_n: float

    def __call__(self, T: np.ndarray, force_n: np.ndarray) -> np.ndarray:
        """The object's pose (4, 4) under a force (3,), N. In the sensor frame it rotates about the tool point, opposite to the tool."""
        turn = Rotation.from_rotvec(-self.deg_per_n * (self.across @ force_n) * self.axis, degrees=True).as_matrix()
        there = T.copy()
        there[:3, :3] = turn @ T[:3, :3]
        there[:3, 3] = self.tool_mm + turn @ (T[:3, 3] - self.tool_mm)
        return there


def friction_between(rig: RigSpec | None, obj: ObjectSpec) -> Friction:
    """Friction between sensor and object: the rig's single coefficient, or the object's own friction if there is no rig."""
    return Friction(rig.friction, rig.friction) if rig else friction_of(obj)


def contact_law(rig: RigSpec | None, mounting: Mounting, obj: ObjectSpec, *, friction: float | Friction | None = None) -> ContactLaw:
    """Friction and compliance of a mounted sensor and an object.

    Parameters
    ----------
    rig : RigSpec or None
        The sensor's rig; None for a sensor without one.
    mounting : Mounting
        The mounting on this rig.
    friction : optional
        Friction that replaces the rig's or the object's (see ``friction_between``).
    """
    turning = None
    if rig and rig.turn_compliance_deg_per_n:
        turning = ArmTurning(mounting.across_in_sensor, mounting.label_turn, mounting.tool_point_mm, rig.turn_compliance_deg_per_n)
    compliance = obj.compliance_mm_per_n + (rig.compliance_mm_per_n if rig else 0.0)
    return ContactLaw(friction_between(rig, obj), compliance, turning).override(friction=friction)


class RigContact:
    """Contacts between one sensor on an arm and one object, from the arm's labels.

    Parameters
    ----------
    solver : SkinSolver
        Solver of the sensor.
    experiment : ExperimentSpec
    touched : ObjectSpec
    rig : RigSpec, optional
        Rig that replaces the sensor's own.

    Attributes
    ----------
    field : ObjectField
        The object's shape.
    law : ContactLaw
    """

    def __init__(self, solver: SkinSolver, experiment: ExperimentSpec, obj: ObjectSpec, *, rig: RigSpec | None = None) -> None:
        self.solver, self.experiment = solver, experiment
        self.rig = rig or rig_of(solver.spec, obj.name)
        self.field = build_field(obj)
        mounting = Mounting(self.rig, experiment, solver.spec.skin)
        self.law = contact_law(self.rig if rig or solver.spec.rig else None, mounting, obj)

    def commanded_path(self, label: ArmLabel) -> ArmPath:
        """The commanded path of the object (see ``arm_path``, also for errors)."""
        return arm_path(self.rig, self.experiment, self.solver.spec.skin, self.field, label)

    def along(self, way: ArmPath, *, friction: float | Friction | None = None) -> Iterator[tuple[float, ContactState]]:
        """Every converged state along the path, with its fraction of the path. ``friction`` replaces the friction of the law.

        Raises
        ------
        ContactError
            As ``SkinSolver.path``.
        """
        return self.solver.path(self.field, way.path, law=self.law, friction=friction)

    def end(self, label: ArmLabel, *, friction: float | Friction | None = None) -> ContactState:
        """The state at the end of the path of a label. Errors as ``along``."""
        return self.solver.press(self.field, self.commanded_path(label).path, law=self.law, friction=friction)
