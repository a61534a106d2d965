"""The plan of the study of unseen objects: what is simulated, trained and evaluated."""

from dataclasses import dataclass

import numpy as np

from scenes import ExperimentSpec, ObjectSpec, RandomisationSpec, SensorSpec, load_experiment
from training.data.dataset import Dataset, join_datasets
from training.errors import TrainingError
from training.generation import GenerationConfig, require_count
from training.studies.sim_to_real.variants import contact_of
from twin.types import FINE

# Difference between the seeds of the evaluated contacts and of the training contacts, so that no evaluated contact is trained on.
TESTS_APART = 1000
# Name of the model that is trained on all objects of ``Plan.train``.
MIXED = "mixed"
# Largest ratio of the error on an unseen object to the error on the first object for which the aim counts as reached.
TIMES = 1.5


@dataclass(frozen=True)
class ObjectsPlan:
    """What is simulated, trained and evaluated.

    Attributes
    ----------
    sensor : SensorSpec
    experiment : ExperimentSpec
        Its ranges contain the labels of the evaluated contacts. Training uses its wide form, if it has one.
    randomisation : RandomisationSpec
    train, unseen : tuple of ObjectSpec
        Objects. The first of ``train`` is also trained on alone.
    count, tests : int
        Contacts to train on, and to evaluate on, for each object.
    seed, across : int
    epochs : int or None
        Epochs of both trainings; None: the model's own number.
    workers : int
        Number of simulating processes.
    """

    sensor: SensorSpec
    experiment: ExperimentSpec
    randomisation: RandomisationSpec
    train: tuple[ObjectSpec, ...]
    unseen: tuple[ObjectSpec, ...]
    count: int = 100
    tests: int = 50
    seed: int = 0
    across: int = FINE
    epochs: int | None = None
    workers: int = 1

    def __post_init__(self) -> None:
        names = [each.name for each in (*self.train, *self.unseen)]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise TrainingError(f"{', '.join(twice)}: given twice; an object is either trained on or unseen")
        if len(self.train) < 2 or not self.unseen:
            raise TrainingError("give at least two objects to train on and an unseen one")
        require_count(self.count)
        require_count(self.tests, "`tests`")

    @property
    def wider(self) -> ExperimentSpec:
        """The experiment that is trained on."""
        return load_experiment(self.experiment, wide=bool(self.experiment.wide or self.experiment.wider))

    @property
    def alone(self) -> ObjectSpec:
        """The object that is also trained on alone."""
        return self.train[0]

    def sets(self) -> list[tuple[str, GenerationConfig, int]]:
        """Folder, configuration and number of contacts of every data set."""
        learnt = [
            (f"sim/{o.name}", self._config(o, self.wider, 0), self.count * (len(self.train) if o is self.alone else 1)) for o in self.train
        ]
        tests = [(f"tests/{o.name}", self._config(o, self.experiment, TESTS_APART), self.tests) for o in (*self.train, *self.unseen)]
        return learnt + tests

    def _config(self, obj: ObjectSpec, experiment: ExperimentSpec, apart: int) -> GenerationConfig:
        return GenerationConfig(
            sensor=self.sensor,
            object=obj,
            experiment=experiment,
            randomisation=self.randomisation,
            friction=obj.friction,
            seed=self.seed + apart,
            images="none",
            states="all",
            across=self.across,
        )

    def trained_on(self, sets: dict[str, Dataset]) -> dict[str, Dataset]:
        """The data set that each model is trained on, by the model's name. Both have the same number of contacts."""
        parts = [sets[f"sim/{obj.name}"] for obj in self.train]
        first = parts[0].rows(np.flatnonzero(contact_of(parts[0]) < self.count))
        return {MIXED: join_datasets([first, *parts[1:]]), self.alone.name: parts[0]}
