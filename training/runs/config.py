"""Settings of a training run, what they choose of a data set, and the identity of the data: digests and marks of its frames, independent of
the table's order."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from training.data.dataset import Dataset, split_rows
from training.data.targets import TARGET_COLUMNS
from training.errors import TrainingError
from training.models.part import SEEN_DECIMALS, Model, Recipe
from twin.store import inputs_digest

MOST_SEED = 2**32 - 1  # largest seed. PyTorch takes seeds of 64 bits, and each network has its own seed
DIGESTS = {  # keys of the digests in a run's configuration, with the words for a message about a difference
    "names": "frames of other names",
    "labels": "other labels",
    "frames": "other frames, or other pins found in them, under the same names",
}
ASIDE = ("problems", "data")  # keys of a run's configuration that do not affect its result
COUNTED = "parameters"  # key that only a finished run's configuration has: the number of parameters of its networks
EXACT = 9  # decimals of labels, mm and deg, that are compared, because the last bits of a sum may differ between machines
NAMED = 3  # most frames, or settings, that a message names
MARK_BYTES = 8  # size of a frame's mark: a million frames have two equal marks by chance once in 37 million cases


@dataclass(frozen=True)
class RunConfig:
    """Settings of a run.

    Attributes
    ----------
    model : str
    recipe : Recipe
    labels : {"corrected", "raw"}
    seed : int
        Seed of weights and order. It also shifts which fold is held out.
    split : int or None
        Seed of the validation fifth that is kept out of training; None trains on all rows.
    helpers : tuple of str
        Auxiliary label columns, which are trained only because they improve the others; they have less weight.
    size : dict
        Sizes of the network that differ from the model's own.
    labelled : dict
        ``identity_of`` the real frames from which the errors of simulated pins were fitted, and their ``image_names``; empty for other
        runs.

    Raises
    ------
    TrainingError
        A seed is out of range.
    """

    model: str
    recipe: Recipe
    labels: str = "corrected"
    seed: int = 0
    split: int | None = 0
    helpers: tuple[str, ...] = ()
    size: dict[str, int] = field(default_factory=dict)
    labelled: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, seed in (("seed", self.seed), ("split", self.split)):
            if seed is not None and not 0 <= seed <= MOST_SEED:
                raise TrainingError(f"--{name} {seed}: give a whole number from 0 to {MOST_SEED}")


def training_rows(config: RunConfig, data: Dataset) -> np.ndarray:
    """Rows (m,) of a data set in order (``Dataset.in_order``) on which a run is trained."""
    return np.arange(len(data)) if config.split is None else split_rows(len(data), config.split, data.group)[0]


def training_labels(data: Dataset, config: RunConfig) -> np.ndarray:
    """Labels (M, K) of the kind that a run is trained on, mm and deg."""
    return data.targets.corrected if config.labels == "corrected" else data.targets.raw


def identity_of(data: Dataset, model: Model) -> dict[str, str]:
    """Digests of a data set as a model sees it, by the keys of ``DIGESTS``. The order of the rows does not matter."""
    ordered = data.in_order()
    targets = ordered.targets
    return {
        "names": inputs_digest(ordered.pins.image_name.tolist(), ordered.group),
        "labels": inputs_digest(targets.names, *(np.round(getattr(targets, key), EXACT) + 0.0 for key in TARGET_COLUMNS)),
        "frames": inputs_digest(model.inputs_seen(ordered)),
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
            "give exactly what the run was trained on, or `rows` all for a recording it has not seen"
        )
    return np.array([row for name in names for row in found[name]], int)


def frame_marks(data: Dataset) -> np.ndarray:
    """Two marks (M, 2) int64 of each frame, which identify it under another name or in another recording.

    The first mark is that of its pins' places, the second that of their displacements. In joined data sets only the second stays the same.
    """
    pins = data.pins
    places = [np.round(px, SEEN_DECIMALS) + 0.0 for px in (pins.nodes_px, pins.nodes_px - pins.reference.pins_px)]
    digests = [[hashlib.blake2b(frame.tobytes(), digest_size=MARK_BYTES).digest() for frame in kind] for kind in places]
    return np.array([[int.from_bytes(digest, "little", signed=True) for digest in kind] for kind in digests], np.int64).reshape(2, -1).T


def trained_before(learnt: np.ndarray | None, data: Dataset) -> list[str]:
    """A line if a run was trained on frames of a data set, found by the run's marks (m, 2), or if the run does not hold its frames'
    marks."""
    if learnt is None:
        return ["the run does not name its training frames, so it is not known whether these are among them; train again to know"]
    known = np.isin(frame_marks(data), learnt).any(axis=1)
    if not known.any():
        return []
    return [
        f"{int(known.sum())} of these {len(data)} frames are frames that the run was trained on (first {data.pins.image_name[known][0]}): "
        "errors on them are smaller than on new ones; give a recording it has not seen, or `rows` validation"
    ]


def changed_since(config: Mapping, data: Dataset, model: Model) -> list[str]:
    """Differences between a data set and the one that a run was trained on, one line each. Runs of earlier versions do not hold them."""
    rows = config["rows"]
    if "frames" not in rows:
        return [
            "the run is of an earlier version and does not name its frames: if the table was sorted again, or frames or labels have "
            "changed since, these may not be its held-out frames; train again to know"
        ]
    now = identity_of(data, model)
    return [f"the run was trained on {DIGESTS[key]}: something has changed since" for key in DIGESTS if now[key] != rows.get(key)]


def difference(wanted: Mapping, found: Mapping) -> str:
    """Differences of data and settings between two configurations of runs, in words; "" if there are none."""
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
        return [DIGESTS["names"]]  # labels and frames then differ in any case
    return [DIGESTS[key] for key in differ] or ["another number of frames"]
