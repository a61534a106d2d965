"""A drawn data set, simulated contacts and models trained on them, shared by all tests of a process that only look at them."""

import pytest
from drawn_recording import config_of, drawn_dataset
from small_generation import small_config

from scenes import load_experiment
from training.generation import generate
from training.run import train_run
from training.train import train_model

PRESSES = """
description = "gentle presses and short drags"
object = "plane"
approach = "z"
zero_mm = 0.0
clear = [0, 0, -3, 0, 0, 0]
tap = [0, 0, 3, 0, 0, 0]
targets = ["pose_3", "pose_4"]
[pose]
pose_3 = [1.0, 1.8]
pose_4 = [-10, 10]
pose_5 = [-10, 10]
[move]
move_1 = [-1.2, 1.2]
move_2 = [-1.2, 1.2]
"""


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    return drawn_dataset(tmp_path_factory.mktemp("drawn"))


@pytest.fixture(scope="session")
def trained(data, tmp_path_factory):
    """Folder of a finished run."""
    out = tmp_path_factory.mktemp("trained")
    assert train_run(config_of("vgnn", epochs=30, batch=16), data, out)
    return out


@pytest.fixture(scope="session")
def contacts(tmp_path_factory):
    """Folder of a simulated data set, and of a run of ``touch`` that learnt from it."""
    home = tmp_path_factory.mktemp("maps")
    (home / "presses.toml").write_text(PRESSES)
    config = small_config(home, experiment=load_experiment(home / "presses.toml"), states="all", randomisation=None)
    generate(home / "set", config, 10)
    train_model("touch", config.sensor, [home / "set"], home / "run", target="contact", members=1, kernel=False, epochs=20, split=None)
    return home / "set", home / "run", config.sensor
