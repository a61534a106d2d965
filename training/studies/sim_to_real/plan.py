"""The plan of the sim-to-real study, and the names in its tables."""

from dataclasses import dataclass
from pathlib import Path

from scenes import ExperimentSpec, ObjectSpec, SensorSpec, load_experiment, load_object
from training.data.simulated import is_simulated
from training.errors import TrainingError
from training.generation import require_count
from twin.errors import DatasetError
from twin.types import FINE

FULL = "sim_only"
"""Name and folder of the twin with all ingredients."""
MOST_DRAWS = 1000
"""Most draws of what the twin misses, for each contact. More would not fit into memory."""
REAL, BOTH = "real", "simulated and real"
"""Names of rows of models that were trained on real frames alone, and from simulated contacts and real frames."""
EVENLY = ", even"
"""What is added to these where the frames are not sampled at random, but nearest to an even sequence."""
WITHOUT = ", {count} without labels"
"""What is added to these where the model also learnt from ``count`` frames without labels."""


@dataclass(frozen=True)
class SimToRealPlan:
    """Settings of a study.

    Attributes
    ----------
    sensor : SensorSpec
    frames : Path
        A labelled real recording.
    experiment : ExperimentSpec
        The experiment that the recording was made with. It also names the labels that are trained on.
    contacts : ExperimentSpec or None
        The experiment that is simulated; None: ``experiment`` with its wider ranges.
    labels : int
        Number of labelled frames that are used with the simulated contacts.
    seed : int
        Seed of the choice of frames, the contacts and the weights.
    draws : int
        Number of discrepancies that are sampled for each contact.
    count : int
        Number of contacts to simulate.
    simulated : tuple of Path
        Finished data sets to use instead of simulating contacts for the twin with all ingredients; several are joined.
    calibrate : bool
        Fit the specification to the labelled frames first.
    ablate : bool
        Also train without one ingredient at a time.
    epochs : int or None
        Epochs of every training; None: the default of that training.
    workers : int
        Processes that simulate.
    across : int
        Elements along each side of the skin's grid.

    Raises
    ------
    DatasetError
        ``draws`` or ``count`` is out of range.
    TrainingError
        A folder of ``simulated`` holds no simulated data set.
    """

    sensor: SensorSpec
    frames: Path
    experiment: ExperimentSpec
    contacts: ExperimentSpec | None = None
    labels: int = 40
    seed: int = 0
    draws: int = 2
    count: int = 500
    simulated: tuple[Path, ...] = ()
    calibrate: bool = False
    ablate: bool = False
    epochs: int | None = None
    workers: int = 1
    across: int = FINE

    def __post_init__(self) -> None:
        require_count(self.count)
        if not 1 <= self.draws <= MOST_DRAWS:
            raise DatasetError(f"`draws` {self.draws}: expected 1 to {MOST_DRAWS} for each contact")
        for folder in self.simulated:
            if not is_simulated(folder):
                raise TrainingError(f"`sim` {folder}: no simulated data set; give the folder of one that 'twin dataset' has finished")

    @property
    def target_object(self) -> ObjectSpec:
        """The object of the recording's experiment."""
        return load_object(self.experiment.object)

    @property
    def wider(self) -> ExperimentSpec:
        """The experiment that is simulated."""
        if self.contacts is not None:
            return self.contacts
        return load_experiment(self.experiment, wide=bool(self.experiment.wide or self.experiment.wider))
