"""Makes two tables of a folder of force curves: the forces at the end of every contact, and whole curves of some.

The folder holds ``targets.csv`` with a row for each contact (``ft_data_csv``, ``pose_1..6``, ``move_1..6``, ``Fx``, ``Fy``, ``Fz``), and
the curves in ``ft_data`` (``Time``, ``Fx``, ``Fy``, ``Fz``). Usage: ``python force_curves.py FOLDER OUT --rows 50 --whole 1 2 11``.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

LAST = 12
"""Samples at the end whose mean counts as the force of a contact: 0.05 s at 240 Hz, about one period of the arm's oscillation."""
EVERY = 2
"""Each second sample of a whole curve is kept."""
FORCES = ("Fx", "Fy", "Fz")
LABELS = ("pose_3", "pose_4", "pose_5", "move_1", "move_2", "move_6")


def make_tables(folder: Path, out: Path, rows: int, whole: list[int]) -> None:
    """Write ``targets.csv``, whose ``label_Fx..`` are the forces of the folder's own table, and ``curves.csv``; rows count from 1."""
    with (folder / "targets.csv").open() as file:
        contacts = list(csv.DictReader(file))[:rows]
    ends, samples = [], []
    for number, contact in enumerate(contacts, 1):
        curve = np.genfromtxt(folder / "ft_data" / contact["ft_data_csv"], delimiter=",", names=True)
        force_n = np.stack([curve[axis] for axis in FORCES], axis=1)
        end = [number, *(contact[key] for key in LABELS), *force_n[-LAST:].mean(axis=0).round(4), *(contact[axis] for axis in FORCES)]
        ends.append(end)
        samples += [[number, time, *force] for time, force in zip(curve["Time"], force_n, strict=True)][::EVERY] if number in whole else []
    out.mkdir(parents=True, exist_ok=True)
    for name, columns, lines in (
        ("targets.csv", ("row", *LABELS, *FORCES, *(f"label_{axis}" for axis in FORCES)), ends),
        ("curves.csv", ("row", "Time", *FORCES), samples),
    ):
        with (out / name).open("w", newline="") as file:
            csv.writer(file).writerows([columns, *lines])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--rows", type=int, default=50)
    parser.add_argument("--whole", type=int, nargs="*", default=[])
    given = parser.parse_args()
    make_tables(given.folder, given.out, given.rows, given.whole)
