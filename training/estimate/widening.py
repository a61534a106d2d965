"""What widens a model's intervals: lost pins, a strange frame, an unmeasured camera, another unit, and what is assumed of the sensor."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scenes.sensor import SensorSpec
from training.estimate.domain import FEWEST, Domain, DomainVerdict

LOST_USUAL = 0.02
"""Share of lost pins in usual frames."""
LOST_WIDENS = 2.0
"""Growth of the intervals with the share of lost pins. With a hidden patch of 15 or 30 % of the pins, errors of depth in the twin grow by a
factor of 1.2 or 1.6."""
ASSUMED_RADIUS, ASSUMED_MM, ASSUMED_DEG = 0.1, 0.015, 1.0
"""Half widths for what a specification only assumes: share of a length, because all lengths are proportional to the radius; share of the
radius; and angle. Simulated taps on a plate with a skin thinner by 0.3 or thicker by 0.4 mm, or a gel 2.5 times softer or stiffer, come out
0.11 to 0.21 mm and 0.1 to 0.35 deg off (radius 20 mm)."""
SIMULATED_FORCES = ("force_x", "force_y", "force_z", "torque_z")
"""Labels that are proportional to the stiffness of the simulated sensor."""


@dataclass(frozen=True)
class Widening:
    """Widens the intervals of K labels, and states why.

    Attributes
    ----------
    sensor : SensorSpec
    domain : Domain or None
    columns, units : sequence of str
        Name and unit of each label.
    unmeasured : float
        Factor for a camera that may have moved; 1 if its place is known.
    other_unit : tuple of float
        Factors for a sensor that is not the unit of the weights, for each label; empty if it is, or if they are not known.
    """

    sensor: SensorSpec
    domain: Domain | None
    columns: Sequence[str]
    units: Sequence[str]
    unmeasured: float
    other_unit: tuple[float, ...] = ()

    @property
    def caveats(self) -> list[str]:
        """Reasons why the intervals of all frames are wider than the model's own, one line each."""
        found = []
        if self.domain is None:
            found.append(
                f"the run does not contain the pin patterns of its training (an earlier version, or fewer frames than {FEWEST}), so frames "
                "outside its domain are not recognised; train it again"
            )
        if self.unmeasured > 1:
            found.append(
                f"without a frame without contact the camera's position is not known: all intervals are {self.unmeasured:g} times wider; "
                "give one (--no-contact, --at-rest)"
            )
        if self.other_unit:
            factors = ", ".join(f"{name} {factor:.2g}" for name, factor in zip(self.columns, self.other_unit, strict=True))
            found.append(
                "the pins at rest are not those of the unit that the weights learnt from, and its skin may differ: intervals are wider "
                f"({factors} times); train with its own frames ('twin train')"
            )
        if self._assumes:
            mm = ASSUMED_MM * self.sensor.skin.outer_radius_mm
            found.append(
                "the model was trained on simulated contacts of a sensor whose contacts were never calibrated: radius, skin and gel are "
                f"assumed; for that the intervals contain {ASSUMED_RADIUS:.0%} of each length, {mm:.2g} mm and {ASSUMED_DEG:g} deg; "
                "'twin calibrate contact' with labelled contacts determines them better"
            )
        stiffness = self.sensor.skin.stiffness_factor
        if self._force.any() and stiffness > 1:
            skin, gel = self.sensor.skin.young_modulus_mpa, self.sensor.gel.young_modulus_mpa
            found.append(
                f"forces and torques assume a skin of {skin:.3g} MPa and a gel of {gel:.3g} MPa, and may be {stiffness:.3g} times larger "
                "or smaller; their intervals contain that; 'twin calibrate contact' with 3 or more presses of measured force determines "
                "it better"
            )
        return found

    def __call__(
        self, value: np.ndarray, half: np.ndarray, lost_share: float, verdict: DomainVerdict, excess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
        """Low and high ends (K,) of the intervals with all unknown effects, and notes on this frame."""
        lost = 1.0 + LOST_WIDENS * lost_share if lost_share > LOST_USUAL else 1.0
        if verdict.notes and self.domain is not None:
            half = np.maximum(half, self.domain.least) * verdict.factor + verdict.added
        half = half * lost * self.unmeasured * (self.other_unit or 1.0) + excess + self._assumption_widths(value)
        stiffness = self.sensor.skin.stiffness_factor  # the true forces may be larger or smaller by this factor
        more, less = value * (stiffness - 1), value * (1 / stiffness - 1)
        low = value - half + np.where(self._force, np.minimum(more, less), 0.0)
        high = value + half + np.where(self._force, np.maximum(more, less), 0.0)
        notes = (f"{lost_share:.0%} of the pins were not found: intervals are {lost:.1f} times wider",) if lost > 1 else ()
        return low, high, (*verdict.notes, *notes)

    @property
    def _assumes(self) -> bool:
        """Whether the model was trained on simulated contacts of a sensor whose contacts were never calibrated."""
        return self.domain is not None and self.domain.simulated and self.sensor.rig is None

    def _assumption_widths(self, value: np.ndarray) -> np.ndarray:
        """Half widths (K,) that are due to what is only assumed of the sensor, for estimates (K,)."""
        lengths = ASSUMED_MM * self.sensor.skin.outer_radius_mm + ASSUMED_RADIUS * np.abs(value)
        angles = np.where(self._force, 0.0, ASSUMED_DEG)
        return float(self._assumes) * np.where([unit == "mm" for unit in self.units[: len(value)]], lengths, angles)

    @property
    def _force(self) -> np.ndarray:
        """(K,) bool: labels that are forces or torques of simulated contacts. They are proportional to the sensor's stiffness."""
        return np.isin(self.columns, SIMULATED_FORCES)
