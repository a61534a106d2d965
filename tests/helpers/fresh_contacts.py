"""Contacts that no shipped model has seen, simulated on a coarse mesh."""

from pathlib import Path

from scenes import load_experiment, load_object, load_randomisation, load_sensor
from training.data.dataset import Dataset, load_dataset
from training.data.simulated import config_of
from training.estimate.estimator import PoseEstimator
from training.generation import GenerationConfig, generate
from twin.rig.kinematics import rig_of


def simulate_contacts(
    folder: Path, sensor: str, experiment: str, count: int, *, seed: int, across: int, states: str = "all", raw: bool = False
) -> Path:
    """A data set of pins alone, contacts randomised as 'contact'; goes on where it was. ``raw``: in px of raw frames."""
    spec, plan = load_sensor(sensor), load_experiment(experiment)
    if raw:
        spec = spec.model_copy(update={"recording": None, "pipeline": spec.pipeline.model_copy(update={"processed": None})})
    config = GenerationConfig(
        sensor=spec,
        object=load_object(plan.object),
        experiment=plan,
        randomisation=load_randomisation("contact"),
        friction=rig_of(spec).friction,
        seed=seed,
        images="none",
        states=states,
        across=across,
    )
    generate(folder, config, count)
    return folder


def read_for(estimator: PoseEstimator, folder: Path) -> Dataset:
    """The data set as a model's inputs and truth."""
    return load_dataset(folder, config_of(folder).sensor, estimator.names, form=estimator.form)
