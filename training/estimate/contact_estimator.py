"""One estimator for several kinds of contact of a sensor: it finds the kind of a frame's contact, and estimates the pose by that kind's
model.

Its folder holds the small copies of runs, the classifier of the kinds (``training.estimate.contacts``), and ``contacts.json``: the run of
each kind, with the intervals for this kind. Several kinds may share a run that was trained on all of them. The shipped weights of a sensor
may have such a folder inside: ``contacts``.
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
from training.estimate.contacts import CONTACTS, Contacts, fit_contacts, read_contacts, write_contacts
from training.estimate.estimator import PoseEstimate, PoseEstimator
from training.models.part import Prediction, Unseen
from training.runs.packed import folder_of, pack
from training.runs.run_files import damage_error
from twin.camera.capture import in_form
from twin.frames import Recording
from twin.frames.tables import numbers
from twin.store import write_json, writes
from twin.types import Frame

# Folder, inside that of a sensor's weights, with the models of several kinds of contact.
INSIDE = "contacts"
# File with the model and the intervals of each kind.
KINDS = "contacts.json"
# Names of intervals in that file.
INTERVALS = ("quantile", "raw_quantile")
AGAIN = "copy the model's folder again"


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
        """Load a folder that ``put_together`` wrote.

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
            raise damage_error(path, "it does not state which model is of which kind", AGAIN) from error
        if unlike:
            raise damage_error(path, f"no intervals are called {unlike[0]}", AGAIN)
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
        """The estimator itself, because models of several kinds of contact do not estimate slip."""
        return self

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


@dataclass(frozen=True)
class KindOfContact:
    """A kind of contact, as input of ``put_together``.

    Attributes
    ----------
    model : str
        Name of the run that estimates it.
    frames : sequence of Dataset
        Frames of this kind, on which the classifier is trained. Give the training frames of the run.
    intervals : dict of str to array
        The run's interval quantiles for this kind, from frames that it did not learn from (``training.studies.judging.intervals_on``). If
        empty, the run's own intervals are used.
    """

    model: str
    frames: Sequence[Dataset]
    intervals: Mapping[str, np.ndarray] = field(default_factory=dict)


@writes(CONTACTS, KINDS)
def put_together(runs: Mapping[str, Path], kinds: Mapping[str, KindOfContact], out: Path, *, seed: int = 0) -> ContactEstimator:
    """Make one estimator of several kinds of contact, and write it to a folder.

    Parameters
    ----------
    runs : dict of str to Path
        Finished runs by name; each must have a small copy (``training.runs.packed.pack``).
    kinds : dict of str to KindOfContact

    Raises
    ------
    TrainingError
        A run has no small copy, or there are too few frames or kinds.
    """
    contacts = fit_contacts({name: kind.frames for name, kind in kinds.items()}, seed=seed)
    for name, run in runs.items():
        pack(run, out / name)
    write_contacts(out / CONTACTS, contacts)
    said: dict[str, dict[str, object]] = {}
    for name, kind in kinds.items():
        said[name] = {"model": kind.model} | {key: np.asarray(value).tolist() for key, value in kind.intervals.items()}
    write_json(out / KINDS, said)
    return ContactEstimator.load(out)
