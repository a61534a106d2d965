"""The two forms of a sensor's frames: their sizes, the conversion of pixel coordinates between them, and recognition of a frame's form.

A recording is the camera's frame cropped, thresholded and resized at capture. With the crop (x0, y0, x1, y1) and the recorded
size (w, h), and pixel centres at integers, ``x_rec = (x_raw - x0 + 0.5) w / (x1 - x0) - 0.5``; likewise for y.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mode

import cv2
import numpy as np

from scenes.sensor import BlobSpec, PipelineSpec, Polarity, RecordingSpec, SensorSpec
from twin.errors import ErrorsAs, FrameError
from twin.frames.images import bits_used, read_levels, to_eight_bits
from twin.types import Form

# Share of black and white pixels above which a frame counts as thresholded. It is below 1, because resizing leaves gray edges.
TWO_LEVEL_SHARE = 0.9
# A second criterion. A thresholded frame of small caps that was resized has many gray edges. It is mostly black (first share of all
# pixels), and of its other pixels at least the second share is white; or mostly white and black, if its pins are dark. (Measured: 0.16 and
# more in resized thresholded frames of three sensors, at most 0.04 in raw ones.)
MOSTLY_BLACK, WHITE_OF_REST = 0.5, 0.1
# Least share of black pixels, and least share of white pixels, in a thresholded frame.
LEAST_OF_EACH_LEVEL = 0.005
# Least share of the gray pixels of a thresholded frame that lie at most this far (px) from a white and from a black one, because resizing
# makes them of its edges. (Measured: 0.72 and more in thresholded frames of three sensors, resized by 0.5 to 1.9; 0.04 for a gray picture
# of dark skin, gray caps and a white housing.)
AT_EDGES, EDGE_PX = 0.4, 2
# Share of a picture's pixels that are gray and away from edges, below which it is thresholded nevertheless: a line of text, a broken
# row. The caps of a gray picture are 4 % of it or more.
FEW_AWAY = 0.03
# Gray levels below which a pixel counts as black, and above which it counts as white.
BLACK_BELOW, WHITE_ABOVE = 16, 239
# Mean difference of a picture's colours, gray levels, above which it is not gray. JPEG gives gray pictures some colour.
COLOURLESS_BELOW = 4.0
# Number of frames by which the size and form of a recording are recognised.
VOTES = 25


def raw_to_recording(recording: RecordingSpec | None, raw_px: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of the camera's frame to pixels of the recording.

    Raises
    ------
    FrameError
        The sensor has no processed form.
    """
    corner, scale = _corner_and_scale(recording)
    return (np.asarray(raw_px, float) - corner + 0.5) * scale - 0.5


def recording_to_raw(recording: RecordingSpec | None, recording_px: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of the recording to pixels of the camera's frame; raises as ``raw_to_recording``."""
    corner, scale = _corner_and_scale(recording)
    return (np.asarray(recording_px, float) + 0.5) / scale + corner - 0.5


def from_raw(recording: RecordingSpec | None, form: Form, raw_px: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of the camera's frame to pixels of the given form; raises as ``raw_to_recording``, or if there is no such form."""
    return raw_to_recording(recording, raw_px) if form_named(form) == Form.PROCESSED else np.asarray(raw_px, float)


def form_named(name: str) -> Form:
    """The form of a name, "raw" say.

    Raises
    ------
    FrameError
        There is no such form.
    """
    with ErrorsAs(ValueError, lambda error: FrameError(f"no form is called {name!r}; there are: {', '.join(Form)}")):
        return Form(name)


def frame_size(spec: SensorSpec, form: Form) -> tuple[int, int]:
    """(width, height) in px of the sensor's frames of a form.

    Raises
    ------
    FrameError
        The sensor has no processed form, or there is no such form.
    """
    sizes, form = known_sizes(spec), form_named(form)
    if form not in sizes:
        raise FrameError(f"sensor '{spec.name}' has no processed form: its recordings are raw frames; use the raw form")
    return sizes[form]


def blob_spec(pipeline: PipelineSpec, form: Form) -> BlobSpec:
    """The pin detection's settings for frames of a form.

    Raises
    ------
    FrameError
        The sensor has no processed form, or there is no such form.
    """
    found = pipeline.raw if form_named(form) == Form.RAW else pipeline.processed
    if found is None:
        raise FrameError("the sensor has no processed form ([pipeline.processed]): its recordings are raw frames; use the raw form")
    return found


def gray_levels(image: np.ndarray) -> np.ndarray:
    """(H, W) luminance of a gray (H, W), one-channel (H, W, 1) or RGB (H, W, 3) image, in the image's own type."""
    if image.ndim == 2:
        return image
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.shape[2] == 3 else image[..., 0]


def pin_levels(image: np.ndarray, polarity: Polarity) -> np.ndarray:
    """Gray levels (H, W) in which pins are brighter than the skin: those of `gray_levels`, inverted if the pins are dark."""
    gray = gray_levels(image)
    return cv2.bitwise_not(gray) if polarity == "dark" else gray


def levels_at(gray: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Gray levels (...,) of the pixels nearest to places (..., 2)."""
    column, row = np.moveaxis(np.clip(np.round(px), 0, np.array(gray.shape[::-1]) - 1).astype(int), -1, 0)
    return gray[row, column].astype(float)


def polarity_of(pipeline: PipelineSpec, form: Form) -> Polarity:
    """Whether pins are bright or dark in frames of a form; if the sensor has no such form, as in raw frames."""
    blob = pipeline.processed if form == Form.PROCESSED else None
    return (blob or pipeline.raw).polarity


def known_sizes(spec: SensorSpec) -> dict[Form, tuple[int, int]]:
    """(width, height) in px of the sensor's frames of each form that it has."""
    sizes = {Form.RAW: (spec.camera.width_px, spec.camera.height_px)}
    if spec.recording:
        sizes[Form.PROCESSED] = (spec.recording.width_px, spec.recording.height_px)
    return sizes


@dataclass(frozen=True)
class FrameKind:
    """Common properties of the frames of a recording.

    Attributes
    ----------
    form : Form
    size_px : (int, int)
        Width and height.
    bits : int
        Bits in use in 16-bit files; 0 for 8-bit files.
    """

    form: Form
    size_px: tuple[int, int]
    bits: int = 0


def times(size_px: Sequence[int]) -> str:
    """A size as people write it: 640x480."""
    return f"{size_px[0]}x{size_px[1]}"


def is_two_level(image: np.ndarray) -> bool:
    """Whether a picture was thresholded at capture: its pixels are black or white, apart from the edges that a resize leaves gray."""
    if image.ndim == 3 and float(np.mean(np.ptp(image, axis=2))) > COLOURLESS_BELOW:
        return False
    image = gray_levels(image)
    black, white = image < BLACK_BELOW, image > WHITE_ABOVE
    low, high = float(np.mean(black)), float(np.mean(white))
    ground, pins = max(low, high), min(low, high)
    resized = ground > MOSTLY_BLACK and pins > WHITE_OF_REST * (1 - ground)
    if not (low + high > TWO_LEVEL_SHARE or resized) or pins <= LEAST_OF_EACH_LEVEL:
        return False
    gray, square = ~(black | white), np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1))
    at_edge = np.logical_and(*(cv2.dilate(level.astype(np.uint8), square) > 0 for level in (black, white)))
    away = float(np.mean(gray & ~at_edge))
    return away < FEW_AWAY or 1 - away / float(np.mean(gray)) > AT_EDGES


def recognise_form(spec: SensorSpec, image: np.ndarray) -> Form:
    """Recognise the form of a sensor's frame by its size. If both forms have this size, the content decides.

    Raises
    ------
    FrameError
        The frame has the size of neither form.
    """
    size = _size_px(image)
    fitting = [form for form, expected in known_sizes(spec).items() if expected == size]
    if not fitting:
        expected = " or ".join(f"{times(expected)} ({form})" for form, expected in known_sizes(spec).items())
        raise FrameError(f"expected {expected} for {spec.name}, got {times(size)}; use the matching `sensor` or the unresized frame")
    if len(fitting) == 1:
        return fitting[0]
    return Form.PROCESSED if is_two_level(image) else Form.RAW


def form_of(image: np.ndarray, name: str, spec: SensorSpec | None, form: Form | None) -> Form:
    """Form of a frame: the given one if the frame has its size; if none is given, the form is recognised by size and content.

    Raises
    ------
    FrameError
        The frame's size is not one of the sensor's, or not that of the given form.
    """
    if form is not None:
        form = form_named(form)
    if spec is None:
        return form or (Form.PROCESSED if is_two_level(image) else Form.RAW)
    with ErrorsAs(FrameError, lambda error: FrameError(f"{name}: {error}")):
        told = recognise_form(spec, image)
    if form is None:
        return told
    expected = known_sizes(spec).get(form)
    if expected is None:
        raise FrameError(f"{name}: sensor {spec.name} has no {form} form (no [{form}] section); give frames of its {told} form as such")
    if expected != _size_px(image):
        wanted, got = f"{times(expected)} ({form} form)", f"{times(_size_px(image))} ({told} form)"
        remedy = "give frames of this form, or the form, sensor or weights that suit these frames"
        raise FrameError(f"{name}: expected {wanted} of {spec.name}, got {got}; {remedy}")
    return form


def common_kind(files: list[Path], spec: SensorSpec | None, form: Form | None) -> FrameKind:
    """The most frequent kind among up to ``VOTES`` usable frames spread over a recording; of equally frequent kinds the first.

    Raises
    ------
    FrameError
        No frame is usable.
    """
    spread = dict.fromkeys(np.linspace(0, len(files) - 1, min(VOTES, len(files))).astype(int).tolist())
    votes: dict[int, FrameKind] = {}
    reasons: dict[int, str] = {}
    for k in [*spread, *(k for k in range(len(files)) if k not in spread)]:
        try:
            stored, _ = read_levels(files[k])
            votes[k] = FrameKind(form_of(to_eight_bits(stored)[0], files[k].name, spec, form), _size_px(stored), bits_used(stored))
        except FrameError as error:
            reasons[k] = str(error)
        if len(votes) == VOTES:
            break
    if not votes:
        raise FrameError(f"no usable frame among {len(files)}; the first: {reasons[0]}")
    kinds = [votes[k] for k in sorted(votes)]
    size = mode(kind.size_px for kind in kinds)
    kinds = [kind for kind in kinds if kind.size_px == size]
    return FrameKind(mode(kind.form for kind in kinds), size, max(kind.bits for kind in kinds))


def _corner_and_scale(recording: RecordingSpec | None) -> tuple[np.ndarray, np.ndarray]:
    """First pixel (x, y) of the crop in the camera's frame, and number of recorded pixels for one pixel of the camera, in x and y."""
    if recording is None:
        raise FrameError("the sensor has no processed form ([recording]): its recordings are raw frames; use the raw form")
    x0, y0, x1, y1 = recording.crop_px
    return np.array([x0, y0], float), np.array([recording.width_px / (x1 - x0), recording.height_px / (y1 - y0)])


def _size_px(image: np.ndarray) -> tuple[int, int]:
    """(width, height) of an image."""
    return image.shape[1], image.shape[0]
