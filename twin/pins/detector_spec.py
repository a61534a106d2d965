"""The parameters of a way to find pins: what ``twin tune`` writes and ``--pipeline`` takes."""

from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
import tomlkit
from pydantic import Field

from scenes.base import Fraction, Name, Positive, Section, SpecError
from scenes.load import read_section
from scenes.sensor import BlobSpec, CameraSpec, RecordingSpec, SensorSpec
from twin.camera.projection import project
from twin.errors import FrameError
from twin.frames.forms import blob_spec, known_frames
from twin.geometry.pins import rest_pins
from twin.store import write_result
from twin.types import Form

Method = Literal["twin", "legacy", "adaptive", "fixed", "simple", "log", "dog", "doh"]
METHODS: dict[Method, str] = {
    "twin": "this program's pipeline: adaptive threshold, splitting, matching to the layout",
    "legacy": "the published method: the recorder's threshold, resize, SimpleBlobDetector, exact count",
    "adaptive": "adaptive mean threshold and connected components",
    "fixed": "one threshold and connected components",
    "simple": "OpenCV's SimpleBlobDetector on gray levels",
    "log": "scikit-image's Laplacian of Gaussian",
    "dog": "scikit-image's difference of Gaussians",
    "doh": "scikit-image's determinant of Hessian",
}
assert set(METHODS) == set(get_args(Method))
# The threshold by which frames were made is not known from them; the recorder of the published TacTip recordings has this one.
UNKNOWN_BLOCK_PX, UNKNOWN_OFFSET = 61, -5.0
LEAST_LEVEL = 0.5  # gray levels: no threshold goes below


class Evidence(Section):
    """How sure a tuning is: what it saw.

    Attributes
    ----------
    frames : int
        Number of frames that were looked at.
    exact_rate : float
        Share of the frames in which all pins in view were found.
    low_rate : float
        Lower end of the 90 % interval of that share.
    threshold_slack : float
        Gray levels by which the threshold may move either way at nearly the same rate.
    mask_slack_px : float
        Distance between the outermost pins seen and the mask.
    sure : {"sure", "fairly sure", "unsure"}
        These numbers in words.
    """

    frames: int
    exact_rate: Fraction
    low_rate: Fraction
    threshold_slack: float
    mask_slack_px: float
    sure: Literal["sure", "fairly sure", "unsure"]


class DetectorSpec(Section):
    """One way to find the pins of one sensor in frames of one form.

    Attributes
    ----------
    name : str
        The file's stem; not a key of the file.
    method : str
        A key of ``METHODS``, which says what each does.
    form : {"raw", "recording"}
        Form of the frames.
    size_px : (width, height), optional
        Of the frames; without it those of the sensor's specification.
    blob : BlobSpec
        As in a sensor's ``[pipeline.raw]``. Its ``threshold`` is the contrast in gray levels that ``log``, ``dog`` and ``doh`` ask of a
        blob, and the lowest level that ``simple`` looks at.
    radius_px : (smallest, largest)
        Radii of the caps.
    recording : RecordingSpec, optional
        What the published method's recorder does to a raw frame.
    pins_px : (N, 2) float
        Where the tuning saw the pins at rest, in the specification's order; empty: the specification's own layout.
    evidence : Evidence, optional
        How sure the tuning is.
    """

    name: Name
    method: Method
    form: Annotated[Form, Field(strict=False)] = Form.RAW  # files hold its text
    size_px: tuple[Annotated[int, Field(ge=16, le=8192)], Annotated[int, Field(ge=16, le=8192)]] | None = None
    blob: BlobSpec
    radius_px: tuple[Positive, Positive] = (2.0, 8.0)
    recording: RecordingSpec | None = None
    pins_px: tuple[tuple[float, float], ...] = ()
    evidence: Evidence | None = None

    def stricter(self, levels: float) -> "DetectorSpec":
        """The same with a threshold that many gray levels stricter."""
        if not levels:
            return self
        if self.method == "legacy" and self.recording is not None:
            moved = self.recording.model_copy(update={"threshold_offset": self.recording.threshold_offset - levels})
            return self.model_copy(update={"recording": moved})
        adaptive = self.method in ("twin", "adaptive") and self.blob.threshold_block_px
        threshold = self.blob.threshold - levels if adaptive else max(self.blob.threshold + levels, LEAST_LEVEL)
        return self.model_copy(update={"blob": self.blob.model_copy(update={"threshold": threshold})})


def shipped_detector(spec: SensorSpec, form: Form, method: Method = "twin") -> DetectorSpec:
    """What a sensor's specification says: this program's pipeline, or the published method where the sensor has recordings."""
    return DetectorSpec(name=method, method=method, form=form, blob=blob_spec(spec.pipeline, form), recording=spec.recording)


def with_detector(spec: SensorSpec, detector: DetectorSpec) -> SensorSpec:
    """A sensor whose pins are found as a tuning found best, in frames of the size and form that it was made on.

    The tuning's places of the pins at rest become the specification's. Where the frames have another size, so does the camera (or the
    recording), and the camera's focal lengths and principal point are scaled and shifted as its view of the pins is.

    Raises
    ------
    FrameError
        The tuning is one of another number of pins.
    """
    if detector.pins_px and len(detector.pins_px) != spec.pins.count:
        raise FrameError(
            f"'{detector.name}' was tuned for {len(detector.pins_px)} pins, {spec.name} has {spec.pins.count}: tune it for this sensor"
        )
    blob = detector.blob.model_copy(update={"rest_px": detector.pins_px or detector.blob.rest_px})
    pipeline = spec.pipeline.model_copy(update={str(detector.form): blob})
    changed: dict[str, Section | None] = {"pipeline": pipeline}
    size = detector.size_px
    if size is not None and size != known_frames(spec).size_px.get(detector.form):
        width, height = size
        if detector.form == Form.RAW:
            changed["pipeline"] = pipeline.model_copy(update={"usual_caps": None})  # the caps' edges have another width in these frames
            seen_px = np.array(detector.pins_px).reshape(-1, 2)
            changed["camera"] = camera_seeing(spec, seen_px, np.arange(len(seen_px))).model_copy(
                update={"width_px": width, "height_px": height}
            )
        elif spec.recording is not None:
            changed["recording"] = spec.recording.model_copy(update={"width_px": width, "height_px": height})
        else:
            whole = (0, 0, spec.camera.width_px, spec.camera.height_px)
            changed["recording"] = RecordingSpec(
                crop_px=whole, width_px=width, height_px=height, threshold_block_px=UNKNOWN_BLOCK_PX, threshold_offset=UNKNOWN_OFFSET
            )
    return spec.model_copy(update=changed)


def camera_seeing(spec: SensorSpec, pins_px: np.ndarray, known: np.ndarray) -> CameraSpec:
    """The camera, scaled and shifted so that it sees the ``known`` (n,) of the pins at rest where pins (N, 2) are, by least squares."""
    camera = spec.camera
    if not len(known):
        return camera
    ours, seen = project(spec.view, rest_pins(spec.geometry).caps_mm[known]), pins_px[known]
    middle, seen_middle = ours.mean(axis=0), seen.mean(axis=0)
    scale = float(np.sqrt(np.sum((seen - seen_middle) ** 2) / np.sum((ours - middle) ** 2)))
    cx, cy = (seen_middle + scale * (np.array([camera.cx_px, camera.cy_px]) - middle)).tolist()
    return camera.model_copy(update={"fx_px": scale * camera.fx_px, "fy_px": scale * camera.fy_px, "cx_px": cx, "cy_px": cy})


def load_detector(path: Path) -> DetectorSpec:
    """Read what ``twin tune`` wrote.

    Raises
    ------
    FrameError
        It is no such file; names key and remedy.
    """
    try:
        return read_section(path, DetectorSpec)
    except SpecError as error:
        raise FrameError(f"{error}; give a file written by 'twin tune', or one of {', '.join(METHODS)}") from error


def write_detector(path: Path, detector: DetectorSpec, comment: str = "") -> None:
    """Write a detector's parameters for `load_detector`.

    Raises
    ------
    StoreError
        They can't be written; the error's ``unsaved`` has them.
    """
    document = tomlkit.document()
    for line in comment.splitlines():
        document.add(tomlkit.comment(line))
    data = {key: value for key, value in detector.model_dump(mode="json").items() if value is not None and key != "name"}
    pins = tomlkit.array()
    for x, y in data["pins_px"]:
        pins.add_line([round(x, 2), round(y, 2)])
    pins.add_line(indent="")
    data["pins_px"] = pins
    for key in sorted(data, key=lambda k: isinstance(data[k], dict)):  # tables come last
        document.add(key, data[key])
    write_result(path.parent, {path.name: tomlkit.dumps(document)})
