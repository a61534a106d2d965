"""``--at-rest``: which frame without contact pins are counted from."""

from pathlib import Path
from typing import Annotated

import typer

FIRST, NONE = "first", "none"

AtRest = Annotated[
    str,
    typer.Option(
        "--at-rest",
        metavar="FRAME|first|none",
        help="no-contact frame that pins are counted from: a file, the first that is taken (an error if the sensor seems pressed in it), "
        "or none (the specification's layout)",
    ),
]


def given_frame(text: str, estimator):
    """The no-contact frame of a file or a recording's folder; None where ``first`` or ``none`` was asked for.

    Raises
    ------
    FrameError
        There is no such frame.
    """
    from twin.errors import FrameError
    from twin.recordings import open_recording

    if text in (FIRST, NONE):
        return None
    if not Path(text).exists():
        raise FrameError(f"--at-rest {text}: no such file; expected a frame without contact, 'first' or 'none'")
    recording = open_recording(text, estimator.sensor, estimator.form)
    return recording.reference if recording.reference is not None else recording.read(0)


def counting_from_first(estimator, frame):
    """The estimator that counts pins from the first frame that was taken.

    Raises
    ------
    FrameError
        The sensor seems pressed in it, or the model can't count from it.
    """
    from twin.preprocess import require_untouched

    found = estimator.at_rest(frame)
    remedy = "move it clear of everything and begin again, or give a frame that was taken without contact: --at-rest FRAME"
    require_untouched(estimator.sensor, estimator.form, frame, remedy)
    return found
