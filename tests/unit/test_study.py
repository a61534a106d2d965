"""The parts of the paper's comparison say what they measured, and nothing that they did not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.errors import TrainingError
from training.runs.run import is_finished, train_run
from training.studies.tac_vgnn.models import PeakMemory, measure_training, plan_run, table_row, train_all
from training.studies.tac_vgnn.study import AreaChange, compare_graphs, ordering, recorded_contacts
from twin.pins import make_graph
from twin.report.page import write_table


def test_graphs_have_the_edges_their_kind_implies(data):
    rows = {row["graph"]: row for row in compare_graphs(data.pins)}
    assert rows["knn"]["edges_no_contact"] == 6 * 127 == rows["knn"]["edges_least"] == rows["knn"]["edges_most"]
    hull = 6  # the outer sides of the hexagon bow inwards: its hull is the corners
    assert rows["delaunay"]["edges_no_contact"] == 2 * (3 * 127 - 3 - hull) == rows["voronoi"]["edges_no_contact"] == 744
    assert rows["voronoi"]["features"] == 3 and all(row["ms"] > 0 for row in rows.values())


def test_a_study_is_resumed_and_never_speaks_of_what_was_not_run(data, tmp_path):
    plans = [plan_run(name, labels="raw", seed=0, split=0, epochs=2) for name in ("tac-vgnn", "vgnn-without-kernel")]
    train_all(plans, data, tmp_path, max_minutes=0.0)
    untouched = table_row(plans[1], data, tmp_path, None)
    assert untouched["state"] == "not begun" and "pose_2_raw" not in untouched
    train_run(plans[0].config, data, tmp_path / plans[0].folder, max_minutes=0.0)  # ends after an epoch
    early = table_row(plans[0], data, tmp_path, 0.0)
    assert early["state"] == "ended early" and early["epochs"] == 1 and early["epochs_allowed"] == 2
    train_all(plans, data, tmp_path, max_minutes=None)
    rows = [table_row(plan, data, tmp_path, 0.0) for plan in plans]
    assert [row["state"] for row in rows] == ["finished"] * 2 and rows[0]["frames"] == 18 and rows[0]["without_prediction"] == 0
    assert all(is_finished(plan.config, data, tmp_path / plan.folder) for plan in plans)
    other = plan_run("tac-vgnn", labels="raw", seed=0, split=0, epochs=3)
    with pytest.raises(TrainingError, match="other settings"):
        is_finished(other.config, data, tmp_path / other.folder)
    assert [name for name, _, _ in ordering([*rows, untouched], "pose_2_raw")] == sorted(
        ("tac-vgnn", "vgnn-without-kernel"), key=lambda name: {row["model"]: row["pose_2_raw"] for row in rows}[name]
    )
    text = write_table(tmp_path / "models.csv", [*rows, untouched]).read_text()
    assert text.count("\n") == 4 and "not begun,,," in text


def test_a_run_taught_by_other_labelled_frames_is_not_gone_on_with(data, tmp_path):
    """The simulated contacts' pins differ, and nothing else that a run tells."""
    plan = plan_run("vgnn-without-kernel", labels="raw", seed=0, split=0, epochs=2).config
    taught, otherwise = (replace(plan, labelled={"image_names": [name]}) for name in ("frame_1.png", "frame_2.png"))
    train_run(taught, data, tmp_path, max_minutes=0.0)
    with pytest.raises(TrainingError, match="other settings or data"):
        train_run(otherwise, data, tmp_path)
    train_run(taught, data, tmp_path)
    assert is_finished(taught, data, tmp_path)
    with pytest.raises(TrainingError, match="other settings or data"):
        is_finished(otherwise, data, tmp_path)


def test_unknown_parts_are_named():
    with pytest.raises(TrainingError, match="without graph, modes, kernel"):
        plan_run("vgnn-without-pins", labels="raw", seed=0, split=0)
    assert plan_run("vgnn-without-graph", labels="raw", seed=0, split=0).config.size == {"layers": 0}


def test_an_epochs_time_is_given_only_where_an_epoch_was_run(data):
    from training.models import MODELS
    from training.models.part import ArrayInputs

    row = measure_training("gnn", data.pins, MODELS["gnn"].prepare(data, np.arange(len(data))).inputs, 32)
    assert row["rows_timed"] == len(data) and row["s_per_epoch"] == pytest.approx(row["ms_per_frame"] * len(data) / 1e3)
    images = ArrayInputs(np.zeros((len(data), 128, 128), np.uint8))
    row = measure_training("cnn-v2", data.pins, images, 8)
    assert row["rows_timed"] == 32 and row["s_per_epoch"] is None


def test_memory_is_what_was_taken_while_watched():
    with PeakMemory() as first:
        taken = torch.ones(64, 2**18)  # 64 MiB
        del taken
    with PeakMemory() as second:  # what was freed before does not hide it
        taken = torch.ones(64, 2**18)
        del taken
    assert 50 < first.peak < 90 and 50 < second.peak < 90


def test_growth_is_found_where_it_is(data):
    rest = data.pins.reference
    graph = make_graph("voronoi", rest.pins_px, outmost=rest.outmost)
    middle = rest.pins_px.mean(axis=0)
    lower = rest.pins_px[:, 1] > middle[1] + 30
    found = AreaChange("bottom", 2.0, graph, np.where(lower, 0.5, 1.0) * graph.area_px2).figures()
    assert found["largest_growth_percent"] == pytest.approx(100) and found["growth_y_px"] > 30 and abs(found["growth_x_px"]) < 3


def test_recorded_frames_beside_the_twins_are_straight_presses(data):
    found = recorded_contacts(data)
    assert [contact.name for contact in found] == ["centre, recorded"] * 2
    names = data.pins.image_name.tolist()
    for contact, wanted in zip(found, (2.0, 4.0), strict=True):
        k = names.index(contact.source)
        assert abs(contact.depth_mm - wanted) < 1 and abs(data.targets.corrected[k, 1]) < 10
