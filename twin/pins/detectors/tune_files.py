"""Tunes the pin detection on a folder of a user's own frames, and writes the parameters to a file."""

from dataclasses import dataclass
from pathlib import Path

from scenes import SensorSpec
from twin.errors import OptionError, format_count
from twin.frames import Recording, evenly_read, open_recording
from twin.frames.forms import known_sizes, times
from twin.pins.detectors.detector_spec import Evidence, Method, write_detector
from twin.pins.detectors.tune import Tuned, tune
from twin.pins.pipeline import Pipeline
from twin.progress import Progress, silent, stage
from twin.store import writes_file
from twin.types import Form, Frame, ReadableResult

# Most frames that are used if no other number is given.
LIMIT = 12


@dataclass(frozen=True, repr=False)
class TunedOnFrames(ReadableResult):
    """The result of a tuning on a user's frames.

    Attributes
    ----------
    tuned : Tuned
    evidence : Evidence
        Evidence for the reliability of the tuning.
    written : list of Path
        The written file, if one was requested.
    odd : list of str
        Irregularities of the recording.
    """

    tuned: Tuned
    evidence: Evidence
    written: list[Path]
    odd: list[str]

    def lines(self) -> list[str]:
        """The result as lines of text: how reliable it is, the parameters, and reasons to doubt them."""
        detector, evidence = self.tuned.detector, self.evidence
        blob, exact, low = detector.blob, 100 * evidence.exact_rate, 100 * evidence.low_rate
        (x, y), radius, slack = blob.mask_center_px, blob.mask_radius_px, evidence.mask_slack_px
        lines = [
            f"{evidence.sure}: all pins in view found in {exact:.0f} % of {format_count(evidence.frames, 'frames')} "
            f"(90 % sure: at least {low:.0f} %)",
            f"mask centre ({x:g}, {y:g}) px, radius {radius:g} px, {slack:g} px beyond the outermost pins",
        ]
        if recorder := detector.recording:
            lines.append(f"crop {recorder.crop_px}, adaptive threshold {recorder.threshold_offset:g} over {recorder.threshold_block_px} px")
        elif blob.spot_sigma_px:
            lines.append(f"bright spots of {blob.spot_sigma_px:g} px (sd); no threshold is used")
        else:
            over = f" over {blob.threshold_block_px} px, erosion {blob.erosion_px} px" if blob.threshold_block_px else ""
            lines.append(
                f"threshold {blob.threshold:g}{over}, may change by {evidence.threshold_slack:g} gray levels; least area "
                f"{blob.min_area_px2:g} px2"
            )
        lines.append(self.tuned.rest.line())
        return [*lines, *(f"note: {note}" for note in [*self.tuned.notes, *self.odd])]


@writes_file()
def tune_on_frames(
    path: Path,
    sensor: SensorSpec,
    *,
    out: Path | None = None,
    method: Method = "twin",
    form: Form | None = None,
    limit: int = LIMIT,
    progress: Progress = silent,
) -> TunedOnFrames:
    """Find the parameters from at most ``limit`` frames, spread evenly over those at a path.

    Parameters
    ----------
    path : Path
        Path as for ``open_recording``. If it has a frame without contact, this frame gives the pins at rest.
    sensor : SensorSpec
        Only the layout and the polarity of its pins are used.
    out : Path, optional
        The ``.toml`` file to write.

    Raises
    ------
    FrameError
        No frame shows the layout, or the frame without contact does not, or ``out`` is not the name of a ``.toml`` file.
    """
    if out is not None and out.suffix != ".toml":
        raise OptionError(f"`out` {out}: give the name of a .toml file")
    recording = open_recording(path, None, form or (Form.RAW if sensor.recording is None else None))
    frames = evenly_read(recording, limit)
    odd = recording.notes() + _of_another_size(recording, sensor)
    with stage(progress, "tuning") as step:
        found = tune(frames, sensor, method, given=recording.reference, progress=step)
    evidence = found.detector.evidence
    assert evidence is not None  # ``tune`` always gives evidence
    odd += _worse(evidence, recording, frames, sensor)
    if out is not None:
        write_detector(
            out,
            found.detector,
            f"Found by 'twin tune' from frames of {recording.path.name} ({len(frames)}); {evidence.sure}. {found.rest.line()}.",
        )
    return TunedOnFrames(found, evidence, [] if out is None else [out], odd)


def _worse(evidence: Evidence, recording: Recording, frames: list[Frame], sensor: SensorSpec) -> list[str]:
    """A note if the specification's own detection finds all pins in more of the frames; none for frames of another size."""
    if known_sizes(sensor).get(recording.form) != recording.size_px:
        return []
    own = Pipeline(sensor, recording.form)
    rate = sum(own(frame).complete for frame in frames) / len(frames)
    if rate <= evidence.exact_rate:
        return []
    return [
        f"the detection of the specification itself finds all pins in {rate:.0%} of these frames: keep it, or tune with `method`, other "
        "frames or a frame without contact (`no_contact`)"
    ]


def _of_another_size(recording: Recording, sensor: SensorSpec) -> list[str]:
    """A note if the frames have the size of none of the sensor's forms."""
    sizes = known_sizes(sensor).values()
    if recording.size_px in sizes:
        return []
    own = " or ".join(times(size) for size in sizes)
    return [
        f"{recording.names[0]}: {times(recording.size_px)}, {sensor.name} has frames of {own}; these parameters are for frames of "
        f"{times(recording.size_px)} only"
    ]
