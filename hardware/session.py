"""A live session on disk: every frame as it was, and a line of JSON for each step.

``session.json`` says what the session is. ``steps.jsonl`` has one line a step, ``frames/`` the pictures (PNG, lossless). A picture is
written before its line, so every picture that a line names exists, and the session can be read up to its last complete line at any
time. ``rest.png`` is the frame without contact that pins were counted from, if one was taken.
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import numpy as np

from hardware.cameras.recorded import SequentialSource
from hardware.errors import DeviceError
from twin.errors import FrameError
from twin.frames.images import read_image, write_image
from twin.store import write_json
from twin.types import Form, Frame

ABOUT, STEPS, FRAMES, REST = "session.json", "steps.jsonl", "frames", "rest.png"
VERSION = 1


def is_session(path: str | Path) -> bool:
    """Whether a folder holds a recorded session."""
    return (Path(path) / ABOUT).is_file() and (Path(path) / STEPS).is_file()


class SessionWriter:
    """Appends the steps of a session.

    Parameters
    ----------
    folder : path
        A new or empty folder, or the folder of a session that ended before its first step. Such a session is begun anew.
    about : dict
        Sensor, camera, model and arm, in types that JSON can hold.
    """

    def __init__(self, folder: str | Path, about: dict) -> None:
        self.folder = Path(folder)
        begun_only = is_session(self.folder) and not (self.folder / STEPS).stat().st_size
        if self.folder.exists() and any(self.folder.iterdir()) and not begun_only:
            raise DeviceError(f"{self.folder}: not empty; give a new folder for the session")
        (self.folder / FRAMES).mkdir(parents=True, exist_ok=True)
        (self.folder / REST).unlink(missing_ok=True)
        write_json(self.folder / ABOUT, {"version": VERSION, **about})
        self._lines = (self.folder / STEPS).open("a", encoding="utf-8")
        self._written: dict[int, str] = {}  # the newest picture by its number: a frame may serve several steps
        self.count = 0

    def append(self, frame: Frame, step: dict) -> None:
        """Write a step and its frame."""
        name = self._written.get(frame.sequence)
        if name is None:
            name = f"frame_{self.count:06d}.png"
            write_image(self.folder / FRAMES / name, frame.image)
            self._written = {frame.sequence: name}
        about_frame = {"file": name, "name": frame.name, "form": str(frame.form), "time_s": frame.time_s, "sequence": frame.sequence}
        line = {"step": self.count, "frame": about_frame, **{key: plain(value) for key, value in step.items()}}
        self._lines.write(json.dumps(line) + "\n")
        self._lines.flush()
        self.count += 1

    def keep_rest(self, frame: Frame) -> None:
        """Keep the frame without contact that pins are counted from."""
        write_image(self.folder / REST, frame.image)

    def close(self) -> None:
        """End the session; its lines are on disk already."""
        self._lines.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_steps(folder: str | Path) -> list[dict]:
    """Every complete step of a session; a line that was being written when it ended is left out."""
    steps = []
    for line in (Path(folder) / STEPS).read_text(encoding="utf-8", errors="replace").split("\n")[:-1]:
        try:
            steps.append(json.loads(line))
        except ValueError:
            break
    return steps


class SessionSource(SequentialSource):
    """A session's frames in the order of its steps. A frame that served several steps is given once for each.

    Parameters
    ----------
    folder : path
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not is_session(self.folder):
            raise FrameError(f"{folder}: holds no recorded session ({ABOUT} and {STEPS} are expected); '--record DIR' writes one")
        self.about = json.loads((self.folder / ABOUT).read_text())
        self.steps = read_steps(self.folder)
        if not self.steps:
            raise FrameError(f"{folder}: the session ended before its first step; nothing to replay")
        super().__init__(str(folder), Form(self.steps[0]["frame"]["form"]))

    @property
    def rest(self) -> Frame | None:
        """The frame without contact that pins were counted from; None if they were counted from the nominal layout."""
        if not (self.folder / REST).is_file():
            return None
        return Frame(read_image(self.folder / REST)[0], self.form, REST)

    def _frames(self) -> Iterator[Frame]:
        for step in self.steps:
            about = step["frame"]
            image, _ = read_image(self.folder / FRAMES / about["file"])
            yield Frame(image, Form(about["form"]), about["name"], about["time_s"], about["sequence"])


def plain(value: object) -> object:
    """The value as JSON can hold it: an array becomes a list, a number that is not finite becomes null."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(part) for part in (value.tolist() if isinstance(value, np.ndarray) else value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
