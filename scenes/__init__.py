"""Specifications of sensors, objects, experiments and servo parameters, as data that are validated when they are loaded."""

from scenes.base import SpecError
from scenes.experiment import ExperimentSpec
from scenes.load import list_specifications, load_experiment, load_object, load_randomisation, load_sensor, load_servo, user_spec_dir
from scenes.object import ObjectSpec
from scenes.randomisation import RandomisationSpec
from scenes.rig import RigSpec
from scenes.sensor import SensorSpec
from scenes.servo import PlacementSpec, ServoSpec
