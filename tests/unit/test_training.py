"""Runs: kept, continued, evaluated; and what a trained model refuses."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from drawn_frames import drawn_frame
from drawn_recording import FRAMES, config_of

from scenes import load_sensor
from training.data.dataset import Dataset, join_datasets
from training.data.pins import PinTable
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator, digest_of, models_by_sensor
from training.models import recipe_of
from training.models.part import Prediction
from training.runs.config import changed_since, trained_before, training_rows
from training.runs.run import fold_rows, is_finished, train_run
from training.runs.run_files import folder_of, read_tensors
from training.studies.evaluation import Evaluation, Predictions
from training.studies.judging import leak_check, measure_errors, rows_to_evaluate, write_evaluation
from twin.errors import FrameError, warn_once
from twin.pins import Pipeline, nominal_reference
from twin.store import contents
from twin.types import Form, Frame


@pytest.mark.parametrize("model", [pytest.param("vgnn", marks=pytest.mark.slow), "tac-vgnn-release"])
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


def test_time_that_is_up_after_a_networks_last_epoch_ends_the_run(data, tmp_path):
    config = config_of("vgnn", epochs=1, batch=32, members=3, kernel=False)
    assert not train_run(config, data, tmp_path, max_minutes=0)
    assert len((tmp_path / "curves.csv").read_text().splitlines()) == 1 + 1


def test_another_run_in_the_same_folder_is_refused(data, trained, tmp_path):
    shutil.copytree(trained, tmp_path / "finished")
    with pytest.raises(TrainingError, match="finished run"):
        train_run(config_of("vgnn", epochs=30, batch=16), data, tmp_path / "finished")
    train_run(config_of("vgnn", epochs=3), data, tmp_path / "begun", max_minutes=0)
    with pytest.raises(TrainingError, match="other settings"):
        train_run(config_of("vgnn", epochs=4), data, tmp_path / "begun")


def in_another_order(data):
    return data.rows(np.random.default_rng(5).permutation(len(data)))


def with_other_labels(data):
    return replace(data, targets=replace(data.targets, raw=data.targets.raw + 1, corrected=data.targets.corrected + 1))


def with_other_moves(data):
    return replace(data, targets=replace(data.targets, executed=1 - data.targets.executed))


def with_another_frame(data):
    nodes = data.pins.nodes_px.copy()
    nodes[7] = nodes[8]
    return replace(data, pins=replace(data.pins, nodes_px=nodes))


def with_other_names(data):
    return replace(data, pins=replace(data.pins, image_name=np.char.add("g", data.pins.image_name)))


CHANGES = {
    "other labels": with_other_labels,
    "other labels ": with_other_moves,
    "other frames, or other pins found in them, under the same names": with_another_frame,
    "frames of other names": with_other_names,
}


@pytest.mark.parametrize("words", CHANGES)
def test_a_run_is_not_gone_on_with_and_not_offered_on_data_that_changed(data, tmp_path, words):
    config, changed = config_of("vgnn", epochs=2, batch=32, members=1, kernel=False), CHANGES[words](data)
    for minutes in (0, None):  # begun, then finished
        train_run(config, data, tmp_path, max_minutes=minutes)
        assert is_finished(config, data, tmp_path) == (minutes is None)
        with pytest.raises(TrainingError, match=words.strip()):
            is_finished(config, changed, tmp_path)
        with pytest.raises(TrainingError, match=words.strip() if minutes == 0 else "finished run"):
            train_run(config, changed, tmp_path)


def test_a_table_in_another_order_is_the_same_data(data, tmp_path):
    config, mixed = config_of("vgnn", epochs=2, batch=32, members=1, kernel=False), in_another_order(data)
    train_run(config, data, tmp_path / "one")
    train_run(config, mixed, tmp_path / "other", max_minutes=0)
    train_run(config, data, tmp_path / "other")
    one, other = (read_tensors(tmp_path / name / "weights.pt") for name in ("one", "other"))
    assert all(torch.equal(value, other["networks"][0][key]) for key, value in one["networks"][0].items())
    assert is_finished(config, mixed, tmp_path / "one")


def test_the_frames_kept_out_are_judged_whatever_the_order_of_the_table(data, trained):
    estimator, mixed = PoseEstimator.load(trained), in_another_order(data)
    kept = json.loads((trained / "config.json").read_text())["rows"]["kept_out"]
    assert len(kept) == 18
    for each in (data, mixed, mixed.rows(np.flatnonzero(np.isin(mixed.pins.image_name, kept)))):
        assert each.pins.image_name[rows_to_evaluate(estimator, each, "validation")].tolist() == kept
    made = [estimator.predict_rows(each, rows_to_evaluate(estimator, each, "validation")).mean for each in (data, mixed)]
    assert np.array_equal(*made)
    assert not changed_since(estimator.config, mixed, estimator.part)
    (said,) = changed_since(estimator.config, with_other_labels(data), estimator.part)
    assert "other labels" in said


def test_frames_that_a_run_learnt_from_are_known_again_under_any_name(data, trained, tmp_path):
    learnt = PoseEstimator.load(trained).learnt_from
    kept = np.isin(data.pins.image_name, json.loads((trained / "config.json").read_text())["rows"]["kept_out"])
    (said,) = trained_before(learnt, data)
    assert said.startswith(f"{(~kept).sum()} of these {FRAMES} frames") and "the run was trained on" in said
    assert not trained_before(learnt, data.rows(np.flatnonzero(kept)))
    few = in_another_order(data.rows(np.flatnonzero(~kept)[:7]))
    renamed = replace(few, pins=replace(few.pins, image_name=np.array([f"other_{k}.png" for k in range(7)])))
    assert trained_before(learnt, renamed)[0].startswith("7 of these 7 frames")
    other = replace(data.rows(np.flatnonzero(kept)), folders=(tmp_path / "a",))
    assert trained_before(learnt, join_datasets([other, replace(renamed, folders=(tmp_path / "b",))]))[0].startswith("7 of these 25 frames")
    assert "not known" in trained_before(None, data)[0]


def test_a_run_of_an_earlier_version_is_judged_and_says_what_it_cannot_tell(data, trained, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    config = json.loads((run / "config.json").read_text())
    kept = config["rows"]["kept_out"]
    (run / "config.json").write_text(json.dumps(config | {"rows": {"usable": FRAMES, "train": 72}}))
    estimator = PoseEstimator.load(run)
    judged = data.pins.image_name[rows_to_evaluate(estimator, data, "validation")].tolist()
    assert sorted(judged) == sorted(kept)
    (said,) = changed_since(estimator.config, data, estimator.part)
    assert "may not be its held-out frames" in said


def test_frames_of_folders_of_one_name_are_told_apart(data, tmp_path):
    parts = [replace(data, folders=(tmp_path / place / "taps",)) for place in ("monday", "tuesday")]
    both = join_datasets(parts)
    assert len(set(both.pins.image_name.tolist())) == 2 * FRAMES
    assert both.pins.image_name[0] == "monday/taps/f_0.png"
    assert join_datasets([parts[0], replace(data, folders=(tmp_path / "tilts",))]).pins.image_name[0] == "taps/f_0.png"


def test_the_split_of_several_recordings_goes_by_name(data, tmp_path):
    parts = [replace(data, folders=(tmp_path / name,)) for name in ("taps", "tilts")]
    config = config_of("vgnn")
    kept = []
    for each in (parts, [in_another_order(part) for part in parts]):
        both = join_datasets(each).in_order()
        kept.append(np.delete(both.pins.image_name, training_rows(config, both)).tolist())
    assert kept[0] == kept[1] and len(kept[0]) == 36


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_too_few_frames_to_learn_from_are_refused_in_words(data, tmp_path, frames):
    with pytest.raises(TrainingError, match=f"{frames} usable frames are too few; 3 are needed"):
        train_run(config_of("vgnn", epochs=1), data.rows(np.arange(frames)), tmp_path / "run")
    assert contents(tmp_path / "run") == []


def test_the_fewest_frames_are_learnt_from(data, tmp_path):
    for model in ("vgnn", "gnn", "tac-vgnn-release"):
        assert train_run(config_of(model, epochs=1), data.rows(np.arange(4)), tmp_path / model)
        assert PoseEstimator.load(tmp_path / model)


@pytest.mark.parametrize("changes", [{"seed": -1}, {"seed": 10**20}, {"split": -2}])
def test_seeds_out_of_range_are_refused(changes):
    with pytest.raises(TrainingError, match=f"--{next(iter(changes))} .*from 0 to 4294967295"):
        replace(config_of("vgnn"), **changes)


def test_a_run_begun_by_other_code_is_not_gone_on_with(data, tmp_path, monkeypatch):
    train_run(config_of("vgnn", epochs=3), data, tmp_path, max_minutes=0)
    monkeypatch.setattr("training.runs.run.fingerprint", lambda *makers: "of another version")
    with pytest.raises(TrainingError, match="another version of the program"):
        train_run(config_of("vgnn", epochs=3), data, tmp_path)


def test_a_run_keeps_all_that_made_it(trained):
    config = json.loads((trained / "config.json").read_text())
    assert config["recipe"]["epochs"] == 30 and config["sensor"]["name"] == "mg400-127" and config["pipeline"]["detection"]
    assert config["columns"] == ["pose_2", "pose_6"] and config["units"] == ["mm", "deg"]


def test_a_trained_model_tells_the_pose(data, trained, tmp_path):
    estimator = PoseEstimator.load(trained)
    rows = rows_to_evaluate(estimator, data, "validation")
    made = estimator.predict_rows(data, rows)
    metrics = measure_errors(made, data, rows)
    assert metrics["corrected"]["pose_2"]["mae"] < 0.3 and metrics["corrected"]["pose_6"]["mae"] < 5
    assert metrics["without_prediction"] == 0 and metrics["frames"] == 18
    written = write_evaluation(tmp_path, made, data, rows, metrics, "corrected")
    head = written[0].read_text().splitlines()[0].split(",")
    assert head[:5] == ["image_name", "pose_2_true", "pose_2_pred", "pose_2_lo90", "pose_2_hi90"] and head[-1] == "valid"


def test_no_share_above_one_and_no_area_below_zero_is_judged_or_written(data, tmp_path):
    """An interval stays that around the unbounded estimate, as it was calibrated."""
    labels = np.column_stack([np.full(len(data), 1.0), np.full(len(data), 3.0)])
    told = replace(data, targets=replace(data.targets, names=("slip_share", "contact_area"), raw=labels, corrected=labels))
    mean, half = np.tile([1.5, -2.0], (len(data), 1)), np.tile([0.6, 1.0], (len(data), 1))
    rows = np.arange(5)
    made = Prediction(mean[rows], half[rows], half[rows], np.full(5, np.nan))
    found = measure_errors(made, told, rows)["corrected"]
    assert found["slip_share"]["mae"] == 0.0 and found["slip_share"]["coverage_90"] == 1.0
    assert found["contact_area"]["mae"] == 3.0 and found["contact_area"]["coverage_90"] == 0.0
    table = write_evaluation(tmp_path, made, told, rows, {}, "corrected")[0].read_text().splitlines()
    assert table[1].split(",")[1:9] == ["1", "1", "0.9", "1", "3", "0", "0", "0"]


def test_intervals_from_too_few_frames_are_said_to_be_too_narrow(data, tmp_path):
    warn_once.cache_clear()  # another test may have been told
    with pytest.warns(RuntimeWarning, match="frames that training did not see are too narrow; 9 or more"):
        train_run(config_of("vgnn", epochs=1, members=1, kernel=False), data.rows(np.arange(8)), tmp_path)


def test_one_frame_at_a_time_says_what_the_table_says(data, trained):
    estimator = PoseEstimator.load(trained)
    frame = drawn_frame(data.pins.sensor, Form.PROCESSED, data.pins.nodes_px[3])
    one = estimator(frame)
    seen = Pipeline(data.pins.sensor, Form.PROCESSED, data.pins.reference)(frame)
    table = PinTable(
        data.pins.sensor, Form.PROCESSED, data.pins.reference, np.array(["f"]), seen.graph.nodes_px[None], seen.graph.area_px2[None],
        np.isnan(seen.pins_px[None, :, 0]), np.ones(1, bool),
    )  # fmt: skip
    assert one.valid and np.allclose(one.value, estimator.predict_table(table).mean[0], atol=1e-6)
    assert (one.low < one.value).all() and (one.value < one.high).all()


def test_a_run_of_another_sensor_than_the_pages_is_refused(trained):
    assert models_by_sensor(trained, "mg400-127")("mg400-127").sensor.name == "mg400-127"
    with pytest.raises(TrainingError, match="a model of 'mg400-127', not of 'ur5-331'"):
        models_by_sensor(trained, "ur5-331")


def test_another_sensors_frames_are_refused(data, trained):
    estimator = PoseEstimator.load(trained)
    other = load_sensor("mg400-331")
    pins = replace(data.pins, sensor=other)
    with pytest.raises(FrameError, match="trained on processed frames of 'mg400-127'.*'mg400-331'"):
        estimator.predict_table(pins)
    rest = nominal_reference(other, Form.PROCESSED).pins_px
    with pytest.raises(FrameError, match="expected 256x256"):
        estimator(drawn_frame(other, Form.PROCESSED, rest))
    with pytest.raises(FrameError, match="expected a processed frame"):
        estimator(Frame(np.zeros((256, 256), np.uint8), Form.RAW))


def test_a_frame_without_pins_is_not_valid_and_says_why(trained):
    made = PoseEstimator.load(trained)(Frame(np.zeros((256, 256), np.uint8), Form.PROCESSED))
    assert not made.valid and "no pins" in made.reason and np.isnan(made.value).all()


def test_rows_a_model_learnt_from_are_not_judged(data, trained):
    estimator = PoseEstimator.load(trained)
    assert len(rows_to_evaluate(estimator, data, "all")) == FRAMES
    fewer = Dataset(data.pins.rows(np.arange(50)), data.targets.rows(np.arange(50)), data.folders)
    with pytest.raises(TrainingError, match="of the 18 frames that the run kept out of its training are not among its 50 usable ones"):
        rows_to_evaluate(estimator, fewer, "validation")


def test_each_network_watches_rows_of_its_own():
    train = np.arange(100)
    folds = [fold_rows(train, 0, member) for member in range(10)]
    assert sorted(np.concatenate([held for held, _ in folds])) == list(range(100))
    assert all(not set(held) & set(learnt) for held, learnt in folds)


def test_a_model_that_estimates_from_time_is_found(data):
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
    monkeypatch.setattr("training.estimate.estimator.fingerprint", lambda *makers: "of another version")
    found.append(digest_of(copy))
    assert len(set(found)) == 5  # its displacements alone change no estimate with known rest places


def test_the_time_of_an_estimate_is_without_that_of_compiling():
    """The first estimate of a process loads or compiles code, so it is made twice."""
    seen = []

    class Counting:
        def with_history(self):
            return self

        def __call__(self, frame):
            seen.append(frame.name)
            return len(seen)

    frames = [SimpleNamespace(name=name) for name in "ab"]
    assert list(Predictions(Counting(), frames)) == [("a", 2), ("b", 3)] and seen == ["a", "a", "b"]


def test_labels_that_were_not_corrected_are_not_called_so():
    def lines(raw, corrected):
        errors = {kind: {"pose_2": {"mae": mae, "coverage_90": 0.9}} for kind, mae in (("raw", raw), ("corrected", corrected))}
        return Evaluation(errors | {"leak_slope": None, "ms_per_frame": None}, [], {"pose_2": "mm"}, 3, [], []).lines()

    assert "corrected" not in lines(0.1, 0.1)[0] and "0.1 mm" in lines(0.1, 0.1)[0]
    assert "0.2 mm against corrected labels, 0.1 against raw" in lines(0.1, 0.2)[0]
