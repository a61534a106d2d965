"""Measurement of the light at the edge of the disc that no formula describes (glue, burrs, glare), as a table by azimuth and radius."""

import numpy as np

from scenes.sensor import CameraSpec, HousingSpec, RimSpec, SensorSpec
from twin.camera.capture import expose
from twin.camera.projection import sensor_to_camera
from twin.evaluation.pictures.aligned import SATURATED, Aligned, to_light, with_changes
from twin.optics.glass import ray_table
from twin.optics.static_layer import RIM_UNIT, rim_places, static_layer

# Distances from the edge of the housing's opening, inwards and outwards, that the table covers, mm. No pin comes so near to the edge.
INSIDE_MM, OUTSIDE_MM = 1.75, 0.4
# Number of azimuths and of radii in the table. There are many radii, because the light changes steeply at the edge.
AZIMUTHS, RADII = 240, 32
# Rounds of correction, and share of the missing light that each round adds. Several rounds are needed, because blur and sharpening act
# after the correction.
ROUNDS, GAIN = 3, 0.9


def fit_rim(spec: SensorSpec, frames: list[Aligned], light: list[np.ndarray]) -> SensorSpec:
    """The specification with ``housing.rim``: the light of real frames minus that of rendered ones, mean over the frames.

    A saturated pixel never lowers the light.

    Parameters
    ----------
    spec : SensorSpec
        A specification in which everything else was fitted.
    frames : list of Aligned
    light : list of (H, W, 3) or (H, W) float
        Rendered light of each frame's state.
    """
    ring = spec.housing
    inner, outer = ring.aperture_radius_mm - INSIDE_MM, ring.aperture_radius_mm + OUTSIDE_MM
    cell, weight, pixels = _cells(spec.camera, ring, inner, outer)
    window = (0, 0, spec.camera.width_px, spec.camera.height_px)
    before = static_layer(spec, window)[0]
    table = np.zeros((AZIMUTHS, RADII, 3))
    if ring.rim is not None and np.shape(ring.rim.light) == table.shape:
        table += np.array(ring.rim.light) / RIM_UNIT
    total = np.maximum(np.bincount(cell.ravel(), weight.ravel(), minlength=AZIMUTHS * RADII), 1e-6)
    for _ in range(ROUNDS):
        spec = _with_rim(spec, inner, outer, table)
        more = static_layer(spec, window)[0] - before
        more = more if spec.camera.channels == "color" else more.mean(axis=2)
        missing = np.mean([_missing(spec, frame, np.maximum(lit + more, 0)) for frame, lit in zip(frames, light, strict=True)], axis=0)
        for k in range(3):
            flat = missing.reshape(missing.shape[0] * missing.shape[1], -1)[pixels, k if missing.ndim == 3 else 0]
            table[..., k] += GAIN * (
                np.bincount(cell.ravel(), (weight * flat[:, None]).ravel(), minlength=AZIMUTHS * RADII) / total
            ).reshape(AZIMUTHS, RADII)
    return _with_rim(spec, inner, outer, table)


def _with_rim(spec: SensorSpec, inner_mm: float, outer_mm: float, table: np.ndarray) -> SensorSpec:
    """The specification with a table (A, R, 3) of linear light as its rim."""
    rim = RimSpec(inner_mm=inner_mm, outer_mm=outer_mm, light=np.rint(RIM_UNIT * table).astype(int).tolist())
    return with_changes(spec, housing={"rim": rim.model_dump()})


def _missing(spec: SensorSpec, frame: Aligned, light: np.ndarray) -> np.ndarray:
    """Light of a real frame minus that of a render, in the renderer's unit."""
    shown = expose(light, spec.capture)
    lacking = to_light(frame.image, spec.response) - to_light(shown, spec.response)
    return np.where((frame.image >= SATURATED) & (shown >= SATURATED), 0.0, lacking)


def _cells(camera: CameraSpec, ring: HousingSpec, inner_mm: float, outer_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The four table entries (n, 4) around each pixel of the band, their bilinear weights (n, 4), and the pixels' flat indices (n,)."""
    corners = ray_table(camera, (0, 0, camera.width_px, camera.height_px)) @ sensor_to_camera(camera)[:3, :3]
    rays = ((corners[:-1, :-1] + corners[1:, 1:]) / 2).reshape(-1, 3)
    turn, along = rim_places(ring, inner_mm, outer_mm, (AZIMUTHS, RADII), rays[:, :2] / rays[:, 2:] * (ring.z_mm + camera.distance_mm))
    pixels = np.flatnonzero((along > 0) & (along < RADII - 1))
    turn, along = turn[pixels], along[pixels]
    row, column = np.floor(turn).astype(int), np.minimum(np.floor(along).astype(int), RADII - 2)
    a, b = turn - row, along - column
    cell = np.stack([(row + j) % AZIMUTHS * RADII + column + k for j in (0, 1) for k in (0, 1)], axis=1)
    weight = np.stack([(a if j else 1 - a) * (b if k else 1 - b) for j in (0, 1) for k in (0, 1)], axis=1)
    return cell, weight, pixels
