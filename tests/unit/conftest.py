"""A drawn data set and a model trained on it, shared by all tests of a process that only look at them."""

import pytest
from drawn_recording import config_of, drawn_dataset

from training.run import train_run


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    return drawn_dataset(tmp_path_factory.mktemp("drawn"))


@pytest.fixture(scope="session")
def trained(data, tmp_path_factory):
    """Folder of a finished run."""
    out = tmp_path_factory.mktemp("trained")
    assert train_run(config_of("vgnn", epochs=30, batch=16), data, out)
    return out
