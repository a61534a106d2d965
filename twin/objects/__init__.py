"""Objects as signed-distance fields, in the object frame (origin touched first, z into the object)."""

from twin.objects.build import ObjectField, build_field

__all__ = ["ObjectField", "build_field"]
