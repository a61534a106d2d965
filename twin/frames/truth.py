"""Exact truth of simulated frames beside their table: the arrays of ``truth.zarr``."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import zarr

from twin.errors import ErrorsAs, FrameError
from twin.types import Form

# Zarr group with the exact values of the frames.
TRUTH = "truth.zarr"
AGAIN = "copy the data set again, or make it again"
NEVER_ZERO = (
    "pins_px",
    "rest_px",
    "visible",
)  # arrays without any all-zero chunk. zarr reads a missing chunk as zeros, so a missing chunk of these arrays means damage.


def image_name(index: int, state: int) -> str:
    """Name of a contact's picture, numbered as in recordings."""
    return f"frame_{index}_{state}.png"


def open_truth(folder: Path) -> tuple[zarr.Group, str, Form]:
    """The truth of a data set, the name of its sensor, and the form of its frames.

    Raises
    ------
    FrameError
        The data set is damaged or not finished.
    """
    path = folder / TRUTH
    # damaged metadata can raise any exception in zarr
    with ErrorsAs(Exception, lambda error: FrameError(f"{path}: damaged, or of no finished data set; {AGAIN}")):
        truth = zarr.open_group(path, mode="r")
        return truth, str(truth.attrs["sensor"]), Form(str(truth.attrs["form"]))


def row_of(truth: zarr.Group) -> dict[str, int]:
    """Row of each frame's name in the truth, which is in the order of the contacts. The table may have another order."""
    found: dict[str, int] = {}
    states: dict[int, int] = {}
    for row, contact in enumerate(arrays_of(truth, ("path_id",))["path_id"].tolist()):
        states[contact] = states.get(contact, -1) + 1
        found[image_name(contact, states[contact])] = row
    return found


def arrays_of(truth: zarr.Group, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Arrays of ``truth.zarr`` by name.

    Raises
    ------
    FrameError
        An array is damaged or missing.
    """
    found = {}
    for name in names:
        try:
            array = truth.get(name)
            if isinstance(array, zarr.Array) and not (name in NEVER_ZERO and array.nchunks_initialized < array.nchunks):
                found[name] = np.asarray(array[:])
        except Exception as error:  # damaged bytes can raise any exception in zarr and its codecs
            raise FrameError(f"{truth.store_path}: array '{name}' is damaged; {AGAIN}") from error
        if name not in found:
            raise FrameError(f"{truth.store_path}: array '{name}' is missing, or a part of it; {AGAIN}")
    return found
