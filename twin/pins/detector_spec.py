"""The parameters of a way to find pins: what ``twin tune`` writes and ``--pipeline`` takes."""

from pathlib import Path
from typing import Annotated, Literal, get_args

import tomlkit
from pydantic import Field

from scenes.base import Fraction, Name, Positive, Section, SpecError
from scenes.load import read_section
from scenes.sensor import BlobSpec, RecordingSpec, SensorSpec
from twin.errors import FrameError
from twin.frames.forms import blob_spec
from twin.store import write_text
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
LEAST_LEVEL = 0.5  # gray levels: no threshold goes below


class Evidence(Section):
    """How sure a tuning is: what it saw.

    ``exact_rate``: share of the frames in which all pins were found. ``low_rate``: lower end of its 90 % interval.
    ``threshold_slack``: gray levels by which the threshold may move either way at nearly the same rate.
    ``mask_slack_px``: between the outermost pins seen and the mask.
    """

    frames: int
    exact_rate: Fraction
    low_rate: Fraction
    threshold_slack: float
    mask_slack_px: float
    sure: Literal["sure", "fairly sure", "unsure"]


class DetectorSpec(Section):
    """One way to find the pins of one sensor in frames of one form.

    ``blob`` as in a sensor's ``[pipeline.raw]``; its ``threshold`` is the contrast in gray levels that ``log``, ``dog`` and
    ``doh`` ask of a blob, and the lowest level that ``simple`` looks at. ``radius_px``: of the caps, from the smallest to the largest.
    ``recording``: what the published method's recorder does to a raw frame. ``pins_px``: where the tuning saw the pins at
    rest, in the specification's order (without them: the specification's own layout).
    """

    name: Name
    method: Method
    form: Annotated[Form, Field(strict=False)] = Form.RAW  # files hold its text
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
        They can't be written.
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
    write_text(path, tomlkit.dumps(document))
