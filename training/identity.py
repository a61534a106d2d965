"""The data that a run learnt from, identified by the names of its frames, in any order of the table."""

import hashlib
from collections.abc import Mapping

import numpy as np

from training.dataset import Dataset
from training.models.part import SEEN_DECIMALS, Model
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
MARK_BYTES = 8  # of a frame's mark: of a million frames two have the same by chance once in 37 million


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


def frame_marks(data: Dataset) -> np.ndarray:
    """Two marks (M, 2) int64 of each frame, by which it is known again under another name or in another recording.

    The first is of its pins' places, the second of their displacements: a data set that is joined to others keeps the second alone.
    """
    pins = data.pins
    places = [np.round(px, SEEN_DECIMALS) + 0.0 for px in (pins.nodes_px, pins.nodes_px - pins.reference.pins_px)]
    digests = [[hashlib.blake2b(frame.tobytes(), digest_size=MARK_BYTES).digest() for frame in kind] for kind in places]
    return np.array([[int.from_bytes(digest, "little", signed=True) for digest in kind] for kind in digests], np.int64).reshape(2, -1).T


def learnt_before(learnt: np.ndarray | None, data: Dataset) -> list[str]:
    """A line if a run learnt from frames of a data set, by the marks of those (m, 2); if it does not tell its frames, that it does not."""
    if learnt is None:
        return ["the run does not tell from which frames it learnt: whether these are among them is not known; train again to know"]
    known = np.isin(frame_marks(data), learnt).any(axis=1)
    if not known.any():
        return []
    return [
        f"{int(known.sum())} of these {len(data)} frames are frames that the run learnt from (first {data.pins.image_name[known][0]}): "
        "errors on them are smaller than on new ones; give a recording it has not seen, or --rows validation"
    ]


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
