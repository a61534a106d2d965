"""The parameters of a pin detector, as ``twin tune`` writes them and ``--pipeline`` reads them; or a user's own function in its place.

A function in a Python file is named ``FILE.py:FUNCTION``. It takes the picture of a frame, (H, W) or (H, W, 3) RGB uint8, and returns the
places (n, 2) of the pins that it finds: x (column) and y (row) in px of the picture, in any order. Rows that are not finite count as not
found.
"""

import hashlib
import importlib.util
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
import tomlkit
from pydantic import Field, model_validator

from scenes.base import Fraction, Name, Positive, Section, SpecError
from scenes.load import read_section
from scenes.sensor import BlobSpec, CameraSpec, Polarity, RecordingSpec, SensorSpec
from scenes.write import toml_document
from twin.camera.projection import project
from twin.errors import ErrorsAs, FrameError, OptionError
from twin.frames.forms import blob_spec, known_sizes
from twin.geometry.pins import rest_pins
from twin.store import write_result
from twin.types import Form, Frame

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
OWN: Literal["own"] = "own"
"""Method of a detector that uses a function of the user; it has no parameters and can't be tuned."""
# Assumed block, px, and offset, gray levels, of a recorder's threshold, because frames do not show how they were thresholded. The values
# are those of the published TacTip recordings' recorder.
UNKNOWN_BLOCK_PX, UNKNOWN_OFFSET = 61, -5.0
LEAST_LEVEL = 0.5  # smallest fixed threshold, gray levels


class Evidence(Section):
    """Evidence for the reliability of a tuning.

    Attributes
    ----------
    frames : int
        Number of frames that were used.
    exact_rate : float
        Share of the frames in which all pins in view were found.
    low_rate : float
        Lower end of the 90 % interval of that share.
    threshold_slack : float
        Gray levels by which the threshold can change in both directions at nearly the same rate.
    mask_slack_px : float
        Distance between the outermost found pins and the mask.
    sure : {"sure", "fairly sure", "unsure"}
        The reliability that follows from these numbers.
    """

    frames: int
    exact_rate: Fraction
    low_rate: Fraction
    threshold_slack: float
    mask_slack_px: float
    sure: Literal["sure", "fairly sure", "unsure"]


class DetectorSpec(Section):
    """A method to find the pins of one sensor in frames of one form, with its parameters.

    Attributes
    ----------
    name : str
        The file's stem; not a key of the file.
    method : str
        A key of ``METHODS``, which describes each method; or ``OWN``.
    form : {"raw", "processed"}
        Form of the frames.
    size_px : (width, height), optional
        Width and height of the frames; by default those of the sensor's specification.
    blob : BlobSpec
        Parameters as in a sensor's ``[pipeline.raw]``. For ``log``, ``dog`` and ``doh``, ``threshold`` is the least contrast of a blob in
        gray levels. For ``simple`` it is the lowest of the thresholds.
    radius_px : (smallest, largest)
        Smallest and largest radius of the caps, px.
    recording : RecordingSpec, optional
        Recorder with which the published method converts a raw frame first.
    pins_px : (N, 2) float
        Pins at rest that the tuning found, in the specification's order; if empty, the specification's own layout is used.
    evidence : Evidence, optional
        Evidence for the reliability of the tuning.
    finder, finder_digest : str
        With ``OWN``: the function as ``FILE.py:FUNCTION``, and a digest of the file.
    """

    name: Name
    method: Method | Literal["own"]
    form: Annotated[Form, Field(strict=False)] = Form.RAW  # not strict, because files hold the form as text
    size_px: tuple[Annotated[int, Field(ge=16, le=8192)], Annotated[int, Field(ge=16, le=8192)]] | None = None
    blob: BlobSpec
    radius_px: tuple[Positive, Positive] = (2.0, 8.0)
    recording: RecordingSpec | None = None
    pins_px: tuple[tuple[float, float], ...] = ()
    evidence: Evidence | None = None
    finder: str = ""
    finder_digest: str = ""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.method == OWN) != bool(self.finder):
            raise ValueError(f'method = "{OWN}" needs finder = "FILE.py:FUNCTION", and no other method has a finder')
        return self

    def stricter(self, levels: float) -> "DetectorSpec":
        """The same parameters with a threshold that is stricter by this number of gray levels. A function of the user has none."""
        if not levels or self.method == OWN:
            return self
        if self.method == "legacy" and self.recording is not None:
            return self.alter(recording={"threshold_offset": self.recording.threshold_offset - levels})
        adaptive = self.method in ("twin", "adaptive") and self.blob.threshold_block_px
        threshold = self.blob.threshold - levels if adaptive else max(self.blob.threshold + levels, LEAST_LEVEL)
        return self.alter(blob={"threshold": threshold})


def shipped_detector(spec: SensorSpec, form: Form, method: Method = "twin") -> DetectorSpec:
    """The detector with the parameters of a sensor's specification, for this program's pipeline or another method."""
    return DetectorSpec(name=method, method=method, form=form, blob=blob_spec(spec.pipeline, form), recording=spec.recording)


def with_detector(spec: SensorSpec, detector: DetectorSpec) -> SensorSpec:
    """A sensor with the parameters of a tuning, for frames of the size and form for which the tuning was made.

    The tuning's pins at rest become the specification's. If the frames have another size, the size of the camera (or of the recording) is
    changed, too. The camera's focal lengths and principal point are then scaled and shifted so that it sees the pins at these places.

    Raises
    ------
    FrameError
        The tuning belongs to another number of pins.
    """
    if detector.pins_px and len(detector.pins_px) != spec.pins.count:
        raise FrameError(
            f"'{detector.name}' was tuned for {len(detector.pins_px)} pins, {spec.name} has {spec.pins.count}: tune it for this sensor"
        )
    blob = detector.blob.alter(rest_px=detector.pins_px or detector.blob.rest_px)
    pipeline = spec.pipeline.alter(**{str(detector.form): blob})
    changed: dict[str, Section | None] = {"pipeline": pipeline}
    size = detector.size_px
    if size is not None and size != known_sizes(spec).get(detector.form):
        width, height = size
        if detector.form == Form.RAW:
            changed["pipeline"] = pipeline.alter(usual_caps=None)  # caps have another edge width in frames of this size
            seen_px = np.array(detector.pins_px).reshape(-1, 2)
            changed["camera"] = camera_seeing(spec, seen_px, np.arange(len(seen_px))).alter(width_px=width, height_px=height)
        elif spec.recording is not None:
            changed["recording"] = spec.recording.alter(width_px=width, height_px=height)
        else:
            changed["recording"] = whole_recording((spec.camera.width_px, spec.camera.height_px), size, blob.polarity)
    return spec.alter(**changed)


def whole_recording(camera_px: tuple[int, int], size_px: tuple[int, int], polarity: Polarity) -> RecordingSpec:
    """A recorder that keeps the camera's whole frame. Thresholded frames do not show how they were thresholded."""
    return RecordingSpec(
        crop_px=(0, 0, *camera_px),
        width_px=size_px[0],
        height_px=size_px[1],
        threshold_block_px=UNKNOWN_BLOCK_PX,
        threshold_offset=UNKNOWN_OFFSET if polarity == "bright" else -UNKNOWN_OFFSET,
    )


def camera_seeing(spec: SensorSpec, pins_px: np.ndarray, known: np.ndarray) -> CameraSpec:
    """The camera, scaled and shifted by least squares to see the ``known`` (n,) pins at rest at their places in ``pins_px`` (N, 2)."""
    camera = spec.camera
    if not len(known):
        return camera
    ours, seen = project(spec.view, rest_pins(spec.geometry).caps_mm[known]), pins_px[known]
    middle, seen_middle = ours.mean(axis=0), seen.mean(axis=0)
    scale = float(np.sqrt(np.sum((seen - seen_middle) ** 2) / np.sum((ours - middle) ** 2)))
    cx, cy = (seen_middle + scale * (np.array([camera.cx_px, camera.cy_px]) - middle)).tolist()
    return camera.alter(fx_px=scale * camera.fx_px, fy_px=scale * camera.fy_px, cx_px=cx, cy_px=cy)


def load_detector(path: Path) -> DetectorSpec:
    """Read the parameters that ``twin tune`` wrote.

    Raises
    ------
    FrameError
        The file does not hold such parameters; the message names the key and the remedy.
    """
    with ErrorsAs(SpecError, lambda error: FrameError(f"{error}; give a file written by 'twin tune', or one of {', '.join(METHODS)}")):
        return read_section(path, DetectorSpec)


def write_detector(path: Path, detector: DetectorSpec, comment: str = "") -> None:
    """Write a detector's parameters in the form that `load_detector` reads.

    Raises
    ------
    StoreError
        The file can't be written; the error's ``unsaved`` has its text.
    """
    data = {key: value for key, value in detector.model_dump(mode="json").items() if value is not None and key != "name"}
    data["pins_px"] = [[round(x, 2), round(y, 2)] for x, y in detector.pins_px]
    write_result(path.parent, {path.name: tomlkit.dumps(toml_document(data, comment))})


def is_own(text: str) -> bool:
    """Whether a text names a function in a Python file."""
    return text.rpartition(":")[0].endswith(".py")


def own_name(text: str) -> str:
    """The function's name in ``FILE.py:FUNCTION``, which is there and can be called.

    Raises
    ------
    OptionError
        There is no such file or function, or the file raises an error when it is run.
    """
    path, name = _parts(text)
    _function(path, name, _digest(path))
    return name


def own_detector(text: str, spec: SensorSpec, form: Form) -> DetectorSpec:
    """The detector that uses the function ``FILE.py:FUNCTION``; its name is the function's.

    Its code counts as changed when the file has changed. Other files that it imports are not looked at.

    Raises
    ------
    OptionError
        As `own_name`.
    """
    path, name = _parts(text)
    digest = _digest(path)
    _function(path, name, digest)
    own = {"name": name, "method": OWN, "finder": f"{path}:{name}", "finder_digest": digest}
    return shipped_detector(spec, form).model_copy(update=own)


def own_places(detector: DetectorSpec, frame: Frame) -> np.ndarray:
    """Places (n, 2) that the user's function finds in a frame, px.

    Raises
    ------
    FrameError
        The function raises an error, or what it returns are not places.
    """
    path, name = _parts(detector.finder)
    function = _function(path, name, detector.finder_digest)
    with ErrorsAs(Exception, lambda error: FrameError(f"{name} failed: {type(error).__name__}: {error}")):
        returned = function(frame.image.copy())
    try:
        px = np.asarray(returned, float)
    except (TypeError, ValueError):
        px = np.zeros(0)
        returned = type(returned).__name__
    if px.size == 0 and np.ndim(returned):
        return np.zeros((0, 2))
    if px.ndim != 2 or px.shape[1] != 2:
        got = f"an array {px.shape}" if px.size else str(returned)
        raise FrameError(f"{name} returned {got}; return places (n, 2): x (column) and y (row) in px of the picture")
    return px[np.isfinite(px).all(axis=1)]


def _parts(text: str) -> tuple[Path, str]:
    file, _, name = text.rpartition(":")
    return Path(file).resolve(), name


def _digest(path: Path) -> str:
    """Of the file's content."""
    with ErrorsAs(OSError, lambda error: OptionError(f"{path} can't be read ({error.strerror}); give FILE.py:FUNCTION")):
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


@cache
def _function(path: Path, name: str, digest: str) -> Callable[[np.ndarray], Any]:
    """The function of a file, which is run once for each of its contents. What lies beside the file can be imported by it."""
    described = importlib.util.spec_from_file_location(f"tactip_own_{digest}", path)
    if described is None or described.loader is None:
        raise OptionError(f"{path}: is no Python file; give FILE.py:FUNCTION")
    if _digest(path) != digest:
        raise OptionError(f"{path}: was changed during the work; give the same command again")
    module = importlib.util.module_from_spec(described)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    try:
        described.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise OptionError(f"{path}: ended with {type(error).__name__}: {error}; repair it, and try 'python {path.name}'") from error
    function = getattr(module, name, None)
    if not callable(function):
        there = [key for key, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__ and callable(value)]
        raise OptionError(f"{path}: has no function '{name}'; it has: {', '.join(there) or 'none'}")
    return function
