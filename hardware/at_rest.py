"""Which frame without contact a model counts pins from: a given one, the first that is taken, or none."""

from pathlib import Path

from hardware.step import SensorModel
from twin.errors import FrameError
from twin.preprocess import require_untouched
from twin.recordings import open_recording
from twin.types import Frame

FIRST, NONE = "first", "none"


def given_frame(at_rest: str, model: SensorModel) -> Frame | None:
    """The no-contact frame of a file, or of a recording's folder; None for ``first`` and ``none``.

    Raises
    ------
    FrameError
        There is no such frame.
    """
    if at_rest in (FIRST, NONE):
        return None
    if not Path(at_rest).exists():
        raise FrameError(f"--at-rest {at_rest}: no such file; expected a frame without contact, '{FIRST}' or '{NONE}'")
    recording = open_recording(at_rest, model.sensor, model.form)
    return recording.reference if recording.reference is not None else recording.read(0)


def counting_from_first(model: SensorModel, frame: Frame) -> SensorModel:
    """The model that counts pins from the first frame that was taken.

    Raises
    ------
    FrameError
        The sensor seems pressed in it, or the model can't count from it.
    """
    found = model.at_rest(frame)
    remedy = "move it clear of everything and begin again, or give a frame that was taken without contact: --at-rest FRAME"
    require_untouched(model.sensor, model.form, frame, remedy)
    return found
