"""Another film for the same view."""

from scenes.sensor import SensorSpec


def scaled(spec: SensorSpec, scale: float) -> SensorSpec:
    """The same view on another number of pixels."""
    camera, sizes = spec.camera, ("width_px", "height_px", "fx_px", "fy_px")
    changed = {name: type(getattr(camera, name))(scale * getattr(camera, name)) for name in sizes}
    changed |= {name: scale * (getattr(camera, name) + 0.5) - 0.5 for name in ("cx_px", "cy_px")}
    return spec.model_copy(update={"camera": camera.model_copy(update=changed)})
