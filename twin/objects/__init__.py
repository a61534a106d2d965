"""Objects as signed-distance fields, in the object frame: the sensor touches the origin first, and z points into the object."""

from twin.objects.build import build_field
from twin.objects.level_set import ObjectField
