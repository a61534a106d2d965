"""Reads simulated data sets without pictures, and the known properties of their contacts that the table of labels does not hold."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from scenes.files import read_regular
from scenes.load import explain_problems
from scenes.sensor import SensorSpec
from training.data.targets import CONTACT_UNITS
from training.generation.config import GenerationConfig
from training.generation.store import CONFIG, DRAWS, read_record
from twin.errors import DatasetError, ErrorsAs, FrameError
from twin.frames import Recording
from twin.frames.folders import image_folders
from twin.frames.forms import frame_size, from_raw, recording_to_raw
from twin.frames.tables import LARGEST_BYTES, order_by_table, read_table
from twin.frames.truth import AGAIN, TRUTH, arrays_of, open_truth, row_of
from twin.rig.kinematics import Mounting, object_pose, rig_of
from twin.rig.touch import SmoothSurface, surface_labels
from twin.types import Form

TABLE = "targets.csv"
LEAST_AREA_MM2 = 1e-6  # least contact area, mm^2, by which the sliding area is divided, so that without contact the share is 0


def is_simulated(folder: Path) -> bool:
    """Whether a folder holds a simulated data set."""
    return (folder / TRUTH).is_dir()


def is_pins_only(folder: Path) -> bool:
    """Whether a folder holds a simulated data set without pictures."""
    return is_simulated(folder) and not image_folders(folder, None)


def open_simulated(folder: Path, spec: SensorSpec, form: Form | None = None) -> tuple[Recording, dict[str, np.ndarray]]:
    """Read a data set without pictures: its table, and its arrays ``pins_px`` and ``rest_px`` (M, N, 2) and ``visible`` (M, N).

    Parameters
    ----------
    form : Form, optional
        Form of the frames in whose pixels the pins are given; by default that of the data set.

    Raises
    ------
    FrameError
        The data set was simulated for another sensor, or its table and its truth have different numbers of rows.
    """
    truth, sensor, given = open_truth(folder)
    if sensor != spec.name:
        raise FrameError(f"{folder}: simulated for '{sensor}', not for '{spec.name}'; give the matching `sensor`")
    problems: list[str] = []
    table = read_table(folder / TABLE, problems) if (folder / TABLE).is_file() else None
    if table is None:
        raise FrameError(f"{folder}: no {TABLE} of a finished data set; repeat the command that made it")
    _, labels = order_by_table([folder / TABLE], [folder / name for name in table.name_lists[0]], problems)
    names = table.name_lists[0]
    rows_by_name = row_of(truth)
    strange = [name for name in names if name not in rows_by_name]
    if strange or len(names) != len(rows_by_name):
        said = f", among them {strange[0]}, which is not there" if strange else ""
        raise FrameError(f"{folder / TABLE}: {len(names)} rows{said}; {TRUTH} has {len(rows_by_name)}: the data set is damaged; {AGAIN}")
    rows = [rows_by_name[name] for name in names]
    arrays = {key: array[rows] for key, array in arrays_of(truth, ("pins_px", "rest_px", "visible")).items()}
    if arrays["pins_px"].shape[1] != spec.pins.count:
        raise FrameError(f"{folder}: pins {arrays['pins_px'].shape} in {TRUTH}, '{spec.name}' has {spec.pins.count}; {AGAIN}")
    form = form or given
    if form != given:
        for key in ("pins_px", "rest_px"):
            raw_px = recording_to_raw(spec.recording, arrays[key]) if given == Form.PROCESSED else arrays[key]
            arrays[key] = from_raw(spec.recording, form, raw_px)
    return Recording(folder, form, names, frame_size(spec, form), labels, problems=problems), arrays


def config_of(folder: Path) -> GenerationConfig:
    """The configuration of a simulated data set.

    Raises
    ------
    DatasetError
        The file is missing or damaged.
    """
    path = folder / CONFIG
    with ErrorsAs(ValidationError, lambda error: DatasetError(f"{path}: damaged ({explain_problems(error, GenerationConfig)}); {AGAIN}")):
        return GenerationConfig.model_validate(read_record(path))


def labels_of_surface(folder: Path, names: np.ndarray) -> dict[str, np.ndarray]:
    """Depth and angle of the touched surface, of any shape, as labels: see ``twin.rig.touch.surface_labels``.

    The object's place follows from the pose to which the arm was sent and from the rig's parameters that were sampled for the contact,
    minus the object's displacement by its compliance. Therefore the labels of a flat plate are those of the table without moves that were
    not executed.

    Parameters
    ----------
    folder : Path
        A simulated data set, with or without pictures.
    names : (M,) str
        Names of frames.

    Returns
    -------
    dict of str to (M,) float
        Labels in mm and deg by the name of the table's column; NaN for frames that are not in the table. The dict is empty if depth
        and one angle do not describe how the surface is touched.
    """
    config = config_of(folder)
    truth, _, _ = open_truth(folder)
    rows_by_name = row_of(truth)
    draws = _draws(folder / DRAWS)
    rows = np.array([rows_by_name.get(name, -1) for name in names.tolist()], int)
    arrays = arrays_of(truth, ("pose", "move", "executed", "force_n", "path_id"))
    pose = (arrays["pose"] - arrays["move"] * ~arrays["executed"][:, None])[rows]
    force_n, contact = arrays["force_n"][rows], np.where(rows < 0, -1, arrays["path_id"][rows])
    surface = SmoothSurface(config.object)
    found: dict[str, np.ndarray] = {}
    for path_id in np.unique(contact[rows >= 0]):
        mine = contact == path_id
        if int(path_id) not in draws:
            raise FrameError(f"{folder / DRAWS}: has no row of contact {path_id}; {AGAIN}")
        sensor = _with_rig(config.sensor, draws[int(path_id)])
        rig = rig_of(sensor, config.object.name)
        sent = np.stack([object_pose(rig, config.experiment, each, sensor.skin.apex_mm) for each in pose[mine]])
        sent[:, 2, 3] += config.object.compliance_mm_per_n * force_n[mine, 2]
        for label, values in surface_labels(config.experiment, Mounting(rig, config.experiment, sensor.skin), surface, sent).items():
            found.setdefault(label, np.full(len(rows), np.nan))[mine] = values
    return found


def contact_labels(folder: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Force, torque, area, sliding share and contact of simulated frames: values (M,) by the names of ``CONTACT_UNITS``.

    Parameters
    ----------
    names : M str
        Names of frames; values are NaN for frames that are not in the data set.
    """
    truth, _, _ = open_truth(folder)
    rows_by_name = row_of(truth)
    rows = np.array([rows_by_name.get(name, -1) for name in names], int)
    arrays = arrays_of(truth, ("force_n", "torque_nmm", "area_mm2", "slipping_mm2", "map_touched_mm2"))
    area, pressed = arrays["area_mm2"], np.maximum(arrays["map_touched_mm2"].sum(axis=1), LEAST_AREA_MM2)
    slips = np.minimum(arrays["slipping_mm2"] / pressed, 1.0)
    values = (*arrays["force_n"].T, arrays["torque_nmm"][:, 2], area, slips, area > 0)
    return {name: np.where(rows < 0, np.nan, each[rows]) for name, each in zip(CONTACT_UNITS, values, strict=True)}


def _draws(path: Path) -> dict[int, dict[str, float]]:
    """The rig's parameters that were sampled for each contact, by its number."""
    try:
        rows = list(csv.DictReader(io.StringIO(read_regular(path, LARGEST_BYTES).decode(), newline=""), strict=True))
        return {int(row["path_id"]): {key: float(row[key]) for key in row if str(key).startswith("rig.")} for row in rows}
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        how = getattr(error, "strerror", None) or "not a complete table of numbers"
        raise FrameError(f"{path}: damaged ({how}); {AGAIN}") from error


def _with_rig(sensor: SensorSpec, drawn: dict[str, float]) -> SensorSpec:
    """The sensor with the rig's parameters that were sampled for a contact."""
    rig = {key.removeprefix("rig."): value for key, value in drawn.items()}
    return sensor.model_copy(update={"rig": rig_of(sensor).model_copy(update=rig)})
