"""Specifications: what exists. Sensors and objects as data, validated where they enter."""

from scenes.errors import SpecError
from scenes.load import (
    list_objects,
    list_sensors,
    load_object,
    load_sensor,
    user_spec_dir,
)
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec

__all__ = [
    "ObjectSpec",
    "SensorSpec",
    "SpecError",
    "list_objects",
    "list_sensors",
    "load_object",
    "load_sensor",
    "user_spec_dir",
]
