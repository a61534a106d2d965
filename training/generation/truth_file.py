"""``truth.zarr``: everything that is known about the frames of a simulated data set, row by row as in its table."""

import shutil
from pathlib import Path

import numpy as np
import zarr

TRUTH = "truth.zarr"
CHUNK_ROWS = 256
UNITS = {
    "caps_mm": "mm, sensor frame",
    "caps_px": "px of the frame: exact projection of each cap's centre",
    "rest_px": "px of the frame: the same sensor without contact",
    "pins_px": "px of the frame: caps_px with the noise of a measurement",
    "visible": "whether the cap is inside the frame and no other pin stands before it",
    "force_n": "N, of the skin on the object, sensor frame",
    "torque_nmm": "N mm about the sensor's origin",
    "area_mm2": "mm2 of skin in contact",
    "slipping_mm2": "mm2 of it that slides",
    "T_sensor_object": "the object's pose, mm",
    "pose": "pose_1..6 as in targets.csv: mm, deg",
    "move": "move_1..6 as in targets.csv: mm, deg",
    "executed": "whether the move had been made when the frame was taken",
    "path_id": "number of the contact that the state belongs to: split by it, never by row",
    "fraction": "of the contact's way done",
}


class TruthFile:
    """A Zarr group that grows by rows, ``CHUNK_ROWS`` at a time: a chunk is written once, when it is full."""

    def __init__(self, path: Path) -> None:
        self.path = path
        shutil.rmtree(path, ignore_errors=True)
        self._group = zarr.create_group(path, zarr_format=3)
        self._waiting: dict[str, list] = {}

    def append(self, arrays: dict) -> None:
        """Add rows: for each key an array (S, ...)."""
        for key, rows in arrays.items():
            self._waiting.setdefault(key, []).extend(rows)
        while len(self._waiting["path_id"]) >= CHUNK_ROWS:
            self._flush(CHUNK_ROWS)

    def close(self, attributes: dict) -> None:
        """Write what is left."""
        if self._waiting["path_id"]:
            self._flush(len(self._waiting["path_id"]))
        self._group.attrs.update(attributes)

    def _flush(self, rows: int) -> None:
        for key, waiting in self._waiting.items():
            block = np.stack(waiting[:rows])
            del waiting[:rows]
            if key not in self._group:
                shape, chunks = (0, *block.shape[1:]), (CHUNK_ROWS, *block.shape[1:])
                array = self._group.create_array(key, shape=shape, chunks=chunks, dtype=block.dtype, attributes={"meaning": UNITS[key]})
            array = self._group[key]
            start = array.shape[0]
            array.resize((start + rows, *block.shape[1:]))
            array[start:] = block
