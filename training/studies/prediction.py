"""The pose in every frame of a recording, as a trained model tells it."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from training.estimator import PoseEstimate, PoseEstimator
from twin.recordings import Recording, open_recording


@dataclass(frozen=True)
class Predictions:
    """Estimates of a recording's frames, made as they are asked for: iterate over it.

    Attributes
    ----------
    estimator : PoseEstimator
    recording : Recording
    """

    estimator: PoseEstimator = field(repr=False)
    recording: Recording = field(repr=False)

    def __iter__(self) -> Iterator[tuple[str, PoseEstimate]]:
        """The name of each frame, and what the model makes of it."""
        for frame in self.recording:
            yield frame.name, self.estimator(frame)

    def lines(self) -> Iterator[str]:
        """For people: each frame's pose as soon as it is told, and at the end the frames that can't be read."""
        for name, made in self:
            yield f"{name}: {_said(made)}"
        for bad in self.recording.failed:
            yield f"skipped {bad['image_name']}: {bad['reason']}"


def predict_frames(run: str | Path, frames: str | Path) -> Predictions:
    """What a trained model tells of the frames at a path.

    A recording's frame without contact tells where its pins are at rest, where the model can count from it.

    Parameters
    ----------
    run : path
        As ``PoseEstimator.load`` takes it.
    frames : path
        As ``open_recording`` takes it.

    Raises
    ------
    TrainingError
        There is no such run.
    FrameError
        There are no such frames, or they are of another sensor.
    """
    estimator = PoseEstimator.load(run)
    recording = open_recording(frames, estimator.sensor, estimator.form)
    if recording.reference is not None and estimator.counts_from_rest:
        estimator = estimator.at_rest(recording.reference)
    return Predictions(estimator, recording)


def _said(made: PoseEstimate) -> str:
    if not made.valid:
        return f"not valid: {made.reason}"
    rows = zip(made.names, made.units, made.value, made.low, made.high, strict=True)
    pose = ", ".join(f"{name} {value:.3f} {unit} [{low:.3f}, {high:.3f}]" for name, unit, value, low, high in rows)
    moved = "" if made.executed != made.executed else f", move executed {made.executed:.2f}"  # NaN: the model doesn't tell
    return f"{pose}{moved} ({made.ms:.1f} ms)"
