"""Simulated data sets: what they hold is right, and does not show how they were made."""

import csv
import json
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import zarr
from small_generation import contents, small_config

from scenes import load_object, load_sensor
from training.data.dataset import load_dataset, split_rows
from training.data.simulated import open_simulated
from training.data.targets import correct_labels
from training.generation import DatasetError, generate
from training.generation.config import draw_contact
from training.runs.run import fold_rows
from training.studies.sim_to_real.steps import arm_labels, with_missing
from twin.camera.projection import project
from twin.errors import ContactError, MeshError, RenderError, StoreError, TwinError
from twin.frames.forms import raw_to_recording
from twin.geometry.solid import Resolution
from twin.mechanics.solver import SkinSolver
from twin.pins import nominal_reference
from twin.rig.contact import RigContact
from twin.rig.kinematics import rig_of
from twin.rig.labels import read_arm_labels, read_executed
from twin.store import atomic, lock_folder
from twin.types import Form

COUNT = 4
SAME_PX = 1e-4  # arrays are stored as float32
NOISE_PX = 0.1
SAME_STATE_PX = 0.048  # a path that goes further has a grid that is fine elsewhere, too (measured 0.0437 on 8 elements across)
ARC_MM = 6e-3  # what a path's straight pieces miss of the arm's arc


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A data set of all states, made in one go."""
    home = tmp_path_factory.mktemp("made")
    config = small_config(home, states="all")
    summary = generate(home / "set", config, COUNT)
    return home / "set", config, summary


def rows_of(folder, name):
    with (folder / name).open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_draw_depends_on_seed_and_number_alone(tmp_path):
    config = small_config(tmp_path)
    one, again, other = (draw_contact(config, k, 0) for k in (7, 7, 8))
    assert np.array_equal(one.label.pose, again.label.pose) and one.values == again.values and one.image_seed == again.image_seed
    assert not np.array_equal(one.label.pose, other.label.pose) and one.values != other.values
    assert draw_contact(config, 7, 1).values != one.values
    plain = draw_contact(small_config(tmp_path, randomisation=None), 7, 0)
    assert np.array_equal(plain.label.pose, one.label.pose), "what is randomised beside the labels must not change them"


def test_draws_keep_to_their_ranges(tmp_path):
    config = small_config(tmp_path)
    draws = [draw_contact(config, k, 0) for k in range(300)]
    for label, (low, high) in config.experiment.ranges().items():
        kind, axis = label.split("_")
        values = [getattr(d.label, kind)[int(axis) - 1] for d in draws]
        assert low <= min(values) and max(values) <= high
        assert max(values) - min(values) > 0.95 * (high - low) or low == high
    frictions = np.array([d.friction for d in draws])
    assert 0.1 < np.mean(frictions == 0) < 0.3 and frictions.max() <= 1 and frictions[frictions > 0].min() >= 0.1
    assert 0.5 < np.mean([d.label.executed for d in draws]) < 0.7
    nominal = config.sensor.skin
    assert all(abs(d.sensor.skin.thickness_mm - nominal.thickness_mm) <= 0.1 for d in draws)
    assert all(0.8 <= d.sensor.skin.young_modulus_mpa / nominal.young_modulus_mpa <= 1.25 for d in draws)


def test_the_table_and_the_truth_agree(made):
    folder, config, summary = made
    truth, rows = zarr.open_group(folder / "truth.zarr", mode="r"), rows_of(folder, "targets.csv")
    assert summary.frames == len(rows) == truth["path_id"].shape[0] and summary.contacts == COUNT
    assert [int(row["path_id"]) for row in rows] == truth["path_id"][:].tolist()
    assert np.allclose([[float(row[f"pose_{k}"]) for k in range(1, 7)] for row in rows], truth["pose"][:])
    executed = read_executed(folder, [row["image_name"] for row in rows], [])
    assert [bool(executed[row["image_name"]]) for row in rows] == truth["executed"][:].tolist()
    assert set(truth["path_id"][:]) == set(range(COUNT)) and len(rows_of(folder, "draws.csv")) == COUNT
    meta = json.loads((folder / "meta.json").read_text())
    assert meta["tap_move"] == [0, 5, 0, 0, 0, 0] and meta["num_poses"] == COUNT and meta["poses_rng"][1][1] == -4.4
    noise = truth["pins_px"][:] - truth["caps_px"][:]
    assert noise.std() == pytest.approx(NOISE_PX, rel=0.1) and abs(noise.mean()) < NOISE_PX / 10
    pressed = truth["force_n"][:, 2] > 0
    assert pressed.mean() > 0.9 and (truth["slipping_mm2"][:] <= truth["area_mm2"][:] + 1e-9).all()


def test_the_labels_of_a_contact_are_the_truths(made):
    folder, config, _ = made
    data = load_dataset(folder, config.sensor, "contact")
    names, units = data.targets.names, data.targets.units
    told = dict(zip(names, data.targets.corrected.T, strict=True))
    truth = zarr.open_group(folder / "truth.zarr")
    np.testing.assert_allclose(told["force_z"], truth["force_n"][:, 2])
    np.testing.assert_allclose(told["contact_area"], truth["area_mm2"][:])
    assert ((told["slip_share"] >= 0) & (told["slip_share"] <= 1)).all()
    assert dict(zip(names, units, strict=True))["torque_z"] == "Nmm"
    assert {"pose_2", "pose_6", "move_1", "move_6"} <= set(names)


def test_a_state_on_the_way_is_the_end_of_its_own_label(tmp_path):
    """The state at a part of tap or move, against a contact that ends there; without friction load steps leave no trace."""
    config = small_config(tmp_path, states="all", randomisation=None, friction=0.0)
    generate(tmp_path / "set", config, 2)
    truth = zarr.open_group(tmp_path / "set" / "truth.zarr", mode="r")
    labels = read_arm_labels(_recording(tmp_path / "set", config))
    path_of, fraction = truth["path_id"][:], truth["fraction"][:]
    contact = RigContact(SkinSolver(config.sensor, resolution=Resolution(config.across)), config.experiment, config.object)
    for path in range(2):
        rows = np.flatnonzero(path_of == path)
        assert (np.diff(fraction[rows]) > 0).all() and fraction[rows[-1]] == 1
        for row in rows[[1, -2]]:
            state = contact.end(labels[row], friction=0.0)
            assert np.abs(state.T_sensor_object - truth["T_sensor_object"][row]).max() < ARC_MM
            px = raw_to_recording(config.sensor.recording, project(config.sensor.view, state.caps_mm))
            assert np.abs(px - truth["caps_px"][row]).max() < SAME_STATE_PX


def test_a_table_in_another_order_has_the_same_pins_and_labels(made, tmp_path):
    folder, config, _ = made
    copy = tmp_path / "set"
    shutil.copytree(folder, copy)
    head, *rows = (copy / "targets.csv").read_text().splitlines()
    (copy / "targets.csv").write_text("\n".join([head, *rows[::-1]]) + "\n")
    before, after = (load_dataset(each, config.sensor) for each in (folder, copy))
    assert after.pins.image_name.tolist() == before.pins.image_name.tolist()[::-1]
    after = after.in_order()
    assert np.array_equal(after.pins.nodes_px, before.pins.nodes_px)
    assert np.array_equal(after.targets.corrected, before.targets.corrected)
    assert np.array_equal(after.group, before.in_order().group)


def without_a_chunk(folder):
    next(p for p in (folder / "truth.zarr" / "pins_px" / "c").rglob("*") if p.is_file()).unlink()


def with_a_damaged_chunk(folder):
    chunk = next(p for p in (folder / "truth.zarr" / "rest_px" / "c").rglob("*") if p.is_file())
    chunk.write_bytes(chunk.read_bytes()[:100])


def without_a_row(folder):
    lines = (folder / "targets.csv").read_text().splitlines()
    (folder / "targets.csv").write_text("\n".join(lines[:3] + lines[4:]) + "\n")


def with_a_strange_row(folder):
    text = (folder / "targets.csv").read_text()
    (folder / "targets.csv").write_text(text.replace("frame_1_0", "frame_99_0"))


def without_a_draw(folder):
    lines = (folder / "draws.csv").read_text().splitlines()
    (folder / "draws.csv").write_text("\n".join(lines[:1] + lines[2:]) + "\n")


DAMAGES = {
    "generation.json empty": lambda folder: (folder / "generation.json").write_text(""),
    "generation.json a list": lambda folder: (folder / "generation.json").write_text("[1]"),
    "generation.json without a sensor": lambda folder: (folder / "generation.json").write_text("{}"),
    "truth.zarr without attributes": lambda folder: (folder / "truth.zarr" / "zarr.json").write_text(""),
    "truth.zarr a part missing": without_a_chunk,
    "truth.zarr a part damaged": with_a_damaged_chunk,
    "targets.csv a row missing": without_a_row,
    "targets.csv a strange row": with_a_strange_row,
    "draws.csv a contact missing": without_a_draw,
    "draws.csv binary": lambda folder: (folder / "draws.csv").write_bytes(bytes(range(256))),
    "draws.csv not there": lambda folder: (folder / "draws.csv").unlink(),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_data_set_is_refused_by_the_name_of_its_file(made, tmp_path, what):
    folder, config, _ = made
    copy = tmp_path / "set"
    shutil.copytree(folder, copy)
    DAMAGES[what](copy)
    with pytest.raises(TwinError, match=rf"set/{what.split()[0]}.*(copy the data set again)") as error:
        load_dataset(copy, config.sensor)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("content", ["", "[1]", "{}", '{"modules": [], "libraries": {}}'])
def test_a_damaged_record_of_the_code_is_refused(made, tmp_path, content):
    folder, config, _ = made
    copy = tmp_path / "set"
    shutil.copytree(folder, copy)
    (copy / "made_by.json").write_text(content)
    with pytest.raises(StoreError, match=r"made_by\.json.*give another `out`"):
        generate(copy, config, COUNT + 1)


def test_a_data_set_goes_on_only_with_the_same_mesh(tmp_path):
    mesh = tmp_path / "ball.stl"
    trimesh.creation.icosphere(subdivisions=2, radius=12.0).export(mesh)
    config = small_config(tmp_path, object=load_object(mesh), randomisation=None)
    generate(tmp_path / "set", config, 1)
    (label,) = load_dataset(tmp_path / "set", config.sensor).targets.corrected
    trimesh.creation.icosphere(subdivisions=2, radius=9.0).export(mesh)
    with pytest.raises(DatasetError, match=r"with other settings \(object\)"):
        generate(tmp_path / "set", small_config(tmp_path, object=load_object(mesh), randomisation=None), 2)
    with pytest.raises(MeshError, match="has changed since"):  # what it touched gives the labels, too
        load_dataset(tmp_path / "set", config.sensor)
    with pytest.raises(DatasetError, match="has changed since"):
        generate(tmp_path / "set", config, 2)
    assert np.isfinite(label).all()


def _recording(folder, config):
    from training.data.simulated import open_simulated

    return open_simulated(folder, config.sensor)[0]


def test_pins_alone_are_read_like_frames_and_split_by_contact(made):
    folder, config, summary = made
    data = load_dataset(folder, load_sensor("mg400-127"), "surface-2d-shear")
    assert len(data) == summary.frames and data.pins.form == Form.PROCESSED
    truth = zarr.open_group(folder / "truth.zarr", mode="r")
    moved = data.pins.nodes_px - data.pins.reference.pins_px
    assert np.abs(moved - (truth["pins_px"][:] - truth["rest_px"][:])).max() < SAME_PX, "displacements, from each sensor's own rest"
    assert np.allclose(data.pins.reference.pins_px, nominal_reference(config.sensor, Form.PROCESSED).pins_px)
    assert np.isfinite(data.pins.area_px2).all() and np.array_equal(data.pins.lost, ~truth["visible"][:])
    slope = np.tan(np.radians(rig_of(config.sensor).plate_tilt_deg))
    flat = correct_labels(data.targets.names, data.targets.raw, data.targets.executed, data.targets.move, slope, truth["pose"][:, 0])
    assert np.abs(data.targets.corrected - flat).max() < ARC_MM, "on a plate the surface that was touched has the arm's labels"
    undone = data.targets.executed == 0
    assert undone.any() and np.allclose(data.targets.corrected[undone, 2:], 0)
    train, held = split_rows(len(data), 0, data.group)
    assert not set(data.group[train]) & set(data.group[held]) and len(train) + len(held) == len(data)
    watched, learnt = fold_rows(train, 0, 0, data.group)
    assert len(watched) and not set(data.group[watched]) & set(data.group[learnt]) and set(watched) | set(learnt) == set(train)


def test_a_broken_off_run_ends_with_the_same_bytes(made, tmp_path, monkeypatch):
    """Broken off between contacts, while a record is written, and while the tables are."""
    folder, config, _ = made
    calls = []

    def broken_at(limit):
        def replace(source, target):
            calls.append(target)
            if len(calls) == limit:
                raise KeyboardInterrupt
            os.replace(source, target)

        return SimpleNamespace(**vars(os) | {"replace": replace})  # for this module alone

    for limit in (4, 4, 6):  # in the second record, in the first table, in the last step of all
        calls.clear()
        monkeypatch.setattr(atomic, "os", broken_at(limit))
        with pytest.raises(KeyboardInterrupt):
            generate(tmp_path / "set", config, COUNT)
        monkeypatch.undo()
    assert generate(tmp_path / "set", config, COUNT).before == COUNT
    assert contents(tmp_path / "set") == contents(folder)


def test_a_larger_count_goes_on_where_a_smaller_one_ended(made, tmp_path):
    folder, config, _ = made
    generate(tmp_path / "set", config, 2)
    with pytest.raises(DatasetError, match="holds contacts up to 1; give `count` 2 or more"):
        generate(tmp_path / "set", config, 1)
    assert generate(tmp_path / "set", config, COUNT).before == 2
    assert contents(tmp_path / "set") == contents(folder)


def test_failed_contacts_are_listed_and_replaced(tmp_path, monkeypatch):
    import training.generation.make as make

    config, real = small_config(tmp_path), make.draw_contact

    def draw(config, index, attempt):
        if index == 1 and attempt < 2:
            raise ContactError(f"planted {attempt}")
        return real(config, index, attempt)

    monkeypatch.setattr(make, "draw_contact", draw)
    summary = generate(tmp_path / "set", config, 3)
    assert summary.frames == 3 and summary.failed == 2
    failures = [list(row.values()) for row in rows_of(tmp_path / "set", "failures.csv")]
    assert failures == [["1", "0", "planted 0"], ["1", "1", "planted 1"]]
    assert [row["attempt"] for row in rows_of(tmp_path / "set", "draws.csv")] == ["0", "2", "0"]
    labels = zarr.open_group(tmp_path / "set" / "truth.zarr", mode="r")["pose"][:]
    assert np.array_equal(labels[1], real(config, 1, 2).label.pose)
    monkeypatch.setattr(make, "draw_contact", lambda *_: (_ for _ in ()).throw(ContactError("always")))
    with pytest.raises(DatasetError, match="contact 3: 20 samples failed one after another, the last: always"):
        generate(tmp_path / "set", config, 4)


def test_other_options_and_foreign_folders_are_refused(made, tmp_path):
    folder, config, _ = made
    with pytest.raises(DatasetError, match=r"with other settings \(seed\)"):
        generate(folder, config.model_copy(update={"seed": 5}), COUNT)
    (tmp_path / "photo.txt").write_text("mine")
    with pytest.raises(DatasetError, match="holds something else"):
        generate(tmp_path, config, COUNT)
    assert [p.name for p in tmp_path.iterdir()] == ["photo.txt"], "and left as they were"


def test_a_data_set_made_by_other_code_is_refused_and_left_as_it_was(made, tmp_path):
    folder, config, _ = made
    shutil.copytree(folder, tmp_path / "set")
    record = tmp_path / "set" / "made_by.json"
    told = json.loads(record.read_text())
    solver = "twin.mechanics.solver"
    assert solver in told["modules"] and "numpy" in told["libraries"]
    record.write_text(json.dumps(told | {"modules": told["modules"] | {solver: "0" * 16}}))
    before = contents(tmp_path / "set")
    with pytest.raises(StoreError, match=rf"made by another version of the program \({solver} changed\); give another `out`, or remove"):
        generate(tmp_path / "set", config, COUNT + 1)
    assert contents(tmp_path / "set") == before
    record.unlink()
    with pytest.raises(StoreError, match="does not say what version of the program made it"):
        generate(tmp_path / "set", config, COUNT + 1)


def test_two_runs_at_once_in_one_folder_are_refused(made):
    folder, config, _ = made
    with lock_folder(folder), pytest.raises(StoreError, match="another run is at work there"):
        generate(folder, config, COUNT)
    assert generate(folder, config, COUNT).before == COUNT


def test_a_full_disk_ends_the_run_in_one_line(made, tmp_path, monkeypatch):
    folder, config, _ = made

    def full(number):
        if len(list((tmp_path / "set" / "records").glob("*.npz"))) == 2:
            raise OSError(28, "No space left on device")
        os.fsync(number)

    monkeypatch.setattr(atomic, "os", SimpleNamespace(**vars(os) | {"fsync": full}))
    with pytest.raises(DatasetError, match=r"No space left on device\); free some space .*; 2 contacts kept"):
        generate(tmp_path / "set", config, COUNT)
    assert not list(tmp_path.rglob("*.part"))
    monkeypatch.undo()
    generate(tmp_path / "set", config, COUNT)
    assert contents(tmp_path / "set") == contents(folder)


def test_pictures_are_those_of_the_states(tmp_path):
    """A rendered frame's pins are found where the truth says."""
    config = small_config(tmp_path, images="processed", quality="preview", randomisation=None)
    try:
        generate(tmp_path / "set", config, 1)
    except RenderError as error:
        pytest.skip(str(error))
    data = load_dataset(tmp_path / "set", config.sensor)
    truth = zarr.open_group(tmp_path / "set" / "truth.zarr", mode="r")
    assert len(data) == 1 and data.pins.form == Form.PROCESSED and not data.problems
    assert np.median(np.linalg.norm(data.pins.nodes_px - truth["caps_px"][:], axis=2)) < 0.5
    moved = with_missing(data, arm_labels(data), SimpleNamespace(draw_px=lambda labels, moved_px, contact, seed: -moved_px), 0)
    assert moved.pins.nodes_px == pytest.approx(np.tile(data.pins.reference.pins_px, (1, 1, 1))), "pictures' pins, what is missing added"
    assert moved.pins.area_px2[0] == pytest.approx(data.pins.reference.area_px2)


def test_labels_say_where_the_arm_was_sent_however_far_it_gives_way(tmp_path):
    plain = small_config(tmp_path)
    rig = rig_of(plain.sensor)
    yields = plain.sensor.model_copy(update={"rig": rig.model_copy(update={"compliance_mm_per_n": 0.4, "turn_compliance_deg_per_n": 3.0})})
    told, pressed = [], []
    for name, sensor in (("stiff", plain.sensor), ("compliant", yields)):
        generate(tmp_path / name, plain.model_copy(update={"sensor": sensor}), 3)
        told.append(load_dataset(tmp_path / name, sensor, "surface-2d").targets.corrected)
        pressed.append(zarr.open_group(tmp_path / name / "truth.zarr", mode="r")["force_n"][:, 2])
    assert np.abs(told[0] - told[1]).max() < ARC_MM and (pressed[1] < 0.95 * pressed[0]).all()


@pytest.mark.parametrize("count", [0, -1, 2_000_000_000, 99_999_999_999_999_999_999])
def test_a_count_beyond_all_bounds_is_refused_before_anything_is_made(tmp_path, count):
    with pytest.raises(DatasetError, match=rf"`count` {count}: a data set has 1 to \d+ contacts"):
        generate(tmp_path / "out", small_config(tmp_path), count)
    assert not (tmp_path / "out").exists()


def test_a_scheduler_that_does_not_answer_leaves_nothing_behind(tmp_path):
    with pytest.raises(DatasetError, match="`scheduler` nowhere: no scheduler answers"):
        generate(tmp_path / "out", small_config(tmp_path), 1, scheduler="nowhere")
    assert not (tmp_path / "out").exists()


def test_pins_of_a_data_set_are_given_in_either_form(made):
    folder, config, _ = made
    recorded, raw = (open_simulated(folder, config.sensor, form)[1] for form in (Form.PROCESSED, Form.RAW))
    for key in ("pins_px", "rest_px"):
        np.testing.assert_allclose(raw_to_recording(config.sensor.recording, raw[key]), recorded[key], atol=SAME_PX)
    assert load_dataset(folder, config.sensor, form=Form.RAW).pins.form == Form.RAW
