"""Outputs: what others wrote is not overwritten, a folder is tried before the work, and one run at a time writes into it."""

import errno
import json
import os
import resource
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from twin.cli import main
from twin.errors import StoreError
from twin.report.skin3d import write_surface
from twin.store import contents, lock_folder, output, output_file, overwriting, write_result, write_text, writes, writes_file, written_by_us
from twin.store.output import WRITTEN

NAMES = ("table.csv", "page.html", "pictures")
NOT_OURS = "did not write"


@writes(*NAMES)
def work(out: Path, text: str = "made", *, then: Callable[[], None] | None = None) -> Path:
    """A run that writes one file of the three, and a folder."""
    write_text(out / "table.csv", text)
    (out / "pictures").mkdir(exist_ok=True)
    write_text(out / "pictures" / "first.png", text)
    if then is not None:
        then()
    return out / "table.csv"


@writes_file(".*.csv")
def fitted(out: Path | None, text: str = "made") -> None:
    if out is not None:
        write_text(out.with_name(f"{out.stem}.light.csv"), text)
        write_text(out, text)


def everything(folder: Path) -> dict[str, object]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


@pytest.mark.parametrize("name", NAMES)
def test_what_others_wrote_is_not_overwritten_and_the_work_does_not_begin(tmp_path: Path, name: str) -> None:
    if name == "pictures":
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.png").touch()
    else:
        (tmp_path / name).write_text("by hand")
    before = everything(tmp_path)
    with pytest.raises(StoreError, match=rf"{NOT_OURS}.*\({name}\).*`force=True`"):
        work(tmp_path)
    assert everything(tmp_path) == before
    with overwriting():
        work(tmp_path)
    assert work(tmp_path).read_text() == "made"  # now it is the program's


@pytest.mark.parametrize("kind", ["folder", "link to nowhere", "link to a file"])
def test_what_is_no_file_is_not_overwritten(tmp_path: Path, kind: str) -> None:
    place = tmp_path / "out" / "table.csv"
    place.parent.mkdir()
    (tmp_path / "mine.csv").write_text("by hand")
    if kind == "folder":
        place.mkdir()
        (place / "mine").touch()
    else:
        place.symlink_to(tmp_path / ("mine.csv" if kind == "link to a file" else "nowhere"))
    with pytest.raises(StoreError, match=NOT_OURS):
        work(tmp_path / "out")
    assert (tmp_path / "mine.csv").read_text() == "by hand"


def test_own_results_are_replaced_and_other_files_do_not_matter(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("by hand")
    work(tmp_path)
    assert work(tmp_path, "again").read_text() == "again"
    assert written_by_us(tmp_path) == ["pictures", "table.csv"]
    assert (tmp_path / "notes.txt").read_text() == "by hand"


def test_a_result_that_was_changed_by_hand_is_not_overwritten(tmp_path: Path) -> None:
    work(tmp_path).write_text("changed")
    with pytest.raises(StoreError, match=r"changed since \(table\.csv\)"):
        work(tmp_path)


def test_after_an_error_results_belong_to_the_program_and_nothing_else_is_listed(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        work(tmp_path, then=raises(RuntimeError()))
    assert written_by_us(tmp_path) == ["pictures", "table.csv"]
    assert set(json.loads((tmp_path / WRITTEN).read_text())) == {"pictures", "table.csv"}
    (tmp_path / "page.html").write_text("by hand")
    with pytest.raises(StoreError, match=NOT_OURS):
        work(tmp_path)


def test_a_run_that_wrote_nothing_leaves_nothing(tmp_path: Path) -> None:
    with output(tmp_path / "out", *NAMES):
        pass
    assert everything(tmp_path / "out") == {}


def test_after_a_kill_the_same_command_goes_on(tmp_path: Path) -> None:
    pid = os.fork()
    if not pid:
        work(tmp_path, then=lambda: os._exit(9))
    os.waitpid(pid, 0)
    assert (tmp_path / "table.csv").read_text() == "made"
    assert work(tmp_path, "again").read_text() == "again"


def raises(error: Exception) -> Callable[[], None]:
    def end() -> None:
        raise error

    return end


@pytest.mark.parametrize("content", ["", "{", "[]", "[" * 100_000, '{"table.csv": 1}'])
def test_a_damaged_list_names_nothing(tmp_path: Path, content: str) -> None:
    work(tmp_path)
    (tmp_path / WRITTEN).write_text(content)
    with pytest.raises(StoreError, match=NOT_OURS):
        work(tmp_path)


def test_a_file_beside_others_is_not_lost_and_its_folder_is_free_meanwhile(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text("by hand")
    for name in ("mine.toml", "mine.light.csv"):
        (tmp_path / name).write_text("by hand")
        with pytest.raises(StoreError, match=NOT_OURS):
            fitted(tmp_path / "mine.toml")
        (tmp_path / name).unlink()
    fitted(tmp_path / "mine.toml")
    fitted(tmp_path / "mine.toml", "again")
    assert written_by_us(tmp_path) == ["mine.light.csv", "mine.toml"]
    with output_file(tmp_path / "other.toml"), lock_folder(tmp_path):
        pass
    fitted(None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.light.csv", "mine.toml"], "the user's folder shows results alone"


def test_a_file_is_written_where_the_home_takes_no_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/proc/nowhere")
    fitted(tmp_path / "mine.toml")
    with pytest.raises(StoreError, match=NOT_OURS):
        fitted(tmp_path / "mine.toml")


def test_single_files_and_results_may_share_a_folder(tmp_path: Path) -> None:
    fitted(tmp_path / "mine.toml")
    work(tmp_path)
    fitted(tmp_path / "mine.toml", "again")
    assert work(tmp_path, "again").read_text() == "again"
    assert written_by_us(tmp_path) == ["mine.light.csv", "mine.toml", "pictures", "table.csv"]


def test_a_name_with_brackets_is_no_pattern(tmp_path: Path) -> None:
    (tmp_path / "m1.toml").write_text("by hand")
    fitted(tmp_path / "m[1].toml")
    with pytest.raises(StoreError, match=r"\(m\[1\]\.toml\)"):
        (tmp_path / "m[1].toml").write_text("changed")
        fitted(tmp_path / "m[1].toml")
    assert (tmp_path / "m1.toml").read_text() == "by hand"


def _file(path: Path) -> Path:
    path.write_text("by hand")
    return path


PLACES = {
    "a file": _file,
    "below a file": lambda path: _file(path) / "below",
    "a pipe": lambda path: os.mkfifo(path) or path,
    "a link to nowhere": lambda path: path.symlink_to("/proc/nowhere") or path,
    "a name too long": lambda path: path.with_name("n" * 300),
    "where nothing can be made": lambda path: Path("/proc/nowhere"),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("opened", [lambda path: output(path, *NAMES), lambda path: output_file(path / "mine.toml")])
def test_a_place_that_cannot_be_written_is_told_before_the_work(tmp_path: Path, place: str, opened) -> None:
    path = PLACES[place](tmp_path / "there")
    with pytest.raises(StoreError, match=r"can't be written \(.*\); \w+") as told, opened(path):
        pytest.fail("the work began")
    assert path.name in str(told.value)


def test_a_full_disk_is_told_by_the_path(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"out.*can't be written \(No space left.*free some space"):
        work(tmp_path / "out", then=raises(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
    with pytest.raises(OSError, match="No such device"):  # anything else is none of the output's
        work(tmp_path / "out", then=raises(OSError(errno.ENODEV, os.strerror(errno.ENODEV))))


def test_one_run_at_a_time_and_whoever_holds_a_folder_may_open_it_again(tmp_path: Path) -> None:
    told: list[str] = []

    def other() -> None:
        try:
            work(tmp_path)
        except StoreError as error:
            told.append(str(error))

    with output(tmp_path, *NAMES):
        work(tmp_path)
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert len(told) == 1
    assert "another run is at work there" in told[0]
    other()
    assert len(told) == 1


def test_a_function_that_is_to_write_has_the_parameter(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="no parameter 'nowhere'"):
        writes("a", to="nowhere")(work)


def test_a_surface_is_there_whole_or_not_at_all_and_a_full_disk_ends_no_process(tmp_path: Path) -> None:
    """VTK's own writer ends the process by a segmentation fault where the disk is full."""
    surface = pv.Sphere()
    surface.point_data["displacement_mm"] = np.linspace(0, 1, surface.n_points)
    path = write_surface(tmp_path / "skin.vtp", surface)
    whole, read = path.read_bytes(), pv.read(path)
    assert np.array_equal(read.points, surface.points) and np.array_equal(read.faces, surface.faces)
    assert np.array_equal(read.point_data["displacement_mm"], surface.point_data["displacement_mm"])

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    try:
        with pytest.raises(StoreError, match=r"skin\.vtp: can't be written"):
            write_surface(path, surface)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == whole and contents(tmp_path) == [path.name]


def test_a_full_standard_output_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        monkeypatch.setattr(sys, "argv", ["twin", "sensors"])
        with pytest.raises(SystemExit) as end:
            main()
    assert end.value.code == 1
    error = capsys.readouterr().err
    assert error.startswith("twin: error: the standard output or a cache: can't be written (No space left on device); free")
    assert error.count("\n") == 1


def test_a_result_that_cannot_be_written_is_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    texts = {"mine.pins.csv": "1,2\n", "mine.toml": "a = 1\n"}
    with pytest.raises(StoreError, match=r"mine\.pins\.csv: can't be written.*printed") as error:
        write_result(tmp_path / "nowhere", texts)
    assert error.value.unsaved == texts

    def fail() -> None:
        raise error.value

    monkeypatch.setattr("twin.cli.command_line", lambda: lambda prog_name: fail())
    with pytest.raises(SystemExit):
        main()
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and all(name in said.out and text in said.out for name, text in texts.items())
    with Path("/dev/full").open("w") as full, pytest.raises(SystemExit) as end:
        monkeypatch.setattr(sys, "stdout", full)
        main()
    assert end.value.code == 1 and capsys.readouterr().err.count("\n") == 1
    write_result(tmp_path, texts)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == texts


def test_a_file_that_a_run_goes_on_from_is_left_to_that_run(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("by hand")
    with pytest.raises(StoreError, match=NOT_OURS), output(tmp_path, gone_on=("state",)):
        pass
    (tmp_path / "state").unlink()
    with output(tmp_path, gone_on=("state",)):
        write_text(tmp_path / "state", "begun")
    (tmp_path / "state").write_text("damaged")
    with output(tmp_path, gone_on=("state",)):
        assert (tmp_path / "state").read_text() == "damaged"


@pytest.mark.parametrize("wrote", [False, True])
def test_a_failed_run_leaves_no_empty_folder(tmp_path: Path, wrote: bool) -> None:
    folder = tmp_path / "new" / "out"

    @writes(*NAMES)
    def fails(out: Path) -> None:
        if wrote:
            write_text(out / "table.csv", "half")
        raise ValueError("no such sensor")

    with pytest.raises(ValueError, match="no such sensor"):
        fails(folder)
    assert folder.exists() == wrote and (tmp_path / "new").exists() == wrote
    (tmp_path / "there").mkdir()
    with pytest.raises(ValueError, match="no such sensor"):
        fails(tmp_path / "there")
    assert (tmp_path / "there").exists()  # it was not made by the run


def test_a_failed_run_keeps_the_folder_in_which_another_will_write(tmp_path: Path) -> None:
    out = tmp_path / "new"
    with output_file(out / "b.toml"):
        with pytest.raises(ValueError, match="no fit"), output_file(out / "a.toml"):
            raise ValueError("no fit")
        write_text(out / "b.toml", "fitted")
    assert written_by_us(out) == ["b.toml"]


def test_a_failed_run_leaves_no_empty_folder_around_a_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no fit"), output_file(tmp_path / "new" / "mine.toml"):
        raise ValueError("no fit")
    assert not (tmp_path / "new").exists()
