"""The specification of a TacTip: geometry, material, optics, camera, recording, pipeline, rig.

Sensor frame: origin at the centre of the dome's sphere, z out of the tip (apex at
``z = skin.outer_radius_mm``), x and y along the image's x (right) and y (down) of an
untilted camera. Lengths mm, stiffness MPa (N/mm^2), angles deg (files only), pixels px
with (0, 0) at the centre of the first pixel of the *raw* camera frame.
"""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from scenes.base import Fraction, Index, Name, NearOne, NonNegative, NotTruth, Positive, Rgb, Section
from scenes.rig import RigSpec


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
    """Gel between skin and lens.

    ``sealed``: its volume as a whole stays exactly constant, whatever its Poisson's ratio. ``absorption_per_mm``:
    Beer-Lambert coefficients for red, green and blue. ``haze``: share of the light towards the camera that the gel
    scatters forward, over a Gaussian of ``haze_sigma_px``.
    """

    sealed: bool = False
    refractive_index: Index = 1.41
    absorption_per_mm: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)
    haze: Fraction = 0.0
    haze_sigma_px: Positive = 20.0


class LensSpec(Section):
    """Rigid flat window (acrylic) that closes the gel; ``z_mm`` is its gel-side face. Behind it is air."""

    z_mm: float
    radius_mm: Positive
    thickness_mm: Positive = 2.0
    refractive_index: Index = 1.49

    @property
    def back_mm(self) -> float:
        """z of the face towards the camera."""
        return self.z_mm - self.thickness_mm


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
    """Camera in the air behind the window; refraction at the window comes on top of what is given here.

    ``distance_mm``: entrance pupil to dome centre (the pupil is at z = -distance). Tilts turn the camera about its
    pupil. ``projection``: ``perspective`` with Brown-Conrady distortion k1, k2, p1, p2 of the tangents, or ``fisheye``
    (Kannala and Brandt 2006) with theta (1 + k1 theta^2 + k2 theta^4). ``aperture_mm`` is the pupil's diameter (0:
    everything is sharp), ``focus_mm`` the distance in air, from the pupil, of what is sharp. ``vignetting`` is the
    share of light lost at the corners, rising with the square of the distance from the image's middle.
    ``red_scale`` and ``blue_scale``: size of these colours' images about (cx, cy) against green's; ``red_shift_px`` and
    ``blue_shift_px``: how far they are shifted.
    """

    width_px: Annotated[int, Field(ge=16, le=8192)]
    height_px: Annotated[int, Field(ge=16, le=8192)]
    channels: Literal["color", "mono"]
    projection: Literal["perspective", "fisheye"] = "perspective"
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
    aperture_mm: NonNegative = 0.0
    focus_mm: Positive = 50.0
    vignetting: Fraction = 0.0
    red_scale: NearOne = 1.0
    blue_scale: NearOne = 1.0
    red_shift_px: tuple[float, float] = (0.0, 0.0)
    blue_shift_px: tuple[float, float] = (0.0, 0.0)

    @model_validator(mode="after")
    def _check(self):
        if self.projection == "fisheye" and (self.p1 or self.p2):
            raise ValueError("p1 and p2 belong to projection = 'perspective'")
        return self


class LedRingSpec(Section):
    """LEDs in the air behind the window, shining along +z: azimuths in the sensor frame.

    Each is a square of ``size_mm`` at ``radius_mm`` from the axis in the plane ``z_mm``, turned to face the axis.
    ``power`` is the light of one LED (independent of its size), ``balance`` each one's share of it (empty: all 1),
    ``off`` lists indices of dead ones. In the LED's reflection in the window ``mirror_share`` of its light shows (the rest
    is hidden from there by the housing), ``core_share`` of it in the middle (a Gaussian of sd ``core_mm``).
    """

    azimuth_deg: Annotated[tuple[float, ...], Field(min_length=1, max_length=64)]
    radius_mm: Positive
    z_mm: float
    size_mm: Positive
    power: Positive = 1.0
    balance: tuple[NonNegative, ...] = ()
    color: Rgb = (1.0, 1.0, 1.0)
    off: tuple[int, ...] = ()
    mirror_share: Fraction = 1.0
    core_share: Fraction = 0.0
    core_mm: Positive = 0.3

    @model_validator(mode="after")
    def _check(self):
        if self.balance and len(self.balance) != len(self.azimuth_deg):
            raise ValueError("balance needs one number for each of azimuth_deg")
        return self


class RimSpec(Section):
    """Measured light of what no formula has: glue, burrs and glare where the housing meets the window.

    In the plane of the housing, about its centre, between the radii ``inner_mm`` and ``outer_mm``: ``light[j][k]`` is what is
    added (linear red, green, blue, thousandths of saturation, may be negative) at azimuth 2 pi j / A and the k-th of evenly spaced radii,
    linear between them.
    """

    inner_mm: Positive
    outer_mm: Positive
    light: Annotated[tuple[tuple[tuple[int, int, int], ...], ...], Field(min_length=3)]

    @model_validator(mode="after")
    def _check(self):
        if self.outer_mm <= self.inner_mm:
            raise ValueError("outer_mm must be larger than inner_mm")
        if len({len(row) for row in self.light}) > 1 or len(self.light[0]) < 2:
            raise ValueError("light needs the same number of radii, at least two, at every azimuth")
        return self


class HousingSpec(Section):
    """The bright ring and wall around the disc the camera sees, in the air.

    A flat annulus about (``center_mm``, ``z_mm``). Its light is relative to the LEDs' power: ``ambient``
    falls off outwards over ``ambient_falloff_mm``; each LED adds ``glow * (1 + d^2 / h^2)^-n`` at a distance
    d from its place at ``glow_radius_mm``, with h the ``glow_height_mm`` and n the ``glow_exponent`` (1.5: a
    small source at height h above matt material; higher: a glossy one). Outside a lip of ``lip_width_mm``
    the wall shows only ``wall_fraction`` of this light. ``fill`` is the radiance with which the innermost
    ``fill_width_mm`` of the ring light the gel. ``rim`` is the light measured on top of all that.
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
    fill: NonNegative = 0.0
    fill_width_mm: Positive = 4.0
    rim: RimSpec | None = None

    @model_validator(mode="after")
    def _check(self):
        if self.outer_radius_mm <= self.aperture_radius_mm:
            raise ValueError("outer_radius_mm must be larger than aperture_radius_mm")
        return self


class SpeckSpec(Section):
    """A bubble or grain on the window's gel side: a soft disc that hides ``opacity`` of what is behind it and sends ``light``."""

    x_mm: float
    y_mm: float
    radius_mm: Positive
    opacity: Fraction
    light: NonNegative = 0.0


class AppearanceSpec(Section):
    """Reflectances (linear, 0 to 1) of what the camera sees.

    ``skin_gloss`` and ``cap_gloss`` are the weights of a rough specular lobe. ``cap_bump`` is the share of the light that
    a cap takes as a small ball would, whatever its direction, not as a flat disc: printed caps are round and translucent.
    ``cap_levels`` is each cap's reflectance relative to ``cap_albedo``, in pin order, where it has been measured; without
    them ``cap_variation`` is the relative sd of a random pattern of number ``cap_pattern`` (another number: another print
    of the sensor). ``cap_shapes``: each cap's outline, relative to a circle, as measured: coefficients a_0, a_2, b_2, a_3,
    b_3, ... of ``1 + a_0 + sum a_m cos(m t) + b_m sin(m t)``, t turning from the sensor's x towards y; ``cap_offsets``: a_1, b_1,
    by which its middle lies beside the pin's, in cap radii.
    """

    skin_albedo: Rgb
    skin_gloss: Fraction = 0.0
    skin_roughness: Annotated[float, Field(ge=0.05, le=1)] = 0.25
    pin_albedo: Rgb
    cap_albedo: Rgb
    cap_gloss: Fraction = 0.0
    cap_roughness: Annotated[float, Field(ge=0.05, le=1)] = 0.25
    cap_bump: Fraction = 0.0
    cap_variation: Fraction = 0.0
    cap_pattern: Annotated[int, Field(ge=0)] = 0
    cap_levels: tuple[Positive, ...] = ()
    cap_shapes: tuple[tuple[float, ...], ...] = ()
    cap_offsets: tuple[tuple[float, float], ...] = ()
    specks: tuple[SpeckSpec, ...] = ()


class ResponseSpec(Section):
    """From linear light to 8-bit gray levels, in this order.

    ``blur_sigma_px`` of the optics; ``exposure`` and ``white_balance``; ``brightness_drift``: relative sd of a gain
    drawn for each frame; noise with variance ``read_noise^2 + shot_noise * light``, light 1 being saturation;
    ``sharpening``: weight of the unsharp mask of ``sharpening_sigma_px`` that cameras apply to the luma, not to its noise, which
    they smooth by ``noise_sigma_px``; the curve ``black + (255 - black) light^(1 / gamma)``;
    ``chroma_sigma_px``: further blur of the light that the colour differences are made of, of which ``chroma_columns``
    neighbours have the first one's (2: a 4:2:2 stream); ``stream``: whole numbers of luma and colour differences (ITU-R BT.601
    or BT.709, studio range)
    that the frame comes as, or "rgb"; ``jpeg_quality`` of the stream (0: not compressed).
    """

    exposure: Positive
    gamma: Positive
    black_level: Annotated[float, Field(ge=0, lt=128)]
    white_balance: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    blur_sigma_px: NonNegative
    brightness_drift: Fraction = 0.0
    read_noise: NonNegative = 2e-4
    shot_noise: NonNegative = 6e-5
    sharpening: NonNegative = 0.0
    sharpening_sigma_px: Positive = 1.5
    chroma_sigma_px: NonNegative = 0.0
    chroma_columns: Annotated[Literal[1, 2], NotTruth] = 1
    noise_sigma_px: NonNegative = 0.0
    stream: Literal["rgb", "bt601", "bt709"] = "rgb"
    jpeg_quality: Annotated[int, Field(ge=0, le=100)] = 0


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
    """A TacTip, complete. ``name`` is the file's stem; ``rig`` is there where contacts of this sensor on a robot were calibrated."""

    name: Name
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
    rig: RigSpec | None = None

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
        if self.camera.distance_mm <= -self.lens.back_mm:
            raise ValueError("camera.distance_mm must put the pupil behind the window (greater than lens.thickness_mm - lens.z_mm)")
        if self.leds.z_mm > self.lens.back_mm:
            raise ValueError("leds.z_mm must not lie in front of the window's back (lens.z_mm - lens.thickness_mm)")
        shapes = self.appearance.cap_shapes
        if shapes and ({len(c) % 2 for c in shapes} != {1} or len({len(c) for c in shapes}) > 1 or len(shapes) != pins.count):
            raise ValueError(f"appearance.cap_shapes needs a_0 and the same number of pairs for each of the {pins.count} pins")
        if self.appearance.cap_levels and len(self.appearance.cap_levels) != pins.count:
            raise ValueError(f"appearance.cap_levels needs one number for each of the {pins.count} pins")
        if (self.recording is None) != (self.pipeline.recording is None):
            raise ValueError("recording and pipeline.recording go together: give both or neither")
        return self
