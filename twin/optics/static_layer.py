"""The static layer: everything that the camera sees besides the gel. This is the housing, the LEDs' reflections, and specks.

Contacts do not change this layer. It is computed once, without noise. Pictures of measured signed values (`values_of`) hold red, green and
blue as 8-bit levels that are fine near zero.
"""

import base64
from collections.abc import Sequence
from functools import lru_cache, partial

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from scenes.sensor import HousingSpec, LedRingSpec, SensorSpec, SpeckSpec, ViewSpec
from twin.camera.projection import sensor_to_camera
from twin.errors import FrameError
from twin.optics.direct_light import Patch, led_patches, lights
from twin.optics.glass import fresnel, ray_table, subpixel_rays
from twin.types import FloatArray

MIDDLE, STEPS = 128, 127
"""Level of the value 0, and number of levels on either side."""
QUALITY = 97
"""JPEG quality of a written picture. Its errors are below those of the measured values."""
ACROSS = 4
"""Number of places along each side of a pixel at which the layer is evaluated if the pixel's corners differ."""
EVEN = 0.02
"""Relative difference of a pixel's corners up to which their mean is the pixel's value."""
RIM_UNIT = 1000.0
"""Value in ``RimSpec.light`` for the light 1, because its numbers are thousandths of saturation."""
BACKGROUND_POWER = 2.2
"""Power of a background's levels (see ``BackgroundSpec.light``)."""
KEPT = 4
"""Number of layers in memory: those of the frame and of a window of it, before and after a change."""
SMALL = 1e-3
"""Smallest reference for the relative difference of light or cover within a pixel. Smaller values need no relative precision."""


def picture_of(values: FloatArray, span: float, power: float) -> str:
    """The data URI of values (H, W, 3), clipped to +-span. Level v stands for ``sign(v - 128) span (|v - 128| / 127)^power``."""
    share = np.minimum(np.abs(values) / span, 1) ** (1 / power)
    levels = np.rint(MIDDLE + STEPS * np.sign(values) * share).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, content = cv2.imencode(".jpg", np.ascontiguousarray(levels[..., ::-1]), options)
    return f"data:image/jpeg;base64,{base64.b64encode(content.tobytes()).decode('ascii')}"


def values_of(picture: str, span: float, power: float, what: str) -> FloatArray:
    """The values (H, W, 3) of a picture (see `picture_of`).

    Raises
    ------
    FrameError
        It is no picture; the message begins with ``what``.
    """
    try:
        content = np.frombuffer(base64.b64decode(picture.partition(",")[2], validate=True), np.uint8)
    except ValueError:
        content = np.zeros(0, np.uint8)
    decoded = cv2.imdecode(content, cv2.IMREAD_COLOR) if len(content) else None
    if decoded is None:
        raise FrameError(f"{what}: the picture can't be decoded; give the whole content of a PNG, JPEG or WebP file")
    share = (decoded[..., ::-1].astype(np.float32) - MIDDLE) / STEPS
    return np.asarray(np.sign(share) * np.abs(share) ** np.float32(power) * np.float32(span), np.float32)


def static_layer(spec: SensorSpec, window_px: tuple[int, int, int, int]) -> tuple[FloatArray, FloatArray]:
    """Light and cover of a window of the raw frame.

    The last few layers are stored. They are used again if only parameters change that do not affect them, such as the gel's haze and the
    caps.

    Returns
    -------
    light : (H, W, 3) float32
        Linear RGB that reaches the film independently of the gel.
    cover : (H, W) float32
        Share of the gel's light that is hidden: the film gets ``light + (1 - cover) * gel``. The array is shared and can't be written to.
    """
    view = spec.view.alter(camera={"vignetting": 0.0})
    ring = spec.housing.alter(background=None)
    light, cover = _compute_light(view, spec.leds, ring, spec.appearance.specks, tuple(window_px))
    return light + background_light(spec, window_px), cover


@lru_cache(maxsize=KEPT)
def _compute_light(
    view: ViewSpec, leds: LedRingSpec, ring: HousingSpec, specks: tuple[SpeckSpec, ...], window_px: tuple[int, int, int, int]
) -> tuple[FloatArray, FloatArray]:
    """Light (H, W, 3), without the measured background, and cover (H, W)."""
    table = ray_table(view.camera, window_px) @ sensor_to_camera(view.camera)[:3, :3]
    seen = partial(_look_along, view, leds, ring, specks)
    at_corners = np.concatenate([part.reshape(*part.shape[:2], -1) for part in seen(table)], axis=2)
    around = np.stack([at_corners[:-1, :-1], at_corners[:-1, 1:], at_corners[1:, :-1], at_corners[1:, 1:]])
    both = around.mean(axis=0)
    uneven = (np.ptp(around, axis=0) > EVEN * np.maximum(both, SMALL)).any(axis=2)
    rows, columns = np.nonzero(cv2.dilate(uneven.astype(np.uint8), np.ones((3, 3), np.uint8)))
    corners = np.stack([[table[rows + j, columns + i] for i in (0, 1)] for j in (0, 1)])
    light, hidden = seen(subpixel_rays(corners, ACROSS))
    both[rows, columns] = np.concatenate([light, hidden[..., None]], axis=2).mean(axis=1)
    seen_light, cover = both[..., :3].astype(np.float32), both[..., 3].astype(np.float32)
    for kept in (seen_light, cover):
        kept.flags.writeable = False
    return seen_light, cover


def background_light(spec: SensorSpec, window_px: tuple[int, int, int, int]) -> FloatArray:
    """Light (H, W, 3) of a window of the raw frame that was measured in addition to everything else (`BackgroundSpec`); may be negative.

    Raises
    ------
    FrameError
        The picture can't be read.
    """
    x0, y0, x1, y1 = window_px
    background, camera = spec.housing.background, spec.camera
    if background is None:
        return np.zeros((y1 - y0, x1 - x0, 3), np.float32)
    values = values_of(background.light, background.span, BACKGROUND_POWER, "housing.background.light")
    if values.shape[:2] != (camera.height_px, camera.width_px):
        values = cv2.resize(values, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA).astype(np.float32, copy=False)
    return values[y0:y1, x0:x1]


def _look_along(
    view: ViewSpec, leds: LedRingSpec, ring: HousingSpec, specks: Sequence[SpeckSpec], rays: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Light (..., 3) and cover (...) along rays from the pupil, whose directions (..., 3) are in the sensor frame and of any length."""
    tangents = rays[..., :2] / np.maximum(rays[..., 2:], 1e-9)
    at_ring = tangents * (ring.z_mm + view.camera.distance_mm)
    wall = beyond_aperture(ring, at_ring) >= 0
    light, cover = np.empty((*wall.shape, 3)), np.ones(wall.shape)
    light[wall] = housing_light(leds, ring, at_ring[wall])
    hidden, shine = _specks(view, specks, tangents[~wall])
    light[~wall] = reflections(view, leds, ring, tangents[~wall]) + shine
    cover[~wall] = hidden
    return light + rim_light(ring, at_ring), cover


def rim_light(ring: HousingSpec, at_mm: FloatArray) -> FloatArray:
    """Light (..., 3) that was measured in addition to the formulas, at places (..., 2) of the housing's plane; bilinear interpolation."""
    if ring.rim is None:
        return np.zeros((*at_mm.shape[:-1], 3))
    table = np.array(ring.rim.light, np.float32) / RIM_UNIT
    turn, along = rim_places(ring, ring.rim.inner_mm, ring.rim.outer_mm, table.shape[:2], at_mm)
    inside = (along >= 0) & (along <= table.shape[1] - 1)
    light = np.zeros((*turn.shape, 3))
    round_table = np.concatenate([table, table[:1]])
    at = turn[inside], along[inside]
    light[inside] = np.stack([map_coordinates(round_table[..., k], at, order=1, mode="nearest") for k in range(3)], axis=-1)
    return light


def rim_places(
    ring: HousingSpec, inner_mm: float, outer_mm: float, shape: tuple[int, int], at_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Row and column (...) of places (..., 2) of the housing's plane in a rim's table, which has ``shape`` azimuths and radii."""
    place = at_mm - ring.center_mm
    turn = np.arctan2(place[..., 1], place[..., 0]) % (2 * np.pi) / (2 * np.pi) * shape[0]
    along = (np.linalg.norm(place, axis=-1) - inner_mm) / (outer_mm - inner_mm) * (shape[1] - 1)
    return turn, along


def beyond_aperture(ring: HousingSpec, at_mm: FloatArray) -> FloatArray:
    """Distance (...) of places (..., 2) of the housing's plane from its opening, mm; negative within it."""
    place = at_mm - ring.center_mm
    if ring.aperture_mm is None:
        return np.sqrt(_squared_length(place)) - ring.aperture_radius_mm
    over = np.abs(place) - np.array(ring.aperture_mm) / 2
    return np.linalg.norm(np.maximum(over, 0), axis=-1) + np.minimum(over.max(axis=-1), 0)


def housing_light(leds: LedRingSpec, ring: HousingSpec, at_mm: FloatArray) -> FloatArray:
    """Radiance (..., 3) that the ring and wall send to the camera from places (..., 2) of their plane.

    ``albedo * power * (ambient * lit share of LEDs * exp(-(rho - aperture) / falloff)
    + glow * sum over LEDs of balance * (1 + |p - led|^2 / h^2)^-n)``. Beyond the lip this is multiplied by ``wall_fraction``.
    """
    patches = led_patches(leds)
    place = at_mm - ring.center_mm
    out = beyond_aperture(ring, at_mm)
    full = max(p.radiance.max() for p in patches) or 1.0
    shares = [p.radiance.max() / full for p in patches]
    light = ring.ambient * np.mean(shares) * np.exp(-np.maximum(out, 0) / ring.ambient_falloff_mm)
    for patch, share in zip(patches, shares, strict=True):
        led = patch.center_mm[:2] / np.linalg.norm(patch.center_mm[:2])
        away2 = _squared_length(place - ring.glow_radius_mm * led) / ring.glow_height_mm**2
        light = light + ring.glow * share * (1 + away2) ** -ring.glow_exponent
    light = leds.power * light * np.where(out < ring.lip_width_mm, 1.0, ring.wall_fraction)
    return light[..., None] * np.array(ring.albedo)


def reflections(view: ViewSpec, leds: LedRingSpec, ring: HousingSpec, tangents: FloatArray) -> FloatArray:
    """Radiance (..., 3) of the lights that both faces of the window reflect, for tangents (..., 2) of rays in air."""
    lens, distance = view.lens, view.camera.distance_mm
    u2 = _squared_length(tangents)
    cos_air = 1 / np.sqrt(1 + u2)
    sine2 = 1 - cos_air**2
    cos_window = np.sqrt(1 - sine2 / lens.refractive_index**2)
    cos_gel = np.sqrt(np.maximum(1 - sine2 / view.gel_index**2, 0))
    outer = fresnel(1 / lens.refractive_index, cos_air, cos_window)
    inner = fresnel(lens.refractive_index / view.gel_index, cos_window, cos_gel)
    from_front = (1 - outer) ** 2 * inner / (1 - outer * inner)
    # length of the detour through the window and back, with tan(window) / tan(air)
    detour = 2 * lens.thickness_mm * cos_air / (lens.refractive_index * cos_window)
    total: FloatArray = np.zeros((*u2.shape, 3))
    for patch in lights(leds, ring):
        straight = (lens.back_mm + distance) + (lens.back_mm - patch.center_mm[2])
        for weight, reach in ((outer, straight), (from_front, straight + detour)):
            at = tangents * np.asarray(reach)[..., None] - patch.center_mm[:2]
            total = total + (weight * _profile(leds, patch, at))[..., None] * patch.radiance
    return total


def _profile(leds: LedRingSpec, patch: Patch, at_mm: FloatArray) -> FloatArray:
    """A light's radiance at places (..., 2) about its centre, relative to its mean."""
    inner, outer = patch.radii_mm
    if outer > 0:
        rho = np.sqrt(_squared_length(at_mm))
        return ((rho >= inner) & (rho <= outer)).astype(float)
    along, across = np.moveaxis(np.abs(at_mm @ np.linalg.inv(patch.half_mm)), -1, 0)
    within = (along <= 1) & (across <= 1)
    share, sd = leds.core_share, leds.core_mm
    core = patch.area_mm2 / (2 * np.pi * sd**2) * np.exp(-_squared_length(at_mm) / (2 * sd**2)) if share else 0.0
    return leds.mirror_share * ((1 - share) * within + share * core)


def _specks(view: ViewSpec, specks: Sequence[SpeckSpec], tangents: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cover (...) and light (..., 3) of the specks on the window's gel side."""
    hidden, shine = np.zeros(tangents.shape[:-1]), np.zeros((*tangents.shape[:-1], 3))
    lens, u2 = view.lens, _squared_length(tangents)[..., None]
    within = 1 / np.sqrt(lens.refractive_index**2 + (lens.refractive_index**2 - 1) * u2)
    at = tangents * (lens.back_mm + view.camera.distance_mm + lens.thickness_mm * within)
    for speck in specks:
        squared = _squared_length(at - [speck.x_mm, speck.y_mm]) / speck.radius_mm**2
        on = squared < 1
        disc = np.minimum(2 - 2 * np.sqrt(squared[on]), 1)  # 1 up to half the radius
        hidden[on] = 1 - (1 - hidden[on]) * (1 - speck.opacity * disc)
        shine[on] += disc[:, None] * speck.light
    return hidden, shine


def _squared_length(vectors: FloatArray) -> FloatArray:
    """Squared lengths (...) of vectors (..., 2); a sum over an axis of two is several times slower."""
    return np.asarray(vectors[..., 0] ** 2 + vectors[..., 1] ** 2)
