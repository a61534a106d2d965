"""Damaged files of a run are named, with what to do; none of them changes an answer in silence."""

import json
import os
import pickle
import shutil

import pytest
import torch
from drawn_recording import config_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scenes import SpecError
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.runs.run import train_run
from training.runs.run_files import pack, read_tensors, write_tensors
from twin.errors import FrameError

CONFIGS = {
    "a list": lambda config: [1],
    "a model with a name of two lines": lambda config: config | {"model": "vg\nnn"},
    "a model with a name without end": lambda config: config | {"model": "v" * 5000},
    "nothing": lambda config: None,
    "no sensor": lambda config: config | {"sensor": None},
    "a sensor without a section": lambda config: config | {"sensor": {k: v for k, v in config["sensor"].items() if k != "pins"}},
    "a sensor of other pins": lambda config: config | {"sensor": config["sensor"] | {"pins": config["sensor"]["pins"] | {"rings": 3}}},
    "a sensor with a wrong number": lambda config: (
        config | {"sensor": config["sensor"] | {"skin": config["sensor"]["skin"] | {"thickness_mm": "thick"}}}
    ),
    "another size": lambda config: config | {"size": {"width": 10**9}},
    "a size that the weights do not have": lambda config: config | {"size": config["size"] | {"width": 17}},
    "no columns": lambda config: config | {"columns": []},
    "columns of another number": lambda config: config | {"columns": ["pose_2"]},
    "columns that are a text": lambda config: config | {"columns": "pose_2"},
    "no rows": lambda config: {k: v for k, v in config.items() if k != "rows"},
    "another form": lambda config: config | {"pipeline": config["pipeline"] | {"form": "cooked"}},
    "another model": lambda config: config | {"model": "transformer"},
}
TENSORS = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2],
    "text": lambda data: b"no weights",
    "a pickle": lambda data: pickle.dumps(print),
    "a pickle within": lambda data: data,
    "a byte changed": lambda data: data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :],
    "nothing but a tensor": lambda data: data,
}


def refused(call, path):
    """The one line that refuses, which names the path and the remedy and passes on no library's advice."""
    with pytest.raises(TrainingError) as error:
        call()
    said = str(error.value)
    assert str(path) in said and "train again" in said
    assert len(said.splitlines()) == 1 and len(said) < 600 and "weights_only" not in said and "pydantic" not in said
    return said


anything = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.lists(st.integers(), max_size=2)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), value=anything | st.dictionaries(st.text(max_size=5), anything, max_size=2))
def test_a_configuration_with_any_other_value_makes_a_model_or_is_refused(trained, tmp_path_factory, data, value):
    """Whatever key of any depth has whatever value: the run is loaded, or one line names it."""
    run = tmp_path_factory.mktemp("any") / "run"
    shutil.copytree(trained, run)
    config = json.loads((run / "config.json").read_text())
    place = config
    while True:
        key = data.draw(st.sampled_from(sorted(place)))
        if not isinstance(place[key], dict) or not place[key] or data.draw(st.booleans()):
            break
        place = place[key]
    place[key] = value
    (run / "config.json").write_text(json.dumps(config))
    try:
        estimator = PoseEstimator.load(run)
    except (TrainingError, FrameError, SpecError) as error:
        assert "\n" not in str(error) and len(str(error)) < 1500
    else:
        assert len(estimator.names) == len(estimator.units)


@pytest.mark.parametrize("what", CONFIGS)
def test_a_configuration_that_makes_no_model_is_refused(trained, tmp_path, what):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(CONFIGS[what](config)))
    refused(lambda: PoseEstimator.load(run), run)


def test_a_configuration_that_is_a_named_pipe_is_not_waited_for(trained, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    (run / "config.json").unlink()
    os.mkfifo(run / "config.json")
    refused(lambda: PoseEstimator.load(run), run / "config.json")


def test_a_configuration_that_is_no_json_is_refused(trained, tmp_path):
    shutil.copytree(trained, tmp_path / "run")
    for content in (b"", b"{", bytes(range(256)), b"[" * 100_000):
        (tmp_path / "run" / "config.json").write_bytes(content)
        refused(lambda: PoseEstimator.load(tmp_path / "run"), tmp_path / "run" / "config.json")


def damage(path, what):
    if what == "a pickle within":
        torch.save({"networks": print}, path)
    elif what == "nothing but a tensor":
        torch.save(torch.zeros(3), path)
    else:
        path.write_bytes(TENSORS[what](path.read_bytes()))


@pytest.mark.parametrize("what", TENSORS)
def test_damaged_weights_are_refused(trained, tmp_path, what):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    damage(run / "weights.pt", what)
    for call in (lambda: PoseEstimator.load(run), lambda: pack(run, tmp_path / "small")):
        refused(call, run / "weights.pt")
    assert not list((tmp_path / "small").glob("[!.]*"))


@pytest.mark.parametrize("what", TENSORS)
def test_a_damaged_checkpoint_is_refused_and_left_alone(data, tmp_path, what):
    config = config_of("vgnn", epochs=2, batch=32, members=1, kernel=False)
    train_run(config, data, tmp_path, max_minutes=0)
    damage(tmp_path / "checkpoint.pt", what)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(TrainingError, match=r"checkpoint\.pt.*remove it to begin again, or give another `out`"):
        train_run(config, data, tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_tensors_come_back_as_they_were_written(tmp_path):
    content = {"a": torch.arange(5), "b": [1.5, {"c": torch.eye(2)}], "d": "text"}
    write_tensors(tmp_path / "x.pt", content)
    found = read_tensors(tmp_path / "x.pt")
    assert torch.equal(found["a"], content["a"]) and torch.equal(found["b"][1]["c"], torch.eye(2)) and found["d"] == "text"


def test_a_changed_byte_in_a_small_copy_is_refused(data, tmp_path):
    train_run(config_of("vgnn", epochs=1, batch=32, members=1, kernel=False), data, tmp_path / "run")
    pack(tmp_path / "run", tmp_path / "small")
    assert PoseEstimator.load(tmp_path / "small").config["rows"]["kept_out"]
    weights = tmp_path / "small" / "weights.safetensors"
    content = bytearray(weights.read_bytes())
    content[-100] ^= 1
    weights.write_bytes(content)
    refused(lambda: PoseEstimator.load(tmp_path / "small"), weights)
