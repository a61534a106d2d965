"""Recordings in the formats found in the wild, whole and broken."""

import contextlib
import json
import os
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame, smooth_warp
from made_records import ABOUT, made_episode
from PIL import Image

from hardware.cameras.reader import capture
from hardware.collect.collect import Collection
from scenes import load_sensor
from training.data.targets import choose_targets
from training.estimate.estimator import PoseEstimator
from twin.errors import FrameError, StoreError
from twin.frames import evenly_read, natural_key, open_recording, read_image
from twin.frames.forms import blob_spec, frame_size, from_raw, is_two_level
from twin.frames.images import write_image
from twin.frames.videos import _Shown, is_cut
from twin.pins import Pipeline, nominal_reference
from twin.pins.batch import overlay_name, preprocess_recording
from twin.records import open_writer
from twin.rig.labels import read_arm_labels
from twin.store import write_text
from twin.types import Form


@pytest.fixture(scope="module")
def spec():
    return load_sensor("mg400-127")


@pytest.fixture(scope="module")
def pictures(spec):
    """The rest picture and three in contact."""
    rng = np.random.default_rng(0)
    rest = nominal_reference(spec, Form.PROCESSED).pins_px
    return [drawn_frame(spec, Form.PROCESSED, smooth_warp(rest, amplitude, rng)).image for amplitude in (0.0, 4.0, 6.0, 8.0)]


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
    assert all(f.form == Form.PROCESSED for f in frames)
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
    assert recording.names == [*names[1:], "frame_77_0.png"]
    assert recording.labels["image_name"].tolist() == [*names[1:], ""]
    np.testing.assert_array_equal(recording.labels["pose_2"], [0.5, 1.0, np.nan])
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

    summary = preprocess_recording(tmp_path / "set", spec, tmp_path / "out").summary
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


def test_a_form_may_be_given_by_its_name_and_an_unknown_one_names_the_known(tmp_path, spec):
    raw = drawn_frame(spec, Form.RAW, nominal_reference(spec, Form.RAW).pins_px)
    assert Pipeline(spec, "raw").form is Form.RAW and frame_size(spec, "processed") == frame_size(spec, Form.PROCESSED)
    assert np.array_equal(capture(raw.image, spec, "processed"), capture(raw.image, spec, Form.PROCESSED))
    write_image(tmp_path / "raw.png", raw.image)
    for unknown in (
        lambda: Pipeline(spec, "foo"),
        lambda: frame_size(spec, "foo"),
        lambda: capture(raw.image, spec, "foo"),
        lambda: from_raw(spec.recording, "foo", np.zeros((1, 2))),
        lambda: blob_spec(spec.pipeline, "foo"),
        lambda: nominal_reference(spec, "foo"),
        lambda: open_recording(tmp_path / "raw.png", spec, "foo"),
    ):
        with pytest.raises(FrameError, match="^no form is called 'foo'; there are: raw, processed"):
            unknown()
    with pytest.raises(FrameError, match=r"a twin.types.Frame is expected, got ndarray; give Frame\(image, Form.RAW\)"):
        Pipeline(spec, Form.RAW)(raw.image)


@pytest.mark.parametrize(("form", "folder"), [("raw", "images"), ("processed", "frames_bw")])
def test_frames_of_a_form_that_is_given_by_its_name_get_that_forms_folder(tmp_path, form, folder):
    assert Collection(tmp_path / "collected", {}, form).pictures.name == folder
    with open_writer(tmp_path / "written", "recording", replace(ABOUT, form=form), 10) as writer:
        writer.write(iter([made_episode(0)]))
    assert (tmp_path / "written" / folder).is_dir()


def test_a_model_refuses_an_unknown_form_as_it_refuses_the_other_one():
    model = PoseEstimator.load("mg400-127")
    model.check(model.sensor, "processed")
    with pytest.raises(FrameError, match="these are raw frames of"):
        model.check(model.sensor, "raw")
    with pytest.raises(FrameError, match="no form is called 'foo'"):
        model.check(model.sensor, "foo")


@pytest.mark.parametrize("scale", [0.5, 0.7, 1.9])
def test_thresholded_frames_that_were_resized_are_still_such(scale):
    """Small caps are edges for the most part then; as raw frames they would be called saturated."""
    spec = load_sensor("mg400-331")
    for form in (Form.PROCESSED, Form.RAW):
        image = drawn_frame(spec, form, nominal_reference(spec, form).pins_px).image
        resized = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        assert is_two_level(resized) == (form == Form.PROCESSED)


def test_a_few_gray_pixels_make_no_thresholded_frame_a_gray_picture(spec):
    image = drawn_frame(spec, Form.PROCESSED, nominal_reference(spec, Form.PROCESSED).pins_px).image.copy()
    assert is_two_level(image) and is_two_level(image[..., None])
    image[0, 0] = 128
    assert is_two_level(image) and is_two_level(image[..., None])
    image[:4] = 128  # a broken row, or a text
    assert is_two_level(image)


def test_a_picture_with_colours_was_not_thresholded():
    """Also if it is dark beside a white housing. Gray pictures keep a little colour by JPEG."""
    image = np.zeros((60, 80, 3), np.uint8)
    image[:, 60:] = 255
    noise = np.random.default_rng(0).integers(0, 6, image.shape, np.uint8)
    assert is_two_level(np.clip(image.astype(int) - noise, 0, 255).astype(np.uint8))
    image[20:40, 20:40] = (40, 90, 160)
    assert not is_two_level(image)


def test_a_gray_picture_of_a_dark_skin_in_a_white_housing_was_not_thresholded():
    """Most of it is black or white; but its caps are gray, with no white beside them."""
    spec = load_sensor("pad-rectangular")
    image = drawn_frame(spec, Form.RAW, nominal_reference(spec, Form.RAW).pins_px).image
    gray = image if image.ndim == 2 else image[..., 0]
    for widest in (10, 40):
        housed = np.pad(np.where(gray > 100, 180, 4).astype(np.uint8), widest, constant_values=255)
        assert not is_two_level(housed)
        assert is_two_level(np.where(housed > 100, 255, 0).astype(np.uint8))


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
    assert preprocess_recording(video, spec, tmp_path / "out").summary["exact_fraction"] == 1.0


@pytest.mark.parametrize("share", [0.4, 0.55, 0.7, 0.9, 0.98])
def test_the_last_frame_of_a_cut_video_is_left_out_as_it_may_be_half_there(video, spec, share):
    whole = [frame.image for frame in open_recording(video, spec)]
    data = video.read_bytes()
    video.write_bytes(data[: int(share * len(data))])
    recording = open_recording(video, spec)
    read = list(recording)
    assert 1 <= len(read) == len(recording) < 12
    assert all(np.array_equal(frame.image, image) for frame, image in zip(read, whole, strict=False)), "none is made up"
    assert any("tap.avi: cut" in problem and "left out" in problem for problem in recording.problems)


def test_a_video_cut_within_its_first_frame_is_refused(video, spec, monkeypatch):
    data = video.read_bytes()
    first = data.index(b"00dc")
    for at in range(first, data.index(b"00dc", first + 4), 4000):
        video.write_bytes(data[:at])
        with pytest.raises(FrameError, match="tap.avi: (no frame can be decoded|cut within its first frame)"):
            open_recording(video, spec)
    made_up = [_Shown(0.0, np.zeros((480, 640, 3), np.uint8), "")]
    monkeypatch.setattr("twin.frames.videos._read_frames", lambda *_: iter(made_up))
    with pytest.raises(FrameError, match="tap.avi: cut within its first frame"):  # where the decoder made it up
        open_recording(video, spec)


def in_frame(data: bytes, number: int) -> int:
    """A place in the middle of a frame of an AVI file."""
    starts = [k for k in range(data.index(b"movi"), len(data)) if data.startswith(b"00dc", k)][number:]
    return starts[0] + 8 + int.from_bytes(data[starts[0] + 4 : starts[0] + 8], "little") // 2


def test_a_damaged_frame_of_a_video_is_left_out_and_told(video, spec):
    whole = {frame.name: frame.image for frame in open_recording(video, spec)}
    data = video.read_bytes()
    at = in_frame(data, 5)
    video.write_bytes(data[:at] + bytes(400) + data[at + 400 :])
    recording = open_recording(video, spec)
    frames = list(recording)
    assert len(frames) == 11 and all(np.array_equal(frame.image, whole[frame.name]) for frame in frames), "the others keep their names"
    (bad,) = recording.failed
    assert bad["image_name"] == "tap_000005" and "damaged" in bad["reason"]
    with pytest.raises(FrameError, match="tap_000005.*damaged"):
        recording.read(5)
    assert len(evenly_read(recording, 12)) == 11 and recording.notes()[-1].startswith("skipped tap_000005: ")


def test_a_damaged_jpeg_is_refused_and_bytes_behind_it_are_told(tmp_path, pictures):
    data, path = cv2.imencode(".jpg", pictures[1])[1].tobytes(), tmp_path / "f.jpg"
    half = len(data) // 2
    for damaged in (data[:half] + bytes(200) + data[half + 200 :], data[:half] + b"\xff" * 200 + data[half + 200 :], data[:half]):
        path.write_bytes(damaged)
        with pytest.raises(FrameError, match="f.jpg"):
            read_image(path)
    path.write_bytes(data[:-2] + b"\x5a\xa5" * 20 + data[-2:])
    image, note = read_image(path)
    path.write_bytes(data)
    assert "extra bytes" in note and np.array_equal(image, read_image(path)[0]) and read_image(path)[1] == ""


def test_a_tiff_with_a_damaged_strip_is_refused(tmp_path, pictures):
    path = tmp_path / "f.tiff"
    cv2.imwrite(str(path), pictures[1])
    data = path.read_bytes()
    half = len(data) // 2
    path.write_bytes(data[:half] + bytes(300) + data[half + 300 :])
    with pytest.raises(FrameError, match="f.tiff: damaged"):
        read_image(path)


def test_frames_evenly_read_leave_out_what_cannot_be_read(tmp_path, spec, pictures):
    names = write_set(tmp_path / "set", "frames_bw", "frame_{}_0.png", pictures, (1, 2, 3))
    break_picture(tmp_path / "set" / "frames_bw" / names[1], "truncated", pictures)
    recording = open_recording(tmp_path / "set", spec)
    assert [frame.name for frame in evenly_read(recording, 3)] == [names[0], names[2]]
    assert f"skipped {names[1]}: truncated" in recording.notes()[-1]
    for name in names:
        break_picture(tmp_path / "set" / "frames_bw" / name, "truncated", pictures)
    with pytest.raises(FrameError, match=f"{names[0]}: truncated"):
        evenly_read(recording, 3)


def test_an_mp4_whose_data_come_last_is_cut_where_a_box_says_so(tmp_path):
    box = (16).to_bytes(4, "big") + b"ftyp" + bytes(8)
    path = tmp_path / "a.mp4"
    for data, cut in (
        (box + (24).to_bytes(4, "big") + b"mdat" + bytes(16), False),
        (box + (24).to_bytes(4, "big") + b"mdat" + bytes(15), True),
        (box + (1).to_bytes(4, "big") + b"mdat" + (32).to_bytes(8, "big") + bytes(16), False),
        (box + (1).to_bytes(4, "big") + b"mdat" + (33).to_bytes(8, "big") + bytes(16), True),
        (box + (0).to_bytes(4, "big") + b"mdat" + bytes(16), False),  # up to the end
        (box + (3).to_bytes(4, "big") + b"junk", True),
        (b"\x1a\x45\xdf\xa3" + bytes(20), False),  # another container
    ):
        path.write_bytes(data)
        assert is_cut(path) is cut


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("name", ["f.png", "clip.avi", "frames"])
def test_a_named_pipe_is_refused_at_once(tmp_path, spec, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(FrameError, match=f"{name}: a named pipe or a device"):
        open_recording(tmp_path / name, spec)


@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="needs an endless device")
@pytest.mark.parametrize("name", ["f.png", "clip.avi"])
def test_an_endless_device_is_refused_at_once(tmp_path, spec, name):
    (tmp_path / name).symlink_to("/dev/zero")
    with pytest.raises(FrameError, match=f"{name}: a named pipe or a device"):
        open_recording(tmp_path / name, spec)
    with pytest.raises(FrameError, match=f"{name}: can't be read .a named pipe or a device"):
        read_image(tmp_path / name)


def test_what_has_a_pictures_name_and_is_no_file_is_told(tmp_path, spec, pictures):
    write_pictures(tmp_path, {"a.png": pictures[1]})
    (tmp_path / "b.png").mkdir()
    (tmp_path / "c.png").symlink_to("nowhere")
    os.mkfifo(tmp_path / "d.png")
    (tmp_path / "e.png").symlink_to("e.png")
    recording = open_recording(tmp_path, spec)
    assert recording.names == ["a.png"]
    told = [problem.split(":")[0] for problem in recording.problems if problem.endswith("; left out")]
    assert told == ["b.png", "c.png", "d.png", "e.png"]
    with pytest.raises(FrameError, match="c.png: a broken link"):
        open_recording(tmp_path / "c.png", spec)


@pytest.mark.parametrize("kind", ["png", "tiff", "webp"])
def test_of_several_pictures_in_a_file_the_first_is_read_and_that_is_told(tmp_path, spec, pictures, kind):
    path = tmp_path / f"a.{kind}"
    if kind == "tiff":
        path.write_bytes(cv2.imencodemulti(".tiff", [pictures[1], pictures[2]])[1].tobytes())
    else:
        images = [Image.fromarray(picture) for picture in pictures[1:3]]
        images[0].save(path, save_all=True, append_images=images[1:], **({"lossless": True} if kind == "webp" else {}))
    image, note = read_image(path)
    assert np.array_equal(image if image.ndim == 2 else image[..., 0], pictures[1]) and "several pictures" in note
    recording = open_recording(path, spec)
    list(recording)
    assert any("several pictures" in problem for problem in recording.problems)
    cv2.imwrite(str(path), pictures[1])
    assert read_image(path)[1] == ""


def test_a_table_of_thousands_of_columns_is_refused_at_once_and_is_the_reason_why_there_are_no_labels(tmp_path, spec, pictures):
    names = write_set(tmp_path, "frames_bw", "f_{}.png", pictures, [0, 1, 2])
    for table, why in (
        ("\n".join(f"{name}," + ",".join("1" * 100_000) for name in ["image_name", *names]), "row 1 has 100001 cells"),
        ("\n".join(["name,pose_2", *(f"{name},1" for name in names)]), "no column image_name"),
        ("image_name,pose_2\ng.png,1", "no row names a picture here"),
    ):
        (tmp_path / "targets.csv").write_text(table)
        recording = open_recording(tmp_path, spec)
        assert not recording.labels and why in recording.labels_found()
        with pytest.raises(FrameError, match=why):
            choose_targets(recording, "surface-2d", np.arange(3), 0.0, [])
        with pytest.raises(FrameError, match=why):
            read_arm_labels(recording)
    (tmp_path / "targets.csv").unlink()
    assert open_recording(tmp_path, spec).labels_found() == "found no table"


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
    made = preprocess_recording(tmp_path / "set", spec, tmp_path / "out", overlay=True, progress=lambda *at: seen.append(at))
    arrays = np.load(tmp_path / "out" / "pins.npz", allow_pickle=False)
    n = spec.pins.count
    assert arrays["image_name"].tolist() == names
    assert arrays["pins_px"].shape == arrays["predicted_px"].shape == (3, n, 2) and arrays["pins_px"].dtype == np.float64
    assert arrays["area_px2"].shape == (3, n)
    assert arrays["found"].tolist() == [n, n, 0] and arrays["valid"].tolist() == [True, True, False]
    assert (np.isnan(arrays["pins_px"]) ^ np.isnan(arrays["predicted_px"])).all()
    written = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert written == made.summary and written["frames"] == 3 and written["exact_fraction"] == pytest.approx(2 / 3)
    assert written["in_view"] == n
    assert repr(made).startswith(f"<Preprocessed: 3 frames, all {n} pins found in 66.67 %") and "\n" not in repr(made)
    assert f"all pins in view ({n - 20} of {n};" in str(replace(made, summary=written | {"in_view": n - 20.0}))
    assert {len(column) for column in made.to_table().values()} == {3}
    assert written["parameters"]["reference"] == "init_0.png" and set(written["ms"]["total"]) == {"p50", "p95", "p99"}
    assert sorted(p.name for p in (tmp_path / "out" / "overlay").iterdir()) == sorted(names)
    assert seen[-1] == (3, 3)
    assert {path.name for path in (tmp_path / "out").glob(".*")} == {".written.json"}


def test_json_nested_without_end_is_reported(tmp_path, spec, pictures):
    cv2.imwrite(str(tmp_path / "a.png"), pictures[1])
    (tmp_path / "deep.json").write_text("[" * 100_000)
    recording = open_recording(tmp_path, spec)
    assert recording.names == ["a.png"] and "deep.json" not in recording.metadata
    assert any("deep.json" in p and "nested" in p for p in recording.problems)


def write_pictures(folder, images):
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in images.items():
        assert cv2.imwrite(str(folder / name), image)


@pytest.mark.parametrize("given", [None, Form.PROCESSED])
def test_most_frames_decide_on_the_form(tmp_path, spec, pictures, given):
    raw = np.zeros((480, 640), np.uint8)
    write_pictures(tmp_path, {"a.png": raw, **{f"b{k}.png": pictures[1] for k in range(4)}})
    recording = open_recording(tmp_path, spec, given)
    assert recording.form == Form.PROCESSED and recording.size_px == (256, 256)
    assert len(list(recording)) == 4 and [f["image_name"] for f in recording.failed] == ["a.png"]


def test_the_first_frame_decides_between_equal_numbers(tmp_path, spec, pictures):
    raw = np.zeros((480, 640), np.uint8)
    write_pictures(tmp_path, {"a.png": raw, "b.png": pictures[1]})
    assert open_recording(tmp_path, spec).form == Form.RAW
    assert open_recording(tmp_path, spec, Form.PROCESSED).size_px == (256, 256)


def test_a_form_that_no_frame_has_is_an_error(tmp_path, spec, pictures):
    write_pictures(tmp_path, {"a.png": pictures[1]})
    with pytest.raises(FrameError, match=r"a.png: expected 640x480 \(raw form\).*got 256x256 \(processed form\)"):
        open_recording(tmp_path, spec, Form.RAW)


def test_a_long_recording_opens_where_few_frames_are_usable(tmp_path, spec, pictures):
    write_pictures(tmp_path, {f"f_{k}.png": np.zeros((9, 9), np.uint8) for k in range(80)})
    write_pictures(tmp_path, {"f_41.png": pictures[1]})
    assert [f.name for f in open_recording(tmp_path, spec)] == ["f_41.png"]


def test_the_next_folder_is_read_where_the_first_is_unusable(tmp_path, spec, pictures):
    write_pictures(tmp_path / "sensor_images", {"image_1.png": np.zeros((50, 60), np.uint8)})
    write_pictures(tmp_path / "processed_images", {"image_1.png": pictures[1]})
    recording = open_recording(tmp_path, spec)
    np.testing.assert_array_equal(recording.read(0).image, pictures[1])
    assert any("sensor_images" in p and "got 60x50" in p for p in recording.problems)
    (tmp_path / "processed_images" / "image_1.png").write_bytes(b"")
    with pytest.raises(FrameError, match="sensor_images: no usable frame.*got 60x50"):
        open_recording(tmp_path, spec)


PLAIN = "image_name,pose_2\nb.png,0.5\na.png,1.5\n"
TABLES = {
    "no suffix": PLAIN.replace(".png", "").encode(),
    "another suffix": PLAIN.replace(".png", ".jpg").encode(),
    "another case": PLAIN.replace(".png", ".PNG").replace("image_name", "Image_Name").encode(),
    "single quotes": PLAIN.replace("b.png", "'b.png'").replace("a.png", "'a.png'").encode(),
    "spaces and quotes": PLAIN.replace("b.png", ' "b.png" ').replace("a.png", "  a.png ").encode(),
    "an open quote": PLAIN.replace("b.png", '"b.png').encode(),
    "UTF-16": PLAIN.encode("utf-16"),
    "UTF-16 without a mark": PLAIN.encode("utf-16-le"),
    "semicolons": PLAIN.replace(",", ";").replace(".5", ",5").encode(),
    "the name column twice": PLAIN.replace(",pose_2", ",pose_2,image_name").replace(".5\n", ".5,x\n").encode(),
    "names in the other column": PLAIN.replace("image_name,", "image_name,sensor_image,")
    .replace("b.", ",b.")
    .replace("a.", ",a.")
    .encode(),
    "carriage returns": PLAIN.replace("\n", "\r").encode(),
}


@pytest.mark.parametrize("how", TABLES)
def test_tables_written_in_other_ways_keep_their_order_and_labels(tmp_path, spec, pictures, how):
    write_pictures(tmp_path, {"a.png": pictures[1], "b.png": pictures[2]})
    (tmp_path / "targets.csv").write_bytes(TABLES[how])
    recording = open_recording(tmp_path, spec)
    assert recording.names == [f.name for f in recording] == ["b.png", "a.png"]
    np.testing.assert_array_equal(recording.labels["pose_2"], [0.5, 1.5])


def test_pictures_with_capital_suffixes_and_equal_stems(tmp_path, spec, pictures):
    write_pictures(tmp_path, {"a.PNG": pictures[1], "b.png": pictures[1], "b.bmp": pictures[2]})
    (tmp_path / "targets.csv").write_text("sensor_image,k\nb.bmp,0\nb.png,1\na.png,2\n")
    recording = open_recording(tmp_path, spec)
    assert recording.names == ["b.bmp", "b.png", "a.PNG"] and recording.labels["k"].tolist() == [0, 1, 2]
    assert len(recording.problems) == 1 and "another suffix or case (a.png)" in recording.problems[0]


def test_of_two_rows_for_a_picture_the_first_counts(tmp_path, spec, pictures):
    write_pictures(tmp_path, {"a.png": pictures[1], "b.png": pictures[2]})
    (tmp_path / "targets.csv").write_text("image_name,k\nb.png,0\nb.png,1\na.png,2\n")
    recording = open_recording(tmp_path, spec)
    assert recording.names == ["b.png", "a.png"] and recording.labels["k"].tolist() == [0, 2]
    assert any("has one before" in p and "b.png" in p for p in recording.problems)


def test_a_table_of_other_pictures_leaves_the_natural_order(tmp_path, spec, pictures):
    write_pictures(tmp_path, {"a.png": pictures[1], "b.png": pictures[2]})
    (tmp_path / "targets.csv").write_text("image_name,k\ny.png,0\nx.png,1\n")
    recording = open_recording(tmp_path, spec)
    assert recording.names == ["a.png", "b.png"] and not recording.labels
    assert any("natural order" in p for p in recording.problems)


def test_pictures_deeper_down_are_pointed_at(tmp_path, spec, pictures):
    write_pictures(tmp_path / "a" / "b", {"x.png": pictures[1]})
    with pytest.raises(FrameError, match=r"folders below \(a/b\); give"):
        open_recording(tmp_path, spec)
    assert len(open_recording(tmp_path / "a", spec)) == 1


def test_a_folder_with_one_video_gives_its_frames(video, spec, pictures):
    cv2.imwrite(str(video.parent / "init_0.png"), np.zeros((480, 640), np.uint8))
    recording = open_recording(video.parent, spec)
    assert len(list(recording)) == 12 and recording.reference.name == "init_0.png"
    (video.parent / "tap_2.avi").write_bytes(video.read_bytes())
    with pytest.raises(FrameError, match=r"2 videos here \(tap.avi, tap_2.avi\); give one of them"):
        open_recording(video.parent, spec)


def test_bytes_after_a_png_don_t_matter_and_missing_ones_do(tmp_path, spec, pictures):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), pictures[1])
    data = path.read_bytes()
    path.write_bytes(data + bytes(500))
    np.testing.assert_array_equal(read_image(path)[0], pictures[1])
    for missing in (1, 12, 60, len(data) - 9):
        path.write_bytes(data[:-missing] + (b"IEND" if missing == 60 else b""))
        with pytest.raises(FrameError, match="truncated PNG|damaged PNG"):
            read_image(path)


def broken_files(folder, pictures):
    """Files that the libraries under OpenCV complain about."""
    write_pictures(folder, {"sum.png": pictures[1], "flow.png": pictures[1], "cut.jpg": pictures[1], "cut.tif": pictures[1]})
    data = bytearray((folder / "sum.png").read_bytes())
    data[len(data) // 2] ^= 0x55
    (folder / "sum.png").write_bytes(data)
    start = data.index(b"IDAT")
    length = int.from_bytes(data[start - 4 : start], "big")
    data[start + length // 2 + 4] ^= 0xFF  # damaged pixels under a correct checksum
    data[start + 4 + length : start + 8 + length] = zlib.crc32(data[start : start + 4 + length]).to_bytes(4, "big")
    (folder / "flow.png").write_bytes(data)
    for name in ("cut.jpg", "cut.tif"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: len(whole) // 2])
    (folder / "no_moov.mp4").write_bytes(b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom" + bytes(4000))


def test_broken_files_make_no_noise(tmp_path, video, pictures, capfd):
    folder = tmp_path / "broken"
    broken_files(folder, pictures)
    data = video.read_bytes()
    (folder / "cut.avi").write_bytes(data[: int(0.55 * len(data))])
    capfd.readouterr()
    for file in sorted(folder.iterdir()):
        with contextlib.suppress(FrameError):
            list(open_recording(file))
    assert capfd.readouterr().err == ""
    os.write(2, b"heard again")
    assert capfd.readouterr().err == "heard again"


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_sixteen_bit_files_of_any_depth_keep_their_levels(tmp_path, spec, pictures, bits):
    top = (1 << bits) - 1
    bright = np.round(pictures[1] * (top / 255)).astype(np.uint16)
    bright[0, 0] = top
    write_pictures(tmp_path, {"a.png": bright // 20, "b.png": bright})
    recording = open_recording(tmp_path, spec, Form.PROCESSED)
    dim, image = (frame.image for frame in recording)
    assert np.abs(image[1:].astype(int) - pictures[1][1:]).max() <= 1
    assert np.abs(dim[1:] - pictures[1][1:] / 20).max() <= 2
    (note,) = recording.problems
    assert f"{bits}-bit" in note and "a.png" in note


def test_overlays_of_pictures_with_equal_stems_are_all_kept(tmp_path, spec, pictures):
    write_pictures(tmp_path / "set", {"a.png": pictures[1], "a.bmp": pictures[2], "b.png": pictures[3]})
    preprocess_recording(tmp_path / "set", spec, tmp_path / "out", overlay=True)
    assert len(list((tmp_path / "out" / "overlay").iterdir())) == 3
    taken = set()
    assert [overlay_name(name, taken) for name in ("a.jpg", "A.png", "a.jpg", "b")] == ["a.png", "A.png.png", "a.jpg.png", "b.png"]
    assert overlay_name("a.jpg", taken) == "a_2.png"


def test_frames_without_pins_are_one_error_with_the_files_written(tmp_path, spec, pictures):
    black = np.zeros_like(pictures[0])
    write_pictures(tmp_path / "set", {"a.png": black, "b.png": black})
    with pytest.raises(FrameError, match="in none of 2 frames; the first, a.png: .*`sensor`, `form`") as error:
        preprocess_recording(tmp_path / "set", spec, tmp_path / "out")
    summary_path = tmp_path / "out" / "summary.json"
    message = str(error.value)
    assert message.startswith(str(tmp_path / "set")) and str(summary_path) in message and "\n" not in message
    summary = json.loads(summary_path.read_text())
    assert [bad["image_name"] for bad in summary["invalid"]] == ["a.png", "b.png"] and summary["exact_fraction"] == 0
    with np.load(tmp_path / "out" / "pins.npz", allow_pickle=False) as arrays:
        assert arrays["valid"].tolist() == [False, False]


def test_a_picture_that_can_not_be_written_is_an_error_and_leaves_no_half_of_it(tmp_path, pictures):
    with pytest.raises(StoreError, match="can't be written"):
        write_image(tmp_path / "missing" / "frame.png", pictures[0])
    (tmp_path / "frame.png").mkdir()
    with pytest.raises(StoreError, match="can't be written"):
        write_image(tmp_path / "frame.png", pictures[0])
    assert [path.name for path in tmp_path.iterdir()] == ["frame.png"]


def test_the_time_of_a_frame_is_without_that_of_compiling(tmp_path, spec, pictures, monkeypatch):
    """Also where there is one frame alone."""
    write_image(tmp_path / "one.png", pictures[1])
    looks, look = [], Pipeline.__call__

    def slow_at_first(self, frame):
        looks.append(look(self, frame))
        return replace(looks[-1], ms=looks[-1].ms | {"total": 9000.0}) if len(looks) == 1 else looks[-1]

    monkeypatch.setattr(Pipeline, "__call__", slow_at_first)
    assert preprocess_recording(tmp_path / "one.png", spec, tmp_path / "out").summary["ms"]["total"]["p50"] < 9000


def test_a_name_that_the_locale_cannot_decode_is_drawn_and_written(tmp_path, spec, pictures):
    """OpenCV itself ends the process at such a name."""
    name = b"f_\xe4.png"
    (tmp_path / "set").mkdir()
    with open(os.path.join(os.fsencode(tmp_path / "set"), name), "wb") as file:
        file.write(cv2.imencode(".png", pictures[1])[1].tobytes())
    preprocess_recording(tmp_path / "set", spec, tmp_path / "out", overlay=True)
    assert os.listdir(os.fsencode(tmp_path / "out" / "overlay")) == [name]
    page = write_text(tmp_path / "page.txt", f"{os.fsdecode(name)} \xe4")
    assert page.read_bytes() == name + " \xe4".encode()
