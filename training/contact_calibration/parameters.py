"""The numbers that contacts are calibrated by."""

from dataclasses import dataclass

import numpy as np

from scenes.experiment import ExperimentSpec
from scenes.sensor import SensorSpec
from twin.kinematics import rig_of

TURNING = {"x": 4, "y": 5, "z": 4}  # which of the turns lies in the plane of the approach and the direction across, from 0 in a pose


@dataclass(frozen=True)
class Parameter:
    """One number of a sensor's specification.

    Attributes
    ----------
    name : str
        Dotted key; ``rig.turn_offset_deg`` is the turn in the plane of approach and across.
    prior : float
        Sd of what is plausible around the start; of the logarithm where ``log``.
    step : float
        For differences.
    log : bool
        Fitted as its logarithm.
    """

    name: str
    prior: float
    step: float
    log: bool = False


PARAMETERS = (
    Parameter("rig.contact_offset_mm", 0.5, 0.05),
    Parameter("rig.tcp_to_dome_mm", 10.0, 0.5),
    Parameter("rig.tcp_lateral_mm", 2.0, 0.2),
    Parameter("rig.turn_offset_deg", 3.0, 0.3),
    Parameter("rig.plate_tilt_deg", 2.0, 0.3),
    Parameter("rig.image_turn_deg", 10.0, 1.0),
    Parameter("rig.friction", 0.7, 0.15, log=True),
    Parameter("gel.young_modulus_mpa", 0.7, 0.15, log=True),
    Parameter("skin.thickness_mm", 0.2, 0.05),
    Parameter("pins.length_mm", 0.3, 0.1, log=True),
)


def values_of(sensor: SensorSpec, experiment: ExperimentSpec, parameters: tuple = PARAMETERS) -> np.ndarray:
    """(P,) what the specification says of the parameters, logarithms where they are fitted so."""
    plain = sensor.model_dump(include={"gel", "skin", "pins"}) | {"rig": rig_of(sensor).model_dump()}
    turning = TURNING[experiment.approach] - 3
    out = []
    for parameter in parameters:
        section, key = parameter.name.split(".")
        value = plain[section][key]
        value = value[turning] if key == "turn_offset_deg" else value
        out.append(np.log(max(value, 1e-3)) if parameter.log else value)
    return np.array(out)


def changed(
    sensor: SensorSpec, experiment: ExperimentSpec, values: np.ndarray, turn_sign: int, parameters: tuple = PARAMETERS
) -> SensorSpec:
    """The sensor with other values (P,) of the parameters.

    Raises
    ------
    ValidationError
        They make no sensor.
    """
    plain = sensor.model_dump(mode="json") | {"rig": rig_of(sensor).model_dump(mode="json")}
    plain["rig"]["turn_sign"] = int(turn_sign)
    for parameter, value in zip(parameters, values, strict=True):
        section, key = parameter.name.split(".")
        number = float(np.exp(value)) if parameter.log else float(value)
        if key == "turn_offset_deg":
            plain[section][key][TURNING[experiment.approach] - 3] = number
        else:
            plain[section][key] = number
    return SensorSpec.model_validate(plain)
