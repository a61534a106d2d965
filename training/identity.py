"""What a run learnt from, by the names of its frames: told apart from other data, and found again in a table of another order."""

from collections.abc import Mapping

import numpy as np

from training.dataset import Dataset
from training.models.part import Model
from training.recipes import TrainingError
from training.targets import TARGET_COLUMNS
from twin.store import inputs_digest

DIGESTS = {  # what a run's configuration tells of its data by a digest, and what a message calls it where it differs
    "names": "frames of other names",
    "labels": "other labels",
    "frames": "other frames under the same names",
}
ASIDE = ("problems", "data")  # keys of a run's configuration that its result does not depend on
COUNTED = "parameters"  # key that only a finished run's configuration has: how many its networks have
EXACT = 9  # decimals of labels that count, mm and deg: the last bits of a sum may differ between machines
NAMED = 3  # frames, or settings, that a message names


def identity_of(data: Dataset, model: Model) -> dict[str, str]:
    """Digests of a data set as a model learns from it, by the keys of ``DIGESTS``; the order of its rows does not matter."""
    ordered = data.in_order()
    targets = ordered.targets
    return {
        "names": inputs_digest(ordered.pins.image_name.tolist(), ordered.group),
        "labels": inputs_digest(targets.names, *(np.round(getattr(targets, key), EXACT) + 0.0 for key in TARGET_COLUMNS)),
        "frames": inputs_digest(model.seen(ordered)),
    }


def rows_named(data: Dataset, names: list[str]) -> np.ndarray:
    """Rows of the frames with these names, in the order of the names, each with all its copies.

    Raises
    ------
    TrainingError
        Frames are missing.
    """
    found: dict[str, list[int]] = {}
    for row in data.natural_order().tolist():
        found.setdefault(str(data.pins.image_name[row]), []).append(row)
    if missing := [name for name in names if name not in found]:
        said = f"; {'; '.join(data.problems[:NAMED])}" if data.problems else ""
        raise TrainingError(
            f"{', '.join(map(str, data.folders))}: {len(missing)} of the {len(names)} frames that the run kept out of its training are not "
            f"among its {len(data)} usable ones ({', '.join(missing[:NAMED])}{', ...' if len(missing) > NAMED else ''}){said}; "
            "give exactly what the run was trained on, or --rows all for a recording it has not seen"
        )
    return np.array([row for name in names for row in found[name]], int)


def changed_since(config: Mapping, data: Dataset, model: Model) -> list[str]:
    """How a data set differs from the one that a run learnt from, a line each; of runs of earlier versions that this can't be told."""
    rows = config["rows"]
    if "frames" not in rows:
        return [
            "the run is of an earlier version and does not name its frames: whether these are the ones that it kept out of its training "
            "can't be told, if the table was sorted anew, or frames or labels have changed since; train again to know"
        ]
    now = identity_of(data, model)
    return [f"the run learnt from {DIGESTS[key]}: something has changed since" for key in DIGESTS if now[key] != rows.get(key)]


def difference(wanted: Mapping, found: Mapping) -> str:
    """In which data and settings two configurations of runs differ, in words; "" where they don't."""
    keys = [key for key in {**wanted, **found} if key not in (*ASIDE, COUNTED) and wanted.get(key) != found.get(key)]
    said: list[str] = []
    if "rows" in keys:
        said += _rows_differ(wanted["rows"], found.get("rows"))
    if "code" in keys:
        said.append("another version of the program")
    others = [key for key in keys if key not in ("rows", "code")]
    if others:
        said.append(f"other settings ({', '.join(others[:NAMED])}{', ...' if len(others) > NAMED else ''})")
    return ", ".join(said)


def _rows_differ(wanted: Mapping, found: object) -> list[str]:
    if not isinstance(found, Mapping) or "names" not in found:
        return ["data that it does not name"]
    differ = [key for key in DIGESTS if wanted[key] != found.get(key)]
    if "names" in differ:
        return [DIGESTS["names"]]  # then labels and frames differ in any case
    return [DIGESTS[key] for key in differ] or ["another number of frames"]
