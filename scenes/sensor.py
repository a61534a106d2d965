"""Specification of a TacTip: geometry, material, optics, camera, recording, pipeline and rig.

Sensor frame: The origin is the centre of a cap's sphere, or the centre of a flat pad's outside. z points out of the tip (apex at
``z = skin.apex_mm``). x and y are along the image's x (right) and y (down) of an untilted camera. Lengths are in mm, stiffness in MPa
(N/mm^2), angles in deg (in files only), and pixels in px with (0, 0) at the centre of the first pixel of the *raw* camera frame.
"""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from scenes.base import Fraction, Index, Name, NearOne, NonNegative, NotTruth, Picture, Positive, Rgb, Section
from scenes.body import GelSpec, SkinSpec
from scenes.pins import PinsSpec
from scenes.rig import RigSpec

Polarity = Literal["bright", "dark"]
"""Whether caps are brighter or darker than the skin around them."""
ELSEWHERE = "leave it out if it was measured on another layout"
"""Remedy in the error for measured values of caps that do not fit the layout."""


class LensSpec(Section):
    """Rigid flat window (acrylic) that closes the gel. Behind it is air.

    Attributes
    ----------
    z_mm : float
        z of its face on the gel side.
    radius_mm : float
        Radius of the window. The default is measured from public CAD of the TacTip.
    thickness_mm : float
        Thickness of the window.
    refractive_index : float
        Refractive index of the window. The default is that of acrylic.
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
    """Camera in the air behind the window. These numbers do not include the refraction at the window, which is computed separately.

    Attributes
    ----------
    width_px, height_px : int
        Size of a frame.
    channels : {"color", "mono"}
        Whether frames are in colour or gray.
    projection : {"perspective", "fisheye"}
        Projection model. "perspective": Brown-Conrady distortion k1, k2, p1, p2 of the tangents. "fisheye":
        theta (1 + k1 theta^2 + k2 theta^4) (Kannala and Brandt 2006).
    fx_px, fy_px, cx_px, cy_px : float
        Focal lengths and principal point.
    distance_mm : float
        Distance from the entrance pupil to the origin (the centre of a cap, or the outside of a pad): the pupil is at z = -distance. It is
        negative if the centre of a shallow cap is behind the pupil.
    tilt_x_deg, tilt_y_deg : float
        Rotation of the camera about its pupil. A positive ``tilt_x_deg`` turns the optical axis towards -y of the sensor frame, a
        positive ``tilt_y_deg`` towards -x.
    turn_deg, mirrored : float, bool
        Turn of the picture from x towards y, and whether it is mirrored left to right before the turn: of a camera that is mounted turned,
        or that looks over a mirror. ``twin check --push`` finds them.
    k1, k2, p1, p2 : float
        Coefficients of the radial (k) and tangential (p) distortion of the ``projection``.
    aperture_mm : float
        Diameter of the entrance pupil. With 0 the image is sharp everywhere.
    focus_mm : float
        Distance in air from the pupil to the plane of focus, if ``aperture_mm`` is above 0. The default is near a TacTip's caps.
    vignetting : float
        Fraction of the light that is lost at the corners. The loss increases with the square of the distance from the image's centre.
    red_scale, blue_scale : float
        Size of the red and of the blue image about the principal point, relative to the green image.
    red_shift_px, blue_shift_px : (x, y)
        Shift of the red and of the blue image, relative to the green image.
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
    turn_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    mirrored: bool = False
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
    """LEDs in the air behind the window. They shine along +z. Each is a square with one side towards the axis.

    The defaults are a ring of six like that of the UR5's TacTip; 'twin calibrate optics' finds a sensor's own.

    Attributes
    ----------
    azimuth_deg : tuple of float
        Azimuth of each LED in the sensor frame.
    radius_mm, z_mm : float
        Distance of the LEDs from the axis, and z of their plane.
    size_mm : float
        Side of the square.
    power : float
        Light of one LED, independent of its size.
    balance : tuple of float
        Factor on each LED's power. If empty, all factors are 1.
    color : three numbers
        Colour of the light, linear RGB.
    off : tuple of int
        Indices of LEDs that do not work.
    mirror_share : float
        Fraction of an LED's light that is visible in its reflection in the window. The housing hides the rest.
    core_share : float
        Fraction of this light that comes from the core of the LED.
    core_mm : float
        Standard deviation of the Gaussian that represents the core.
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
    """Measured light at the rim between housing and window, which is added to the formulas: glue, burrs, glare.

    Attributes
    ----------
    inner_mm, outer_mm : float
        Radii about the housing's centre, in its plane, between which the light was measured.
    light : (A, R, 3) int
        Added linear red, green and blue light in thousandths of saturation; it may be negative. Row j is at azimuth 2 pi j / A, column k at
        the k-th of R evenly spaced radii. The light is linear between them.
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
    """Measured light that contacts do not change, which is added to the formulas: housing, flare, glints, bubbles.

    The default of ``span`` is that of 'twin calibrate optics'.

    Attributes
    ----------
    light : picture of the camera's whole frame, red, green and blue; of another size it is scaled to the frame
        Added linear light, which may be negative. A level v means ``sign(v - 128) span (|v - 128| / 127)^2.2``.
    span : float
        Light of the level 255, relative to saturation. The level 1 has the same light with a negative sign.
    """

    light: Picture
    span: Positive = 2.0


class HousingSpec(Section):
    """The bright ring and wall around the disc that the camera sees: a flat annulus in the air.

    The defaults are those of the UR5's TacTip, without the measured light of its rim.

    Its light is relative to the LEDs' power (formula: ``twin.optics.static_layer.housing_light``).

    Attributes
    ----------
    aperture_radius_mm, outer_radius_mm : float
        Inner and outer radius of the annulus.
    aperture_mm : (width, height), optional
        Size of a rectangular opening along x and y. It replaces the round opening.
    z_mm, center_mm : float, (x, y)
        z of its plane, and its centre.
    albedo : three numbers
        Reflectance, linear RGB.
    ambient : float
        Light at the inner edge.
    ambient_falloff_mm : float
        Length over which this light decreases outwards.
    glow, glow_radius_mm, glow_height_mm, glow_exponent : float
        Each LED adds the light ``glow (1 + d^2 / h^2)^-n`` at the distance d from its position at ``glow_radius_mm``, with the height h
        (``glow_height_mm``) and the exponent n (``glow_exponent``). n = 1.5 is a small source at the height h above a matt material; a
        larger n is a glossy material.
    lip_width_mm, wall_fraction : float
        Width of the lip, and fraction of the light that the wall beyond the lip shows.
    fill, fill_width_mm : float
        Radiance with which the inner part of the ring illuminates the gel, and width of this part.
    rim : RimSpec, optional
        Measured light that is added to these formulas.
    background : BackgroundSpec, optional
        Measured light that is added to the light of the rim, at each pixel of the frame.
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
        Its centre in the sensor frame.
    radius_mm : float
        Radius of the disc.
    opacity : float
        Fraction of the light from behind that it hides.
    light : float
        Radiance that it adds, relative to saturation.
    """

    x_mm: float
    y_mm: float
    radius_mm: Positive
    opacity: Fraction
    light: NonNegative = 0.0


class ReliefSpec(Section):
    """Measured details of caps and of the skin around them: light that is added to the smooth model, at positions fixed to each cap.

    Each pin has a square tile of cells in the plane of its cap. The tile moves and rotates with the cap. The added light is the tile's
    value times the light of the smooth cap, so it decreases with the light of the cap and of the lamps. A point belongs to the nearest cap.
    The defaults use a tile on both caps and skin, as it was measured.

    Attributes
    ----------
    tiles : picture
        Red, green and blue of all tiles, row by row, with as many tiles in a row as fit into the picture's width. A level v means the
        fraction ``sign(v - 128) span (|v - 128| / 127)^1.5`` of the smooth cap's light, which may be negative.
    count : int
        Number of tiles.
    span : float
        Fraction of the smooth cap's light for the level 255. The level 1 has the same fraction with a negative sign.
    cells : int
        Number of cells along a tile's side. Between the centres of cells the value is bilinear.
    reach : float
        Distance of a tile's outermost cell centres from its centre along the sides, in cap radii. One side is along the projection of the
        sensor's x.
    caps, skin : bool
        Whether the tiles are used on the caps with their edges (up to ``SKIN_FROM`` cap radii), and on the skin around.
    pattern : int
        With 0 each pin has its own tile. Another number stands for another print of the sensor: each pin's tile is sampled at random, with
        the mean and the covariance of all measured tiles.
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
    """Reflectances (linear RGB, 0 to 1) of the surfaces in the gel.

    The defaults of skin, pins and caps were fitted to the UR5's TacTip.

    Attributes
    ----------
    skin_albedo, pin_albedo, cap_albedo : three numbers
        Diffuse reflectance: red, green, blue.
    skin_gloss, cap_gloss : float
        Weight of a rough specular lobe.
    skin_roughness, cap_roughness : float
        Roughness of this lobe.
    cap_bump : float
        Fraction of the light that a cap receives like a small ball, from any direction. The cap receives the rest like a flat disc. Printed
        caps are round and translucent.
    cap_levels : tuple of float
        Measured reflectance of each cap relative to ``cap_albedo``, in pin order.
    cap_variation, cap_pattern : float, int
        Relative standard deviation and number of a random pattern of reflectances, if no levels were measured. Another number stands for
        another print of the sensor.
    cap_shapes : (N, 1 + 2 n) float
        Measured outline of each cap relative to a circle: a_0, a_2, b_2, a_3, b_3, ... of ``1 + a_0 + sum a_m cos(m t) + b_m sin(m t)``.
        The angle t goes from the sensor's x towards y.
    cap_offsets : (N, 2) float
        a_1 and b_1: offset of the outline's centre from the pin's centre, in cap radii.
    specks : tuple of SpeckSpec
        Bubbles and grains on the window.
    relief : ReliefSpec, optional
        Measured details of each cap and of the skin around it.
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

    @property
    def dark_caps(self) -> bool:
        """Whether the caps reflect less light than the skin."""
        return sum(self.cap_albedo) < sum(self.skin_albedo)


class ResidualSpec(Section):
    """A small network that corrects the discrepancy of the light and camera models in a colour frame, before the stream rounds the frame.

    It makes frames look like those of the camera. The pins do not need it: it moves their centroids by about a hundredth of a pixel. It is
    off unless ``used`` is set. It is valid only with the calibration with which it was trained.

    Attributes
    ----------
    weights : tuple of float
        Kernels and biases of its four convolutions, one after the other.
    channels, noises : int
        Number of channels in the hidden layers, and number of random values at each pixel.
    center_px, radius_px : two numbers, float
        Circle of the full frame in which the network acts: the lens disc.
    used : bool
        Whether the network is applied to frames.
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
    """The camera's response: from linear light to 8-bit gray levels. ``twin.camera.capture.expose`` says in which order its steps act.

    The defaults are plausible numbers for a USB camera; 'twin calibrate optics' finds a sensor's own.

    Attributes
    ----------
    blur_sigma_px : float
        Standard deviation of the optics' blur.
    exposure, white_balance : float, three numbers
        Gain of all colours, and gain of each colour.
    brightness_drift : float
        Relative standard deviation of a gain that is sampled for each frame.
    read_noise, shot_noise : float
        The noise has the variance ``read_noise^2 + shot_noise * light``; light 1 is saturation.
    noise_sigma_px : float
        Standard deviation of the Gaussian with which the camera smooths the noise of every channel.
    sharpening, sharpening_sigma_px : float
        Weight and standard deviation of the unsharp mask that the camera applies to the luma, but not to its noise.
    gamma, black_level : float
        Parameters of the response curve ``black + (255 - black) light^(1 / gamma)``.
    chroma_sigma_px : float
        Standard deviation of the blur of the colour differences, which are in gray levels.
    chroma_median_px : {0, 3, 5}
        Side of the square of the median filter that the camera then applies to the colour differences, and which preserves edges. 0 means
        no filter.
    chroma_columns : {1, 2}
        Number of neighbouring columns that share the colour differences of the first one (2 for a 4:2:2 stream).
    stream : {"rgb", "bt601", "bt709"}
        Format of the stream: integers of luma and colour differences (ITU-R BT.601 or BT.709, studio range), or RGB.
    jpeg_quality : int
        JPEG quality of the stream. 0 means no compression.
    residual : ResidualSpec, optional
        A small network that acts before the stream, if it is switched on.
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
    """Processing of raw frames in the sensor's recordings: crop, gray, median, adaptive threshold, resize.

    Attributes
    ----------
    crop_px : (x0, y0, x1, y1)
        Part of the raw frame, end exclusive.
    width_px, height_px : int
        Size of the stored image.
    resized : {"after", "before"}
        Whether the picture is resized after the threshold, as in the MG400's recorder, or before it, as in the UR5's. A picture that is
        resized after the threshold has gray edges.
    median_px : {0, 3, 5}
        Width of the median filter before the threshold; 0 means no filter.
    threshold_weights : {"gaussian", "mean"}
        Weights of the mean over the threshold's block.
    threshold_block_px, threshold_offset : int, float
        Arguments of OpenCV's ``adaptiveThreshold``. The block is in pixels of the picture to which the threshold is applied.
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
    """Detection of pins in one form of the sensor's frames. All lengths are in px of a frame of this form.

    Attributes
    ----------
    polarity : {"bright", "dark"}
        Whether the caps are brighter or darker than the skin around them. The gray levels of frames with dark caps are inverted before the
        detection, so all other keys have the same meaning for both.
    threshold : float
        A fixed gray level (0 to 255) if ``threshold_block_px`` is 0, else the offset of an adaptive mean threshold with this block.
    threshold_block_px : int
        Side of the square block of the mean; 0 means one fixed threshold.
    erosion_px : int
        Size of the square erosion kernel; 1 means no erosion.
    mask_center_px, mask_radius_px : (x, y), float
        Centre and radius of the disc in which pins are searched for.
    min_area_px2 : float
        Smallest area of a blob. Smaller blobs are ignored.
    spot_sigma_px : float
        If above 0, pins are detected as bright spots of this size instead of with a threshold. The size is the standard deviation of a
        Gaussian; a cap is about three times as wide. Each spot is compared with its surroundings, so this detection also finds caps that
        have a pattern, are unevenly lit, or are near reflections.
    rest_px : (N, 2) float
        Measured positions of the pins without contact, in frames of this form. If empty, they are the projections by the specification.
    rest_origin : {"measured", "contacts"}
        Whether ``rest_px`` was measured in a frame without contact, or estimated from contacts, which is less accurate.
    """

    polarity: Polarity = "bright"
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
    """Light and focus in the raw frames of a unit when its specification was made. 'twin check' compares new frames with these values.

    Attributes
    ----------
    contrast : float
        Median difference between the caps and the skin around them, in gray levels. It is positive for dark caps, too.
    edge_px : float
        Median width of the caps' edges: the distance over which the level decreases from 90 to 10 % of the contrast.
    unevenness : float
        Difference between the brightest part of the skin and most of the skin, in gray levels.
    """

    contrast: Positive
    edge_px: Positive
    unevenness: NonNegative = 0.0


class PipelineSpec(Section):
    """Pin detection for each form of the sensor's frames.

    Attributes
    ----------
    raw : BlobSpec
        Detection in the camera's own frames.
    processed : BlobSpec, optional
        Detection in processed frames, which are cropped and thresholded.
    usual_caps : UsualCapsSpec, optional
        Light and focus of the unit's raw frames. Without it 'twin check' uses the values of a frame that the twin draws.
    """

    former_keys = {"recording": "processed"}

    raw: BlobSpec
    processed: BlobSpec | None = None
    usual_caps: UsualCapsSpec | None = None


class GeometrySpec(Section):
    """Geometry of skin, window and pins, from which the meshes of a sensor are made (``SensorSpec.geometry``).

    Attributes
    ----------
    skin, lens, pins : SkinSpec, LensSpec, PinsSpec
        The sensor's own sections.
    """

    skin: SkinSpec
    lens: LensSpec
    pins: PinsSpec


class ViewSpec(Section):
    """Parameters of the projection of points in the gel to the image: camera, window and the gel's index (``SensorSpec.view``).

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
    """Parameters that turn the light on the film into a frame: the gel's haze, the camera's optics and response (``SensorSpec.capture``).

    Attributes
    ----------
    gel, camera, response : GelSpec, CameraSpec, ResponseSpec
        The sensor's own sections.
    """

    gel: GelSpec
    camera: CameraSpec
    response: ResponseSpec


class SensorSpec(Section):
    """The complete specification of a TacTip.

    A file needs only [pins], [camera] and [pipeline.raw]. All other sections have the defaults of a printed TacTip.

    Attributes
    ----------
    name : str
        The file's stem; not a key of the file.
    description : str
        One line for ``twin sensors``.
    source : str
        Source of the numbers.
    skin : SkinSpec
        The soft skin.
    gel : GelSpec
        The gel in the skin.
    lens : LensSpec
        The window behind the gel.
    pins : PinsSpec
        Layout and size of the pins.
    layout_unsure : bool
        Whether the specification was made from frames that do not decide the layout.
    camera : CameraSpec
        Position and projection of the camera.
    leds : LedRingSpec
        The LEDs.
    housing : HousingSpec
        The housing that the camera sees around the window.
    appearance : AppearanceSpec
        Reflectances of skin, pins and caps.
    response : ResponseSpec
        The camera's response, from light to gray levels.
    recording : RecordingSpec, optional
        Processing of raw frames in the sensor's recordings.
    pipeline : PipelineSpec
        Detection of the pins.
    rig : RigSpec, optional
        The robot that holds the sensor, if its contacts were calibrated.
    """

    name: Name
    description: str = ""
    source: str = ""
    layout_unsure: bool = False
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
        if skin.shape == "cap" and self.lens.radius_mm >= skin.outer_radius_mm:
            raise ValueError(
                f"lens.radius_mm must be smaller than skin.outer_radius_mm = {skin.outer_radius_mm:g}, got {self.lens.radius_mm:g}; "
                "give a tip of another size its own lens.radius_mm and leds.radius_mm"
            )
        room_mm = inside_mm if skin.shape == "cap" else inside_mm - self.lens.z_mm
        if pins.length_mm + pins.cap_height_mm >= room_mm:
            raise ValueError("pins.length_mm + pins.cap_height_mm must be smaller than a cap's inner radius, or a pad's gel is deep")
        self._check_reach()
        if self.camera.distance_mm <= -self.lens.back_mm:
            least, got = -self.lens.back_mm, self.camera.distance_mm
            raise ValueError(
                "camera.distance_mm must put the pupil behind the window: greater than lens.thickness_mm - lens.z_mm "
                f"= {least:g}, got {got:g}"
            )
        if self.leds.z_mm > self.lens.back_mm:
            raise ValueError("leds.z_mm must not lie in front of the window's back (lens.z_mm - lens.thickness_mm)")
        shapes = self.appearance.cap_shapes
        if shapes and ({len(c) % 2 for c in shapes} != {1} or len({len(c) for c in shapes}) > 1 or len(shapes) != pins.count):
            each = f"a_0 and the same number of pairs for each of the {pins.count} pins"
            raise ValueError(f"appearance.cap_shapes needs {each}; {ELSEWHERE}")
        if self.pipeline.raw.polarity == "dark" and not self.appearance.dark_caps:
            raise ValueError(
                "pipeline.raw.polarity = 'dark' needs caps that are darker than the skin: give appearance.skin_albedo and "
                "appearance.pin_albedo, [0.4, 0.4, 0.4] for example, and appearance.cap_albedo, [0.03, 0.03, 0.03] for example"
            )
        if self.appearance.cap_levels and len(self.appearance.cap_levels) != pins.count:
            raise ValueError(f"appearance.cap_levels needs one number for each of the {pins.count} pins; {ELSEWHERE}")
        if self.appearance.cap_offsets and len(self.appearance.cap_offsets) != pins.count:
            raise ValueError(f"appearance.cap_offsets needs one pair for each of the {pins.count} pins; {ELSEWHERE}")
        relief = self.appearance.relief
        if relief is not None and not relief.pattern and relief.count != pins.count:
            raise ValueError(
                f"appearance.relief needs one tile for each of the {pins.count} pins; give it a pattern above 0 to draw tiles at random"
            )
        for form, blob in (("raw", self.pipeline.raw), ("processed", self.pipeline.processed)):
            if blob is not None and blob.rest_px and len(blob.rest_px) != pins.count:
                raise ValueError(f"pipeline.{form}.rest_px needs one place for each of the {pins.count} pins, or none at all")
        if (self.recording is None) != (self.pipeline.processed is None):
            raise ValueError("recording and pipeline.processed belong together: give both or neither")
        return self

    def _check_reach(self) -> None:
        """Check that the outermost pins are on the skin: inside a cap's rim, or on the flat part of a pad."""
        skin, reach_mm = self.skin, self.pins.reach_mm
        if skin.shape == "cap":
            polar_rad = self.pins.largest_polar_rad(skin.apex_mm - skin.thickness_mm)
            if polar_rad is None or skin.rim_z_mm >= (skin.apex_mm - skin.thickness_mm) * math.cos(polar_rad):
                raise ValueError(f"pins.{'max_polar_deg' if reach_mm is None else 'reach_mm'} puts pins behind skin.rim_z_mm")
            return
        if reach_mm is None:
            raise ValueError("pins.reach_mm is missing: on a flat pad it is the distance of the outermost pin from the axis")
        flat_mm = [half + skin.rim_z_mm for half in skin.half_size_mm]
        if reach_mm > (flat_mm[0] if skin.shape == "round-pad" else math.hypot(*flat_mm)):
            raise ValueError("pins.reach_mm puts pins beyond the flat part of the pad")
