"""Whatever format a record is kept in: what is read back is what was written, and a kill loses no finished episode."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from made_records import ABOUT, COLOUR, assert_same, made_episode

from scenes import load_sensor
from twin import errors
from twin.errors import ExtraError, FrameError, StoreError, TwinError
from twin.frames import open_recording
from twin.records import FORMATS, RecordError, Records, convert, open_records, open_writer, with_pins
from twin.records.folder import SIDECAR

KILLED = """
import os
import sys
from pathlib import Path
from made_records import ABOUT, made_episode
from twin.records import open_writer
def forever():
    for seed in range(100000):
        if seed == 1:
            print(os.getpid(), flush=True)
        yield made_episode(seed)
for folder in sys.argv[2:]:  # each is written to by a process of its own, until that is killed
    if process := os.fork():
        os.waitpid(process, 0)
        continue
    with open_writer(Path(folder), sys.argv[1], ABOUT, 10, at_once=True) as writer:
        writer.write(forever())
"""
TESTS = Path(__file__).parents[1]
WITH_HELPERS = os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS / "helpers")])}
EPISODES = [made_episode(seed, 2 + seed) for seed in range(3)]


def written(folder, to, episodes=EPISODES, about=ABOUT, **options):
    with open_writer(folder, to, about, 10, **options) as writer:
        writer.write(iter(episodes))
    return folder


@pytest.mark.parametrize("at_once", [True, False])
@pytest.mark.parametrize("about", [ABOUT, COLOUR], ids=["gray", "colour"])
@pytest.mark.parametrize("to", FORMATS)
def test_what_is_read_back_is_what_was_written(tmp_path, to, about, at_once):
    episodes = [made_episode(seed, 2 + seed, about) for seed in range(3)]
    found = open_records(written(tmp_path / "r", to, episodes, about, at_once=at_once))
    assert found.about == about or not about.differs(found.about)
    for mine, its in zip(episodes, found.episodes, strict=True):
        assert_same(mine, its)
        # a recording has one picture without contact
        np.testing.assert_array_equal(its.rest, episodes[0].rest if to == "recording" else mine.rest)


@pytest.mark.parametrize("to", FORMATS)
def test_a_record_goes_through_every_format_without_loss(tmp_path, to):
    first = written(tmp_path / "first", to, [replace(each, rest=EPISODES[0].rest) for each in EPISODES])
    last = first
    for number, way in enumerate(FORMATS):
        convert([last], tmp_path / str(number), way)
        last = tmp_path / str(number)
    convert([last], tmp_path / "back", to)
    for mine, its in zip(EPISODES, open_records(tmp_path / "back").episodes, strict=True):
        assert_same(mine, its)


@pytest.mark.parametrize("to", FORMATS)
def test_it_is_gone_on_with_and_no_episode_is_written_twice(tmp_path, to):
    sources = [written(tmp_path / str(k), "mcap", [episode]) for k, episode in enumerate(EPISODES)]
    convert(sources[:1], tmp_path / "out", to)
    done = convert(sources, tmp_path / "out", to)
    assert (done.before, done.episodes, done.steps) == (1, 3, sum(each.length for each in EPISODES))
    again = convert(sources, tmp_path / "out", to)
    assert (again.before, again.episodes) == (3, 3)
    for mine, its in zip(EPISODES, open_records(tmp_path / "out").episodes, strict=True):
        assert_same(mine, its)


def test_paths_may_be_text_and_the_pins_of_another_sensor_are_refused(tmp_path):
    folder = str(written(tmp_path / "a", "recording"))
    assert len(open_records(folder).episodes) == len(EPISODES)
    assert convert([folder], str(tmp_path / "b"), "mcap").episodes == len(EPISODES)
    other = load_sensor("mg400-127")
    found = {"pins": 2 * other.pins.count + 2}
    of_another = replace(ABOUT, numbers=found)
    with pytest.raises(FrameError, match="is 'mg400-127' .127 pins.; leave `sensor` out, or give the matching one"):
        with_pins(Records(of_another, []), other)


@pytest.mark.parametrize(
    ("named", "told"),
    [
        ("ur5-331", "'ur5-331' .331 pins., the given sensor is 'mg400-331' .331 pins.; leave `sensor` out"),
        ("mg400-331", ""),
        ("/home/u/mg400-331.toml", ""),
        ("", ""),
    ],
)
def test_pins_of_a_sensor_of_another_name_are_refused_though_their_number_fits(named, told):
    given = load_sensor("mg400-331")
    records = Records(replace(ABOUT, sensor=named, numbers={"pins": 2 * given.pins.count}), [])
    if not told:
        assert with_pins(records, given) is records
        return
    with pytest.raises(FrameError, match=told):
        with_pins(records, given)


@pytest.mark.parametrize("to", [pytest.param(name, marks=() if name in ("recording", "lerobot") else pytest.mark.slow) for name in FORMATS])
def test_killed_at_any_moment_every_finished_episode_is_there(tmp_path, to):
    folders = [tmp_path / str(number) for number in range(2)]
    run = [sys.executable, "-c", KILLED, to, *map(str, folders)]
    with subprocess.Popen(run, stdout=subprocess.PIPE, env=WITH_HELPERS, start_new_session=True) as process:
        try:
            for after_s in (0.0, 0.07):
                writes = int(process.stdout.readline())
                time.sleep(after_s)
                os.kill(writes, signal.SIGKILL)
            assert not process.wait(60.0)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    for folder in folders:
        found = open_records(folder).episodes
        assert found
        for seed, its in enumerate(found):
            assert_same(made_episode(seed), its)
        more = [made_episode(seed) for seed in range(len(found), len(found) + 2)]
        for seed, its in enumerate(open_records(written(folder, to, more, at_once=True)).episodes):
            assert_same(made_episode(seed), its)


@pytest.mark.parametrize("to", FORMATS)
def test_an_episode_that_fails_leaves_nothing_of_itself(tmp_path, to):
    def broken():
        yield from EPISODES[1].steps()
        raise StoreError("gone")

    with pytest.raises(StoreError, match="gone"):
        written(tmp_path / "r", to, [EPISODES[0], replace(EPISODES[1], steps=broken)], at_once=True)
    assert [each.key for each in open_records(tmp_path / "r").episodes] == ["e0"]
    found = open_records(written(tmp_path / "r", to)).episodes[-2:]
    for mine, its in zip(EPISODES[1:], found, strict=True):
        assert_same(mine, its)


@pytest.mark.parametrize("to", FORMATS)
def test_nothing_foreign_is_written_over(tmp_path, to):
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "notes.txt").write_text("mine")
    with pytest.raises(RecordError, match="holds something else"):
        written(tmp_path / "r", to)
    assert [path.name for path in (tmp_path / "r").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("to", FORMATS)
def test_other_records_do_not_come_into_the_same_folder(tmp_path, to):
    written(tmp_path / "r", to)
    with pytest.raises(RecordError, match="sensor 'ur5-331' instead of 'mg400-127'"):
        written(tmp_path / "r", to, [made_episode(9, 2, COLOUR)], COLOUR)
    other = next(each for each in FORMATS if each != to)
    with pytest.raises(RecordError, match=f"of the format {to}, not {other}"):
        written(tmp_path / "r", other)


@pytest.mark.parametrize("to", FORMATS)
def test_two_runs_do_not_write_at_once(tmp_path, to):
    with open_writer(tmp_path / "r", to, ABOUT, 10), pytest.raises(StoreError, match="another run"):
        subprocess_like = open_writer(tmp_path / "r", to, ABOUT, 10)
        from contextvars import Context

        Context().run(subprocess_like.__enter__)


def damage(path, keep):
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])


@pytest.mark.parametrize(
    ("to", "file"),
    [
        ("recording", "episodes.json"),
        ("recording", "pins.npz"),
        ("lerobot", "meta/info.json"),
        ("lerobot", "meta/episodes/chunk-000/file-000.parquet"),
        ("lerobot", "data/chunk-000/file-000.parquet"),
        ("huggingface", "episodes/000000.json"),
        ("huggingface", "data/000000/metadata.parquet"),
        ("huggingface", "data/000000/episode_000000_000001.png"),
        ("mcap", "episode_000000.mcap"),
    ]
    + [(to, SIDECAR) for to in FORMATS],
)
@pytest.mark.parametrize("keep", [0.0, 0.9])
def test_a_damaged_file_is_one_line(tmp_path, to, file, keep):
    folder = written(tmp_path / "r", to)
    damage(folder / file, keep)
    with pytest.raises(TwinError, match="damaged|can't be read|states") as caught:
        for episode in open_records(folder).episodes:
            list(episode.steps())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("to", "file"),
    [
        ("recording", "targets.csv"),
        ("recording", "pins.npz"),
        ("lerobot", "meta/info.json"),
        ("huggingface", "episodes/000001.json"),
        ("mcap", "episode_000001.mcap"),
    ],
)
def test_a_missing_file_is_told(tmp_path, to, file):
    folder = written(tmp_path / "r", to, at_once=True)
    (folder / file).unlink()
    left = {path: path.read_bytes() for path in folder.rglob("*.p*") if path.name != "tactip.json"}
    with pytest.raises(TwinError, match="is missing"):
        for episode in open_records(folder).episodes:
            list(episode.steps())
    with pytest.raises(TwinError, match="is missing|damaged"):  # nothing is written over what is left
        written(folder, to, [made_episode(9)])
    assert left == {path: path.read_bytes() for path in left}


def test_an_mcap_file_with_changed_bytes_is_told_or_read_as_it_was(tmp_path):
    """In a compressed chunk, whose numbers would change without a word, in a message's definition, or in the index."""
    path = written(tmp_path / "r", "mcap", EPISODES[:1]) / "episode_000000.mcap"
    data, told = path.read_bytes(), 0
    for place in range(300, len(data), 150):
        for changed in (bytes([data[place] ^ 4]), bytes(64)):
            path.write_bytes(data[:place] + changed + data[place + len(changed) :])
            try:
                (found,) = open_records(path.parent).episodes
                assert_same(EPISODES[0], found)
            except RecordError as error:
                assert "damaged" in str(error)
                told += 1
    assert told > 50


@pytest.mark.parametrize(("to", "file"), [("lerobot", "data/chunk-000/file-000.parquet"), ("huggingface", "data/000000/metadata.parquet")])
def test_a_table_with_a_changed_byte_is_told_or_read_as_it_was(tmp_path, to, file):
    folder = written(tmp_path / "r", to, EPISODES[:1])
    labels = open_recording(folder).labels if to == "lerobot" else {}
    data, told = (folder / file).read_bytes(), 0
    for place in range(4, len(data), len(data) // 75):
        (folder / file).write_bytes(data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :])
        try:
            (found,) = open_records(folder).episodes
            assert_same(EPISODES[0], found)
            for name, column in (open_recording(folder).labels if to == "lerobot" else {}).items():
                np.testing.assert_array_equal(column, labels[name])
        except TwinError:
            told += 1
    assert told > 25


def test_a_model_with_a_single_label_is_kept_in_every_format(tmp_path):
    about = replace(ABOUT, numbers={"pose": 6, "estimate": 1, "low": 1, "high": 1}, estimates=("pose_2",))
    episode = made_episode(1, 3, about)
    for to in FORMATS:
        assert_same(episode, open_records(written(tmp_path / to, to, [episode], about)).episodes[0])


def test_a_missing_library_names_its_remedy(tmp_path):
    def missing(name):
        raise ModuleNotFoundError(name, name=name)

    for to, library in (("lerobot", "pyarrow"), ("mcap", "mcap")):
        with patch.object(errors, "import_module", missing), pytest.raises(ExtraError, match=f"{library}.*tactip-twin\\[records\\]"):
            written(tmp_path / to, to)
        assert not (tmp_path / to).exists()


def test_numbers_that_do_not_fit_are_refused(tmp_path):
    def few():
        for step in EPISODES[0].steps():
            yield replace(step, values={**step.values, "pose": np.zeros(3, np.float32)})

    for to in FORMATS:
        with pytest.raises(RecordError, match=r"pose of shape \(3,\), expected \(6,\)"):
            written(tmp_path / to, to, [replace(EPISODES[0], steps=few)])


def test_a_time_before_the_first_frame_is_refused(tmp_path):
    def back():
        for k, step in enumerate(EPISODES[0].steps()):
            yield replace(step, time_s=-float(k))

    for to in FORMATS:
        with pytest.raises(RecordError, match="-1.0 s after the first"):
            written(tmp_path / to, to, [replace(EPISODES[0], steps=back)])


def test_lerobot_says_what_its_readers_want(tmp_path):
    info = json.loads((written(tmp_path / "r", "lerobot") / "meta/info.json").read_text())
    stats = json.loads((tmp_path / "r" / "meta/stats.json").read_text())
    frames = sum(each.length for each in EPISODES)
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"], info["total_tasks"]) == ("v3.0", 3, frames, 2)
    assert info["splits"] == {"train": "0:3"} and not [name for name in info["features"] if "/" in name]
    assert np.shape(stats["observation.images.tactip"]["mean"]) == (3, 1, 1)
    poses = np.concatenate([[step.values["pose"] for step in each.steps()] for each in EPISODES]).astype(float)
    for key, expected in {"mean": poses.mean(axis=0), "std": poses.std(axis=0), "min": poses.min(axis=0), "max": poses.max(axis=0)}.items():
        np.testing.assert_allclose(stats["observation.state"][key], expected, rtol=1e-9)
    pins = np.concatenate([[step.values["pins"] for step in each.steps()] for each in EPISODES]).reshape(-1, 2)
    np.testing.assert_allclose(stats["observation.tactile.pins"]["mean"], np.nanmean(pins.astype(float), axis=0), rtol=1e-9)


def test_a_video_has_the_pictures_in_their_order(tmp_path):
    def smooth(level):
        for step in EPISODES[0].steps():
            yield replace(step, image=np.full((24, 32), level + 20 * round(10 * step.time_s), np.uint8))

    episodes = [replace(EPISODES[0], key=f"k{level}", steps=lambda level=level: smooth(level)) for level in (30, 120)]
    found = open_records(written(tmp_path / "r", "lerobot", episodes, video=True))
    means = [[float(step.image.mean()) for step in episode.steps()] for episode in found.episodes]
    np.testing.assert_allclose(means, [[30, 50], [120, 140]], atol=4.0)
    with pytest.raises(RecordError, match="`video`"):
        written(tmp_path / "m", "mcap", video=True)
