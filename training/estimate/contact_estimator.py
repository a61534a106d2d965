"""One estimator for several kinds of contact of a sensor: it finds the kind of a frame's contact, and estimates the pose by that kind's
model.

Its folder holds the small copies of runs, the classifier of the kinds (``Contacts``), and ``contacts.json``: the run of each kind, with the
intervals for this kind. Several kinds may share a run that was trained on all of them. The shipped weights of a sensor may have such a
folder inside: ``contacts``.

Kinds (plate, edge, ...) are distinguished by a small network on the modes of the displacements. Whether the frame shows a contact of this
kind at all is for the domain of the kind's model to say (``training.estimate.domain``).
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

import numpy as np

from scenes.sensor import SensorSpec
from training.data.dataset import Dataset
from training.data.pins import PinTable
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimate, PoseEstimator
from training.models.part import Prediction, Unseen
from training.runs.run_files import AGAIN, damage_error, folder_of
from twin.camera.capture import in_form
from twin.frames import Recording
from twin.frames.tables import numbers
from twin.store import ArrayFile, Layers, layers_from, through_layers
from twin.types import Frame

CONTACTS = "contacts.safetensors"
FILE = ArrayFile("file of kinds of contact", "tests/weights/contacts.py", version=1, error=TrainingError, again=AGAIN)
# Folder, inside that of a sensor's weights, with the models of several kinds of contact.
INSIDE = "contacts"
# File with the model and the intervals of each kind.
KINDS = "contacts.json"
# Names of intervals in that file.
INTERVALS = ("quantile", "raw_quantile")
COPY_AGAIN = "copy the model's folder again"


@dataclass(frozen=True)
class DisplacementModes:
    """Principal components of displacements (M, N, 2), ``mean`` (2 N,) and ``components`` (2 N, K)."""

    mean: np.ndarray
    components: np.ndarray

    @classmethod
    def of(cls, moved: np.ndarray, most: int) -> "DisplacementModes":
        """The first of the components of displacements (M, N, 2), at most ``most``; all are scaled by the first one's deviation."""
        flat = moved.reshape(len(moved), -1)
        mean = flat.mean(axis=0)
        _, sizes, directions = np.linalg.svd(flat - mean, full_matrices=False)
        return cls(mean, directions[: min(most, len(flat) - 1)].T * np.sqrt(len(flat)) / sizes[0])

    def __call__(self, moved: np.ndarray) -> np.ndarray:
        """(M, K) amplitudes."""
        return (moved.reshape(len(moved), len(self.mean)) - self.mean) @ self.components


@dataclass(frozen=True)
class Contacts:
    """The known kinds of contact of one sensor.

    Attributes
    ----------
    kinds : tuple of str
    modes : Modes
        Modes of all kinds together.
    layers : tuple of (weights, offset)
        The network that distinguishes the kinds.
    """

    kinds: tuple[str, ...]
    modes: DisplacementModes
    layers: Layers = field(repr=False)

    def likeliest(self, pins: PinTable, among: Sequence[str]) -> np.ndarray:
        """(M,) str: the most probable of some kinds for each valid frame of a table."""
        names = [name for name in self.kinds if name in among]
        columns = [self.kinds.index(name) for name in names]
        scores = through_layers(self.layers, self.modes(moved_of(pins)), lambda x: np.maximum(x, 0))
        return np.array(names)[scores[:, columns].argmax(axis=1)]


def moved_of(pins: PinTable) -> np.ndarray:
    """(M, N, 2) displacements from rest, in mean rest spacings."""
    return (pins.nodes_px - pins.reference.pins_px) / pins.reference.spacing_px.mean()


def read_contacts(path: Path) -> Contacts:
    """Read the contacts that ``write_contacts`` wrote, also with version 1.0.0.

    Raises
    ------
    TrainingError
        The file can't be read, or is damaged.
    """
    with FILE.open_arrays(path) as (about, single):
        found = {key: array.astype(float) for key, array in single.items()}
        kinds = about.get("kinds") or sorted({key.split(".")[1] for key in found if key.startswith("kinds.")})
        return Contacts(tuple(kinds), DisplacementModes(found["modes.mean"], found["modes.components"]), layers_from(found))


class ContactEstimator:
    """Estimates kind and pose of the contact in frames of one sensor. A raw frame is first converted to the form of its recorder.

    Parameters
    ----------
    parts : dict of str to PoseEstimator
        A model for each kind; all belong to one sensor and form.
    contacts : Contacts

    Raises
    ------
    TrainingError
        The models are of different kinds, sensors or forms.
    """

    def __init__(self, parts: Mapping[str, PoseEstimator], contacts: Contacts) -> None:
        if set(parts) != set(contacts.kinds):
            raise TrainingError(f"models of {', '.join(sorted(parts))}, but the kinds of contact are {', '.join(sorted(contacts.kinds))}")
        self.parts, self.contacts = dict(parts), contacts
        first = self._any
        for part in self.parts.values():
            part.check(first.sensor, first.form)
        self.sensor, self.form = first.sensor, first.form

    @property
    def _any(self) -> PoseEstimator:
        return next(iter(self.parts.values()))

    @classmethod
    def load(cls, folder: Path) -> "ContactEstimator":
        """Load a folder that ``put_together`` (tests/weights/contacts.py) wrote.

        Raises
        ------
        TrainingError
            A model, or the classifier of the kinds, can't be read.
        """
        path = folder / KINDS
        try:
            kinds = {name: (str(kind.pop("model")), kind) for name, kind in json.loads(path.read_text(encoding="utf-8")).items()}
            unlike = [key for _, intervals in kinds.values() for key in intervals if key not in INTERVALS]
        except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
            raise damage_error(path, "it does not state which model is of which kind", COPY_AGAIN) from error
        if unlike:
            raise damage_error(path, f"no intervals are called {unlike[0]}", COPY_AGAIN)
        models = {model: PoseEstimator.load(folder / model) for model, _ in kinds.values()}
        parts = {name: models[model].with_intervals(intervals) for name, (model, intervals) in kinds.items()}
        return cls(parts, read_contacts(folder / CONTACTS))

    @property
    def counts_from_rest(self) -> bool:
        """Whether all models can use a frame without contact of the present sensor."""
        return all(part.counts_from_rest for part in self.parts.values())

    @property
    def recorded_sensor(self) -> SensorSpec:
        """As for ``PoseEstimator``."""
        return self._any.recorded_sensor

    def at_rest(self, frame: Frame) -> "ContactEstimator":
        """The models for the sensor that took ``frame`` without contact; raises as ``PoseEstimator.at_rest``."""
        return self._with({name: part.at_rest(frame) for name, part in self.parts.items()})

    @property
    def caveats(self) -> list[str]:
        """As for ``PoseEstimator``; of all models."""
        return list(dict.fromkeys(line for part in self.parts.values() for line in part.caveats))

    def with_history(self) -> "ContactEstimator":
        """The models for consecutive frames. They name pins as in the frame before; slip is not estimated."""
        return self._with({name: part.keep_names() for name, part in self.parts.items()})

    def at_known_rest(self) -> "ContactEstimator":
        """As for ``PoseEstimator``."""
        return self._with({name: part.at_known_rest() for name, part in self.parts.items()})

    def at_rest_of(self, frames: Iterable[Frame]) -> tuple["ContactEstimator", bool]:
        """As for ``PoseEstimator``."""
        nodes_px = self._any.at_known_rest().nodes_in(frames)
        best = max(self.parts.values(), key=lambda part: part.rest.usual_share(nodes_px))
        rest, undecided = best.rest.of_contacts(nodes_px, "these contacts")
        return self._with({name: part.with_rest_pins(rest).noting(undecided) for name, part in self.parts.items()}), rest is not None

    def _with(self, parts: dict[str, PoseEstimator]) -> "ContactEstimator":
        found = copy(self)
        found.parts = parts
        return found

    def __call__(self, frame: Frame) -> PoseEstimate:
        """Estimate kind and pose of the contact in one frame.

        The estimate is not valid, and states the reason, if too few pins are found, or if the contact is of no known kind.

        Raises
        ------
        FrameError
            The frame does not belong to the sensor.
        """
        started = perf_counter()
        seen = self._any.pins_in(in_form(frame, self.form, self.sensor.recording))
        if isinstance(seen, Unseen):
            return self._any.estimate_without_pose(seen, started)
        kind = str(self.contacts.likeliest(seen.pins, tuple(self.parts))[0])
        return self.parts[kind].estimate_one(seen, started, kind)

    def taken_for(self, pins: PinTable) -> dict[str, float]:
        """Shares of a table's valid frames that are classified as each kind, and as "none": those that the kind's model refuses."""
        kinds = self.contacts.likeliest(pins, tuple(self.parts))
        known = np.zeros(len(kinds), bool)
        for name, part in self.parts.items():
            known[kinds == name] = part.knows(pins.rows(np.flatnonzero(kinds == name)))
        return {name: float(np.mean(known & (kinds == name))) for name in self.parts} | {"none": float(np.mean(~known))}

    def for_labels(self, recording: Recording) -> list[str]:
        """The kinds whose labels all vary in a recording; of these, the kinds with the most labels.

        Raises
        ------
        TrainingError
            There is no such kind.
        """
        known = {name: numbers(cells) for name, cells in recording.labels.items()}
        varied = {name for name, values in known.items() if np.isfinite(values).any() and np.nanmax(values) > np.nanmin(values)}
        fitting = {name: len(part.names) for name, part in self.parts.items() if set(part.names) <= varied}
        if not fitting:
            needed = "; ".join(f"{name}: {', '.join(part.names)}" for name, part in self.parts.items())
            raise TrainingError(f"{recording.path}: its varying labels fit no kind of contact of the weights ({needed}); give another")
        first = max(fitting, key=lambda name: fitting[name])
        return [name for name in fitting if self.parts[name].names == self.parts[first].names]

    def predict_rows(self, data: Dataset, rows: np.ndarray, kinds: Sequence[str]) -> Prediction:
        """Estimate the labels of some rows (B,) of a data set, each by the most probable of some kinds with the same labels."""
        told = self.contacts.likeliest(data.pins.rows(rows), kinds)
        none = np.full((len(rows), len(self.parts[kinds[0]].names)), np.nan)
        made = Prediction(none.copy(), none.copy(), none.copy(), none[:, 0].copy())
        for name in kinds:
            here = np.flatnonzero(told == name)
            if len(here):
                part = self.parts[name].predict_rows(data, rows[here])
                for key in ("mean", "half_width", "half_width_raw", "executed"):
                    getattr(made, key)[here] = getattr(part, key)
        return made


def contacts_folder(run: str | Path) -> Path | None:
    """The folder with the models of several kinds, for a run's folder or a sensor's name; None if it has none."""
    folder = folder_of(run)
    return next((place for place in (folder, folder / INSIDE) if (place / CONTACTS).is_file()), None)
