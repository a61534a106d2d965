"""The twins of a study: the one with all ingredients, and twins without one ingredient each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenes import load_randomisation
from scenes.experiment import ExperimentSpec, MoveRanges
from scenes.object import ObjectSpec
from scenes.randomisation import FrictionSpread, RandomisationSpec
from scenes.rig import RigSpec
from scenes.sensor import SensorSpec
from training.data.dataset import Dataset, load_dataset
from training.errors import TrainingError
from training.generation import GenerationConfig, generate
from training.studies.sim_to_real.discrepancy import FRICTIONS
from training.studies.sim_to_real.plan import FULL, SimToRealPlan
from twin.progress import Progress, stage
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel
from twin.types import Form

# Elements across the skin of the twin with a coarse mesh.
COARSE = 12
# Share of the contacts that the twin with few contacts is trained on.
FEW = 0.2
# Angle in deg to whose multiples the axes of an uncalibrated sensor are rounded.
QUARTER_DEG = 90.0


@dataclass(frozen=True)
class Twin:
    """How contacts are simulated, and which of them are used for training.

    Attributes
    ----------
    name : str
        Name of the run's folder.
    says : str
        Name in the study's table.
    contacts : str
        Name of the set of contacts; several twins may have the same set.
    randomisation : RandomisationSpec
    across : int
        Elements along each side of the skin's grid.
    learns : bool
        Whether a discrepancy is fitted to the labelled frames and added to the pins.
    share : float
        Share of the set's contacts, the first ones, that are used for training.
    """

    name: str
    says: str
    contacts: str
    sensor: SensorSpec
    experiment: ExperimentSpec
    randomisation: RandomisationSpec
    across: int
    learns: bool = True
    share: float = 1.0

    @property
    def frictions(self) -> tuple[float, ...]:
        """The frictions with which labelled frames are simulated, so that the residuals do not include the effect of friction."""
        return FRICTIONS if self.randomisation.friction else (rig_of(self.sensor).friction,)

    def config(self, obj: ObjectSpec, seed: int) -> GenerationConfig:
        """Configuration of the twin's contacts, without pictures."""
        return GenerationConfig(
            sensor=self.sensor,
            object=obj,
            experiment=self.experiment,
            randomisation=self.randomisation,
            friction=rig_of(self.sensor).friction,
            seed=seed,
            images="none",
            states="all",
            across=self.across,
        )

    def simulated_sets(
        self, plan: SimToRealPlan, out: Path, sensor: SensorSpec, form: Form, given: Sequence[Path], progress: Progress
    ) -> list[Dataset]:
        """Contacts as a sensor's data sets: the finished ones ``given``, or one simulated to the folder ``out`` if there are none."""
        if not given:
            given = [out / self.contacts]
            with stage(progress, f"{self.name}: {self.experiment.name}") as step:
                generate(given[0], self.config(plan.target_object, plan.seed), plan.count, workers=plan.workers, progress=step)
        found = []
        for folder in given:
            with stage(progress, f"states of {folder.name}") as step:
                found.append(load_dataset(folder, sensor, plan.experiment.targets, form=form, progress=step))
        return found

    def part(self, contacts: Dataset) -> Dataset:
        """The states of the contacts that are used for training."""
        if self.share == 1:
            return contacts
        group = contact_of(contacts)
        numbers = np.unique(group)
        return contacts.rows(np.flatnonzero(np.isin(group, numbers[: int(np.ceil(self.share * len(numbers)))])))


def contact_of(simulated: Dataset) -> np.ndarray:
    """(M,) int: the number of the contact that each state of a simulated data set belongs to.

    Raises
    ------
    TrainingError
        The data set is not one of simulated contacts.
    """
    if simulated.group is None:
        raise TrainingError(f"{', '.join(map(str, simulated.folders))}: no simulated contacts; give a data set of 'twin dataset'")
    return simulated.group.astype(int)


def full_twin(plan: SimToRealPlan, sensor: SensorSpec, labels: Sequence[ArmLabel], friction: FrictionSpread | None) -> Twin:
    """The twin with all ingredients; if all moves of the labels were executed, it executes all moves, too."""
    changes = {"friction": friction} | ({"executed_share": 1.0} if all(label.executed for label in labels) else {})
    return Twin(FULL, "simulated", "sim", sensor, plan.wider, load_randomisation("moves").model_copy(update=changes), plan.across)


def without_one_ingredient(
    full: Twin, uncalibrated: SensorSpec, any_friction: RandomisationSpec, every_tolerance: RandomisationSpec
) -> list[Twin]:
    """Twins that differ from ``full`` in one ingredient each.

    Parameters
    ----------
    uncalibrated : SensorSpec
        The sensor without any measurement of labelled frames; see ``as_mounted``.
    any_friction : RandomisationSpec
        Draws friction from a range that does not depend on labelled frames.
    every_tolerance : RandomisationSpec
        Also draws properties of skin and gel.
    """

    def but(name: str, says: str, *, shared: bool = False, **changes: Any) -> Twin:
        return replace(full, name=f"sim_{name}", says=says, contacts=full.contacts if shared else name, **changes)

    wide = every_tolerance.model_copy(update={"friction": full.randomisation.friction})
    still = full.experiment.model_copy(update={"move": MoveRanges()})
    return [
        but("bare", "simulated, bare", shared=True, learns=False),
        but("few", f"simulated, {FEW:.0%} of the contacts", shared=True, share=FEW),
        but("coarse", f"simulated, {COARSE} elements across", across=COARSE),
        but("one_friction", "simulated, one friction", randomisation=full.randomisation.model_copy(update={"friction": None})),
        but("any_friction", "simulated, any friction", randomisation=any_friction),
        but("taps", "simulated, without moves", experiment=still),
        but("tolerances", f"simulated, randomised as '{every_tolerance.name}'", randomisation=wide),
        but("uncalibrated", "simulated, uncalibrated", sensor=uncalibrated, learns=False),
    ]


def as_mounted(sensor: SensorSpec) -> SensorSpec:
    """The sensor as known before any measurement: its turn about its axis to a quarter turn, and the tool point at the tip."""
    rig = rig_of(sensor)
    quarter = QUARTER_DEG * round(rig.image_turn_deg / QUARTER_DEG)
    plain = RigSpec(tcp_to_dome_mm=-sensor.skin.apex_mm, turn_sign=rig.turn_sign, image_turn_deg=quarter)
    return sensor.model_copy(update={"rig": plain})
