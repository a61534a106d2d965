"""Specifications: what exists. Sensors, objects and experiments as data, validated where they enter."""

from scenes.errors import SpecError
from scenes.experiment import ExperimentSpec
from scenes.load import (
    list_experiments,
    list_objects,
    list_randomisations,
    list_sensors,
    load_experiment,
    load_object,
    load_randomisation,
    load_sensor,
    user_spec_dir,
)
from scenes.object import ObjectSpec
from scenes.randomisation import RandomisationSpec
from scenes.rig import RigSpec
from scenes.sensor import SensorSpec

__all__ = [
    "ExperimentSpec",
    "ObjectSpec",
    "RandomisationSpec",
    "RigSpec",
    "SensorSpec",
    "SpecError",
    "list_experiments",
    "list_objects",
    "list_randomisations",
    "list_sensors",
    "load_experiment",
    "load_object",
    "load_randomisation",
    "load_sensor",
    "user_spec_dir",
]
