"""The twin against frames whose truth is known: frames that it made itself."""

import csv

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame
from small_generation import ACROSS, small_config
from sound_page import read_sound_page

from training.generation.config import draw_label
from twin.errors import FrameError
from twin.evaluation.labelled import ContactModel, compare, measure_frames, table_of
from twin.evaluation.labelled.report import summary_of, write_validation
from twin.pins import nominal_reference
from twin.types import Form

COUNT = 4
FOUND_PX = 0.15  # a drawn cap's centre as the pipeline measures it
FRICTION = 0.65  # of the frames; one of those that are tried


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording drawn from simulated pins: half of the moves not executed, another friction than the rig's."""
    folder = tmp_path_factory.mktemp("recorded")
    config = small_config(folder, randomisation=None)
    model = ContactModel(config.sensor, config.experiment, config.object, Form.PROCESSED, across=ACROSS)
    rest_px = nominal_reference(config.sensor, Form.PROCESSED).pins_px
    (folder / "set" / "frames_bw").mkdir(parents=True)
    cv2.imwrite(str(folder / "set" / "init_0.png"), drawn_frame(config.sensor, Form.PROCESSED, rest_px).image)
    rows, done = ["image_name,pose_2,pose_6,move_1,move_6"], ["image_name,executed"]
    for k in range(COUNT):
        label = draw_label(config.experiment, np.random.default_rng(k), executed_share=float(k % 2))
        px = rest_px + model.displacement_px(label, FRICTION)
        cv2.imwrite(str(folder / "set" / "frames_bw" / f"f_{k}.png"), drawn_frame(config.sensor, Form.PROCESSED, px).image)
        rows.append(",".join([f"f_{k}.png", *(repr(float(v)) for v in (label.pose[1], label.pose[5], label.move[0], label.move[5]))]))
        done.append(f"f_{k}.png,{int(label.executed)}")
    (folder / "set" / "targets.csv").write_text("\n".join(rows) + "\n")
    (folder / "set" / "move_executed.csv").write_text("\n".join(done) + "\n")
    return folder / "set", config, model


@pytest.fixture(scope="module")
def found(recorded):
    folder, config, model = recorded
    return compare(model, measure_frames(folder, config.sensor, None, 0), friction_frames=1)


def test_an_individual_friction_reproduces_a_frame_of_the_twin(found):
    sought = np.flatnonzero(np.isfinite(found.friction_error_px))
    assert len(sought) == 1 and found.executed[sought[0]]
    assert found.friction[sought[0]] == FRICTION and found.friction_error_px[sought[0]] < FOUND_PX
    assert found.friction_error_px[sought[0]] < found.error_px[sought[0]]


def test_figures_are_separate_for_executed_and_not_executed_moves(found):
    rows = {row["group"]: row for row in table_of(found)}
    assert rows["move executed"]["frames"] == rows["move not executed"]["frames"] == COUNT // 2
    assert rows["all"]["error_px"] == pytest.approx(found.error_px.mean())
    assert (found.by["shear_mm"][~found.executed] == 0).all() and (found.by["shear_mm"][found.executed] > 0).all()


def test_a_wrong_executed_flag_shows(recorded, found):
    folder, config, model = recorded
    flags = (folder / "move_executed.csv").read_text()
    (folder / "move_executed.csv").unlink()
    try:
        naive = compare(model, measure_frames(folder, config.sensor, None, 0))
    finally:
        (folder / "move_executed.csv").write_text(flags)
    assert naive.executed.all() and naive.error_px[~found.executed].mean() > 2 * found.error_px[~found.executed].mean()


@pytest.mark.usefixtures("undrawn_charts")
def test_page_and_table_hold_every_frame(found, recorded, tmp_path):
    _, config, _ = recorded
    page, table, _ = write_validation(tmp_path, found, config.sensor.description, summary_of(found, config.sensor.name))
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["image_name"] for row in rows] == found.measured.names
    assert np.allclose([float(row["error_px"]) for row in rows], found.error_px, rtol=1e-4)
    read = read_sound_page(page.read_text(encoding="utf-8"), tmp_path)
    assert "move not executed" in read.text and {"errors.png", "frames.png"} <= set(read.addresses)


def test_frames_without_labels_are_refused(recorded, tmp_path):
    folder, config, _ = recorded
    cv2.imwrite(str(tmp_path / "a.png"), cv2.imread(str(folder / "init_0.png"), cv2.IMREAD_UNCHANGED))
    with pytest.raises(FrameError, match="no labels"):
        measure_frames(tmp_path, config.sensor, None, 0)
