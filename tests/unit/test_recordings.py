"""Recordings in the formats found in the wild, whole and broken."""

import json

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame, smooth_warp

from scenes import load_sensor
from twin.errors import FrameError
from twin.preprocess import nominal_reference
from twin.preprocess.batch import preprocess_recording
from twin.recordings import natural_key, open_recording
from twin.types import Form


@pytest.fixture(scope="module")
def spec():
    return load_sensor("mg400-127")


@pytest.fixture(scope="module")
def pictures(spec):
    """The rest picture and three in contact."""
    rng = np.random.default_rng(0)
    rest = nominal_reference(spec, Form.RECORDING).pins_px
    return [drawn_frame(spec, Form.RECORDING, smooth_warp(rest, amplitude, rng)).image for amplitude in (0.0, 4.0, 6.0, 8.0)]


def write_set(root, folder, pattern, pictures, numbers, column="image_name", init=True):
    (root / folder).mkdir(parents=True)
    if init:
        cv2.imwrite(str(root / "init_0.png"), pictures[0])
    names = [pattern.format(k) for k in numbers]
    for name, picture in zip(names, pictures[1:], strict=True):
        cv2.imwrite(str(root / folder / name), picture)
    rows = [f"{name},{k},{0.5 * k}" for k, name in enumerate(names)]
    (root / "targets.csv").write_text("\n".join([f"{column},obj_id,pose_2", *rows]) + "\n")
    return names


@pytest.mark.parametrize(
    "folder,pattern,column",
    [
        ("frames_bw", "frame_{}_0.png", "image_name"),
        ("images", "image_{}.png", "sensor_image"),
        ("sensor_images", "image_{}.png", "sensor_image"),
        ("processed_images", "image_{}.png", "sensor_image"),
    ],
)
def test_folder_formats_in_the_order_of_their_table(tmp_path, spec, pictures, folder, pattern, column):
    names = write_set(tmp_path, folder, pattern, pictures, (10, 2, 1), column)
    recording = open_recording(tmp_path, spec)
    frames = list(recording)
    assert [f.name for f in frames] == recording.names == names
    assert [f.sequence for f in frames] == [0, 1, 2]
    assert all(f.form == Form.RECORDING for f in frames)
    assert recording.reference.name == "init_0.png"
    np.testing.assert_array_equal(recording.labels["pose_2"], [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(frames[1].image, pictures[2])
    assert not recording.problems and not recording.failed


def test_the_inner_folder_alone_will_do(tmp_path, spec, pictures):
    names = write_set(tmp_path, "frames_bw", "frame_{}_0.png", pictures, (3, 1, 2))
    recording = open_recording(tmp_path / "frames_bw", spec)
    assert recording.names == names and recording.reference is not None


def test_without_a_table_frames_come_in_natural_order(tmp_path, spec, pictures):
    for name, picture in zip(("f_10.png", "f_9.png", "f_1.png"), pictures[1:], strict=True):
        cv2.imwrite(str(tmp_path / name), picture)
    (tmp_path / "notes.txt").write_text("not a picture")
    assert open_recording(tmp_path, spec).names == ["f_1.png", "f_9.png", "f_10.png"]
    assert sorted(["a10", "a9b", "a9"], key=natural_key) == ["a9", "a9b", "a10"]


def test_rows_and_pictures_that_don_t_pair_are_reported(tmp_path, spec, pictures):
    names = write_set(tmp_path, "frames_bw", "frame_{}_0.png", pictures, (1, 2, 3))
    (tmp_path / "frames_bw" / names[0]).rename(tmp_path / "frames_bw" / "frame_77_0.png")
    recording = open_recording(tmp_path, spec)
    assert recording.names == names[1:]
    np.testing.assert_array_equal(recording.labels["pose_2"], [0.5, 1.0])
    assert any("frame_1_0.png" in p and "without a picture" in p for p in recording.problems)
    assert any("frame_77_0.png" in p and "without a row" in p for p in recording.problems)


def test_windows_paths_and_infinity_are_tolerated_and_reported(tmp_path, spec, pictures):
    names = write_set(tmp_path, "frames_bw", "frame_{}_0.png", pictures, (1, 2, 3))
    table = (tmp_path / "targets.csv").read_text().replace("frame_", "C:\\data\\set\\frame_")
    (tmp_path / "targets.csv").write_text(table)
    (tmp_path / "meta.json").write_text('{"dir": "C:\\data\\users", "limit": Infinity}')
    (tmp_path / "env_params.json").write_text("{broken")
    (tmp_path / "collect_params.json").write_text(json.dumps({"n": 3}))
    recording = open_recording(tmp_path, spec)
    assert recording.names == names
    assert recording.metadata["collect_params.json"] == {"n": 3} and recording.metadata["meta.json"]["limit"] == float("inf")
    assert "env_params.json" not in recording.metadata
    text = "\n".join(recording.problems)
    assert "meta.json" in text and "Infinity" in text and "env_params.json" in text


def break_picture(path, how, pictures):
    data = path.read_bytes()
    if how == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "garbage":
        path.write_bytes(b"no picture at all")
    else:
        cv2.imwrite(str(path), np.zeros((100, 90), np.uint8))


@pytest.mark.parametrize("how", ["truncated", "empty", "garbage", "wrong size"])
@pytest.mark.parametrize("which", [0, 1])
def test_a_broken_picture_is_listed_and_skipped(tmp_path, spec, pictures, how, which):
    names = write_set(tmp_path / "set", "frames_bw", "frame_{}_0.png", pictures, (1, 2, 3))
    break_picture(tmp_path / "set" / "frames_bw" / names[which], how, pictures)
    recording = open_recording(tmp_path / "set", spec)
    good = [name for k, name in enumerate(names) if k != which]
    assert [f.name for f in recording] == good
    assert [f["image_name"] for f in recording.failed] == [names[which]] and "\n" not in recording.failed[0]["reason"]

    summary = preprocess_recording(tmp_path / "set", spec, tmp_path / "out")
    arrays = np.load(tmp_path / "out" / "pins.npz", allow_pickle=False)
    assert arrays["image_name"].tolist() == good and summary["frames"] == 2
    assert [f["image_name"] for f in summary["failed"]] == [names[which]]


def test_sixteen_bit_pictures_are_scaled_and_noted(tmp_path, spec, pictures):
    cv2.imwrite(str(tmp_path / "deep.png"), pictures[1].astype(np.uint16) * 257)
    recording = open_recording(tmp_path / "deep.png", spec)
    (frame,) = recording
    np.testing.assert_array_equal(frame.image, pictures[1])
    assert "16-bit" in recording.problems[0]


def test_form_is_told_by_size_and_can_be_given(tmp_path, spec):
    rest = nominal_reference(spec, Form.RAW).pins_px
    cv2.imwrite(str(tmp_path / "raw.png"), drawn_frame(spec, Form.RAW, rest).image)
    assert open_recording(tmp_path / "raw.png", spec).form == Form.RAW
    assert open_recording(tmp_path / "raw.png").form == Form.RAW
    cv2.imwrite(str(tmp_path / "odd.png"), np.zeros((50, 60), np.uint8))
    with pytest.raises(FrameError, match="expected 640x480.*got 60x50"):
        open_recording(tmp_path / "odd.png", spec)


def test_nothing_usable_is_one_error_line(tmp_path, spec):
    empty = tmp_path / "empty"
    empty.mkdir()
    text = tmp_path / "text"
    text.mkdir()
    (text / "a.txt").write_text("x")
    only_init = tmp_path / "only_init"
    only_init.mkdir()
    cv2.imwrite(str(only_init / "init_0.png"), np.zeros((256, 256), np.uint8))
    for path in (tmp_path / "missing", empty, text, only_init):
        with pytest.raises(FrameError, match=";|give") as error:
            open_recording(path, spec)
        assert "\n" not in str(error.value)


@pytest.fixture
def video(tmp_path, spec):
    rest = nominal_reference(spec, Form.RAW).pins_px
    rng = np.random.default_rng(0)
    path = tmp_path / "tap.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (640, 480))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG video")
    for amplitude in np.linspace(0, 8, 12):
        image = drawn_frame(spec, Form.RAW, smooth_warp(rest, amplitude, rng)).image
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_a_video_gives_its_frames(video, spec, tmp_path):
    recording = open_recording(video, spec)
    frames = list(recording)
    assert len(frames) == len(recording) == 12 and recording.form == Form.RAW
    assert frames[11].time_s == pytest.approx(11 / 25, abs=0.05)
    assert preprocess_recording(video, spec, tmp_path / "out")["exact_fraction"] == 1.0


def test_a_video_that_ends_early_gives_what_is_there(video, spec):
    data = video.read_bytes()
    video.write_bytes(data[: int(0.55 * len(data))])
    recording = open_recording(video, spec)
    assert 1 <= len(list(recording)) == len(recording) < 12
    video.write_bytes(b"RIFF no video")
    with pytest.raises(FrameError, match="no frame can be decoded"):
        open_recording(video, spec)


def test_batch_writes_what_it_promises(tmp_path, spec, pictures):
    names = write_set(tmp_path / "set", "frames_bw", "frame_{}_0.png", [*pictures[:3], np.zeros_like(pictures[0])], (7, 3, 5))
    seen = []
    summary = preprocess_recording(tmp_path / "set", spec, tmp_path / "out", overlay=True, progress=lambda *at: seen.append(at))
    arrays = np.load(tmp_path / "out" / "pins.npz", allow_pickle=False)
    n = spec.pins.count
    assert arrays["image_name"].tolist() == names
    assert arrays["pins_px"].shape == arrays["predicted_px"].shape == (3, n, 2) and arrays["pins_px"].dtype == np.float64
    assert arrays["area_px2"].shape == (3, n)
    assert arrays["found"].tolist() == [n, n, 0] and arrays["valid"].tolist() == [True, True, False]
    assert (np.isnan(arrays["pins_px"]) ^ np.isnan(arrays["predicted_px"])).all()
    written = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert written == summary and written["frames"] == 3 and written["exact_fraction"] == pytest.approx(2 / 3)
    assert written["parameters"]["reference"] == "init_0.png" and set(written["ms"]["total"]) == {"p50", "p95", "p99"}
    assert sorted(p.name for p in (tmp_path / "out" / "overlay").iterdir()) == sorted(names)
    assert seen[-1] == (3, 3)
    assert not list((tmp_path / "out").glob(".*"))
