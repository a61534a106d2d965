"""What recordings, data sets, collections and sessions are as records: their numbers, their episodes, and the pins in their pictures."""

import csv
import json

import numpy as np
import pytest
from drawn_frames import drawn_frame

from scenes import load_experiment, load_sensor, load_servo
from training.generation.store import TruthFile
from twin.errors import FrameError
from twin.frames.images import write_image
from twin.pins import nominal_reference
from twin.records import FORMATS, KeptAlso, RecordError, convert, open_records, with_pins
from twin.records.session import SessionWriter
from twin.rig.kinematics import Mounting
from twin.store import contents
from twin.types import Form, Frame

SENSOR = load_sensor("mg400-127")
REST_PX = nominal_reference(SENSOR, Form.PROCESSED).pins_px
NAMES = ("frame_0_0.png", "frame_0_1.png", "frame_1_0.png")


def shifted(k):
    """Pins of the k-th picture, and the picture."""
    pins_px = REST_PX + [0.8 * k, -0.5 * k]
    return pins_px, drawn_frame(SENSOR, Form.PROCESSED, pins_px).image


def session(folder, steps=3, about=None):
    told = {"sensor": "mg400-127", "arm": "mg400-lenient:10.0.0.7:29999", "object": "can", "servo": load_servo("surface").model_dump()}
    with SessionWriter(folder, told if about is None else about) as writer:
        writer.keep_rest(Frame(shifted(0)[1], Form.PROCESSED))
        for k in range(steps):
            line = {"names": ["pose_2", "pose_6"], "value": [k, np.nan], "low": [k - 1, 0], "high": [k + 1, 0]}
            poses = {"exposed_pose": np.arange(6) + k, "sent": np.arange(6) - k}
            writer.append(Frame(shifted(k)[1], Form.PROCESSED, f"f{k}", 50.0 + 0.1 * k, k + 1), line | poses)
    return folder


def recording(folder, **columns):
    """Three rasterised frames with a table of these columns."""
    for k, name in enumerate(NAMES):
        (folder / "frames_bw").mkdir(parents=True, exist_ok=True)
        write_image(folder / "frames_bw" / name, shifted(k)[1])
    write_image(folder / "init_0.png", shifted(0)[1])
    with (folder / "targets.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["image_name", *columns])
        writer.writerows(zip(NAMES, *columns.values(), strict=True))
    return folder


def test_a_session_is_one_episode_of_the_arms_poses_and_the_models_estimates(tmp_path):
    records = open_records(session(tmp_path / "s"))
    (episode,) = records.episodes
    steps = list(episode.steps())
    assert (records.about.frame, records.about.robot, records.about.estimates) == ("base", "mg400", ("pose_2", "pose_6"))
    assert episode.task == "follow the can" and episode.length == 3 and episode.started_s > 1.5e9
    assert [step.time_s for step in steps] == [0.0, 0.1, 0.2] and records.rate_hz() == 10
    np.testing.assert_array_equal(steps[2].values["pose"], np.arange(6) + 2)
    np.testing.assert_array_equal(steps[2].values["action"], np.arange(6) - 2)
    np.testing.assert_array_equal(steps[2].values["estimate"], [2, np.nan])
    mounting = Mounting.of(SENSOR, load_experiment(load_servo("surface").experiment))
    np.testing.assert_allclose(episode.T_tool_sensor, mounting.T_tool_sensor)


def test_steps_that_use_a_frame_again_have_their_own_times_and_the_record_no_address(tmp_path):
    """A data set with one time for two steps has two actions at one moment; a published one must not name a host."""
    with SessionWriter(tmp_path / "s", {"sensor": "mg400-127", "arm": "mg400:10.0.0.7"}) as writer:
        for number, decided_s in ((1, 50.25), (1, 50.3), (1, 50.35), (2, 50.4), (2, 50.45)):
            frame = Frame(shifted(number)[1], Form.PROCESSED, "", 50.0 + 0.15 * number, number)
            writer.append(frame, {"exposed_pose": np.arange(6), "sent": np.arange(6), "time_s": decided_s})
    for to in ("lerobot", "recording"):
        convert([tmp_path / "s"], tmp_path / to, to)
        (episode,) = open_records(tmp_path / to).episodes
        assert [step.time_s for step in episode.steps()] == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2])
        assert "10.0.0.7" not in "".join(path.read_text() for path in (tmp_path / to).rglob("*.json"))
    assert json.loads((tmp_path / "lerobot/meta/info.json").read_text())["robot_type"] == "mg400"


def test_pins_are_found_in_the_pictures(tmp_path):
    (episode,) = with_pins(open_records(session(tmp_path / "s"))).episodes
    for k, step in enumerate(episode.steps()):
        np.testing.assert_allclose(step.values["pins"], shifted(k)[0], atol=0.3)  # the frames have two levels
    unknown = open_records(session(tmp_path / "t", about={"camera": "x"}))
    assert "pins" not in with_pins(unknown).about.numbers and "`sensor`" in with_pins(unknown).notes[-1]
    assert with_pins(unknown, SENSOR).about.numbers["pins"] == 254
    with pytest.raises(FrameError, match="mg400-331 are 360x360"):
        with_pins(unknown, load_sensor("mg400-331"))


def test_a_cut_session_is_translated_up_to_its_last_line(tmp_path):
    folder = session(tmp_path / "s", 4)
    lines = (folder / "steps.jsonl").read_text()
    (folder / "steps.jsonl").write_text(lines[:-5])
    done = convert([folder], tmp_path / "out", "lerobot")
    assert (done.episodes, done.steps) == (1, 3) and any("cut" in note for note in done.notes)


def test_a_recordings_frames_are_episodes_and_states_of_one_contact_one_episode(tmp_path):
    plain = open_records(recording(tmp_path / "a", pose_1=[1, 2, 3], move_6=[4, 5, 6], Fz=[0, 1, 2]))
    assert [episode.length for episode in plain.episodes] == [1, 1, 1] and plain.about.frame == "work"
    (step,) = plain.episodes[1].steps()
    np.testing.assert_array_equal(step.values["pose"], [2, 0, 0, 0, 0, 0])  # a coordinate without a column never moved
    np.testing.assert_array_equal(step.values["move"], [0, 0, 0, 0, 0, 5])
    assert any("Fz" in note for note in plain.notes)  # a force whose frame nobody knows
    np.testing.assert_array_equal(plain.episodes[0].rest, shifted(0)[1])
    paths = open_records(recording(tmp_path / "b", pose_1=[1, 2, 3], path_id=[7, 7, 8]))
    assert [episode.length for episode in paths.episodes] == [2, 1]
    assert [float(step.values["pose"][0]) for step in paths.episodes[0].steps()] == [1, 2]


@pytest.mark.parametrize("to", FORMATS)
def test_moves_that_were_not_executed_are_taken_out_and_said(tmp_path, to):
    """Their labels say where the arm was about to go. A copy without this knowledge would teach wrong labels."""
    source = recording(tmp_path / "r", pose_2=(1, 2, 3), pose_6=(10, 20, 30), move_1=(0.5, 1, 2), move_6=(4, 5, 6))
    (source / "move_executed.csv").write_text("image_name,executed\n" + "".join(f"{name},{k % 2}\n" for k, name in enumerate(NAMES)))
    done = convert([source], tmp_path / "out", to)
    assert any("moves that were not, or not certainly, executed (2) are removed" in note for note in done.notes)
    steps = [step.values for episode in open_records(tmp_path / "out").episodes for step in episode.steps()]
    assert [step["pose"][[0, 1, 5]].tolist() for step in steps] == [[-0.5, 1, 6], [0, 2, 20], [-2, 3, 24]]
    assert [step["move"][[0, 5]].tolist() for step in steps] == [[0, 0], [1, 5], [0, 0]]


def test_a_picture_that_can_not_be_read_is_left_out_and_said(tmp_path):
    folder = recording(tmp_path / "a", pose_1=[1, 2, 3])
    (folder / "frames_bw" / NAMES[1]).write_bytes(b"no picture")
    done = convert([folder], tmp_path / "out", "mcap", sensor=SENSOR)
    assert (done.episodes, done.steps) == (2, 2) and any(NAMES[1] in note for note in done.notes)
    assert [episode.key.split("/")[1].split("#")[0] for episode in open_records(tmp_path / "out").episodes] == [NAMES[0], NAMES[2]]


@pytest.mark.parametrize(
    "times", [["12:00:01"] * 4, ["0.0", "", "0.2", "0.3"], ["", "0", "1", "2"], ["0", "inf", "1", "2"], ["3", "2", "1", "0"]]
)
@pytest.mark.parametrize("to", FORMATS)
def test_times_that_are_none_are_noted_and_not_taken_over(tmp_path, times, to):
    (tmp_path / "r" / "images").mkdir(parents=True)
    for k in range(4):
        write_image(tmp_path / "r" / "images" / f"f{k}.png", np.random.default_rng(k).integers(0, 255, (24, 32), np.uint8))
    rows = "".join(f"f{k}.png,{k},1,{time_s}\n" for k, time_s in enumerate(times))
    (tmp_path / "r" / "targets.csv").write_text("image_name,pose_1,path_id,time_s\n" + rows)
    made = convert([tmp_path / "r"], tmp_path / "out", to)
    assert any("time_s" in note for note in made.notes)
    assert [step.time_s for step in open_records(tmp_path / "out").episodes[0].steps()] == [0.0, 0.1, 0.2, 0.3]


def test_a_data_sets_truth_goes_with_it(tmp_path):
    folder = recording(tmp_path / "set", pose_1=[1, 2, 3], path_id=[0, 0, 1])
    truth = TruthFile(folder / "truth.zarr")
    rng = np.random.default_rng(0)
    arrays = {"pins_px": rng.normal(size=(3, 127, 2)), "force_n": rng.normal(size=(3, 3)), "torque_nmm": rng.normal(size=(3, 3))}
    truth.append(arrays | {"pose": rng.normal(size=(3, 6)), "path_id": np.array([0, 0, 1])})
    truth.close({"sensor": "mg400-127", "form": "processed"})
    experiment = load_experiment("surface-2d")
    made = {"sensor": SENSOR.model_dump(mode="json"), "experiment": experiment.model_dump(mode="json")}
    (folder / "generation.json").write_text(json.dumps(made))
    records = with_pins(open_records(folder))
    assert records.about.sensor == "mg400-127" and [episode.length for episode in records.episodes] == [2, 1]
    (step,) = records.episodes[1].steps()
    np.testing.assert_array_equal(step.values["pins"], arrays["pins_px"][2].astype(np.float32))
    np.testing.assert_array_equal(step.values["wrench"], np.float32([*arrays["force_n"][2], *arrays["torque_nmm"][2]]))
    np.testing.assert_allclose(records.episodes[0].T_tool_sensor, Mounting.of(SENSOR, experiment).T_tool_sensor)


def test_pins_without_pictures_are_refused(tmp_path):
    (tmp_path / "truth.zarr").mkdir()
    with pytest.raises(RecordError, match="`images` raw"):
        open_records(tmp_path)


def test_a_collection_is_kept_in_further_formats_while_it_grows(tmp_path):
    folder = recording(tmp_path / "c", pose_1=[1, 2, 3])
    lines = (folder / "targets.csv").read_text().splitlines()
    asked = [{"image_name": name, "asked": [k] * 12} for k, name in enumerate(NAMES)]
    formats = ("lerobot", "huggingface", "mcap")
    for last in (NAMES[1], NAMES[2]):
        (folder / "frames_bw" / last).rename(folder / last.replace("png", "later"))
    with KeptAlso(folder, formats, SENSOR) as kept:
        for count in (1, 2, 3):
            if count > 1:
                name = NAMES[count - 1]
                (folder / name.replace("png", "later")).rename(folder / "frames_bw" / name)
            (folder / "targets.csv").write_text("\n".join(lines[: count + 1]) + "\n")
            (folder / "contacts.jsonl").write_text("".join(json.dumps(each) + "\n" for each in asked[:count]))
            kept.catch_up()
            for each in formats:
                assert len(open_records(folder / each).episodes) == count
    for each in formats:
        steps = [step for episode in open_records(folder / each).episodes for step in episode.steps()]
        assert [step.values["action"].tolist() for step in steps] == [[k] * 6 for k in range(3)]
    with pytest.raises(RecordError, match="no further format bag"):
        KeptAlso(folder, ("bag",), SENSOR)


def test_sources_that_do_not_fit_together_are_refused_before_anything_is_written(tmp_path):
    one, other = session(tmp_path / "s"), recording(tmp_path / "r", pose_1=[1, 2, 3])
    with pytest.raises(RecordError, match="does not fit"):
        convert([one, other], tmp_path / "out", "mcap", sensor=SENSOR)
    assert not contents(tmp_path / "out")
