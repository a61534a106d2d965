"""Simulated data sets without pictures, read like recordings: their pins come from the ground truth."""

from pathlib import Path

import numpy as np
import zarr

from scenes.sensor import SensorSpec
from training.generation.truth_file import TRUTH
from twin.errors import FrameError
from twin.preprocess.forms import frame_size
from twin.recordings import Recording
from twin.recordings.folders import image_folders
from twin.recordings.tables import order_by_table, read_table
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
    arrays = {key: truth[key][:] for key in ("pins_px", "rest_px", "visible")}
    if len(names) != len(arrays["pins_px"]) or arrays["pins_px"].shape[1] != spec.pins.count:
        raise FrameError(f"{folder}: {len(names)} rows in the table, pins {arrays['pins_px'].shape} in {TRUTH}; make the data set again")
    form = Form(truth.attrs["form"])
    return Recording(folder, form, names, frame_size(spec, form), labels, problems=problems), arrays
