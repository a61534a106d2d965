"""Translates records from any format into any other, and keeps a record in further formats while it is being made."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from scenes import SensorSpec, SpecError, load_sensor
from scenes.files import LONGEST_PATH, quote
from twin.errors import FrameError, library, warn_once
from twin.frames.forms import frame_size, times
from twin.frames.lerobot import RESTS
from twin.pins.pipeline import Pipeline, measure_reference
from twin.progress import Progress, silent, stage
from twin.records.folder import SIDECAR, FolderWriter, format_of
from twin.records.huggingface import HuggingFaceWriter, huggingface_records
from twin.records.lerobot import INFO, LeRobotWriter, lerobot_records
from twin.records.record import About, Episode, RecordError, Records, RecordStep, is_pins
from twin.records.recording import RecordingWriter, recording_records
from twin.records.ros2 import Ros2Writer, ros2_records
from twin.records.session import is_session, rig_records, session_records
from twin.store import writes
from twin.types import Frame, ReadableResult

WRITERS: dict[str, type[FolderWriter]] = {each.FORMAT: each for each in (RecordingWriter, LeRobotWriter, HuggingFaceWriter, Ros2Writer)}
"""Class that writes each format."""
_READ: tuple[Callable[[Path], Records], ...] = (recording_records, lerobot_records, huggingface_records, ros2_records)
READERS = dict(zip(WRITERS, _READ, strict=True))
"""Function that reads the records of each format."""
FORMATS = tuple(READERS)
"""Formats that can be written."""
ALSO = tuple(name for name in FORMATS if name != RecordingWriter.FORMAT)
"""Formats in which a record can be kept in addition to its own."""


def open_records(path: str | Path) -> Records:
    """Records of any format: a session, a recording, a data set, or the result of a translation.

    Raises
    ------
    RecordError
        There is nothing at ``path``, or it is damaged.
    FrameError
        A recording or session can't be read.
    """
    path = Path(path)
    if not path.exists():
        raise RecordError(f"{quote(path, LONGEST_PATH)}: no such file or folder; give a recording, a session or a translated record")
    if path.suffix == ".mcap":
        return ros2_records(path)
    if path.is_dir():
        if is_session(path):
            return session_records(path)
        if name := format_of(path):
            if name not in READERS:
                raise RecordError(f"{path}: of the unknown format {quote(name)}; read it with the program that wrote it")
            return READERS[name](path)
        if (path / INFO).is_file():
            return lerobot_records(path)
        if (records := rig_records(path)) is not None:
            return records
    return recording_records(path)


def with_pins(records: Records, spec: SensorSpec | None = None) -> Records:
    """Records with the pins that are found in their pictures, if they have none. A pin that is not found is NaN.

    Parameters
    ----------
    spec : SensorSpec, optional
        The sensor. By default the one that the records name. If they name none, or an unknown one, the records are returned unchanged.

    Raises
    ------
    FrameError
        The pictures, or the pins that the records have, are not of this sensor.
    """
    if any(map(is_pins, records.about.numbers)):
        if spec is not None:
            _require_pins_of(spec, records.about)
        return records
    if spec is None:
        with suppress(SpecError):
            spec = load_sensor(records.about.sensor) if records.about.sensor else None
    if spec is None:
        note = "no pins: the record does not name a known sensor; give `sensor`, so that its pins are detected"
        return replace(records, notes=[*records.notes, note])
    if (expected := frame_size(spec, records.about.form)) != records.about.size_px:
        got = f"{records.episodes[0].key if records.episodes else 'the record'}: frames of {times(records.about.size_px)}"
        raise FrameError(f"{got}, those of {spec.name} are {times(expected)}; give the matching `sensor`, or another recording or session")
    numbers = {"pins": 2 * spec.pins.count, **records.about.numbers}
    about = replace(records.about, sensor=spec.name, numbers=numbers)
    found = [replace(episode, steps=partial(_translated_steps, episode, about, spec)) for episode in records.episodes]
    return Records(about, found, records.notes)


def _require_pins_of(spec: SensorSpec, about: About) -> None:
    """Refuse a sensor if the pins of a record are those of another one, by its name or by their number."""
    count = next(count for name, count in about.numbers.items() if is_pins(name)) // 2
    name = Path(about.sensor).stem
    if name in ("", spec.name) and count == spec.pins.count:
        return
    owner = f"of the sensor '{name}' ({count} pins)" if name else f"of a sensor with {count} pins"
    problem = f"the record holds pins {owner}, the given sensor is '{spec.name}' ({spec.pins.count} pins)"
    raise FrameError(f"{problem}; leave `sensor` out, or give the matching one")


def _translated_steps(episode: Episode, about: About, spec: SensorSpec) -> Iterator[RecordStep]:
    reference = None
    if episode.rest is not None:
        reference = measure_reference(spec, about.form, Frame(episode.rest, about.form, "the picture without contact"))
    pipeline = Pipeline(spec, about.form, reference)
    for step in episode.steps():
        pins_px = pipeline(Frame(step.image, about.form)).pins_px.astype(np.float32)
        yield replace(step, values={"pins": pins_px, **step.values})


def open_writer(folder: Path, to: str, about: About, rate_hz: int, *, video: bool = False, at_once: bool = False) -> FolderWriter:
    """The writer of a format for a folder. It must be entered as a context.

    Parameters
    ----------
    to : str
        One of ``FORMATS``.
    video, at_once : bool
        As for ``FolderWriter``.

    Raises
    ------
    RecordError
        There is no such format, or the format has no videos.
    """
    if to not in FORMATS:
        raise RecordError(f"no format {quote(to)}; there are {', '.join(FORMATS)}")
    writer = WRITERS[to]
    if video and not writer.VIDEOS:
        raise RecordError(f"`video` is an option of the format {LeRobotWriter.FORMAT}; {to} stores pictures without loss; leave it out")
    if len(about.views) > 1 and not writer.VIEWS:
        raise RecordError(f"{to} has one picture in a step, this record has {len(about.views)}; give lerobot or mcap, or one session of it")
    return writer(folder, about, rate_hz, video=video, at_once=at_once)


@dataclass(frozen=True, repr=False)
class Converted(ReadableResult):
    """The result of ``convert``.

    Attributes
    ----------
    folder : Path
    to : str
        Format.
    episodes, steps : int
        Number in the folder.
    before : int
        Number of episodes in the folder before.
    notes : list of str
        Irregularities of the sources.
    """

    folder: Path
    to: str
    episodes: int
    steps: int
    before: int
    notes: list[str] = field(default_factory=list)

    @property
    def written(self) -> list[Path]:
        """The folder."""
        return [self.folder]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        new = f" ({self.episodes - self.before} new)" if self.before else ""
        return [*(f"note: {note}" for note in self.notes), f"episodes: {self.episodes}, frames: {self.steps}{new} as {self.to}"]


@writes(gone_on=tuple(dict.fromkeys((SIDECAR, RESTS, *(name for each in WRITERS.values() for name in each.NAMES)))))
def convert(
    sources: Sequence[str | Path],
    out: str | Path,
    to: str,
    *,
    sensor: SensorSpec | None = None,
    task: str = "",
    video: bool = False,
    progress: Progress = silent,
) -> Converted:
    """Translate records into a format. If the folder already holds such records, the missing episodes are added.

    Parameters
    ----------
    sources : sequence of str or Path
        Paths as for ``open_records``.
    out : Path
        A new or empty folder, or one with records of the same format and sensor, and with the same numbers in each step.
    to : str
        One of ``FORMATS``.
    sensor : SensorSpec, optional
        The sensor whose pins are to be found, if a source does not name it.
    task : str
        Description of the task of all episodes; by default what each source states.
    video : bool
        Store LeRobot's pictures as video, which loses detail.

    Raises
    ------
    RecordError
        A source can't be read or does not fit the others, the folder holds something else, or a library is missing.
    FrameError
        A recording or session can't be read, or is not of the sensor.
    StoreError
        The folder can't be written to, or another run uses it.
    """
    out = Path(out)
    opened = [with_pins(open_records(source), sensor).with_task(task) for source in sources]
    if not any(records.episodes for records in opened):
        named = ", ".join(map(str, sources[:3])) or "nothing was given"
        raise RecordError(f"{named}: no finished episode to translate; give a recording, a session or a translated record")
    first = opened[0]
    for source, records in zip(sources, opened, strict=True):
        if wrong := first.about.differs(records.about):
            raise RecordError(f"{source}: does not fit {sources[0]} ({'; '.join(wrong)}); translate it into another `out`")
    with open_writer(out, to, first.about, first.rate_hz(), video=video) as writer, stage(progress, "episodes") as step:
        before, total = len(writer.facts), sum(len(records.episodes) for records in opened)
        writer.write(_missing(opened, writer, lambda done: step(done, total)))
        facts = writer.facts
    notes = list(dict.fromkeys([*(note for records in opened for note in records.notes), *writer.notes()]))
    return Converted(out, to, len(facts), sum(int(each["length"]) for each in facts), before, notes)


def _missing(opened: Sequence[Records], writer: FolderWriter, done: Callable[[int], object]) -> Iterator[Episode]:
    """Episodes that a writer does not hold yet. Each is given once."""
    given = set(writer.keys)
    for number, episode in enumerate((episode for records in opened for episode in records.episodes), 1):
        if episode.key not in given:
            given.add(episode.key)
            yield episode
        done(number)


class KeptAlso(ExitStack):
    """Keeps a growing record in further formats, each in its own subfolder. A context manager.

    The record itself is always complete. If the process is killed, the missing episodes of the other formats are written when the same
    command continues, or by ``convert``.

    Parameters
    ----------
    folder : Path
        Folder of the record in its own format.
    formats : sequence of str
        Formats, each of ``ALSO``.
    sensor : SensorSpec
    at_once : bool
        As for ``open_writer``.

    Raises
    ------
    RecordError
        There is no such format, or a library is missing.
    """

    def __init__(self, folder: Path, formats: Sequence[str], sensor: SensorSpec, *, at_once: bool = True) -> None:
        super().__init__()
        self.folder, self.formats, self.sensor, self.at_once = folder, tuple(dict.fromkeys(formats)), sensor, at_once
        for name in self.formats:
            if name not in ALSO:
                raise RecordError(f"no further format {quote(name)} for a record; there are {', '.join(ALSO)}")
            for needed in WRITERS[name].LIBRARIES:
                library(needed)
        self._writers: list[FolderWriter] = []

    def catch_up(self) -> None:
        """Write the episodes of the record that the other formats do not have.

        Raises
        ------
        TwinError
            As for ``convert``.
        """
        if not self.formats:
            return
        records = with_pins(open_records(self.folder), self.sensor)
        if not self._writers:
            rate_hz = records.rate_hz()
            for name in self.formats:
                writer = open_writer(self.folder / name, name, records.about, rate_hz, at_once=self.at_once)
                self._writers.append(self.enter_context(writer))
        for writer in self._writers:
            writer.write(_missing([records], writer, lambda done: None))
            for note in writer.notes():
                warn_once(note)
