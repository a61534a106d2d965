"""Simulated data sets: read like recordings where they have no pictures, and what is known of their contacts beyond the table."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import zarr

from scenes.sensor import SensorSpec
from training.generation.config import GenerationConfig
from training.generation.store import CONFIG, DRAWS, TRUTH
from twin.errors import FrameError
from twin.frames import Recording
from twin.frames.folders import image_folders
from twin.frames.forms import frame_size
from twin.frames.tables import order_by_table, read_table
from twin.rig.kinematics import object_pose, rig_of
from twin.rig.mounting import Mounting
from twin.rig.touch import Surface, surface_labels
from twin.types import Form

TABLE = "targets.csv"


def is_simulated(folder: Path) -> bool:
    """Whether a folder holds a simulated data set."""
    return (folder / TRUTH).is_dir()


def is_pins_only(folder: Path) -> bool:
    """Whether a folder holds a simulated data set without pictures."""
    return is_simulated(folder) and not image_folders(folder, None)


def open_simulated(folder: Path, spec: SensorSpec) -> tuple[Recording, dict[str, np.ndarray]]:
    """A data set without pictures: its table, and its arrays ``pins_px`` and ``rest_px`` (M, N, 2) and ``visible`` (M, N).

    Raises
    ------
    FrameError
        It is another sensor's, or its table and truth don't belong together.
    """
    truth = zarr.open_group(folder / TRUTH, mode="r")
    if truth.attrs["sensor"] != spec.name:
        raise FrameError(f"{folder}: simulated for '{truth.attrs['sensor']}', not for '{spec.name}'; give the matching --sensor")
    problems: list[str] = []
    table = read_table(folder / TABLE, problems) if (folder / TABLE).is_file() else None
    if table is None:
        raise FrameError(f"{folder}: no {TABLE} of a finished data set; give the command that made it once more")
    _, labels = order_by_table([folder / TABLE], [folder / name for name in table.name_lists[0]], problems)
    names = table.name_lists[0]
    arrays = _arrays(truth, ("pins_px", "rest_px", "visible"))
    if len(names) != len(arrays["pins_px"]) or arrays["pins_px"].shape[1] != spec.pins.count:
        raise FrameError(f"{folder}: {len(names)} rows in the table, pins {arrays['pins_px'].shape} in {TRUTH}; make the data set again")
    form = Form(str(truth.attrs["form"]))
    return Recording(folder, form, names, frame_size(spec, form), labels, problems=problems), arrays


def config_of(folder: Path) -> GenerationConfig:
    """What a simulated data set was made with."""
    return GenerationConfig.model_validate_json((folder / CONFIG).read_text())


def touched_labels(folder: Path, names: np.ndarray) -> dict[str, np.ndarray]:
    """Depth and angle of the surface that was touched, whatever its shape, as labels: see ``twin.rig.touch.surface_labels``.

    Where the object stood is where the arm was sent, by the rig's numbers that were drawn for each contact, less what the object
    gave way, so that the flat plate's are the table's own, with moves that were not executed taken out.

    Parameters
    ----------
    folder : Path
        Of a simulated data set, with or without pictures.
    names : (M,) str
        Frames of it.

    Returns
    -------
    dict of str to (M,) float
        mm and deg by the table's columns, NaN for frames that it does not name; empty where depth and one angle do not tell how a
        surface is touched.
    """
    config = config_of(folder)
    truth = zarr.open_group(folder / TRUTH, mode="r")
    with (folder / TABLE).open(newline="") as file:
        row_of = {row["image_name"]: k for k, row in enumerate(csv.DictReader(file))}
    with (folder / DRAWS).open(newline="") as file:
        draws = {int(row["path_id"]): row for row in csv.DictReader(file)}
    rows = np.array([row_of.get(name, -1) for name in names.tolist()], int)
    arrays = _arrays(truth, ("pose", "move", "executed", "force_n", "path_id"))
    pose = (arrays["pose"] - arrays["move"] * ~arrays["executed"][:, None])[rows]
    force_n, contact = arrays["force_n"][rows], np.where(rows < 0, -1, arrays["path_id"][rows])
    surface = Surface(config.object)
    found: dict[str, np.ndarray] = {}
    for path_id in np.unique(contact[rows >= 0]):
        mine = contact == path_id
        sensor = _rigged(config.sensor, draws[int(path_id)])
        sent = np.stack([object_pose(rig_of(sensor), config.experiment, each, sensor.skin.outer_radius_mm) for each in pose[mine]])
        sent[:, 2, 3] += config.object.compliance_mm_per_n * force_n[mine, 2]
        for label, values in surface_labels(config.experiment, Mounting.of(sensor, config.experiment), surface, sent).items():
            found.setdefault(label, np.full(len(rows), np.nan))[mine] = values
    return found


def _arrays(truth: zarr.Group, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Arrays of ``truth.zarr`` by name."""
    found = {}
    for name in names:
        array = truth.get(name)
        if not isinstance(array, zarr.Array):
            raise FrameError(f"{truth.store_path}: no array '{name}'; the data set is damaged or of another version: make it again")
        found[name] = np.asarray(array[:])
    return found


def _rigged(sensor: SensorSpec, drawn: dict[str, str]) -> SensorSpec:
    """The sensor with the rig that was drawn for a contact."""
    rig = {key.removeprefix("rig."): float(value) for key, value in drawn.items() if key.startswith("rig.")}
    return sensor.model_copy(update={"rig": rig_of(sensor).model_copy(update=rig)})
