"""A session is readable up to its last complete step whenever it was cut off."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from hardware.cameras.source import SessionSource
from twin.errors import FrameError, StoreError
from twin.frames.images import write_image
from twin.records import open_records
from twin.records.session import FRAMES, REST, STEPS, Session, SessionWriter, is_session
from twin.types import Form, Frame

WRITER = """
import sys, numpy as np
from twin.records.session import SessionWriter
from twin.types import Form, Frame
rng = np.random.default_rng(0)
with SessionWriter(sys.argv[1], {"camera": "none"}) as session:
    print("ready", flush=True)
    for k in range(100000):
        image = rng.integers(0, 255, (120, 160), np.uint8)
        session.append(Frame(image, Form.RAW, f"f{k}", float(k), k + 1), {"sum": int(image.sum()), "pose": np.arange(6.0)})
"""


def frame(k: int, image=None) -> Frame:
    return Frame(np.full((8, 8), k, np.uint8) if image is None else image, Form.PROCESSED, f"f{k}", 0.5 * k, k + 1)


def test_pauses_unread_frames_and_frames_that_are_used_again_are_said(tmp_path):
    """The camera's frames come every 0.5 s; 4 to 9 were not read, and the last one was used twice."""
    with SessionWriter(tmp_path / "s", {}) as session:
        for k in (0, 1, 2, 3, 10, 11, 11):
            session.append(frame(k), {})
    notes = "".join(open_records(tmp_path / "s").notes)
    assert "1 pause, 3.5 s in all, the longest 3.5 s after frame 3; usually 0.5 s" in notes
    assert "6 frames of the camera between the recorded ones" in notes and "1 of 7 steps use the same frame as the step before" in notes
    with SessionWriter(tmp_path / "even", {}) as session:
        for k in range(4):
            session.append(frame(k), {})
    assert open_records(tmp_path / "even").notes == []


@pytest.mark.parametrize("after_s", [0.21, *(pytest.param(more, marks=pytest.mark.slow) for more in (0.05, 0.43))])
def test_killed_at_any_moment_it_is_whole_up_to_the_last_line(tmp_path, after_s):
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path / "s")], stdout=subprocess.PIPE, env=os.environ)
    process.stdout.readline()
    steps = tmp_path / "s" / STEPS
    while not steps.exists() or steps.read_bytes().count(b"\n") < 4:  # on a busy machine a step takes as long as all waits
        time.sleep(0.01)
    time.sleep(after_s)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    source = SessionSource(tmp_path / "s")
    assert len(source.session.steps) >= 4
    with source:
        for step in source.session.steps:
            assert int(source.read().image.astype(int).sum()) == step["sum"]
        with pytest.raises(EOFError):
            source.read()


def test_a_session_that_ended_before_its_first_step_is_begun_anew_and_no_other(tmp_path):
    with SessionWriter(tmp_path / "s", {"try": 1}) as session:
        session.keep_rest(frame(9))
    with SessionWriter(tmp_path / "s", {"try": 2}) as session:
        session.append(frame(0), {"k": 0})
    assert [step["k"] for step in Session(tmp_path / "s").steps] == [0]
    assert not (tmp_path / "s" / REST).exists()
    with pytest.raises(StoreError, match="not empty"):
        SessionWriter(tmp_path / "s", {})


def test_a_torn_last_line_is_left_out(tmp_path):
    with SessionWriter(tmp_path / "s", {}) as session:
        for k in range(3):
            session.append(frame(k), {"k": k})
    whole = (tmp_path / "s" / STEPS).read_bytes()
    last = whole.rstrip(b"\n").rfind(b"\n") + 1
    for cut in range(last, len(whole)):
        (tmp_path / "s" / STEPS).write_bytes(whole[:cut])
        assert [step["k"] for step in Session(tmp_path / "s").steps] == [0, 1]


def test_a_frame_that_serves_several_steps_is_kept_once_and_comes_as_often(tmp_path):
    with SessionWriter(tmp_path / "s", {}) as session:
        for k in (0, 0, 1):
            session.append(frame(k), {})
    assert len(list((tmp_path / "s" / FRAMES).iterdir())) == 2
    with SessionSource(tmp_path / "s") as source:
        assert source.form is Form.PROCESSED
        assert [source.read().sequence for _ in range(3)] == [1, 1, 2]


def test_what_is_no_number_becomes_null_and_lines_stay_json(tmp_path):
    with SessionWriter(tmp_path / "s", {}) as session:
        session.append(frame(0), {"value": np.array([1.0, np.nan]), "np": np.float32(2), "name": "x"})
    line = (tmp_path / "s" / STEPS).read_text()
    assert "NaN" not in line
    step = json.loads(line)
    assert step["value"] == [1.0, None] and step["np"] == 2.0


def test_a_session_overwrites_nothing(tmp_path):
    (tmp_path / "other.txt").write_text("mine")
    with pytest.raises(StoreError, match="not empty"):
        SessionWriter(tmp_path, {})
    assert not is_session(tmp_path)
    with pytest.raises(FrameError, match="no recorded session"):
        SessionSource(tmp_path)


def recorded(folder):
    with SessionWriter(folder, {"sensor": "s"}) as session:
        for k in range(2):
            session.append(frame(k), {"value": [float(k)]})
    return folder


def replayed(folder):
    with SessionSource(folder) as source:
        return [source.read() for _ in source.session.steps], source.notes()


@pytest.mark.parametrize("name", ["../../secret.png", "/etc/passwd", "..", "a/b.png", "", "a\u0000b"])
def test_a_picture_is_named_without_a_folder(tmp_path, name):
    folder = recorded(tmp_path / "s")
    lines = (folder / STEPS).read_text().splitlines()
    step = json.loads(lines[1])
    step["frame"]["file"] = name
    (folder / STEPS).write_text("\n".join([lines[0], json.dumps(step)]) + "\n")
    with pytest.raises(FrameError, match="steps.jsonl, line 2: frame.file"):
        SessionSource(folder)


@pytest.mark.parametrize("linked", ["frames/frame_000001.png", "frames", REST])
def test_a_picture_outside_the_session_is_not_read_by_a_link(tmp_path, linked):
    folder = recorded(tmp_path / "s")
    write_image(folder / REST, frame(7).image)
    (folder / linked).rename(tmp_path / "elsewhere")
    (folder / linked).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FrameError, match="outside the session"):
        replayed(folder)
        _ = SessionSource(folder).session.rest


def test_a_picture_that_is_a_link_to_itself_is_refused(tmp_path):
    folder = recorded(tmp_path / "s")
    (folder / "frames/frame_000001.png").unlink()
    (folder / "frames/frame_000001.png").symlink_to("frame_000001.png")
    with pytest.raises(FrameError, match="frame_000001.png: can't be read"):
        replayed(folder)


def test_a_session_behind_a_link_is_read(tmp_path):
    recorded(tmp_path / "s")
    (tmp_path / "link").symlink_to("s")
    assert len(replayed(tmp_path / "link")[0]) == 2


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("session.json", b"", "session.json: damaged, no JSON"),
        ("session.json", b"[" * 100_000, "session.json: damaged, no JSON"),
        ("session.json", b"[1]", "session.json: damaged, holds no keys and values"),
        ("session.json", b"{}", "session.json: is of version None, expected 1"),
        ("session.json", b'{"version": 99}', "version 99, expected 1"),
        ("session.json", b"\xff\xfe", "session.json: damaged, no JSON"),
        ("session.json", b" " * 2_000_000, "larger than"),
        (STEPS, b"", "ended before its first step"),
        (STEPS, b"1\n2\n", "line 1 is cut or damaged"),
        (STEPS, b'{"step": 0}\n', "line 1: frame: Field required"),
        (STEPS, b'{"step": 0, "frame": 3}\n', "line 1: frame: "),
        (
            STEPS,
            b'{"step": 0, "frame": {"file": "a.png", "name": "a", "form": "cooked", "time_s": 0, "sequence": 0}}\n',
            "line 1: frame.form: ",
        ),
        (
            STEPS,
            b'{"step": 0, "frame": {"file": "a.png", "name": "a", "form": "raw", "time_s": 0, "sequence": 0}, "value": ["x"]}\n',
            "value.0: ",
        ),
    ],
)
def test_a_damaged_session_is_refused_in_one_line(tmp_path, name, content, says):
    folder = recorded(tmp_path / "s")
    (folder / name).write_bytes(content)
    with pytest.raises(FrameError, match=says) as caught:
        SessionSource(folder)
    assert str(folder) in str(caught.value) and len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("clock", [{}, {"unix_s": "noon", "monotonic_s": 1.0}, {"unix_s": 1.0}, [], {"unix_s": None, "monotonic_s": 3.0}])
def test_a_session_whose_clock_is_damaged_has_no_start(tmp_path, clock):
    folder = recorded(tmp_path / "s")
    about = json.loads((folder / "session.json").read_text())
    (folder / "session.json").write_text(json.dumps(about | {"clock": clock}))
    assert open_records(folder).episodes[0].started_s == 0.0


def test_what_follows_a_damaged_line_is_left_out_and_told(tmp_path):
    folder = recorded(tmp_path / "s")
    with (folder / STEPS).open("a") as file:
        file.write('{"frame": \n{"step": 3}\n')
    frames, notes = replayed(folder)
    assert len(frames) == 2 and notes == ["steps.jsonl: line 3 is cut or damaged; the lines before it are read"]


def test_missing_lines_are_not_passed_over(tmp_path):
    folder = tmp_path / "s"
    with SessionWriter(folder, {}) as session:
        for k in range(4):
            session.append(frame(k), {})
    lines = (folder / STEPS).read_text().splitlines(keepends=True)
    (folder / STEPS).write_text("".join(lines[:2]))
    assert replayed(folder)[1] == ["frames/ has pictures without a step in steps.jsonl (2): the session was interrupted"]
    (folder / STEPS).write_text("".join([*lines[:1], *lines[2:]]))
    with pytest.raises(FrameError, match="steps.jsonl, line 2 is of step 2: lines are missing"):
        SessionSource(folder)
