"""The disk cache: it keeps what was computed, and whatever happens to its files, the right arrays come back."""

import errno
import io
import os
import subprocess
import sys
import warnings

import numpy as np
import pytest

from twin.store import atomic, cache, cached_arrays

KEY = {"size": 3, "bytes": b"abc"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TACTIP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Work:
    """Gives the same arrays each time and counts."""

    def __init__(self, scale: float = 1.0):
        self.scale, self.times = scale, 0

    def __call__(self):
        self.times += 1
        return {"values": self.scale * np.arange(12.0).reshape(3, 4), "spacing": np.array(0.25), "ids": np.array([3, 1], np.int32)}


def entries(folder) -> list:
    return sorted(path for path in folder.iterdir() if path.name != "modules.json")


def assert_right(found, work):
    wanted = Work(work.scale)()
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        assert np.array_equal(found[name], value)
        assert found[name].dtype == value.dtype


def test_arrays_are_computed_once_and_come_back_the_same(folder):
    work = Work()
    for _ in range(3):
        assert_right(cached_arrays("field", KEY, work), work)
    assert work.times == 1
    assert len(entries(folder)) == 1


@pytest.mark.parametrize("changed", [{"size": 4, "bytes": b"abc"}, {"size": 3, "bytes": b"abd"}, {"size": 3}, {"size": 3, "bytes": "abc"}])
def test_another_key_is_another_entry(folder, changed):
    cached_arrays("field", KEY, Work())
    other = Work(2.0)
    assert_right(cached_arrays("field", changed, other), other)
    assert other.times == 1


def test_the_keys_order_does_not_matter_but_the_kind_and_the_format_do(folder, monkeypatch):
    work = Work()
    cached_arrays("field", KEY, work)
    cached_arrays("field", dict(reversed(KEY.items())), work)
    assert work.times == 1
    cached_arrays("mesh", KEY, work)
    monkeypatch.setattr(cache, "_FORMAT", cache._FORMAT + 1)
    cached_arrays("field", KEY, work)
    assert work.times == 3


def test_what_other_code_computed_is_not_taken(folder, monkeypatch):
    work = Work()
    cached_arrays("field", KEY, work)
    monkeypatch.setattr(cache, "fingerprint", lambda *makers: "of another version")
    cached_arrays("field", KEY, work)
    assert work.times == 2 and len(entries(folder)) == 2


def test_work_that_was_typed_in_is_not_kept(folder):
    """The source of a function without a file can't be read, so nobody could say whether it is still the same."""
    namespace = {"__name__": "typed_in", "np": np}
    exec("def compute(): return {'values': np.arange(3)}", namespace)
    with pytest.warns(RuntimeWarning, match="typed_in: its source can't be read"):
        assert cached_arrays("field", KEY, namespace["compute"])["values"].tolist() == [0, 1, 2]
    assert not folder.exists()


def test_a_key_or_an_array_that_can_not_be_kept_is_the_callers_error(folder):
    with pytest.raises(TypeError, match="JSON and bytes"):
        cached_arrays("field", {"x": object()}, Work())
    with pytest.raises(TypeError, match="arrays of objects"):
        cached_arrays("field", KEY, lambda: {"x": np.array([object()])})


def test_nothing_is_kept_of_work_that_fails(folder):
    with pytest.raises(ZeroDivisionError):
        cached_arrays("field", KEY, lambda: 1 / 0)
    assert not folder.exists()


def flip(data: bytes) -> bytes:
    middle = data.index(np.float64(7.0).tobytes())
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def pickled(data: bytes) -> bytes:
    file = io.BytesIO()
    np.savez(file, values=np.array([{"a": 1}], object))
    return file.getvalue()


DAMAGE = {
    "empty": lambda data: b"",
    "truncated": lambda data: data[: len(data) // 2],
    "short by a byte": lambda data: data[:-1],
    "one bit": flip,
    "other bytes": lambda data: b"not a cache entry" * 40,
    "pickled": pickled,
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_file_is_named_once_and_written_anew(folder, kind):
    work = Work()
    cached_arrays("field", KEY, work)
    (path,) = entries(folder)
    path.write_bytes(DAMAGE[kind](path.read_bytes()))
    with pytest.warns(RuntimeWarning, match=path.name):
        assert_right(cached_arrays("field", KEY, work), work)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_right(cached_arrays("field", KEY, work), work)
    assert work.times == 2


def test_a_file_that_can_not_be_opened_is_no_reason_to_stop(folder):
    work = Work()
    cached_arrays("field", KEY, work)
    (path,) = entries(folder)
    path.unlink()
    path.mkdir()  # neither readable nor replaceable, for root too
    with pytest.warns(RuntimeWarning):
        assert_right(cached_arrays("field", KEY, work), work)


def test_a_folder_that_can_not_be_made_is_named_once(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("TACTIP_CACHE", str(tmp_path / "file" / "cache"))
    work = Work()
    with pytest.warns(RuntimeWarning, match="set TACTIP_CACHE to a writable folder, or to off") as caught:
        for size in range(3):
            assert_right(cached_arrays("field", {"size": size}, work), work)
    assert len(caught) == 1
    assert str(tmp_path) in str(caught[0].message)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to read-only folders")
def test_a_read_only_folder_is_read_but_not_written(folder):
    work = Work()
    cached_arrays("field", KEY, work)
    folder.chmod(0o500)
    try:
        assert_right(cached_arrays("field", KEY, work), work)
        assert work.times == 1
        with pytest.warns(RuntimeWarning, match=str(folder)):
            assert_right(cached_arrays("other", KEY, work), work)
    finally:
        folder.chmod(0o700)


@pytest.mark.parametrize("step", ["savez", "replace", "mkdir", "iterdir"])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_a_full_or_read_only_disk_leaves_no_part_behind(folder, monkeypatch, step, code):
    def fail(*args, **options):
        if step == "savez":
            args[0].write(b"half an entry")
        raise OSError(code, os.strerror(code))

    owner = {"savez": atomic.np, "replace": atomic.os}.get(step, cache.Path)
    work = Work()
    with monkeypatch.context() as patch, pytest.warns(RuntimeWarning, match=os.strerror(code)):
        patch.setattr(owner, step, fail)
        assert_right(cached_arrays("field", KEY, work), work)
    assert not folder.exists() or not [path for path in entries(folder) if path.suffix == ".part"]


def test_off_touches_no_disk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TACTIP_CACHE", "off")
    work = Work()
    for _ in range(2):
        assert_right(cached_arrays("field", KEY, work), work)
    assert work.times == 2
    assert not entries(tmp_path)


def test_without_a_choice_the_users_cache_folder_is_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic.platformdirs, "user_cache_dir", lambda name: str(tmp_path / name))
    for unset in (lambda: monkeypatch.delenv("TACTIP_CACHE", raising=False), lambda: monkeypatch.setenv("TACTIP_CACHE", "")):
        unset()
        assert atomic.cache_folder() == tmp_path / "tactip-twin"


def test_the_longest_unused_entries_go_first_and_strangers_stay(folder, monkeypatch):
    work = Work()
    cached_arrays("field", {"size": 0}, work)
    (first,) = entries(folder)
    stranger = folder / "holiday.npz"
    stranger.write_bytes(bytes(100_000))
    os.utime(stranger, (0, 0))
    left_over = folder / f".{first.name}.x1.part"  # of a killed process
    left_over.write_bytes(b"half")
    os.utime(left_over, (1, 1))
    os.utime(first, (1_000, 1_000))
    for size in (1, 2):
        before = set(entries(folder))
        cached_arrays("field", {"size": size}, work)
        (new,) = set(entries(folder)) - before
        os.utime(new, (1_000 + size, 1_000 + size))
    cached_arrays("field", {"size": 0}, work)  # used: now the youngest
    monkeypatch.setattr(cache, "_LIMIT_BYTES", int(2.5 * first.stat().st_size))
    cached_arrays("field", {"size": 3}, work)
    assert stranger.exists() and first.exists() and not left_over.exists()
    assert len(entries(folder)) == 3
    assert work.times == 4
    cached_arrays("field", {"size": 1}, work)
    assert work.times == 5


WRITER = """
import sys
import numpy as np
from twin.store import cache_folder, cached_arrays

seed = int(sys.argv[1])
for turn in range(60):
    key = turn % 3
    found = cached_arrays("field", {"key": key}, lambda: {"values": np.full(50_000, float(key))})
    assert (found["values"] == key).all() and found["values"].shape == (50_000,)
    if turn % 7 == seed:
        for path in cache_folder().glob("*.npz"):
            path.unlink(missing_ok=True)
"""


def test_processes_share_a_folder(folder, tmp_path):
    """Two processes write, read and remove the same entries: each always reads whole arrays, without a warning."""
    script = tmp_path / "writer.py"
    script.write_text(WRITER)
    run = [sys.executable, "-W", "error", str(script)]
    workers = [subprocess.Popen([*run, str(seed)], stderr=subprocess.PIPE, text=True) for seed in (1, 4)]
    for worker in workers:
        _, said = worker.communicate(timeout=120)
        assert worker.returncode == 0, said
    assert not list(folder.glob(".*.part"))
