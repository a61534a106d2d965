"""The specification of a TacTip: geometry, material, optics, camera, recording, pipeline.

Sensor frame: origin at the centre of the dome's sphere, z out of the tip (apex at
``z = skin.outer_radius_mm``), x and y along the image's x (right) and y (down) of an
untilted camera. Lengths mm, stiffness MPa (N/mm^2), angles deg (files only), pixels px
with (0, 0) at the centre of the first pixel of the *raw* camera frame.
"""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from scenes.base import Fraction, NonNegative, Positive, Rgb, Section


class RelaxationTerm(Section):
    """A part of the shear stiffness that relaxes (one Maxwell element): ``fraction`` of it, with time constant ``time_s``."""

    fraction: Annotated[float, Field(gt=0, lt=1)]
    time_s: Positive


class MaterialSpec(Section):
    """A nearly incompressible rubber: Young's modulus and Poisson's ratio at rest, and how it stiffens.

    ``law``: ``neo-hookean``; ``mooney-rivlin``, where ``second_invariant_share`` is c01 / (c10 + c01);
    ``yeoh``, with ``c20_c10`` and ``c30_c10`` relative to c10. ``relaxation``: a Prony series; the moduli
    above are the fast ones, before anything has relaxed.
    """

    young_modulus_mpa: Positive
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)]
    law: Literal["neo-hookean", "mooney-rivlin", "yeoh"] = "neo-hookean"
    second_invariant_share: Fraction = 0.0
    c20_c10: NonNegative = 0.0
    c30_c10: NonNegative = 0.0
    relaxation: tuple[RelaxationTerm, ...] = ()

    @model_validator(mode="after")
    def _check_law(self):
        if self.law != "mooney-rivlin" and self.second_invariant_share:
            raise ValueError("second_invariant_share belongs to law = 'mooney-rivlin'")
        if self.law != "yeoh" and (self.c20_c10 or self.c30_c10):
            raise ValueError("c20_c10 and c30_c10 belong to law = 'yeoh'")
        if sum(term.fraction for term in self.relaxation) >= 1:
            raise ValueError("the fractions of relaxation must sum to less than 1: some stiffness must stay")
        return self


class SkinSpec(MaterialSpec):
    """Hemispherical skin, clamped in the rim plane ``z = rim_z_mm``."""

    outer_radius_mm: Positive
    thickness_mm: Positive
    rim_z_mm: float = 0.0


class GelSpec(MaterialSpec):
    """Gel between skin and lens. ``sealed``: its volume as a whole stays exactly constant, whatever its Poisson's ratio."""

    sealed: bool = False


class LensSpec(Section):
    """Rigid flat window that closes the gel; ``z_mm`` is its gel-side face."""

    z_mm: float
    radius_mm: Positive


class PinsSpec(Section):
    """Pins on the skin's inside, normal to it.

    ``rings``: ring i has 6 i pins. ``hexagon``: hexagonal rings of 6 i pins. Both have
    1 + 3 r (r + 1) pins for r rings, ``max_polar_deg`` being the outermost (corner) pin's
    polar angle. ``spacing``: the ring's (flat hexagon's) radius is proportional to the polar
    angle (``polar``), or to its sine, so that the pins are even in plan (``plan``).
    ``phase_deg`` is the azimuth of the first pin of each ring, from x towards y.
    """

    layout: Literal["rings", "hexagon"]
    spacing: Literal["polar", "plan"] = "polar"
    rings: Annotated[int, Field(ge=1, le=40)]
    max_polar_deg: Annotated[float, Field(gt=0, lt=90)]
    phase_deg: float = 0.0
    length_mm: Positive
    diameter_mm: Positive
    cap_diameter_mm: Positive
    cap_height_mm: Positive

    @property
    def count(self) -> int:
        """Number of pins N."""
        return 1 + 3 * self.rings * (self.rings + 1)


class CameraSpec(Section):
    """Effective pinhole camera, seen from inside the gel (window refraction absorbed).

    ``distance_mm``: pinhole to dome centre (the pinhole is at z = -distance). Tilts turn the
    camera about its pinhole. Distortion: Brown-Conrady k1, k2, p1, p2 on normalised coordinates.
    """

    width_px: Annotated[int, Field(ge=16, le=8192)]
    height_px: Annotated[int, Field(ge=16, le=8192)]
    channels: Literal["color", "mono"]
    fx_px: Positive
    fy_px: Positive
    cx_px: float
    cy_px: float
    distance_mm: Positive
    tilt_x_deg: Annotated[float, Field(ge=-30, le=30)] = 0.0
    tilt_y_deg: Annotated[float, Field(ge=-30, le=30)] = 0.0
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


class LedRingSpec(Section):
    """LEDs as apparent emitters on the gel's side (refraction absorbed): azimuths in the sensor frame.

    Each is a square of ``size_mm`` at ``radius_mm`` from the axis in the plane ``z_mm``, shining along +z.
    ``off`` lists indices of dead ones.
    """

    azimuth_deg: Annotated[tuple[float, ...], Field(min_length=1, max_length=64)]
    radius_mm: Positive
    z_mm: float
    size_mm: Positive
    power: Positive = 1.0
    color: Rgb = (1.0, 1.0, 1.0)
    off: tuple[int, ...] = ()


class HousingSpec(Section):
    """The bright ring and wall around the disc the camera sees, at its apparent place.

    A flat annulus about (``center_mm``, ``z_mm``). Its light is relative to the LEDs' power: ``ambient``
    falls off outwards over ``ambient_falloff_mm``; each LED adds ``glow * (1 + d^2 / h^2)^-n`` at a distance
    d from its place at ``glow_radius_mm``, with h the ``glow_height_mm`` and n the ``glow_exponent`` (1.5: a
    small source at height h above matt material; higher: a glossy one). Outside a lip of ``lip_width_mm``
    the wall shows only ``wall_fraction`` of this light.
    """

    aperture_radius_mm: Positive
    outer_radius_mm: Positive
    z_mm: float
    center_mm: tuple[float, float] = (0.0, 0.0)
    albedo: Rgb
    ambient: NonNegative = 1.5
    ambient_falloff_mm: Positive = 20.0
    glow: NonNegative = 6.0
    glow_radius_mm: Positive
    glow_height_mm: Positive = 1.5
    glow_exponent: Positive = 1.5
    lip_width_mm: NonNegative = 1.0
    wall_fraction: Fraction = 1.0

    @model_validator(mode="after")
    def _check(self):
        if self.outer_radius_mm <= self.aperture_radius_mm:
            raise ValueError("outer_radius_mm must be larger than aperture_radius_mm")
        return self


class AppearanceSpec(Section):
    """Reflectances (linear, 0 to 1) of what the camera sees, and the LEDs' reflections in the lens.

    A glint is a square of ``glint_size_mm`` at ``glint_radius_mm`` in the housing's plane; its strength is
    relative to the LEDs' power, 0 for none. ``cap_variation`` is the relative sd of the caps' reflectance
    from pin to pin, a fixed pattern of ``cap_pattern`` (another number: another print of the same sensor).
    """

    skin_albedo: Rgb
    skin_gloss: Fraction
    pin_albedo: Rgb
    cap_albedo: Rgb
    cap_variation: Fraction = 0.0
    cap_pattern: Annotated[int, Field(ge=0)] = 0
    glint_strength: Fraction = 0.5
    glint_radius_mm: Positive = 16.5
    glint_size_mm: Positive = 1.0


class ResponseSpec(Section):
    """From linear light to 8-bit gray levels: exposure, response curve, blur, noise."""

    exposure: Positive
    gamma: Positive
    black_level: Annotated[float, Field(ge=0, lt=128)]
    white_balance: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    blur_sigma_px: NonNegative
    noise_sd: NonNegative


class RecordingSpec(Section):
    """The capture side of the sensor's recordings: crop, adaptive threshold, resize.

    ``crop_px`` = (x0, y0, x1, y1), end exclusive; ``threshold_block_px`` and
    ``threshold_offset`` as OpenCV's adaptiveThreshold takes them.
    """

    crop_px: tuple[int, int, int, int]
    width_px: Annotated[int, Field(ge=16)]
    height_px: Annotated[int, Field(ge=16)]
    threshold_block_px: Annotated[int, Field(ge=3)]
    threshold_offset: float

    @model_validator(mode="after")
    def _check(self):
        x0, y0, x1, y1 = self.crop_px
        if x1 <= x0 or y1 <= y0:
            raise ValueError("crop_px must be (x0, y0, x1, y1) with x1 > x0 and y1 > y0")
        if self.threshold_block_px % 2 == 0:
            raise ValueError("threshold_block_px must be odd")
        return self


class BlobSpec(Section):
    """How pins are found in one form of the sensor's frames.

    All lengths are in px of that form's own frame. ``threshold`` is a fixed gray level
    (0-255) where ``threshold_block_px`` is 0, else the offset of an adaptive mean threshold
    over that block. ``erosion_px`` is the size of the square erosion kernel (1: none).
    """

    threshold: float
    threshold_block_px: Annotated[int, Field(ge=0)] = 0
    erosion_px: Annotated[int, Field(ge=1)] = 1
    mask_center_px: tuple[float, float]
    mask_radius_px: Positive
    min_area_px2: NonNegative = 1.0


class PipelineSpec(Section):
    """Pin detection for the camera's own frames and for the recordings' form."""

    raw: BlobSpec
    recording: BlobSpec | None = None


class SensorSpec(Section):
    """A TacTip, complete. ``name`` is the file's stem."""

    name: str
    description: str
    source: str
    skin: SkinSpec
    gel: GelSpec
    lens: LensSpec
    pins: PinsSpec
    camera: CameraSpec
    leds: LedRingSpec
    housing: HousingSpec
    appearance: AppearanceSpec
    response: ResponseSpec
    recording: RecordingSpec | None = None
    pipeline: PipelineSpec

    @model_validator(mode="after")
    def _check(self):
        skin, pins = self.skin, self.pins
        inner_mm = skin.outer_radius_mm - skin.thickness_mm
        if inner_mm <= 0:
            raise ValueError("skin.thickness_mm must be smaller than skin.outer_radius_mm")
        if pins.length_mm + pins.cap_height_mm >= inner_mm:
            raise ValueError("pins.length_mm + pins.cap_height_mm must be smaller than the inner radius of the skin")
        if self.lens.z_mm > skin.rim_z_mm:
            raise ValueError("lens.z_mm must not lie in front of skin.rim_z_mm")
        if self.skin.rim_z_mm >= inner_mm * math.cos(math.radians(pins.max_polar_deg)):
            raise ValueError("pins.max_polar_deg puts pins behind skin.rim_z_mm")
        if self.camera.distance_mm <= -self.lens.z_mm:
            raise ValueError("camera.distance_mm must put the pinhole behind the lens (greater than -lens.z_mm)")
        if (self.recording is None) != (self.pipeline.recording is None):
            raise ValueError("recording and pipeline.recording go together: give both or neither")
        return self
