"""Runs: kept, continued, judged; and what a trained model refuses."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from drawn_frames import drawn_frame
from drawn_recording import FRAMES, config_of

from scenes import load_sensor
from training.dataset import Dataset
from training.estimator import PoseEstimator, digest_of, folder_of
from training.evaluate import judge, leak_check, rows_to_judge, write_evaluation
from training.models import recipe_of
from training.models.part import Prediction
from training.pins import PinTable
from training.recipes import TrainingError
from training.run import fold_rows, train_run
from twin.errors import FrameError
from twin.pins import Pipeline, nominal_reference
from twin.types import Form, Frame


@pytest.mark.parametrize("model", ["vgnn", "tac-vgnn-release"])
def test_a_run_taken_up_again_ends_as_if_never_ended(data, tmp_path, model):
    config = config_of(model, epochs=3, batch=32, members=2, kernel=False)
    train_run(config, data, tmp_path / "whole")
    for _ in range(20):
        if train_run(config, data, tmp_path / "parts", max_minutes=0):  # one epoch each time
            break
    whole, parts = (torch.load(tmp_path / name / "weights.pt", weights_only=True) for name in ("whole", "parts"))
    for a, b in zip(whole["networks"], parts["networks"], strict=True):
        assert all(torch.equal(a[key], b[key]) for key in a)
    assert torch.equal(whole["quantile"], parts["quantile"])
    assert not (tmp_path / "parts" / "checkpoint.pt").exists()
    rows = (tmp_path / "parts" / "curves.csv").read_text().splitlines()
    assert rows[0].startswith("network,epoch,loss") and len(rows) == 1 + 2 * 3


def test_another_run_in_the_same_folder_is_refused(data, trained, tmp_path):
    with pytest.raises(TrainingError, match="finished run"):
        train_run(config_of("vgnn", epochs=30, batch=16), data, trained)
    train_run(config_of("vgnn", epochs=3), data, tmp_path, max_minutes=0)
    with pytest.raises(TrainingError, match="other settings"):
        train_run(config_of("vgnn", epochs=4), data, tmp_path)


def test_a_run_begun_by_other_code_is_not_gone_on_with(data, tmp_path, monkeypatch):
    train_run(config_of("vgnn", epochs=3), data, tmp_path, max_minutes=0)
    monkeypatch.setattr("training.run.fingerprint", lambda *makers: "of another version")
    with pytest.raises(TrainingError, match="another version of the program"):
        train_run(config_of("vgnn", epochs=3), data, tmp_path)


def test_a_run_keeps_all_that_made_it(trained):
    config = json.loads((trained / "config.json").read_text())
    assert config["recipe"]["epochs"] == 30 and config["sensor"]["name"] == "mg400-127" and config["pipeline"]["detection"]
    assert config["columns"] == ["pose_2", "pose_6"] and config["units"] == ["mm", "deg"]


def test_a_trained_model_tells_the_pose(data, trained, tmp_path):
    estimator = PoseEstimator.load(trained)
    rows = rows_to_judge(estimator, data, "validation")
    made = estimator.predict_rows(data, rows)
    metrics = judge(made, data, rows)
    assert metrics["corrected"]["pose_2"]["mae"] < 0.3 and metrics["corrected"]["pose_6"]["mae"] < 5
    assert metrics["without_prediction"] == 0 and metrics["frames"] == 18
    written = write_evaluation(tmp_path, made, data, rows, metrics, "corrected")
    head = written[0].read_text().splitlines()[0].split(",")
    assert head[:5] == ["image_name", "pose_2_true", "pose_2_pred", "pose_2_lo90", "pose_2_hi90"] and head[-1] == "valid"


def test_one_frame_at_a_time_says_what_the_table_says(data, trained):
    estimator = PoseEstimator.load(trained)
    frame = drawn_frame(data.pins.sensor, Form.RECORDING, data.pins.nodes_px[3])
    one = estimator(frame)
    seen = Pipeline(data.pins.sensor, Form.RECORDING, data.pins.reference)(frame)
    table = PinTable(
        data.pins.sensor, Form.RECORDING, data.pins.reference, np.array(["f"]), seen.graph.nodes_px[None], seen.graph.area_px2[None],
        np.isnan(seen.pins_px[None, :, 0]), np.ones(1, bool),
    )  # fmt: skip
    assert one.valid and np.allclose(one.value, estimator.predict_table(table).mean[0], atol=1e-6)
    assert (one.low < one.value).all() and (one.value < one.high).all()


def test_another_sensors_frames_are_refused(data, trained):
    estimator = PoseEstimator.load(trained)
    other = load_sensor("mg400-331")
    pins = replace(data.pins, sensor=other)
    with pytest.raises(FrameError, match="trained on recording frames of 'mg400-127'.*'mg400-331'"):
        estimator.predict_table(pins)
    rest = nominal_reference(other, Form.RECORDING).pins_px
    with pytest.raises(FrameError, match="expected 256x256"):
        estimator(drawn_frame(other, Form.RECORDING, rest))
    with pytest.raises(FrameError, match="expected a recording frame"):
        estimator(Frame(np.zeros((256, 256), np.uint8), Form.RAW))


def test_a_frame_without_pins_is_not_valid_and_says_why(trained):
    made = PoseEstimator.load(trained)(Frame(np.zeros((256, 256), np.uint8), Form.RECORDING))
    assert not made.valid and "no pins" in made.reason and np.isnan(made.value).all()


def test_rows_a_model_learnt_from_are_not_judged(data, trained):
    estimator = PoseEstimator.load(trained)
    assert len(rows_to_judge(estimator, data, "all")) == FRAMES
    fewer = Dataset(data.pins.rows(np.arange(50)), data.targets.rows(np.arange(50)), data.folders)
    with pytest.raises(TrainingError, match="trained on part of 90 rows"):
        rows_to_judge(estimator, fewer, "validation")


def test_each_network_watches_rows_of_its_own():
    train = np.arange(100)
    folds = [fold_rows(train, 0, member) for member in range(10)]
    assert sorted(np.concatenate([held for held, _ in folds])) == list(range(100))
    assert all(not set(held) & set(learnt) for held, learnt in folds)


def test_a_model_that_reads_the_clock_is_found_out(data):
    undone = data.targets.executed < 0.5
    honest = Prediction(data.targets.corrected, np.ones((FRAMES, 2)), np.ones((FRAMES, 2)), np.full(FRAMES, np.nan))
    clock = Prediction(data.targets.corrected + 0.5 * np.column_stack([np.zeros(FRAMES), data.targets.move[:, 1]]), *[None] * 3)
    assert undone.any() and abs(leak_check(honest.mean, data.targets).slope) < 1e-9
    assert leak_check(clock.mean, data.targets).slope == pytest.approx(0.5)


def test_unknown_models_and_settings_are_named():
    with pytest.raises(TrainingError, match="no model 'vgg'; choose one of vgnn"):
        recipe_of("vgg")
    with pytest.raises(TrainingError, match="no setting epoch"):
        recipe_of("vgnn", epoch=3)
    with pytest.raises(TrainingError, match="no trained model"):
        PoseEstimator.load("nowhere")


def test_a_runs_digest_is_that_of_its_weights_and_configuration(tmp_path, monkeypatch):
    copy = tmp_path / "run"
    shutil.copytree(folder_of("mg400-127"), copy)
    found = [digest_of("mg400-127"), digest_of(copy)]
    assert found[0] == found[1]  # whatever it is called
    for file in sorted(copy.iterdir()):
        content = bytearray(file.read_bytes())
        content[-1] ^= 1
        file.write_bytes(content)
        found.append(digest_of(copy))
    monkeypatch.setattr("training.estimator.fingerprint", lambda *makers: "of another version")
    found.append(digest_of(copy))
    assert len(set(found)) == 4
