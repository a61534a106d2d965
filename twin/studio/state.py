"""Files of the studio: its whole state, and paths of the object."""

import csv
import io
import json
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated
from urllib.parse import parse_qsl, urlencode, urlsplit

import numpy as np
from pydantic import Field, ValidationError

from scenes import load_object, load_sensor
from scenes.base import NonNegative, Section, SpecError, problem_text
from scenes.files import read_regular
from twin.errors import ErrorsAs, TwinError, format_count
from twin.store import text_file, write_json
from twin.store.atomic import make_folder
from twin.studio.pictures import OverlayChoices
from twin.studio.pose import NAMES, ObjectPose
from twin.studio.scene import PinColour
from twin.types import Form

SENSOR, OBJECT = "mg400-331", "sphere"
"""Sensor and object at first."""
MOST_BYTES = 4_000_000
"""Largest size of a file, bytes. The studio writes no larger ones."""
MOST_SHOWN = 80
"""Most characters of a link that an error message repeats."""
MOST_ROWS = 20_000
"""Most poses of a path."""
FIRST_DEPTH_MM = 2.0
"""Depth of the object at first, mm, so that a contact is visible."""
LAST_STATE = "last-state.json"
"""Name of the file with the state that was shown last."""
COLUMNS = ("time_s", *NAMES)
"""Columns of a path's file."""


class StudioState(Section):
    """Everything that determines what the page shows. The page shows the same when the state is opened again.

    Attributes
    ----------
    studio : int
        Version of this format.
    sensor, object : str
        Names or files, as the command line takes them.
    friction : float or None
        Value that replaces the object's own friction.
    pose : dict of str to float
        The object's six numbers (``ObjectPose``).
    form, colour, drawn : Form, PinColour, OverlayChoices
        The frame's form, the quantity that the pins' colours show, and what is drawn over the picture.
    """

    studio: int = 1
    sensor: str
    object: str
    friction: NonNegative | None = None
    pose: dict[str, float] = {}
    form: Annotated[Form, Field(strict=False)] = Form.RAW
    colour: Annotated[PinColour, Field(strict=False)] = PinColour.DISPLACEMENT
    drawn: Annotated[OverlayChoices, Field(strict=False)] = OverlayChoices.GRAPH

    def object_pose(self) -> ObjectPose:
        """The object's pose."""
        return ObjectPose(**self.pose)

    @classmethod
    def read(cls, content: bytes, name: str, remedy: str = "open a file that 'Save state' wrote") -> "StudioState":
        """Read a state.

        Raises
        ------
        TwinError
            It is not a state of this version's studio.
        """
        if len(content) > MOST_BYTES:
            raise TwinError(f"{name}: {len(content)} bytes are not a state of the studio; {remedy}")
        try:
            state = cls.model_validate_json(content)
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"])) or "not a state of the studio"
            raise TwinError(f"{name}: {place}: {problem_text(first)}; {remedy}") from error
        if state.studio != 1 or not set(state.pose) <= set(NAMES):
            raise TwinError(f"{name}: a state of another version; {remedy}")
        return state

    @classmethod
    def load(cls, path: Path) -> "StudioState":
        """Read a state's file; raises as ``read``."""
        with ErrorsAs(OSError, lambda error: TwinError(f"{path}: can't be read ({error.strerror}); give a file that 'Save state' wrote")):
            return cls.read(read_regular(path, MOST_BYTES), str(path))

    def link(self, page: str = "") -> str:
        """The state as a link to a page of the studio, which then shows it. Without ``page`` it is the link's query alone."""
        numbers = {name: f"{value:.4f}".rstrip("0").rstrip(".") for name, value in self.pose.items()}
        friction = {} if self.friction is None else {"friction": f"{self.friction:g}"}
        shown = {"form": self.form, "colour": self.colour, "drawn": self.drawn}
        return f"{page}?" + urlencode({"sensor": self.sensor, "object": self.object, **numbers, **friction, **shown})

    @classmethod
    def of_link(cls, link: str) -> "StudioState":
        """The state of a link from ``link``. Values that the link leaves out have their defaults.

        Raises
        ------
        TwinError
            It is not such a link.
        """
        remedy = "copy the link from the page's folder 'Save'"
        name = f"link {link[:MOST_SHOWN]}{'...' if len(link) > MOST_SHOWN else ''}".replace("\n", " ")
        with ErrorsAs(ValueError, lambda error: TwinError(f"{name}: not a link to a state of the studio ({error}); {remedy}")):
            given = dict(parse_qsl(urlsplit(link).query, keep_blank_values=True, strict_parsing=True, max_num_fields=50))
            numbers = {key: float(given.pop(key)) for key in (*NAMES, "friction") if key in given}
        friction = {key: numbers.pop(key) for key in ("friction",) if key in numbers}
        pose = numbers or {"depth_mm": FIRST_DEPTH_MM}
        return cls.read(json.dumps({**given, **friction, "pose": pose}).encode(), name, remedy)

    def save(self, path: Path) -> Path:
        """Write the state to a file."""
        return write_json(path, self.model_dump(mode="json"))


def first_state(saved: str | Path | None, sensor: str | None, touched: str | None, saves: Path | None = None) -> StudioState:
    """The state of a file or link, else that of a sensor with a small indentation. If nothing is given, the last one of the ``saves``.

    Raises
    ------
    TwinError, SpecError
        The file or link holds no state, or there is no such sensor or object.
    """
    if saved is None and not sensor and not touched and saves is not None and (saves / LAST_STATE).exists():
        with suppress(TwinError, SpecError):  # a damaged file, or one of a sensor that is gone
            return first_state(saves / LAST_STATE, None, None)
    if saved is None:
        state = StudioState(sensor=sensor or SENSOR, object=touched or OBJECT, pose={"depth_mm": FIRST_DEPTH_MM})
    else:
        state = StudioState.of_link(str(saved)) if "?" in str(saved) else StudioState.load(Path(saved))
    load_sensor(state.sensor), load_object(state.object)
    return state


def heading(state: StudioState) -> str:
    """The page's heading."""
    return f"TacTip studio: {state.sensor}"


Way = list[tuple[float, ObjectPose]]
"""Poses with their times in s, increasing from 0."""


def save_trajectory(path: Path, way: Way) -> Path:
    """Write a path as a CSV table (``COLUMNS``)."""
    with text_file(path) as text:
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({"time_s": f"{at:.3f}", **{name: f"{value:.4f}" for name, value in asdict(pose).items()}} for at, pose in way)
    return path


def read_trajectory(content: bytes, name: str) -> Way:
    """Read a path from a CSV table with ``time_s`` and any of the object's six numbers. Missing numbers are zero.

    Raises
    ------
    TwinError
        It is not such a table, or its times do not increase.
    """
    if len(content) > MOST_BYTES:
        raise TwinError(f"{name}: {len(content)} bytes; a trajectory has at most {MOST_ROWS} rows")
    try:
        table = csv.DictReader(io.StringIO(content.decode("utf-8-sig")), strict=True)
        columns = set(table.fieldnames or ())
        if "time_s" not in columns or not columns <= set(COLUMNS):
            raise TwinError(f"{name}: expected the columns {', '.join(COLUMNS)}, found {', '.join(table.fieldnames or ['none'])}")
        rows = [{key: float(cell) for key, cell in row.items()} for row in table]
    except (UnicodeDecodeError, ValueError, TypeError, csv.Error) as error:
        raise TwinError(f"{name}: no readable trajectory ({error}); expected a CSV table of numbers with {', '.join(COLUMNS)}") from error
    if not 0 < len(rows) <= MOST_ROWS:
        raise TwinError(f"{name}: {format_count(len(rows), 'rows')}; a trajectory has 1 to {MOST_ROWS}")
    times = [row.pop("time_s") for row in rows]
    if any(not later > earlier for earlier, later in zip(times, times[1:], strict=False)):
        raise TwinError(f"{name}: time_s does not increase; sort the rows by time")
    poses = [ObjectPose(**({"depth_mm": 0.0} | row)) for row in rows]
    for pose in poses:
        pose.within_limits()  # raises an error if a number is not finite
    return [(at - times[0], pose) for at, pose in zip(times, poses, strict=True)]


def tap_and_shear(pose: ObjectPose) -> Way:
    """A tap from 2 mm above the tip down to 3 mm, a shear along x by 3 mm and back, and the lift. Tilts and twist are not changed."""
    knots_s, depths_mm, shears_mm = (0.0, 1.5, 3.0, 5.0, 6.5, 8.0), (-2.0, 3.0, 3.0, 3.0, 3.0, -2.0), (0.0, 0.0, 3.0, -3.0, 0.0, 0.0)
    times_s = np.linspace(0.0, 8.0, 81)
    moves = zip(times_s.tolist(), *(np.interp(times_s, knots_s, values).tolist() for values in (depths_mm, shears_mm)), strict=True)
    return [(at_s, replace(pose, x_mm=shear, y_mm=0.0, depth_mm=depth)) for at_s, depth, shear in moves]


def next_path(folder: Path, stem: str, suffix: str) -> Path:
    """A path ``STEM-NUMBER`` in a folder that is not in use yet; see ``make_folder``."""
    number = 1
    while (path := make_folder(folder) / f"{stem}-{number}{suffix}").exists():
        number += 1
    return path
