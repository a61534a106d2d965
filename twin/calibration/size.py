"""Gives a specification another size: all lengths in the same proportion."""

from typing import Any

from pydantic import BaseModel

from scenes.sensor import SensorSpec
from twin.errors import OptionError

RADII_MM = (1.0, 200.0)
"""Smallest and largest radius of a dome, mm."""


def of_radius(spec: SensorSpec, radius_mm: float) -> SensorSpec:
    """The specification with a dome of another radius, and every other length scaled by the same factor.

    A camera in px sees the scaled sensor as it saw the other one, because the picture of a pinhole does not change if the scene and its
    distance grow by the same factor. Angles, moduli (MPa) and everything in px stay as they are.

    Parameters
    ----------
    spec : SensorSpec
        With a dome (``skin.outer_radius_mm``).
    radius_mm : float

    Raises
    ------
    OptionError
        The radius lies outside of ``RADII_MM``.
    """
    require_radius(radius_mm)
    return spec.model_validate(_scale("", spec, radius_mm / spec.skin.outer_radius_mm))


def require_radius(radius_mm: float) -> None:
    """Raise OptionError unless a dome may have this radius."""
    least, most = RADII_MM
    if not least <= radius_mm <= most:
        raise OptionError(f"radius {radius_mm:g} mm: give the radius of the tip's dome, {least:g} to {most:g} mm (a TacTip has 20)")


def _scale(name: str, value: Any, factor: float) -> Any:
    """A value with this name, or all those of a section, lengths multiplied."""
    if isinstance(value, BaseModel):
        return {key: _scale(key, part, factor) for key, part in value}
    if isinstance(value, tuple):
        return tuple(_scale(name, each, factor) for each in value)
    if isinstance(value, int | float) and not isinstance(value, bool):
        if name.endswith("_per_mm"):
            return value / factor
        if name.endswith("_mm"):
            return value * factor
    return value
