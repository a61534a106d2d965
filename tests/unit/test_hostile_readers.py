"""Readers of frames, tables, metadata, pins, runs, sessions and records: whatever the bytes, a result or one of our own errors."""

import io
import json
import os
import shutil
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from hardware.cameras.source import SessionSource
from hardware.collect.collect import Collection
from scenes import SpecError, load_sensor
from training.runs.run_files import unpack
from twin.errors import TwinError
from twin.frames import open_recording, read_image
from twin.frames.tables import order_by_table, read_metadata, read_table
from twin.pins import nominal_reference
from twin.pins.graph_files import read_pins
from twin.records.session import STEPS, Session, SessionWriter
from twin.rig.labels import read_executed
from twin.store import Item, find_arrays, find_json, keep_arrays, keep_json
from twin.types import Form

OURS = (TwinError, SpecError)
MANY = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def damage(data: bytes):
    """Damaged copies of bytes: a stretch replaced by others, anywhere."""
    cut = st.tuples(st.integers(0, len(data)), st.integers(0, 2 * len(data)), st.binary(max_size=12))
    return cut.map(lambda c: data[: c[0]] + c[2] + data[c[0] + c[1] :])


@pytest.fixture(scope="module")
def spec():
    return load_sensor("mg400-127")


@pytest.fixture(scope="module")
def frame(spec):
    return drawn_frame(spec, Form.PROCESSED, nominal_reference(spec, Form.PROCESSED).pins_px)


def encoded(frame, suffix: str) -> bytes:
    return cv2.imencode(suffix, frame.image)[1].tobytes()


@MANY
@given(data=st.data(), suffix=st.sampled_from([".png", ".jpg", ".bmp", ".tiff", ".webp", ".pgm"]))
def test_a_damaged_picture_is_a_picture_or_our_error(tmp_path, frame, data, suffix):
    path = tmp_path / f"f{suffix}"
    path.write_bytes(data.draw(damage(encoded(frame, suffix)[:4000] if suffix == ".bmp" else encoded(frame, suffix))))
    try:
        image, note = read_image(path)
    except OURS as error:
        assert path.name in str(error)
    else:
        assert image.dtype == np.uint8 and image.ndim in (2, 3) and isinstance(note, str)


@MANY
@given(content=st.binary(max_size=300))
def test_any_bytes_are_a_picture_or_our_error(tmp_path, content):
    path = tmp_path / "f.png"
    path.write_bytes(content)
    with pytest.raises(OURS, match="f.png"):
        read_image(path)


cells = st.text(max_size=8) | st.floats().map(str) | st.sampled_from(["f_0.png", "F_1.PNG", "a\\f_2.png", "", "nan", "1e999", '"', "#"])
rows = st.lists(st.lists(cells, max_size=5), max_size=6)


@MANY
@given(table=rows, separator=st.sampled_from([",", ";", "\t"]), code=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "latin-1"]))
def test_any_table_orders_the_frames_that_are_there(tmp_path, table, separator, code):
    path, problems = tmp_path / "targets.csv", []
    text = "\n".join(separator.join(row) for row in [["image_name", "pose_2"], *table])
    path.write_bytes(text.encode(code, "replace"))
    files = [tmp_path / f"f_{k}.png" for k in range(3)]
    ordered, labels = order_by_table([path], files, problems)
    assert sorted(ordered) == files, "each frame once"
    assert all(len(column) == len(files) for column in labels.values())
    assert all(isinstance(problem, str) and "\n" not in problem for problem in problems)


@MANY
@given(content=st.binary(max_size=300))
def test_any_bytes_are_a_table_or_a_problem(tmp_path, content):
    path, problems = tmp_path / "targets.csv", []
    path.write_bytes(content)
    assert read_table(path, problems) is not None or "targets.csv" in problems[0]


@MANY
@given(content=st.binary(max_size=200) | st.text(max_size=200).map(lambda t: t.encode("utf-8", "replace")))
def test_any_bytes_are_metadata_or_a_problem(tmp_path, content):
    path, problems = tmp_path / "meta.json", []
    path.write_bytes(content)
    found = read_metadata(path, problems)
    assert found is not None or problems or json.loads(content.decode("utf-8-sig")) is None


@MANY
@given(names=st.lists(st.sampled_from(["f_0.png", "f_1.png", "f_10.png", "init_0.png", "notes.txt"]), unique=True), data=st.data())
def test_a_folder_of_damaged_frames_is_read_or_refused(tmp_path, spec, frame, names, data):
    folder = tmp_path / "frames"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    whole = encoded(frame, ".png")
    for name in names:
        (folder / name).write_bytes(data.draw(st.just(whole) | damage(whole)))
    try:
        recording = open_recording(folder, spec)
    except OURS:
        return
    seen = [each.name for each in recording]
    assert sorted([*seen, *(bad["image_name"] for bad in recording.failed)]) == sorted(recording.names), "each frame is read, or told"


@pytest.fixture(scope="module")
def pins_bytes(spec):  # of one frame
    rest = nominal_reference(spec, Form.PROCESSED).pins_px
    file = io.BytesIO()
    np.savez(file, image_name=np.array(["f_0.png"]), pins_px=rest[None], predicted_px=rest[None], valid=np.ones(1, bool))
    return file.getvalue()


@MANY
@given(data=st.data())
def test_damaged_pins_are_pins_or_our_error(tmp_path, spec, pins_bytes, data):
    path = tmp_path / "pins.npz"
    path.write_bytes(data.draw(damage(pins_bytes)))
    try:
        names, nodes_px = read_pins(path, spec.pins.count)
    except OURS as error:
        assert path.name in str(error)
    else:
        assert nodes_px.shape == (len(names), spec.pins.count, 2) and np.isfinite(nodes_px).all()


@pytest.fixture(scope="module")
def video(tmp_path_factory, frame):
    path = tmp_path_factory.mktemp("video") / "clip.avi"
    height, width = frame.image.shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (width, height))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG video")
    for k in range(4):
        writer.write(cv2.cvtColor(np.roll(frame.image, 3 * k, axis=1), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


@MANY
@given(data=st.data())
def test_a_damaged_video_is_read_or_refused(tmp_path, spec, video, data):
    path = tmp_path / "clip.avi"
    path.write_bytes(data.draw(damage(video.read_bytes()) | st.binary(max_size=200)))
    try:
        recording = open_recording(path, spec)
        frames = list(recording)
    except OURS as error:
        assert path.name in str(error) and len(str(error).splitlines()) == 1
    else:
        assert len(frames) <= len(recording) and all(each.image.shape[:2] == (256, 256) for each in frames)


@MANY
@given(data=st.data())
def test_of_a_cut_video_every_frame_read_is_a_whole_one(tmp_path, spec, video, data):
    whole = [each.image for each in open_recording(video, spec)]
    content = video.read_bytes()
    path = tmp_path / "clip.avi"
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    try:
        recording = open_recording(path, spec)
    except OURS as error:
        assert path.name in str(error)
    else:
        frames = list(recording)
        assert frames and all(np.array_equal(each.image, image) for each, image in zip(frames, whole, strict=False))
        assert len(frames) < len(whole) and any("cut" in problem for problem in recording.problems)


EXECUTED = st.text(max_size=8) | st.sampled_from(["0", "1", "True", "no", "nan", "7", "", "1e999"])


@MANY
@given(column=st.lists(EXECUTED, max_size=4), name=st.sampled_from(["executed", "move_executed", "", "a,b"]))
def test_any_table_of_moves_gives_shares_between_0_and_1_or_a_problem(tmp_path, column, name):
    lines = [f"image_name,{name}", *(f"f_{k}.png,{cell}" for k, cell in enumerate(column))]
    (tmp_path / "move_executed.csv").write_text("\n".join(lines), encoding="utf-8", errors="replace")
    names, problems = [f"f_{k}.png" for k in range(4)], []
    found = read_executed(tmp_path, names, problems)
    assert set(found) <= set(names) and all(0 <= share <= 1 for share in found.values())
    assert len(found) == len(names) or problems, "every frame is accounted for"
    assert all("\n" not in problem for problem in problems)


def pins_file(path: Path, spec, **arrays) -> Path:
    """A ``pins.npz`` of two frames with some arrays replaced; None leaves one out."""
    rest = np.stack([nominal_reference(spec, Form.PROCESSED).pins_px] * 2)
    found = {"image_name": np.array(["f_0.png", "f_1.png"]), "pins_px": rest, "predicted_px": rest, "valid": np.ones(2, bool)} | arrays
    np.savez(path, **{name: array for name, array in found.items() if array is not None})
    return path


def claiming(path: Path, shape: tuple[int, ...]) -> None:
    """An ``.npz`` of a few hundred bytes that claims arrays of a shape."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "w") as file:
        for name in ("image_name", "pins_px", "predicted_px", "valid"):
            file.writestr(f"{name}.npy", header.getvalue() + bytes(64))


@pytest.mark.parametrize(
    ("arrays", "why"),
    [
        ({"valid": None}, "not a pins.npz"),
        ({"valid": np.array(["False", "False"])}, "are not texts, numbers"),
        ({"valid": np.array([0.0, 1.0])}, "are not texts, numbers"),
        ({"image_name": np.array([1, 2])}, "are not texts, numbers"),
        ({"pins_px": np.full((2, 127, 2), "a")}, "are not texts, numbers"),
        ({"pins_px": np.array([None, None])}, "not a pins.npz"),
        ({"pins_px": np.zeros((2, 127, 2))}, "in one place"),
        ({"pins_px": np.full((2, 127, 2), 1e300)}, "in one place, on a line or far off"),
        ({"pins_px": np.full((2, 127, 2), np.inf)}, "lacks a pin"),
        ({"pins_px": np.repeat(np.arange(254.0).reshape(1, 127, 2), 2, axis=0)}, "on a line"),
        ({"valid": np.zeros(2, bool)}, "no valid frame"),
        ({"valid": np.ones(3, bool)}, "do not fit each other"),
    ],
)
def test_pins_that_are_none_are_refused(tmp_path, spec, arrays, why):
    path = pins_file(tmp_path / "pins.npz", spec, **arrays)
    with pytest.raises(TwinError, match=f"pins.npz: .*{why}"):
        read_pins(path, spec.pins.count)


@pytest.mark.parametrize("shape", [(2_600_000_000, 127, 2), (1000, 127, 2), (2**62, 2**62, 4)])
def test_pins_that_claim_terabytes_take_none(tmp_path, spec, shape):
    claiming(tmp_path / "pins.npz", shape)
    with pytest.raises(TwinError, match="pins.npz: not a pins.npz, or a damaged one"):
        read_pins(tmp_path / "pins.npz", spec.pins.count)


def test_pins_that_unpack_without_bound_are_refused(tmp_path, spec, monkeypatch):
    path = pins_file(tmp_path / "pins.npz", spec)
    assert len(read_pins(path, spec.pins.count)[0]) == 2
    monkeypatch.setattr("twin.pins.graph_files.LARGEST_BYTES", 1000)
    with pytest.raises(TwinError, match=r"pins.npz: not a pins.npz"):
        read_pins(path, spec.pins.count)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pins_from_a_named_pipe_are_not_waited_for(tmp_path, spec):
    os.mkfifo(tmp_path / "pins.npz")
    with pytest.raises(TwinError, match="pins.npz: can't be read .a named pipe"):
        read_pins(tmp_path / "pins.npz", spec.pins.count)


def test_a_specification_whose_pins_lie_beyond_any_frame_is_refused(spec):
    with np.errstate(over="ignore"):
        far = spec.model_copy(update={"camera": spec.camera.model_copy(update={"fx_px": 1e308})})
        with pytest.raises(TwinError, match=r"pins at rest .* far off any frame; repair \[camera\]"):
            nominal_reference(far, Form.PROCESSED)


def written_arrays(tmp_path: Path) -> bytes:
    path = tmp_path / "weights.safetensors"
    path.write_bytes(save({"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.ones(2)}))
    return path.read_bytes()


@MANY
@given(data=st.data())
def test_damaged_weights_are_arrays_or_an_error_that_loading_explains(tmp_path, data):
    whole = written_arrays(tmp_path)
    path = tmp_path / "weights.safetensors"
    path.write_bytes(data.draw(damage(whole) | st.binary(max_size=60).map(lambda b: struct.pack("<Q", len(b)) + b)))
    with pytest.raises((ValueError, KeyError)):  # ``PoseEstimator.load`` explains these; even undamaged, the arrays are no model
        unpack({"model": "vgnn", "sensor": {}, "size": {}}, path)


@MANY
@given(data=st.data(), kind=st.sampled_from(["npz", "json"]))
def test_a_damaged_record_is_no_record(tmp_path, data, kind):
    folder = tmp_path / "records"
    shutil.rmtree(folder, ignore_errors=True)
    item = Item("a", (damage,), [1])
    content = {"x": np.arange(3.0)}
    path = keep_arrays(folder, item, content) if kind == "npz" else keep_json(folder, item, {"x": content["x"].tolist()})
    path.write_bytes(data.draw(damage(path.read_bytes())))
    found = find_arrays(folder, item) if kind == "npz" else find_json(folder, item)
    assert found is None or set(found) <= {"x"} or isinstance(found, dict)


@pytest.fixture(scope="module")
def session(tmp_path_factory, frame):
    folder = tmp_path_factory.mktemp("live") / "session"
    with SessionWriter(folder, {"sensor": "mg400-127"}) as writer:
        for k in range(3):
            writer.append(replace(frame, sequence=k), {"value": [float(k)]})
    return folder


@MANY
@given(data=st.data(), name=st.sampled_from(["session.json", "steps.jsonl"]))
def test_a_damaged_session_is_replayed_or_refused(tmp_path, session, data, name):
    folder = tmp_path / "session"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(session, folder)
    (folder / name).write_bytes(data.draw(damage((folder / name).read_bytes())))
    try:
        source = SessionSource(folder)
        with source:
            for _ in range(3):
                source.read()
    except EOFError:
        assert source.notes(), "what is left out is told"
    except OURS as error:
        assert str(folder) in str(error) and len(str(error).splitlines()) == 1


@MANY
@given(content=st.binary(max_size=300))
def test_steps_before_any_bytes_that_are_none_are_read(tmp_path, session, content):
    folder = tmp_path / "session"
    shutil.copytree(session, folder, dirs_exist_ok=True)
    whole = [json.loads(line) for line in (session / STEPS).read_text().splitlines()]
    with (folder / STEPS).open("ab") as file:
        file.write(content)
    try:
        found = Session(folder)
        assert found.steps[: len(whole)] == whole and (not content or found.notes), "what is left out is told"
    except OURS as error:
        assert str(folder) in str(error) and len(str(error).splitlines()) == 1


@pytest.fixture(scope="module")
def collection(tmp_path_factory, frame):
    folder = tmp_path_factory.mktemp("collected") / "collection"
    made = Collection(folder, {"seed": 1}, Form.PROCESSED)
    for k in range(2):
        made.keep(k, frame, np.arange(6.0), np.zeros(6), {"attempt": 0})
    assert made.count == 2
    return folder


@MANY
@given(data=st.data(), name=st.sampled_from(["meta.json", "targets.csv", "contacts.jsonl"]), content=st.none() | st.binary(max_size=60))
def test_a_damaged_collection_is_gone_on_with_or_refused(tmp_path, collection, data, name, content):
    folder = tmp_path / "collection"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(collection, folder)
    (folder / name).write_bytes(data.draw(damage((folder / name).read_bytes())) if content is None else content)
    try:
        assert Collection(folder, {"seed": 1}, Form.PROCESSED).count >= 0
    except OURS as error:
        assert str(folder) in str(error) and len(str(error).splitlines()) == 1
