"""Recordings as data sets: what is odd in them is said once, and the good rows are used."""

import json
import os

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame, smooth_warp

from scenes import load_sensor
from training.data.dataset import load_dataset, split_rows
from training.data.pins import pin_table
from training.data.targets import correct_labels, unit_of
from training.models.cnn.model import image_inputs
from twin.errors import FrameError
from twin.pins import make_reference, nominal_reference
from twin.rig.labels import label_slope, plate_slope
from twin.store import code_of
from twin.types import Form

SENSOR = "mg400-127"
HEADER = "image_name,pose_2,pose_6,move_1,move_6"
LARGEST_MOVE_MM = 5.0  # of the published recordings
SAME_PLATE_MM = 0.025  # about what the best models of the recordings err by


def write_recording(folder, rows, frames, *, table_header=HEADER):
    spec = load_sensor(SENSOR)
    rest = nominal_reference(spec, Form.PROCESSED).pins_px
    (folder / "frames_bw").mkdir(parents=True)
    for name in frames:
        px = smooth_warp(rest, 4.0, np.random.default_rng(len(name) + sum(map(ord, name))))
        cv2.imwrite(str(folder / "frames_bw" / name), drawn_frame(spec, Form.PROCESSED, px).image)
    (folder / "targets.csv").write_text("\n".join([table_header, *rows]) + "\n")
    return spec


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faulty")
    rows = [
        r"C:\data\frames_bw\f_0.png,-1,5,1,2",  # a Windows path
        "f_1.png,-2,nan,1,2",  # no number
        "f_2.png,-3,7,1,2",
        "f_2.png,-3,7,1,2",  # twice
        "f_3.png,oops,8,1,2",  # a word
        "f_9.png,-3,8,1,2",  # no picture
    ]
    spec = write_recording(folder, rows, [f"f_{k}.png" for k in range(5)])  # f_4 has no row
    (folder / "meta.json").write_text('{"dir": "C:\\data\\x", "z": Infinity}')
    return load_dataset(folder, spec)


def test_good_rows_are_used_and_every_fault_is_said(faulty):
    assert faulty.pins.image_name.tolist() == ["f_0.png", "f_2.png"]
    assert faulty.targets.raw.tolist() == [[-1, 5], [-3, 7]]
    said = "\n".join(faulty.problems)
    for fault in (
        "left out (f_2.png)",
        "without a picture (f_9.png)",
        "without a row",
        "invalid JSON",
        "pose_6: 2 cells",
        "pose_2: 2 cells",
    ):
        assert fault.split(" (")[0] in said, (fault, said)
    assert "f_1.png" in said and "f_3.png" in said and "f_4.png" in said


def replaced_in_secret(file, other):
    """Another picture in the place of a file: of the same size and the same time of the last change, as copying tools leave it."""
    before, content = file.stat(), other.read_bytes()
    size = max(before.st_size, len(content))
    file.write_bytes(content.ljust(size, b"\0"))
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    return size


@pytest.mark.parametrize("of", [lambda data: data.pins.nodes_px, lambda data: image_inputs(data).values.numpy()], ids=["pins", "pictures"])
def test_what_is_kept_of_frames_is_not_that_of_frames_that_were_replaced(tmp_path, of):
    names = [f"f_{k}.png" for k in range(2)]
    folder = tmp_path / "r"
    spec = write_recording(folder, [f"{name},-1,5,1,2" for name in names], names)
    first, second = (folder / "frames_bw" / name for name in names)
    size = max(first.stat().st_size, second.stat().st_size)
    first.write_bytes(first.read_bytes().ljust(size, b"\0"))
    before = of(load_dataset(folder, spec))
    assert replaced_in_secret(first, second) == size == first.stat().st_size
    after = of(load_dataset(folder, spec))
    assert not np.array_equal(before[0], after[0]) and np.array_equal(after[0], before[1])


def test_a_missing_column_names_those_that_are_there(tmp_path):
    spec = write_recording(tmp_path / "r", ["f_0.png,1"], ["f_0.png"], table_header="image_name,pose_3")
    with pytest.raises(FrameError, match=r"pose_2, pose_6 is missing; found image_name, pose_3"):
        load_dataset(tmp_path / "r", spec)
    assert load_dataset(tmp_path / "r", spec, ("pose_3",)).targets.raw.tolist() == [[1.0]]


def test_pins_come_from_the_cache_until_a_frame_changes(tmp_path, monkeypatch):
    spec = write_recording(tmp_path / "r", ["f_0.png,-1,5,1,2"], ["f_0.png"])
    first = load_dataset(tmp_path / "r", spec)
    monkeypatch.setattr("training.data.pins.Pipeline", None)  # not callable: a second look would fail
    again = load_dataset(tmp_path / "r", spec)
    assert np.array_equal(first.pins.nodes_px, again.pins.nodes_px)
    (tmp_path / "r" / "meta.json").write_text(json.dumps({"new": 1}))
    with pytest.raises(TypeError):
        load_dataset(tmp_path / "r", spec)


def test_kept_pins_of_recordings_do_not_depend_on_the_simulations_code():
    """Otherwise every change of the mechanics or the renderer would have all recordings read again."""
    parts = {name.rpartition(".")[0] for name in code_of(pin_table).modules}
    assert "twin.pins" in parts
    assert not parts & {"twin.mechanics", "twin.optics", "twin.rig", "training.generation"}


def test_moves_that_were_not_executed_are_taken_out():
    names = ("pose_2", "pose_6", "move_1", "move_6")
    raw = np.array([[-2.0, 10, 3, 4], [-2.0, 10, 3, 4], [-2.0, 10, 3, 4]])
    out = correct_labels(names, raw, np.array([1.0, 0.0, np.nan]), raw[:, 2:], 0.01)
    assert np.allclose(out, [[-2, 10, 3, 4], [-1.97, 6, 0, 0], [-2, 10, 3, 4]])


def test_a_tilted_plate_is_as_deep_on_the_way_of_a_tap_as_where_the_move_was_not_executed():
    """A tap at pose_1 = -3, and the same frame labelled as if it had been moved by 3 to the middle, are one contact."""
    names, move = ("pose_2", "pose_6"), np.array([[0.0, 0.0], [3.0, 0.0]])
    out = correct_labels(names, np.array([[-2.0, 10], [-2.0, 10]]), np.array([1.0, 0.0]), move, 0.01, np.array([-3.0, 0.0]))
    assert np.allclose(out, [[-1.97, 10], [-1.97, 10]])


def test_a_fifth_is_held_out_at_random():
    train, held = split_rows(3763, 1)
    assert np.array_equal(held, np.random.default_rng(1).permutation(3763)[:753]) and len(train) + len(held) == 3763
    assert not set(train) & set(held)


@pytest.mark.parametrize(
    "name, unit", [("pose_2", "mm"), ("move_6", "deg"), ("pose_Rx", "deg"), ("shear_y", "mm"), ("force_z", "N"), ("other", "")]
)
def test_a_column_tells_its_unit(name, unit):
    assert unit_of(name) == unit


def test_copies_of_a_row_stay_together(tmp_path):
    spec = write_recording(tmp_path / "r", ["f_0.png,-1,5,1,2", "f_1.png,-2,5,1,2"], ["f_0.png", "f_1.png"])
    data = load_dataset(tmp_path / "r", spec)
    other = data.pins.relative_to(make_reference(data.pins.reference.pins_px + 1.0, spec.pins))
    both = data.with_copies([other])
    assert both.group.tolist() == [0, 1, 0, 1] and np.array_equal(both.targets.raw, np.tile(data.targets.raw, (2, 1)))
    assert np.array_equal(both.pins.nodes_px, np.concatenate([data.pins.nodes_px, other.nodes_px]))
    train, held = split_rows(len(both), 0, both.group)
    assert not set(both.group[train]) & set(both.group[held])


@pytest.mark.parametrize("name", ["mg400-331", "mg400-127"])
def test_the_plates_tilt_of_labels_and_twin_is_the_same_plates(name):
    """Two fits of one plate: what labels are corrected by, and where the twin has the plate."""
    rig = load_sensor(name).rig
    assert label_slope(rig) == rig.label_depth_per_move != plate_slope(rig)
    assert abs(LARGEST_MOVE_MM * (plate_slope(rig) - label_slope(rig))) < SAME_PLATE_MM


def test_a_recordings_depth_is_corrected_by_its_sensors_rig(tmp_path):
    """By what the specification says, whatever the sensor is called; without that number by the tilt of its plate."""
    rows = ["f_0.png,-1,5,4,2", "f_1.png,-2,5,-3,2"]
    spec = write_recording(tmp_path / "r", rows, ["f_0.png", "f_1.png"])
    (tmp_path / "r" / "move_executed.csv").write_text("image_name,executed\nf_0.png,0\nf_1.png,1\n")
    for number, slope in ((0.02, 0.02), (None, np.tan(np.radians(spec.rig.plate_tilt_deg)))):
        rig = spec.rig.model_copy(update={"label_depth_per_move": number})
        own = spec.model_copy(update={"name": "mine", "rig": rig})
        assert load_dataset(tmp_path / "r", own).targets.corrected[:, 0].tolist() == pytest.approx([-1 + 4 * slope, -2])
