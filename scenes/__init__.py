"""Specifications: what exists. Sensors, objects, experiments and the rig as data, validated where they enter."""

from scenes.errors import SpecError
from scenes.experiment import ExperimentSpec
from scenes.load import (
    list_experiments,
    list_objects,
    list_sensors,
    load_experiment,
    load_mounting,
    load_object,
    load_sensor,
    load_servo,
    mounting_of,
    user_spec_dir,
)
from scenes.object import ObjectSpec
from scenes.rig import MountingSpec, PlacementSpec, ServoSpec
from scenes.sensor import SensorSpec

__all__ = [
    "ExperimentSpec",
    "MountingSpec",
    "ObjectSpec",
    "PlacementSpec",
    "SensorSpec",
    "ServoSpec",
    "SpecError",
    "list_experiments",
    "list_objects",
    "list_sensors",
    "load_experiment",
    "load_mounting",
    "load_object",
    "load_sensor",
    "load_servo",
    "mounting_of",
    "user_spec_dir",
]
