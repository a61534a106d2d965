"""The parameters of the contact calibration."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scenes.experiment import ExperimentSpec
from scenes.sensor import SensorSpec
from twin.calibration.size import of_radius
from twin.rig.kinematics import TURNING, rig_of

LEAST = 1e-3
"""Least number of which a logarithm is computed; for a Poisson's ratio nu the least 1 - 2 nu."""

DETERMINED = 0.5
"""Least share of a parameter's prior variance that the data must remove for it to count as determined."""
Z90 = 1.645
"""Half a 90 % interval of the normal distribution, in standard deviations."""
SIZE = "skin.outer_radius_mm"
"""Key of the radius of a dome. If it is fitted, all lengths of the sensor and its rig are scaled with it (see ``of_radius``) before the
other parameters are set."""


@dataclass(frozen=True)
class FittedParameter:
    """One number of a sensor's specification that is fitted.

    Attributes
    ----------
    name : str
        Dotted key. Of ``rig.turn_offset_deg`` only the turn in the plane of approach and across is fitted.
    prior : float
        Prior standard deviation of the fitted quantity around its start.
    step : float
        Step of the fitted quantity for difference quotients.
    scale : {"plain", "log", "volume"}
        The fitted quantity: the number itself, its logarithm, or, for a Poisson's ratio nu, log(1 - 2 nu), which measures how
        compressible the volume is.
    least : float
        Smallest meaningful number. If the fitted quantity is below it, the number is ``least``.
    """

    name: str
    prior: float
    step: float
    scale: Literal["plain", "log", "volume"] = "plain"
    least: float = -np.inf

    def fitted_quantity(self, number: float) -> float:
        """The fitted quantity that belongs to a number of the specification."""
        if self.scale == "plain":
            return number
        return float(np.log(max(number if self.scale == "log" else 1 - 2 * number, LEAST)))

    def number(self, fitted: float) -> float:
        """The number of the specification that belongs to a fitted quantity."""
        if self.scale == "plain":
            return max(float(fitted), self.least)
        return float(np.exp(fitted) if self.scale == "log" else (1 - np.exp(fitted)) / 2)

    def slope(self, fitted: float) -> float:
        """Absolute change of the number for a change of the fitted quantity by 1."""
        return 1.0 if self.scale == "plain" else float(np.exp(fitted)) / (1 if self.scale == "log" else 2)


PARAMETERS = (
    FittedParameter("rig.contact_offset_mm", 0.5, 0.05),
    FittedParameter("rig.tcp_to_dome_mm", 10.0, 0.5),
    FittedParameter("rig.tcp_lateral_mm", 2.0, 0.2),
    FittedParameter("rig.turn_offset_deg", 3.0, 0.3),
    FittedParameter("rig.plate_tilt_deg", 2.0, 0.3),
    FittedParameter("rig.image_turn_deg", 10.0, 1.0),
    FittedParameter("rig.friction", 0.7, 0.15, "log"),
    FittedParameter("rig.compliance_mm_per_n", 0.1, 0.02, least=0.0),
    FittedParameter("rig.turn_compliance_deg_per_n", 0.3, 0.1),
    FittedParameter("gel.young_modulus_mpa", 0.7, 0.15, "log"),
    FittedParameter("gel.poisson_ratio", 0.7, 0.3, "volume"),
    FittedParameter("skin.thickness_mm", 0.2, 0.05),
    FittedParameter("pins.length_mm", 0.3, 0.1, "log"),
)


def values_of(sensor: SensorSpec, experiment: ExperimentSpec, parameters: tuple[FittedParameter, ...] = PARAMETERS) -> np.ndarray:
    """Fitted quantities (P,) of the specification's parameters."""
    plain = sensor.model_dump(include={"gel", "skin", "pins"}) | {"rig": rig_of(sensor).model_dump()}
    turning = TURNING[experiment.approach] - 3
    out = []
    for parameter in parameters:
        section, key = parameter.name.split(".")
        value = plain[section][key]
        out.append(parameter.fitted_quantity(value[turning] if key == "turn_offset_deg" else value))
    return np.array(out)


def with_quantities(
    sensor: SensorSpec, experiment: ExperimentSpec, values: np.ndarray, turn_sign: int, parameters: tuple[FittedParameter, ...] = PARAMETERS
) -> SensorSpec:
    """The sensor with other fitted quantities (P,) of the parameters.

    Raises
    ------
    ValidationError
        The values do not make a valid sensor.
    """
    for parameter, value in zip(parameters, values, strict=True):
        if parameter.name == SIZE:
            sensor = of_radius(sensor.alter(rig=rig_of(sensor)), parameter.number(value))
    plain = sensor.model_dump(mode="json") | {"rig": rig_of(sensor).model_dump(mode="json")}
    plain["rig"]["turn_sign"] = int(turn_sign)
    for parameter, value in zip(parameters, values, strict=True):
        section, key = parameter.name.split(".")
        number = parameter.number(value)
        if key == "turn_offset_deg":
            plain[section][key][TURNING[experiment.approach] - 3] = number
        else:
            plain[section][key] = number
    return SensorSpec.model_validate(plain)
