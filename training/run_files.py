"""The files of a training run, each written whole or not at all."""

import csv
import io
from pathlib import Path

import numpy as np
import torch

from twin.store import write_text, write_with


def write_tensors(path: Path, content: dict) -> None:
    """A dict of numbers, text, lists, arrays and tensors, as ``torch.load`` reads it with ``weights_only``."""
    write_with(path, lambda file: torch.save(_as_tensors(content), file))


def _as_tensors(value: object) -> object:
    """The same with arrays as tensors, which are read back without running anything that a file may hold."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value)
    if isinstance(value, dict):
        return {key: _as_tensors(part) for key, part in value.items()}
    return [_as_tensors(part) for part in value] if isinstance(value, list) else value


def write_curves(out: Path, curves: list) -> None:
    """``curves.csv`` of networks one after the other."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["network", "epoch", "loss", "held_out_error", "rate", "seconds"])
    for k, points in enumerate(curves):
        writer.writerows([k, *point.values()] for point in points)
    write_text(out / "curves.csv", text.getvalue())
