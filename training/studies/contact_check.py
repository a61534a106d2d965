"""Finding of ``twin check`` about the contacts in frames: whether they are in a model's domain."""

from importlib.util import find_spec
from pathlib import Path

from scenes.sensor import SensorSpec
from twin.errors import format_count
from twin.pins.check import Finding, Grade
from twin.types import Frame

MOST_STRANGE = 0.5
"""Share of the frames with pins above which frames that the model refuses are bad."""


def contact_finding(frames: list[Frame], sensor: SensorSpec, run: Path | None = None) -> Finding | None:
    """Count the frames that a model refuses, and name them with the model's reasons.

    Parameters
    ----------
    frames : list of Frame
        Frames of one form; those in which the pins are not found do not count.
    sensor : SensorSpec
    run : Path, optional
        Folder of a run; the shipped weights of the sensor by default.

    Returns
    -------
    Finding or None
        None if there are no weights for this sensor and form, they hold no domain, or torch is not installed.

    Raises
    ------
    TrainingError
        There is no such run.
    FrameError
        The run is of another sensor or form.
    """
    if run is None and find_spec("torch") is None:
        return None
    from training.estimate.estimator import PoseEstimator  # loads torch
    from training.runs.run_files import shipped_names

    if run is None and sensor.name not in shipped_names():
        return None
    model = PoseEstimator.load(run or sensor.name)
    if run is not None:
        model.check(sensor, frames[0].form)
    if model.form != frames[0].form or model.domain is None:
        return None
    model, assessed, strange = model.at_known_rest(), 0, []
    for frame in frames:
        made = model(frame)
        if made.seen is not None and made.seen.valid:
            assessed += 1
            strange += [] if made.valid else [f"{frame.name}: {made.reason}"]
    share = len(strange) / max(assessed, 1)
    text = f"{assessed - len(strange)} of {format_count(assessed, 'frames')} with pins are contacts that the weights of {sensor.name} know"
    if not strange:
        return Finding("contacts", Grade.HEALTHY, share, text, "")
    verdict = Grade.FAILED if share > MOST_STRANGE else Grade.DEGRADED
    return Finding("contacts", verdict, share, f"{text}; {'; '.join(strange[:3])}", "see the reasons; leave these frames out")
