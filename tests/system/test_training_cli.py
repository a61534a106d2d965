"""From a recording on disk to a trained, evaluated and used model, by the commands a user types (in this process: starting is slow)."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame
from drawn_recording import drawn_pins
from small_generation import EXPERIMENT, SENSOR
from typer.testing import CliRunner

from scenes import load_experiment, load_sensor
from training.data.dataset import load_dataset
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.studies.sim_to_real import SimToRealPlan
from training.studies.sim_to_real.model_inversion import READ, read_twin
from training.studies.sim_to_real.steps import BOTH, EVENLY, REAL, arm_labels
from training.studies.sim_to_real.study import label_efficiency, teach
from twin.cli import command_line
from twin.errors import FrameError, TwinError
from twin.pins import nominal_reference
from twin.rig.labels import ArmLabel
from twin.types import Form

FRAMES = 70
ACROSS = 6  # elements: the coarsest grid, as the commands are tried and not the mechanics


def twin(*arguments):
    done = CliRunner().invoke(command_line(), [str(a) for a in arguments])
    if isinstance(done.exception, TwinError):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    spec = load_sensor("mg400-127")
    reference = nominal_reference(spec, Form.PROCESSED)
    rng = np.random.default_rng(0)
    labels = np.column_stack([rng.uniform(-4, 0, FRAMES), np.sort(rng.uniform(-20, 20, FRAMES)), rng.uniform(-5, 5, (FRAMES, 2))])
    (folder / "frames_bw").mkdir()
    rows = ["image_name,pose_2,pose_6,move_1,move_6"]
    for k, px in enumerate(drawn_pins(labels, reference)):
        cv2.imwrite(str(folder / "frames_bw" / f"f_{k}.png"), drawn_frame(spec, Form.PROCESSED, px).image)
        rows.append(f"f_{k}.png," + ",".join(f"{v:.6f}" for v in labels[k]))
    (folder / "targets.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.fixture(scope="module")
def run(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    said = twin("train", "--model", "vgnn", "--sensor", "mg400-127", "--data", recording, "--out", out, "--epochs", 8, "--batch", 8)
    assert "70 usable frames" in said and "weights.pt" in said
    return out


def test_a_trained_run_is_judged_and_used(recording, run, tmp_path):
    said = twin("evaluate", run, "--data", recording, "--out", tmp_path, "--robustness")
    assert "2 px shift: depth" in said and len(list(csv.DictReader((tmp_path / "robustness.csv").open()))) == 5
    assert "depth: mean error" in said and "ms per frame" in said
    rows = list(csv.DictReader((tmp_path / "predictions.csv").open()))
    assert len(rows) == FRAMES / 5 and all(float(row["pose_2_lo90"]) < float(row["pose_2_hi90"]) and row["valid"] == "1" for row in rows)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["corrected"]["pose_2"]["mae"] < 0.5 and metrics["without_prediction"] == 0 and metrics["corrected"]["bins"]["depth_mm"]
    assert (tmp_path / "errors.png").stat().st_size > 0
    assert "f_3.png: depth" in twin("predict", run, recording / "frames_bw" / "f_3.png")


@pytest.mark.parametrize("model", ["gnn", pytest.param("cnn-v2", marks=pytest.mark.slow)])
def test_the_papers_models_take_the_same_way(model, recording, tmp_path):
    common = ("--data", recording, "--out")
    twin("train", "--model", model, "--sensor", "mg400-127", *common, tmp_path / "run", "--epochs", 1)
    twin("evaluate", tmp_path / "run", *common, tmp_path / "judged", "--label-kind", "raw")
    assert "angle" in twin("predict", tmp_path / "run", recording / "frames_bw" / "f_3.png")


@pytest.mark.slow
def test_the_papers_comparison_is_one_command_and_goes_on_where_it_was(recording, tmp_path):
    command = ("study", "tac-vgnn", "--data", recording, "--sensor", "mg400-127", "--out", tmp_path, "--epochs", 1, "--no-contacts")
    said = twin(*command, "--models", "gnn,vgnn-without-graph", "--batches", "16")
    assert "gnn, seed 0: finished, depth" in said
    weights = tmp_path / "runs" / "gnn-raw-0" / "weights.pt"
    written = weights.stat().st_mtime_ns
    twin(*command, "--models", "gnn,vgnn-without-graph", "--batches", "", "--max-minutes", 0)
    assert weights.stat().st_mtime_ns == written
    rows = list(csv.DictReader((tmp_path / "models.csv").open()))
    assert [row["state"] for row in rows] == ["finished"] * 2 and all(float(row["pose_6_raw"]) > 0 for row in rows)
    page = (tmp_path / "index.html").read_text()
    assert "vgnn-without-graph" in page and "[-2, 2] mm" in page
    assert {"graphs.csv", "efficiency.csv", "efficiency.png", "contacts.csv", "contacts.png", "curves.png"} <= {
        p.name for p in tmp_path.iterdir()
    }


@pytest.mark.slow
def test_objects_never_seen_are_one_command_and_go_on_where_they_were(tmp_path):
    (tmp_path / "gentle.toml").write_text(EXPERIMENT)
    command = ("study", "objects", "--sensor", SENSOR, "--train", "plane,sphere", "--unseen", "cylinder", "--count", 3, "--tests", 2)
    command += ("--experiment", tmp_path / "gentle.toml", "--epochs", 2, "--workers", 1, "--elements", ACROSS, "--out", tmp_path / "study")
    said = twin(*command)
    rows = list(csv.DictReader((tmp_path / "study" / "objects.csv").open()))
    assert [(row["model"], row["object"], row["seen"]) for row in rows] == [
        *(("mixed", "plane", "True"), ("mixed", "sphere", "True"), ("mixed", "cylinder", "False")),
        *(("plane", "plane", "True"), ("plane", "sphere", "False"), ("plane", "cylinder", "False")),
    ]
    assert "cylinder, unseen: depth" in said and "cylinder, unseen" in (tmp_path / "study" / "index.html").read_text()
    weights = [(tmp_path / "study" / name / "weights.pt").stat().st_mtime_ns for name in ("mixed", "plane")]
    results = [line for line in said.splitlines() if "times" in line]
    assert len(results) == 7 and [line for line in twin(*command).splitlines() if "times" in line] == results
    assert weights == [(tmp_path / "study" / name / "weights.pt").stat().st_mtime_ns for name in ("mixed", "plane")], "trained once"
    sets = [option for name in ("plane", "sphere") for option in ("--data", tmp_path / "study" / "sim" / name)]
    twin("train", "--model", "vgnn", "--sensor", SENSOR, *sets, "--epochs", 1, "--no-kernel", "--members", 1, "--out", tmp_path / "run")
    assert "depth: mean error" in twin("evaluate", tmp_path / "run", *sets, "--out", tmp_path / "judged")


WITHOUT_ONE = (
    *("simulated, bare", "simulated, 20% of the contacts", "simulated, 12 elements across", "simulated, one friction"),
    *("simulated, any friction", "simulated, without moves", "simulated, randomised as 'contact'", "simulated, uncalibrated"),
)


def assert_labels_of_frames_without_are_not_used(plan, out):
    """A network is taught the same whatever is written beside the frames whose labels the twin tells."""
    real = load_dataset(plan.frames, plan.sensor, plan.experiment.targets).in_order()
    states = load_dataset(plan.simulated[0], plan.sensor, plan.experiment.targets, form=real.pins.form)
    read, labels, few = read_twin([states], plan.target_object, plan.experiment, seed=0), arm_labels(real), np.arange(0, len(real), 3)
    others, wrong = np.setdiff1d(np.arange(len(real)), few), real.targets.corrected.copy()
    wrong[others] += 100
    odd = [ArmLabel(label.pose + 100 * (row in others), label.move) for row, label in enumerate(labels)]
    changed = replace(real, targets=replace(real.targets, corrected=wrong, raw=wrong))
    told = {}
    for name, data, known in (("told", real, labels), ("odd", changed, odd)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("training.studies.sim_to_real.steps.arm_labels", lambda _, known=known: known)
            teach(read, data, few, np.arange(len(real)), out / name, seed=0, epochs=1)
        told[name] = PoseEstimator.load(out / name).predict_table(real.pins)
    assert (told["told"].mean == told["odd"].mean).all() and (told["told"].half_width == told["odd"].half_width).all()


@pytest.mark.slow
@pytest.mark.parametrize("left_out", [(), WITHOUT_ONE], ids=["full", "ablation"])
def test_what_the_twin_is_worth_on_frames_is_one_command_and_goes_on_where_it_was(tmp_path, left_out):
    (tmp_path / "gentle.toml").write_text(EXPERIMENT)
    gentle = ("--sensor", SENSOR, "--experiment", tmp_path / "gentle.toml", "--elements", ACROSS, "--workers", 1)
    twin("dataset", *gentle, "--images", "none", "--count", 20, "--seed", 7, "--randomise", "contact", "--out", tmp_path / "frames")
    command = ("study", "sim-to-real", *gentle, "--frames", tmp_path / "frames", "--num-labelled", 10, "--count", 16, "--draws", 1)
    command += (*(["--ablate"] if left_out else []), "--epochs", 2, "--out", tmp_path / "study")
    said, sims = twin(*command), tmp_path / "study" / "sim"
    rows = list(csv.DictReader((tmp_path / "study" / "study.csv").open()))
    told = [("simulated", "0"), ("simulated and real", "10"), *((name, "0") for name in left_out), ("real", "10")]
    assert [(row["trained_on"], row["labelled_frames"]) for row in rows[: len(told)]] == told
    assert all(np.isfinite(float(row["pose_2_corrected"])) for row in rows)
    assert "averaged with a Gaussian process" in (tmp_path / "study" / "index.html").read_text()
    trained = [tmp_path / "study" / run / "weights.pt" for run in (*(["sim_bare"] if left_out else []), "real_10", "real_all")]
    written = [weights.stat().st_mtime_ns for weights in trained]
    judged = [line for line in said.splitlines() if "labelled" in line and "depth" in line]
    assert len(judged) == len(rows) and [line for line in twin(*command).splitlines() if line in judged] == judged
    assert [weights.stat().st_mtime_ns for weights in trained] == written, "trained once"
    plan = SimToRealPlan(
        load_sensor(SENSOR), tmp_path / "frames", load_experiment(str(tmp_path / "gentle.toml")), labels=8, simulated=(sims,)
    )
    curves = label_efficiency(plan, tmp_path / "worth", (0, 1))
    assert not any("without labels" in row["trained_on"] for row in curves), "a plate's frames without labels would tell nothing"
    assert {row["labelled_frames"] for row in curves if row["model"] == READ and row["trained_on"] == BOTH} >= {0, 5, 8}
    assert {row["trained_on"] for row in curves} == {REAL, BOTH, REAL + EVENLY, BOTH + EVENLY}
    assert all(np.isfinite(row["pose_2_corrected"]) for row in curves)
    if not left_out:
        assert_labels_of_frames_without_are_not_used(plan, tmp_path)
    for run in ("sim_only", "sim_plus_real", "sim_taught"):
        told = twin("evaluate", tmp_path / "study" / run, "--data", tmp_path / "frames", "--rows", "all", "--out", tmp_path / run)
        assert "angle: mean error" in told


def test_an_audit_of_few_frames_says_that_they_are_too_few(recording, tmp_path):
    said = twin("audit", recording, "--sensor", "mg400-127", "--out", tmp_path)
    assert "too few frames in contact (70) to find out which moves were executed" in said
    assert set(json.loads((tmp_path / "audit.json").read_text())) >= {"no_contact", "not_told"}
    assert "<h1>" in (tmp_path / "audit.html").read_text() and not (tmp_path / "labels_corrected.csv").exists()


def test_mistakes_are_named(recording, run, tmp_path):
    common = ("--sensor", "mg400-127", "--data", recording, "--out", tmp_path)
    with pytest.raises(TrainingError, match="no model 'vgn'"):
        twin("train", "--model", "vgn", *common)
    with pytest.raises(FrameError, match="column pose_9 is missing"):
        twin("train", "--model", "vgnn", "--target", "pose_9", *common)
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.zeros((256, 256), np.uint8))
    with pytest.raises(FrameError, match=r"blank\.png: none of 1 frame gave a pose"):
        twin("predict", run, blank)
    with pytest.raises(TrainingError, match="no trained model"):
        twin("predict", tmp_path, recording / "frames_bw" / "f_3.png")
    with pytest.raises(TrainingError, match="finished run"):
        twin("train", "--model", "vgnn", "--sensor", "mg400-127", "--data", recording, "--out", run)
