"""Determination of the scale of forces from measured forces.

Pins do not determine how stiff a sensor is: a sensor that is twice as stiff moves its pins in the same way, with twice the force. Some
presses with measured forces determine the scale. With the contact fitted to the pins, each press is simulated. The logarithm of measured
over simulated force has the mean ln(s) and the standard error e. Both moduli are multiplied by s, and the compliances of the rig are
divided by s, so that the pins do not move. Forces are then known within a factor exp(t e) in both directions, with t the 95 % quantile of
Student's distribution: 90 % of such intervals contain the true force.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from scenes.body import ASSUMED_FACTOR
from scenes.experiment import ExperimentSpec
from scenes.sensor import SensorSpec
from twin.frames import Recording
from twin.frames.tables import numbers

FEWEST_PRESSES = 3
"""Fewest presses from which a scale is computed. Two presses do not show how large the random error is."""
MOST_PRESSES = 20
"""Most presses that are simulated. Each takes a second or two."""
LEAST_N = 0.2
"""Least force, N, of a press that is used, because scales and zero readings of force sensors are wrong by some hundredths of a newton."""
COVERED = 0.95
"""Quantile of Student's distribution at each end of the interval."""
ALONG = ("Fz", "force_z")
"""Columns of the force along the approach, N, if the specification's rig has no force sensor."""


@dataclass(frozen=True)
class Newtons:
    """The stiffness of a sensor, determined from forces.

    Attributes
    ----------
    presses : int
        Number of presses that were compared; 0 if the stiffness is assumed.
    scale : float
        Measured force divided by simulated force.
    factor : float
        The true forces may be larger or smaller by this factor.
    explanation : str
        The result in words.
    """

    presses: int
    scale: float
    factor: float
    explanation: str

    def of(self, sensor: SensorSpec) -> SensorSpec:
        """The sensor with this stiffness. The rig's compliances are scaled so that the pins move as before."""
        skin = sensor.skin.alter(young_modulus_mpa=self.scale * sensor.skin.young_modulus_mpa, stiffness_factor=self.factor)
        gel = sensor.gel.alter(young_modulus_mpa=self.scale * sensor.gel.young_modulus_mpa)
        rig = sensor.rig and sensor.rig.alter(
            compliance_mm_per_n=sensor.rig.compliance_mm_per_n / self.scale,
            turn_compliance_deg_per_n=sensor.rig.turn_compliance_deg_per_n / self.scale,
        )
        return sensor.alter(skin=skin, gel=gel, rig=rig)


def assume_stiffness(sensor: SensorSpec, why: str) -> Newtons:
    """The result if no forces were measured: the specification's own stiffness."""
    skin, gel, factor = sensor.skin.young_modulus_mpa, sensor.gel.young_modulus_mpa, sensor.skin.stiffness_factor
    return Newtons(
        0,
        1.0,
        factor,
        f"forces: {why}, so the stiffness is assumed (skin {skin:.3g} MPa, gel {gel:.3g} MPa), and every force may be {factor:.2g} times "
        f"larger or smaller; to determine it, measure the force of {FEWEST_PRESSES} presses or more with scales and give it in newtons in "
        f"a column {ALONG[0]}",
    )


def compare_forces(measured_n: ArrayLike, simulated_n: ArrayLike, sensor: SensorSpec) -> Newtons:
    """The stiffness from measured and simulated forces (K,) along the approach. Presses below ``LEAST_N`` are not used."""
    measured, simulated = np.abs(np.asarray(measured_n, float)), np.abs(np.asarray(simulated_n, float))
    usable = (measured >= LEAST_N) & (simulated >= LEAST_N / ASSUMED_FACTOR**2)
    count = int(usable.sum())
    if count < FEWEST_PRESSES:
        return assume_stiffness(sensor, f"too few presses with a force ({count})")
    ratio = np.log(measured[usable] / simulated[usable])
    error = float(ratio.std(ddof=1) / np.sqrt(count) * stdtrit(count - 1, COVERED))
    scale, factor = float(np.exp(ratio.mean())), float(np.exp(error))
    return Newtons(
        count,
        scale,
        factor,
        f"forces: {count} presses determine the stiffness: {scale:.3g} times the previous one, and every force may be {factor:.3g} times "
        f"larger or smaller; single presses scatter by {100 * (np.exp(ratio.std(ddof=1)) - 1):.0f} %",
    )


def pressed_n(recording: Recording, sensor: SensorSpec, experiment: ExperimentSpec) -> np.ndarray:
    """Measured forces (M,) along the approach, N, of a recording's frames; NaN for a frame without a measured force."""
    reads, axis = None if sensor.rig is None else sensor.rig.force_sensor, experiment.axis
    name = next((name for name in (reads.columns[axis : axis + 1] if reads else ALONG) if name in recording.labels), None)
    if name is None:
        return np.full(len(recording), np.nan)
    found = numbers(recording.labels[name])
    return found if reads is None else (found - reads.offset_n[axis]) / reads.gain[axis]
