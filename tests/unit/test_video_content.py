"""What pictures and videos hold is what is read, and what is odd in it is said: flags, sizes, damage, pauses, codecs, animations."""

import json
import struct

import cv2
import numpy as np
import pytest
from made_records import COLOUR, made_episode
from PIL import Image

from hardware.cameras.mjpeg import decode_picture
from twin.errors import FrameError
from twin.frames import frames_at, open_recording
from twin.frames.videos import describe_pauses
from twin.records import Episode, RecordStep, open_writer
from twin.records.record import Records

WIDTH, HEIGHT, COUNT = 64, 48, 10
HALF_TURN = struct.pack(">9i", -1 << 16, 0, 0, 0, -1 << 16, 0, 0, 0, 1 << 30)
"""The matrix of a track that players turn by half a turn (ISO/IEC 14496-12, 8.3.2)."""
MATRIX_AT = 44
"""Place of this matrix behind the name of its box."""
LOSSY_LEVELS = 12
"""Most gray levels, on average, by which codecs change a picture of this test."""


def scene(k, size_px=(WIDTH, HEIGHT)):
    """The k-th picture (H, W, 3), RGB, of a smooth pattern that moves."""
    levels = np.random.default_rng(0).integers(0, 255, (6, 8, 3), np.uint8)
    return np.roll(cv2.resize(levels, size_px, interpolation=cv2.INTER_CUBIC), 2 * k, 1)


def write_video(path, codec, pictures):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25, pictures[0].shape[1::-1])
    for picture in pictures:
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    writer.release()
    return path


def video(path, codec="mp4v", size_px=(WIDTH, HEIGHT)):
    return write_video(path, codec, [scene(k, size_px) for k in range(COUNT)])


def turned_video(path):
    data = bytearray(video(path).read_bytes())
    at = data.index(b"tkhd") + MATRIX_AT
    data[at : at + len(HALF_TURN)] = HALF_TURN
    path.write_bytes(data)
    return path


def turned_picture(path):
    exif = Image.Exif()
    exif[0x112] = 6
    Image.fromarray(scene(0)).save(path, exif=exif, quality=95)
    return path


def alike(image, picture):
    """Whether an image is a picture after a lossy codec."""
    return image.shape == picture.shape and np.abs(image.astype(float) - picture).mean() < LOSSY_LEVELS


def test_a_videos_flag_is_said_and_not_applied(tmp_path):
    found = open_recording(turned_video(tmp_path / "a.mp4"))
    assert all(alike(frame.image, scene(k)) for k, frame in enumerate(found))
    assert any("orientation flag (180 deg) is not applied" in problem for problem in found.problems)
    assert not open_recording(video(tmp_path / "b.mp4")).problems


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif"])
def test_a_pictures_flag_is_said_and_not_applied(tmp_path, name):
    path = turned_picture(tmp_path / name)
    found = open_recording(path)
    assert alike(next(iter(found)).image, scene(0))
    assert sum("orientation flag (EXIF 6) is not applied" in problem for problem in found.problems) == 1
    if name == "a.jpg":
        image, note = decode_picture(path.read_bytes())  # as a live camera's pictures are decoded
        assert alike(image, scene(0)) and "EXIF 6" in note
        (tmp_path / "frames").mkdir()
        Image.fromarray(scene(1)).save(tmp_path / "frames" / "b.jpg")
        with_rest = open_recording(frames_at(tmp_path / "frames", None, path))
        assert alike(with_rest.reference.image, scene(0)) and any("EXIF 6" in problem for problem in with_rest.problems)


def test_the_flags_of_a_lerobot_data_set_are_said_and_not_applied(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    for folder, as_video in (("pictures", False), ("video", True)):
        with open_writer(tmp_path / folder, "lerobot", COLOUR, 10, video=as_video) as writer:
            writer.write(iter([made_episode(0, 3, COLOUR)]))
    (table,) = (tmp_path / "pictures").glob("data/*/*.parquet")
    rows = parquet.read_table(table)
    cells = [{"bytes": turned_picture(tmp_path / "a.jpg").read_bytes(), "path": "a.jpg"}] * 3
    at = rows.schema.get_field_index("observation.images.tactip")
    parquet.write_table(rows.set_column(at, rows.schema.field(at), [cells]), table)
    (film,) = (tmp_path / "video").glob("videos/*/*/*.mp4")
    data = bytearray(film.read_bytes())
    place = data.index(b"tkhd") + MATRIX_AT
    film.write_bytes(data[:place] + HALF_TURN + data[place + len(HALF_TURN) :])
    for folder, flag in (("pictures", "EXIF 6"), ("video", "180 deg")):
        found = open_recording(tmp_path / folder)
        assert sum(f"orientation flag ({flag}) is not applied" in problem for problem in found.problems) == 1
    assert alike(next(iter(open_recording(tmp_path / "pictures"))).image, scene(0))


def test_frames_of_another_size_are_left_out_and_counted(tmp_path, capfd):
    whole, half = video(tmp_path / "a.ts", "mpg2"), write_video(tmp_path / "b.ts", "mpg2", [scene(k, (32, 24)) for k in range(COUNT // 2)])
    both = tmp_path / "both.ts"
    both.write_bytes(whole.read_bytes() + half.read_bytes())
    capfd.readouterr()
    found = open_recording(both)
    frames = list(found)
    assert found.size_px == (WIDTH, HEIGHT) and all(alike(frame.image, scene(k)) for k, frame in enumerate(frames))
    left_out = len(found) - len(frames)
    assert len(frames) >= COUNT - 1 and left_out >= COUNT // 2 - 1, "the decoder loses the last frame of a size"
    assert len(found.failed) == left_out
    assert any(f"{left_out} of {len(found)} frames are left out: another size (32x24)" in problem for problem in found.problems)
    assert sum(note.startswith("skipped") for note in found.notes()) == 1, "frames with the same fault are one line"
    assert capfd.readouterr().err == ""


def test_what_a_decoder_reports_as_damaged_is_left_out_and_counted(tmp_path):
    path = video(tmp_path / "a.mp4")
    data = bytearray(path.read_bytes())
    place = data.index(b"mdat") + 7 * (data.index(b"moov") - data.index(b"mdat")) // 10
    data[place : place + 4] = np.random.default_rng(1).integers(0, 255, 4, np.uint8).tobytes()
    path.write_bytes(data)
    found = open_recording(path)
    frames = list(found)
    assert 0 < len(frames) < COUNT and all(alike(frame.image, scene(frame.sequence)) for frame in frames)
    assert any(f"{COUNT - len(frames)} of {COUNT} frames are left out: damaged (" in problem for problem in found.problems)


def test_repeated_frames_are_counted(tmp_path):
    found = open_recording(write_video(tmp_path / "a.avi", "MJPG", [scene(k // 2) for k in range(COUNT)]))
    assert f"a.avi: {COUNT // 2} of {COUNT} frames repeat the one before them" in found.problems
    assert len(list(found)) == COUNT


def test_an_animated_gif_is_read_whole_and_its_pause_is_said(tmp_path):
    pictures = [Image.fromarray(scene(k)) for k in range(COUNT)]
    pictures[0].save(tmp_path / "a.gif", save_all=True, append_images=pictures[1:], duration=[40] * 4 + [500] + [40] * 5)
    found = open_recording(tmp_path / "a.gif")
    frames = list(found)
    assert len(frames) == COUNT and all(alike(frame.image, scene(k)) for k, frame in enumerate(frames))
    assert "1 pause, 0.5 s in all, the longest 0.5 s after frame 4" in "".join(found.problems)
    (tmp_path / "a.gif").rename(tmp_path / "b.png")
    found = open_recording(tmp_path / "b.png")
    assert len(list(found)) == 1 and any("only the first is read" in problem for problem in found.problems)


def test_no_pause_is_said_of_steady_frames():
    rng = np.random.default_rng(0)
    steady = np.arange(100) / 30 + rng.normal(0, 0.004, 100)
    assert describe_pauses([]) == describe_pauses([1.0]) == describe_pauses([0.0, 0.1]) == describe_pauses(steady) == ""
    assert describe_pauses(np.zeros(5)) == ""


def av1_video(path):
    """An MP4 with AV1, made of the AVIF sequence that Pillow writes: the same boxes with other labels."""
    pictures = [Image.fromarray(scene(k)) for k in range(COUNT)]
    pictures[0].save(path, "AVIF", save_all=True, append_images=pictures[1:], duration=40, quality=90)
    data = path.read_bytes()
    for label, other in ((b"avis", b"isom"), (b"avif", b"iso2"), (b"mif1", b"av01"), (b"meta", b"free")):
        data = data.replace(label, other)
    at = data.index(b"pict", data.index(b"moov"))
    path.write_bytes(data[:at] + b"vide" + data[at + 4 :])
    return path


def test_av1_is_read(tmp_path):
    found = open_recording(av1_video(tmp_path / "a.mp4"))
    frames = list(found)
    assert len(frames) == COUNT and not found.problems and all(alike(frame.image, scene(k)) for k, frame in enumerate(frames))
    assert frames[3].time_s == pytest.approx(0.12, abs=1e-6)


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "xyz1"), ("a.avi", "xyz1"), ("a.mkv", "V_XYZ12")])
def test_the_codec_that_cannot_be_decoded_is_named(tmp_path, name, codec):
    path = video(tmp_path / name)
    data = path.read_bytes()
    for known, unknown in ((b"mp4v", b"xyz1"), (b"esds", b"free"), (b"V_MPEG4", b"V_XYZ12")):
        data = data.replace(known, unknown)
    path.write_bytes(data)
    with pytest.raises(FrameError, match=f"its codec is {codec}.*convert it without loss"):
        open_recording(path)


def episode_at(times_s):
    image = np.zeros((30, 20, 3), np.uint8)
    return Episode("e", "t", lambda: (RecordStep(image, t, {"pose": np.zeros(6, np.float32)}) for t in times_s), len(times_s))


@pytest.mark.parametrize(
    ("name", "steps_s", "fps"),
    [
        ("steady", [1 / 120] * 40, 120),
        ("one pause", [1 / 120] * 20 + [0.05] + [1 / 120] * 19, 120),
        ("every other frame unread in places", [1 / 30] * 3 + [2 / 30, 1 / 30, 2 / 30, 1 / 30] * 10, None),
    ],
)
def test_the_stamps_of_a_lerobot_data_set_are_true_to_half_a_frame_or_the_error_is_said(tmp_path, name, steps_s, fps):
    parquet = pytest.importorskip("pyarrow.parquet")
    times_s = np.round(np.concatenate([[0], np.cumsum(steps_s)]), 9)
    rate_hz = Records(COLOUR, [episode_at(times_s)]).rate_hz()
    with open_writer(tmp_path / "out", "lerobot", COLOUR, rate_hz) as writer:
        writer.write(iter([episode_at(times_s)]))
    stated = json.loads((tmp_path / "out/meta/info.json").read_text())["fps"]
    assert fps is None or stated == fps
    (table,) = (tmp_path / "out").glob("data/*/*.parquet")
    off_s = np.abs(np.array(parquet.read_table(table)["timestamp"].to_pylist()) - times_s).max()
    assert bool(writer.notes()) == bool(off_s > 0.5 / stated)
    if name == "one pause":
        assert f"by up to {off_s:.3g} s" in writer.notes()[0] and "1 pause, 0.05 s" in writer.notes()[0]
