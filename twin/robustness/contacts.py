"""The contacts over which a sweep judges: solved once, kept, and shared by all conditions that leave the mechanics alone."""

from dataclasses import dataclass

import numpy as np

from scenes import load_object
from scenes.sensor import SensorSpec
from twin.geometry.pins import rest_pins
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.store import cached_arrays


@dataclass(frozen=True)
class Contact:
    """An object of `scenes` and how the sensor is pressed against it."""

    name: str
    stimulus: str
    pose: ContactPose


@dataclass(frozen=True)
class PinState:
    """Pins of a contact: feet, axes and caps, (N, 3) each, mm, sensor frame."""

    base_mm: np.ndarray
    axis: np.ndarray
    caps_mm: np.ndarray


CONTACTS = (
    Contact("none", "plane", ContactPose(0.0)),
    Contact("flat", "plane", ContactPose(2.5)),
    Contact("tilted", "plane", ContactPose(4.0, tilt_deg=(8.0, -5.0))),
    Contact("sheared", "plane", ContactPose(3.0, shear_mm=(2.0, 1.0))),
    Contact("edge", "edge", ContactPose(3.5, twist_deg=15.0)),
    Contact("cylinder", "cylinder", ContactPose(3.0, offset_mm=(3.0, 2.0))),
)


def pins_under(spec: SensorSpec, contact: Contact) -> PinState:
    """The pins under a contact, from the cache where it has been solved before.

    Raises
    ------
    ContactError
        The contact can't be solved.
    """
    if contact.pose.indent_mm <= 0:
        rest = rest_pins(spec.geometry)
        return PinState(rest.base_mm, rest.axis, rest.caps_mm)

    def solve():
        state = SkinSolver(spec).press(load_object(contact.stimulus), contact.pose)
        return {"base_mm": state.base_mm, "axis": state.axis, "caps_mm": state.caps_mm}

    optical = {"refractive_index", "absorption_per_mm", "haze", "haze_sigma_px"}
    key = {part: getattr(spec, part).model_dump(mode="json", exclude=optical) for part in ("skin", "gel", "lens", "pins")}
    key |= {"stimulus": load_object(contact.stimulus).model_dump(mode="json"), "pose": vars(contact.pose)}
    return PinState(**cached_arrays("pins-under-contact", key, solve))
