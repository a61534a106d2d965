"""The specification of a TacTip: geometry, material, optics, camera, recording, pipeline, rig.

Sensor frame: origin at the centre of a cap's sphere or in the middle of a flat pad's outside, z out of the tip
(apex at ``z = skin.apex_mm``), x and y along the image's x (right) and y (down) of an
untilted camera. Lengths mm, stiffness MPa (N/mm^2), angles deg (files only), pixels px
with (0, 0) at the centre of the first pixel of the *raw* camera frame.
"""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from scenes.base import Fraction, Index, Name, NearOne, NonNegative, NotTruth, Picture, Positive, Rgb, Section
from scenes.body import GelSpec, SkinSpec
from scenes.pins import PinsSpec
from scenes.rig import RigSpec

ELSEWHERE = "leave it out if it was measured on another layout"
"""What to do with caps that were measured and do not fit."""


class LensSpec(Section):
    """Rigid flat window (acrylic) that closes the gel. Behind it is air.

    Attributes
    ----------
    z_mm : float
        Plane of its gel-side face.
    radius_mm : float
        Of the window. The default is measured from public CAD of the TacTip.
    thickness_mm : float
        From face to face.
    refractive_index : float
        The default is that of acrylic.
    """

    z_mm: float = -2.0
    radius_mm: Positive = 19.25
    thickness_mm: Positive = 2.0
    refractive_index: Index = 1.49

    @property
    def back_mm(self) -> float:
        """z of the face towards the camera."""
        return self.z_mm - self.thickness_mm


class CameraSpec(Section):
    """Camera in the air behind the window. Refraction at the window is not part of these numbers: it comes on top.

    Attributes
    ----------
    width_px, height_px : int
        Size of a frame.
    channels : {"color", "mono"}
        Whether frames are in colour or gray.
    projection : {"perspective", "fisheye"}
        Perspective: Brown-Conrady distortion k1, k2, p1, p2 of the tangents. Fisheye: theta (1 + k1 theta^2 + k2 theta^4)
        (Kannala and Brandt 2006).
    fx_px, fy_px, cx_px, cy_px : float
        Focal lengths and principal point.
    distance_mm : float
        From the entrance pupil to the origin (a cap's centre, a pad's outside): the pupil is at z = -distance. Negative where a shallow
        cap's centre lies behind the pupil.
    tilt_x_deg, tilt_y_deg : float
        The camera is turned about its pupil.
    k1, k2, p1, p2 : float
        Distortion: radial (k) and tangential (p), as ``projection`` says.
    aperture_mm : float
        The pupil's diameter; 0: everything is sharp.
    focus_mm : float
        Distance in air, from the pupil, of what is sharp, where ``aperture_mm`` is above 0. The default is near a TacTip's caps.
    vignetting : float
        Share of light that is lost at the corners; it rises with the square of the distance from the image's middle.
    red_scale, blue_scale : float
        Size of these colours' images about the principal point, relative to green's.
    red_shift_px, blue_shift_px : (x, y)
        How far these images are shifted.
    """

    width_px: Annotated[int, Field(ge=16, le=8192)]
    height_px: Annotated[int, Field(ge=16, le=8192)]
    channels: Literal["color", "mono"] = "mono"
    projection: Literal["perspective", "fisheye"] = "perspective"
    fx_px: Positive
    fy_px: Positive
    cx_px: float
    cy_px: float
    distance_mm: float
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
    def _check(self) -> Self:
        if self.projection == "fisheye" and (self.p1 or self.p2):
            raise ValueError("p1 and p2 belong to projection = 'perspective'")
        return self


class LedRingSpec(Section):
    """LEDs in the air behind the window, shining along +z. Each is a square that is turned to face the axis.

    The defaults are a ring of six like that of the UR5's TacTip; 'twin calibrate optics' finds a sensor's own.

    Attributes
    ----------
    azimuth_deg : tuple of float
        One for each LED, sensor frame.
    radius_mm, z_mm : float
        Distance from the axis, and plane.
    size_mm : float
        Side of the square.
    power : float
        Light of one LED, whatever its size.
    balance : tuple of float
        Factor on each LED's power; empty: all 1.
    color : three numbers
        Linear RGB.
    off : tuple of int
        Indices of dead LEDs.
    mirror_share : float
        Share of an LED's light that shows in its reflection in the window; the housing hides the rest from there.
    core_share : float
        Share of that light in the middle of the LED.
    core_mm : float
        Sd of the Gaussian that stands for the middle.
    """

    azimuth_deg: Annotated[tuple[float, ...], Field(min_length=1, max_length=64)] = (0.0, 60.0, 120.0, 180.0, 240.0, 300.0)
    radius_mm: Positive = 16.7
    z_mm: float = -6.1
    size_mm: Positive = 1.1
    power: Positive = 1.0
    balance: tuple[NonNegative, ...] = ()
    color: Rgb = (1.0, 1.0, 1.0)
    off: tuple[int, ...] = ()
    mirror_share: Fraction = 1.0
    core_share: Fraction = 0.0
    core_mm: Positive = 0.3

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.balance and len(self.balance) != len(self.azimuth_deg):
            raise ValueError("balance needs one number for each of azimuth_deg")
        return self


class RimSpec(Section):
    """Measured light where the housing meets the window, on top of the formulas: glue, burrs, glare.

    Attributes
    ----------
    inner_mm, outer_mm : float
        Radii about the housing's centre, in its plane, between which the light was measured.
    light : (A, R, 3) int
        Added linear red, green and blue in thousandths of saturation, may be negative. Row j is at azimuth 2 pi j / A, column k at
        the k-th of R evenly spaced radii; linear between them.
    """

    inner_mm: Positive
    outer_mm: Positive
    light: Annotated[tuple[tuple[tuple[int, int, int], ...], ...], Field(min_length=3)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.outer_mm <= self.inner_mm:
            raise ValueError("outer_mm must be larger than inner_mm")
        if len({len(row) for row in self.light}) > 1 or len(self.light[0]) < 2:
            raise ValueError("light needs the same number of radii, at least two, at every azimuth")
        return self


class BackgroundSpec(Section):
    """Measured light of everything that contacts do not change, on top of the formulas: housing, flare, glints, bubbles.

    The default of ``span`` is that of 'twin calibrate optics'.

    Attributes
    ----------
    light : picture of the camera's whole frame, red, green and blue; of another size it is scaled to the frame
        Added linear light, which may be negative. A level v stands for ``sign(v - 128) span (|v - 128| / 127)^2.2``.
    span : float
        Light of the levels 255 and (negative) 1, as a share of saturation.
    """

    light: Picture
    span: Positive = 2.0


class HousingSpec(Section):
    """The bright ring and wall around the disc that the camera sees: a flat annulus in the air.

    The defaults are those of the UR5's TacTip, without what was measured of its rim.

    Its light is relative to the LEDs' power (formula: ``twin.optics.static_layer.housing_light``).

    Attributes
    ----------
    aperture_radius_mm, outer_radius_mm : float
        Of the annulus.
    aperture_mm : (width, height), optional
        Of a rectangular opening, along x and y, instead of the round one.
    z_mm, center_mm : float, (x, y)
        Its plane and its centre.
    albedo : three numbers
        Linear RGB.
    ambient : float
        Light at the inner edge.
    ambient_falloff_mm : float
        Length over which that light falls off outwards.
    glow, glow_radius_mm, glow_height_mm, glow_exponent : float
        Each LED adds ``glow (1 + d^2 / h^2)^-n`` at the distance d from its place at ``glow_radius_mm``, with h the
        ``glow_height_mm`` and n the ``glow_exponent``. n = 1.5: a small source at the height h above matt material; higher: glossy.
    lip_width_mm, wall_fraction : float
        Farther out than the lip's width the wall shows only this share of the light.
    fill, fill_width_mm : float
        Radiance with which the innermost ``fill_width_mm`` of the ring light the gel.
    rim : RimSpec, optional
        Light measured on top of all that.
    background : BackgroundSpec, optional
        Light measured on top of the rim's, at each pixel of the frame.
    """

    aperture_radius_mm: Positive = 16.6
    aperture_mm: tuple[Positive, Positive] | None = None
    outer_radius_mm: Positive = 60.0
    z_mm: float = -4.0
    center_mm: tuple[float, float] = (0.0, 0.0)
    albedo: Rgb = (0.9, 0.91, 0.77)
    ambient: NonNegative = 1.5
    ambient_falloff_mm: Positive = 20.0
    glow: NonNegative = 6.0
    glow_radius_mm: Positive = 16.3
    glow_height_mm: Positive = 1.5
    glow_exponent: Positive = 1.5
    lip_width_mm: NonNegative = 1.0
    wall_fraction: Fraction = 1.0
    fill: NonNegative = 0.0
    fill_width_mm: Positive = 4.0
    rim: RimSpec | None = None
    background: BackgroundSpec | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.outer_radius_mm <= self.aperture_radius_mm:
            raise ValueError("outer_radius_mm must be larger than aperture_radius_mm")
        return self


class SpeckSpec(Section):
    """A bubble or grain on the window's gel side: a soft disc.

    Attributes
    ----------
    x_mm, y_mm : float
        Its middle in the sensor frame.
    radius_mm : float
        Of the disc.
    opacity : float
        Share of the light from behind it that it hides.
    light : float
        Radiance that it sends itself, as a share of saturation.
    """

    x_mm: float
    y_mm: float
    radius_mm: Positive
    opacity: Fraction
    light: NonNegative = 0.0


class ReliefSpec(Section):
    """What was measured of caps and of the skin around them: light added to the smooth model's, at places fixed to each cap.

    Each pin has a square tile of cells in the plane of its cap. The tile moves and turns with the cap, and the lights that light
    the cap light it: the added light is the tile's value times the light of the smooth cap, so that a darker cap or lamp makes it darker.
    A place belongs to the nearest cap.
    The defaults are a tile of both caps and skin as it was measured.

    Attributes
    ----------
    tiles : picture
        Red, green and blue of all tiles, row by row, as many in a row as fit the picture's width. A level v stands for the
        share ``sign(v - 128) span (|v - 128| / 127)^1.5`` of the smooth cap's light, which may be negative.
    count : int
        Number of tiles.
    span : float
        Share of the levels 255 and (negative) 1.
    cells : int
        Cells along a tile's side; between their centres the value is bilinear.
    reach : float
        Distance of a tile's outermost cell centres from its middle along the sides, cap radii. One side is along the projection of the
        sensor's x.
    caps, skin : bool
        Whether the tiles are used on the caps with their edges (up to ``SKIN_FROM`` cap radii), and on the skin around.
    pattern : int
        0: each pin has its own tile. Another number is another print of the sensor: each pin's tile is drawn at random, with the mean
        and the covariance of all measured tiles.
    """

    tiles: Picture
    count: Annotated[int, Field(ge=1)]
    span: Positive = 0.5
    cells: Annotated[int, Field(ge=3)]
    reach: Positive
    caps: bool = True
    skin: bool = True
    pattern: Annotated[int, Field(ge=0)] = 0


class AppearanceSpec(Section):
    """Reflectances (linear RGB, 0 to 1) of what the camera sees in the gel.

    The defaults of skin, pins and caps are those fitted to the UR5's TacTip.

    Attributes
    ----------
    skin_albedo, pin_albedo, cap_albedo : three numbers
        Diffuse reflectance: red, green, blue.
    skin_gloss, cap_gloss : float
        Weight of a rough specular lobe.
    skin_roughness, cap_roughness : float
        Roughness of that lobe.
    cap_bump : float
        Share of the light that a cap takes as a small ball does, from any direction, and not as a flat disc: printed caps are
        round and translucent.
    cap_levels : tuple of float
        Reflectance of each cap relative to ``cap_albedo``, in pin order, where it was measured.
    cap_variation, cap_pattern : float, int
        Where no levels were measured: relative sd, and number, of a random pattern. Another number is another print of the sensor.
    cap_shapes : (N, 1 + 2 n) float
        Measured outline of each cap relative to a circle: a_0, a_2, b_2, a_3, b_3, ... of ``1 + a_0 + sum a_m cos(m t) + b_m sin(m t)``,
        t turning from the sensor's x towards y.
    cap_offsets : (N, 2) float
        a_1 and b_1: how far the outline's middle lies beside the pin's, in cap radii.
    specks : tuple of SpeckSpec
        Bubbles and grains on the window.
    relief : ReliefSpec, optional
        What was measured of each cap and of the skin around it.
    """

    skin_albedo: Rgb = (0.0006, 0.00048, 0.0055)
    skin_gloss: Fraction = 0.0
    skin_roughness: Annotated[float, Field(ge=0.05, le=1)] = 0.25
    pin_albedo: Rgb = (0.00075, 0.00065, 0.0072)
    cap_albedo: Rgb = (0.211, 0.411, 0.8)
    cap_gloss: Fraction = 0.0
    cap_roughness: Annotated[float, Field(ge=0.05, le=1)] = 0.25
    cap_bump: Fraction = 0.0
    cap_variation: Fraction = 0.0
    cap_pattern: Annotated[int, Field(ge=0)] = 0
    cap_levels: tuple[Positive, ...] = ()
    cap_shapes: tuple[tuple[float, ...], ...] = ()
    cap_offsets: tuple[tuple[float, float], ...] = ()
    specks: tuple[SpeckSpec, ...] = ()
    relief: ReliefSpec | None = None


class ResidualSpec(Section):
    """A small network that adds to a colour frame what the models of light and camera leave out, before the stream rounds it.

    It makes frames look like the camera's. Pins do not need it: it moves their centroids by a few hundredths of a pixel. It is off unless
    ``used`` is set, and belongs to the calibration that it was taught with.

    Attributes
    ----------
    weights : tuple of float
        Kernels and biases of its four convolutions, one after the other.
    channels, noises : int
        Number of channels within, and of random numbers at each pixel.
    center_px, radius_px : two numbers, float
        It acts within this circle of the full frame: the lens disc.
    used : bool
        Whether frames get it.
    """

    weights: tuple[float, ...]
    channels: Annotated[int, Field(ge=1, le=64)]
    noises: Annotated[int, Field(ge=0, le=8)]
    center_px: tuple[float, float]
    radius_px: Positive
    used: bool = False

    @property
    def shapes(self) -> list[tuple[int, int, int, int]]:
        """Shapes (out, in, k, k) of the four kernels."""
        inner = (self.channels, self.channels, 3, 3)
        return [(self.channels, 3 + self.noises, 5, 5), inner, inner, (3, self.channels, 3, 3)]

    @model_validator(mode="after")
    def _check_count(self) -> Self:
        expected = sum(math.prod(shape) + shape[0] for shape in self.shapes)
        if len(self.weights) != expected:
            raise ValueError(f"weights has {len(self.weights)} numbers, {self.channels} channels and {self.noises} noises need {expected}")
        return self


class ResponseSpec(Section):
    """From linear light to 8-bit gray levels. The steps follow one another in this order.

    The defaults are plausible numbers for a USB camera; 'twin calibrate optics' finds a sensor's own.

    Attributes
    ----------
    blur_sigma_px : float
        Blur of the optics.
    exposure, white_balance : float, three numbers
        Gain, and gain of each colour.
    brightness_drift : float
        Relative sd of a gain that is drawn for each frame.
    read_noise, shot_noise : float
        The noise has the variance ``read_noise^2 + shot_noise * light``; light 1 is saturation.
    noise_sigma_px : float
        The camera smooths the luma's noise by this.
    sharpening, sharpening_sigma_px : float
        Weight and sd of the unsharp mask that the camera applies to the luma, not to its noise.
    gamma, black_level : float
        The curve is ``black + (255 - black) light^(1 / gamma)``.
    chroma_sigma_px : float
        Blur of the colour differences, in gray levels.
    chroma_median_px : {0, 3, 5}
        Side of the square over which the camera then takes their median, which keeps edges (0: none).
    chroma_columns : {1, 2}
        This many neighbouring columns share the colour differences of the first one (2: a 4:2:2 stream).
    stream : {"rgb", "bt601", "bt709"}
        The frame comes as whole numbers of luma and colour differences (ITU-R BT.601 or BT.709, studio range), or as RGB.
    jpeg_quality : int
        Of the stream; 0: not compressed.
    residual : ResidualSpec, optional
        A small network that comes before the stream, if it is switched on.
    """

    exposure: Positive = 1.0
    gamma: Positive = 2.2
    black_level: Annotated[float, Field(ge=0, lt=128)] = 4.0
    white_balance: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    blur_sigma_px: NonNegative = 0.6
    brightness_drift: Fraction = 0.0
    read_noise: NonNegative = 2e-4
    shot_noise: NonNegative = 6e-5
    sharpening: NonNegative = 0.0
    sharpening_sigma_px: Positive = 1.5
    chroma_sigma_px: NonNegative = 0.0
    chroma_median_px: Annotated[Literal[0, 3, 5], NotTruth] = 0
    chroma_columns: Annotated[Literal[1, 2], NotTruth] = 1
    noise_sigma_px: NonNegative = 0.0
    stream: Literal["rgb", "bt601", "bt709"] = "rgb"
    jpeg_quality: Annotated[int, Field(ge=0, le=100)] = 0
    residual: ResidualSpec | None = None


class RecordingSpec(Section):
    """The capture side of the sensor's recordings: crop, gray, median, adaptive threshold, resize.

    Attributes
    ----------
    crop_px : (x0, y0, x1, y1)
        End exclusive.
    width_px, height_px : int
        Size of the stored image.
    resized : {"after", "before"}
        Whether the picture is resized after its threshold, as the MG400's recorder does, or before it, as the UR5's does. Resized after
        it, a picture has gray edges.
    median_px : {0, 3, 5}
        Width of the median filter before the threshold; 0: none.
    threshold_weights : {"gaussian", "mean"}
        How the threshold's block is averaged.
    threshold_block_px, threshold_offset : int, float
        As OpenCV's ``adaptiveThreshold`` takes them; the block is one of the picture that the threshold sees.
    """

    crop_px: tuple[int, int, int, int]
    width_px: Annotated[int, Field(ge=16, le=8192)]
    height_px: Annotated[int, Field(ge=16, le=8192)]
    resized: Literal["after", "before"] = "after"
    median_px: Annotated[Literal[0, 3, 5], NotTruth] = 5
    threshold_weights: Literal["gaussian", "mean"] = "gaussian"
    threshold_block_px: Annotated[int, Field(ge=3, le=8192)]
    threshold_offset: float

    @model_validator(mode="after")
    def _check(self) -> Self:
        x0, y0, x1, y1 = self.crop_px
        if x1 <= x0 or y1 <= y0:
            raise ValueError("crop_px must be (x0, y0, x1, y1) with x1 > x0 and y1 > y0")
        if self.threshold_block_px % 2 == 0:
            raise ValueError("threshold_block_px must be odd")
        return self


class BlobSpec(Section):
    """How pins are found in one form of the sensor's frames. All lengths are in px of that form's own frame.

    Attributes
    ----------
    threshold : float
        A fixed gray level (0 to 255) if ``threshold_block_px`` is 0, else the offset of an adaptive mean threshold over that block.
    threshold_block_px : int
        Side of the square over which the mean is taken; 0: one fixed threshold.
    erosion_px : int
        Size of the square erosion kernel; 1: no erosion.
    mask_center_px, mask_radius_px : (x, y), float
        Disc within which pins are looked for.
    min_area_px2 : float
        Smaller blobs are left out.
    spot_sigma_px : float
        If above 0, pins are not found by a threshold but as bright spots of this size (sd of a Gaussian; a cap is about three wide), each
        compared with its surroundings. It takes caps with a pattern, of uneven light, and near reflections.
    rest_px : (N, 2) float
        Where the pins were measured without contact, in this form's frames; empty: where the camera sees them by the specification.
    rest_origin : {"measured", "contacts"}
        Whether ``rest_px`` was measured in a frame without contact, or made from contacts, which is less exact.
    """

    threshold: float
    threshold_block_px: Annotated[int, Field(ge=0, le=8192)] = 0
    erosion_px: Annotated[int, Field(ge=1, le=100)] = 1
    mask_center_px: tuple[float, float]
    mask_radius_px: Annotated[float, Field(gt=0, le=100_000)]
    min_area_px2: NonNegative = 1.0
    spot_sigma_px: Annotated[float, Field(ge=0, le=200)] = 0.0
    rest_px: tuple[tuple[float, float], ...] = ()
    rest_origin: Literal["measured", "contacts"] = "measured"


class UsualCapsSpec(Section):
    """Light and focus of a unit, as its raw frames showed them when its specification was made; 'twin check' compares with them.

    Attributes
    ----------
    contrast : float
        Gray levels of the caps above the skin around them, median.
    edge_px : float
        Width of the caps' edges, median: the distance in which the level falls from 90 to 10 % of the contrast.
    unevenness : float
        Gray levels by which the brightest part of the skin is brighter than most of it.
    """

    contrast: Positive
    edge_px: Positive
    unevenness: NonNegative = 0.0


class PipelineSpec(Section):
    """Pin detection for each form of the sensor's frames.

    Attributes
    ----------
    raw : BlobSpec
        For the camera's own frames.
    recording : BlobSpec, optional
        For the recordings' cropped and thresholded form.
    usual_caps : UsualCapsSpec, optional
        What the unit's raw frames showed; without it 'twin check' expects what the twin draws.
    """

    raw: BlobSpec
    recording: BlobSpec | None = None
    usual_caps: UsualCapsSpec | None = None


class GeometrySpec(Section):
    """Where skin, window and pins are: what the meshes of a sensor are made from (``SensorSpec.geometry``).

    Attributes
    ----------
    skin, lens, pins : SkinSpec, LensSpec, PinsSpec
        The sensor's own sections.
    """

    skin: SkinSpec
    lens: LensSpec
    pins: PinsSpec


class ViewSpec(Section):
    """What decides where the camera sees a place in the gel: the camera, the window and the gel's index (``SensorSpec.view``).

    Attributes
    ----------
    camera, lens : CameraSpec, LensSpec
        The sensor's own sections.
    gel_index : float
        The gel's refractive index.
    """

    camera: CameraSpec
    lens: LensSpec
    gel_index: Index


class CaptureSpec(Section):
    """What makes a frame from the light on the film: the gel's haze, the camera's optics and its response (``SensorSpec.capture``).

    Attributes
    ----------
    gel, camera, response : GelSpec, CameraSpec, ResponseSpec
        The sensor's own sections.
    """

    gel: GelSpec
    camera: CameraSpec
    response: ResponseSpec


class SensorSpec(Section):
    """A TacTip, complete.

    A file needs only [pins], [camera] and [pipeline.raw]; all other sections have defaults, those of a printed TacTip.

    Attributes
    ----------
    name : str
        The file's stem; not a key of the file.
    description : str
        One line for ``twin sensors``.
    source : str
        Where the numbers come from.
    skin : SkinSpec
        The soft skin.
    gel : GelSpec
        What fills it.
    lens : LensSpec
        The window behind the gel.
    pins : PinsSpec
        The pins' layout and size.
    camera : CameraSpec
        Where the camera is, and how it projects.
    leds : LedRingSpec
        The light.
    housing : HousingSpec
        What the camera sees around the window.
    appearance : AppearanceSpec
        Reflectances of skin, pins and caps.
    response : ResponseSpec
        From light to gray levels.
    recording : RecordingSpec, optional
        How the sensor's recordings were made from raw frames.
    pipeline : PipelineSpec
        How pins are found.
    rig : RigSpec, optional
        The robot that holds the sensor, where its contacts were calibrated.
    """

    name: Name
    description: str = ""
    source: str = ""
    skin: SkinSpec = SkinSpec()
    gel: GelSpec = GelSpec()
    lens: LensSpec = LensSpec()
    pins: PinsSpec
    camera: CameraSpec
    leds: LedRingSpec = LedRingSpec()
    housing: HousingSpec = HousingSpec()
    appearance: AppearanceSpec = AppearanceSpec()
    response: ResponseSpec = ResponseSpec()
    recording: RecordingSpec | None = None
    pipeline: PipelineSpec
    rig: RigSpec | None = None

    @property
    def geometry(self) -> GeometrySpec:
        """Skin, window and pins."""
        return GeometrySpec.model_construct(skin=self.skin, lens=self.lens, pins=self.pins)

    @property
    def view(self) -> ViewSpec:
        """Camera, window and the gel's index."""
        return ViewSpec.model_construct(camera=self.camera, lens=self.lens, gel_index=self.gel.refractive_index)

    @property
    def capture(self) -> CaptureSpec:
        """The gel's haze, the camera's optics and its response."""
        return CaptureSpec.model_construct(gel=self.gel, camera=self.camera, response=self.response)

    @model_validator(mode="after")
    def _check(self) -> Self:
        skin, pins = self.skin, self.pins
        inside_mm = skin.apex_mm - skin.thickness_mm
        if self.lens.z_mm > skin.rim_z_mm:
            raise ValueError("lens.z_mm must not lie in front of skin.rim_z_mm")
        if self.lens.z_mm >= inside_mm:
            raise ValueError("lens.z_mm must lie behind the skin: below -skin.thickness_mm for a flat pad")
        room_mm = inside_mm if skin.shape == "cap" else inside_mm - self.lens.z_mm
        if pins.length_mm + pins.cap_height_mm >= room_mm:
            raise ValueError("pins.length_mm + pins.cap_height_mm must be smaller than a cap's inner radius, or a pad's gel is deep")
        self._check_reach()
        if self.camera.distance_mm <= -self.lens.back_mm:
            raise ValueError("camera.distance_mm must put the pupil behind the window (greater than lens.thickness_mm - lens.z_mm)")
        if self.leds.z_mm > self.lens.back_mm:
            raise ValueError("leds.z_mm must not lie in front of the window's back (lens.z_mm - lens.thickness_mm)")
        shapes = self.appearance.cap_shapes
        if shapes and ({len(c) % 2 for c in shapes} != {1} or len({len(c) for c in shapes}) > 1 or len(shapes) != pins.count):
            each = f"a_0 and the same number of pairs for each of the {pins.count} pins"
            raise ValueError(f"appearance.cap_shapes needs {each}; {ELSEWHERE}")
        if self.appearance.cap_levels and len(self.appearance.cap_levels) != pins.count:
            raise ValueError(f"appearance.cap_levels needs one number for each of the {pins.count} pins; {ELSEWHERE}")
        if self.appearance.cap_offsets and len(self.appearance.cap_offsets) != pins.count:
            raise ValueError(f"appearance.cap_offsets needs one pair for each of the {pins.count} pins; {ELSEWHERE}")
        relief = self.appearance.relief
        if relief is not None and not relief.pattern and relief.count != pins.count:
            raise ValueError(
                f"appearance.relief needs one tile for each of the {pins.count} pins; give it a pattern above 0 to draw tiles at random"
            )
        for form, blob in (("raw", self.pipeline.raw), ("recording", self.pipeline.recording)):
            if blob is not None and blob.rest_px and len(blob.rest_px) != pins.count:
                raise ValueError(f"pipeline.{form}.rest_px needs one place for each of the {pins.count} pins, or none at all")
        if (self.recording is None) != (self.pipeline.recording is None):
            raise ValueError("recording and pipeline.recording go together: give both or neither")
        return self

    def _check_reach(self) -> None:
        """The outermost pins must stand on the skin: before a cap's rim, on a pad's flat part."""
        skin, reach_mm = self.skin, self.pins.reach_mm
        if skin.shape == "cap":
            polar_rad = self.pins.largest_polar_rad(skin.apex_mm - skin.thickness_mm)
            if polar_rad is None or skin.rim_z_mm >= (skin.apex_mm - skin.thickness_mm) * math.cos(polar_rad):
                raise ValueError(f"pins.{'max_polar_deg' if reach_mm is None else 'reach_mm'} puts pins behind skin.rim_z_mm")
            return
        if reach_mm is None:
            raise ValueError("pins.reach_mm is missing: on a flat pad it is the distance of the outermost pin from the axis")
        if reach_mm > math.hypot(*(half + skin.rim_z_mm for half in skin.half_size_mm)) or (
            skin.shape == "round-pad" and reach_mm > skin.outer_radius_mm + skin.rim_z_mm
        ):
            raise ValueError("pins.reach_mm puts pins beyond the flat part of the pad")
