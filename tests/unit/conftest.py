"""A drawn data set, simulated contacts and models trained on them, shared by all tests that only look at them."""

import os
import sys

import numpy as np
import pytest
from drawn_recording import config_of, drawn_dataset
from filelock import FileLock
from small_generation import SENSOR, small_config
from unknown_sensor import leave_out_costs, leave_out_other_layouts, search_few_sizes

from scenes import load_experiment, load_sensor
from training.generation import generate
from training.runs.run import train_run
from training.studies.train import train_model
from twin.frames.images import write_image

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


def written_at(folder):
    """When each file below a folder was written."""
    return {str(path): path.stat().st_mtime_ns for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="session")
def made_once(of_all_workers):
    """Gives a folder by its name. The first process that asks makes what is in it, the others wait; no test writes into it."""
    home, given = of_all_workers / "shared", {}
    home.mkdir(exist_ok=True)

    def folder(name, make):
        made = home / name
        with FileLock(home / f"{name}.lock"):
            if not made.exists():
                making = home / f"{name}-{os.getpid()}"
                making.mkdir()
                make(making)
                making.rename(made)
        given.setdefault(made, written_at(made))
        return made

    yield folder
    for made, then in given.items():
        assert written_at(made) == then, f"a test has written into {made}, which other tests read at the same time: let it use a copy"


@pytest.fixture(scope="session")
def trained(data, made_once):
    """Folder of a finished run."""

    def make(out):
        assert train_run(config_of("vgnn", epochs=30, batch=16), data, out)

    return made_once("trained", make)


@pytest.fixture(scope="session")
def contacts(made_once):
    """Folder of a simulated data set, and of a run of ``touch`` that was trained on it."""

    def make(home):
        (home / "presses.toml").write_text(PRESSES)
        config = small_config(home, experiment=load_experiment(home / "presses.toml"), states="all", randomisation=None)
        generate(home / "set", config, 10)
        train_model("touch", config.sensor, [home / "set"], home / "run", target="contact", members=1, kernel=False, epochs=20, split=None)

    home = made_once("maps", make)
    return home / "set", home / "run", load_sensor(SENSOR)


@pytest.fixture
def no_assumption_costs(monkeypatch):
    """Costs of assumptions, seconds of simulated contacts, are left out: for tests that look at something else of a new sensor."""
    leave_out_costs(monkeypatch)


@pytest.fixture
def no_other_layout(monkeypatch):
    """Frames are searched for no layout but the sensor's own, which takes most of a check and a tuning: for tests of something else."""
    leave_out_other_layouts(monkeypatch)


@pytest.fixture
def few_sizes(monkeypatch):
    """Frames are searched for spots of few sizes: for tests that look at something else than the spots of an unknown sensor."""
    search_few_sizes(monkeypatch)


@pytest.fixture
def undrawn_charts(monkeypatch):
    """Charts of pages are made, but not drawn, which takes seconds: for tests that look at something else of a page."""
    import twin.report.charts  # noqa: F401

    for module in ("twin.report.charts", "training.studies.judging", "training.environments.learn"):
        if module in sys.modules:  # each holds the function under its own name
            monkeypatch.setattr(f"{module}.save_figure", lambda path, figure, **_: write_image(path, np.zeros((8, 8), np.uint8)))
