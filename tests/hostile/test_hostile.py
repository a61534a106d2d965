"""No silent wrong answer, no traceback, nothing lost, nothing open to the network: the catalogue of hostile calls, over every command."""

from __future__ import annotations

import fnmatch
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from forked_program import Ended, Limits, Program
from generators import commands
from hostile_catalogue import CATALOGUE
from hostile_entry import REFUSED, USAGE, Entry
from hostile_inputs import SENSOR, Harmless, copied
from hostile_known import KNOWN

from twin.store import written_by_us
from twin.store.atomic import LOCK
from twin.store.output import WRITTEN

SLOW_MACHINE = 4.0  # times the seconds of an entry, where other work shares the machine
HANGS_S = 10.0  # for entries that are known not to end, which are not waited for longer
PROGRESS = re.compile(  # what only progress prints: bars, or a line every ten seconds
    r"[━╸╺⠀-⣿]|\d/\d+ .*(\d:\d\d:\d\d|-:--:--)|^waiting for a frame, \d+ s so far|^(?!twin: )(at work|.+: (begun|\d+%|\d+ of \d+)(, .*)?)$"
)
ERROR = "twin: error: "
NOTED = re.compile(r"^twin: warning: .*(results|functions) can't be kept|^jit_kernel_write\(\)")  # a full disk may be that of caches, too
TOLD = re.compile(r"^twin: warning: 90 % intervals from \d+ frames that training did not see are too narrow; ")  # few frames were given
OWN = (LOCK, WRITTEN)  # what the store keeps in a folder for itself
VARYING = re.compile(r"\d+\.?\d* ms\b")


class Laboratory:
    """Where hostile calls are made, each in a folder of its own.

    Parameters
    ----------
    folder : Path
    program : Program
    """

    def __init__(self, folder: Path, program: Program) -> None:
        self.folder, self.program = folder, program
        (folder / "harmless").mkdir()
        self.good = Harmless(folder / "harmless", program)
        self._said: dict[str, str] = {}
        self._count = 0

    def problems(self, entry: Entry) -> list[str]:
        """Make an entry's call; what is wrong with how it ended."""
        call, place, paths = self._call(entry, harmless=False)
        if entry.first:
            done = self.program.call(*entry.first.format_map(paths).split(), folder=place / "here", limits=Limits(SLOW_MACHINE * 60))
            assert not done.exit, f"a harmless call failed: twin {entry.first}: {done.stderr[-2000:]}"
            for name, change in entry.then.items():
                change(paths[name])
        before = contents(place, paths["out"])
        written = set(files_in(paths["out"]))
        ended = self._end(entry, call, place, paths)
        found = how_it_ended(entry, ended)
        partial = [name for name in set(files_in(paths["out"])) - written if not any(fnmatch.fnmatch(name, kept) for kept in entry.leaves)]
        if ended.exit and partial:
            found.append(f"left behind: {', '.join(sorted(partial)[:5])}")
        strange = set(not_entered(paths["out"])) - written
        if strange:
            found.append(f"not listed as its own: {', '.join(sorted(strange)[:5])}")
        after = contents(place, paths["out"])
        touched = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
        if touched:
            found.append(f"touched: {', '.join(sorted(touched)[:5])}")
        if entry.same and not ended.exit and self._plain(ended, place) != self._harmless_answer(entry):
            found.append("another answer than with the same input well written, and no word about it")
        if entry.fresh and not ended.exit:
            anew = [word.format_map(paths | {"out": place / "anew"}) for word in entry.call.split()]
            fresh = self._end(entry, anew, place, paths)
            if self._plain(fresh, place / "anew") != self._plain(ended, paths["out"]):
                found.append("another answer than begun again, and no word about it")
        shutil.rmtree(place)
        return found

    def _call(self, entry: Entry, *, harmless: bool) -> tuple[list[str], Path, dict[str, Path]]:
        self._count += 1
        place = self.folder / f"call_{self._count}"
        paths = {"out": place / "out"}
        names = set(re.findall(r"{(\w+)}", " ".join([entry.first, entry.call, *entry.env.values()])))
        for name in sorted(names):
            make = None if harmless and name == "data" else entry.make.get(name)
            if make or name != "out":
                (place / "in" / name).mkdir(parents=True)
                paths[name] = (make or copied("recording" if name == "data" else name))(place / "in" / name, self.good)
        (place / "here").mkdir(parents=True)
        if "{out}/" in entry.call:
            paths["out"].mkdir()
        return [word.format_map(paths) for word in entry.call.split()], place, paths

    def _end(self, entry: Entry, call: list[str], place: Path, paths: dict[str, Path]) -> Ended:
        seconds = HANGS_S if "did not end" in entry.known else SLOW_MACHINE * entry.seconds
        limits = Limits(seconds, 8 << 30, entry.file_bytes, *entry.end)
        env = {key: value.format_map(paths) for key, value in entry.env.items()}
        return self.program.call(*call, folder=place / "here", limits=limits, env=env)

    def _harmless_answer(self, entry: Entry) -> str:
        if entry.call not in self._said:
            call, place, paths = self._call(entry, harmless=True)
            self._said[entry.call] = self._plain(self._end(entry, call, place, paths), place)
            shutil.rmtree(place)
        return self._said[entry.call]

    @staticmethod
    def _plain(ended: Ended, place: Path) -> str:
        """What a call printed, without what varies: places, times, and notes about the input's form."""
        lines = ended.stdout.replace(str(place), "").splitlines()
        return "\n".join(VARYING.sub("ms", line) for line in lines if not line.startswith("note: "))


def files_in(folder: Path) -> list[str]:
    """Names of the files below a folder; the lock of a run may stay behind, and where it left results their list."""
    return [str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.name not in OWN] if folder.is_dir() else []


def not_entered(folder: Path) -> list[str]:
    """Names of the files below a folder that no list of results names, so that they would not be written again."""
    folders = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    entered = {each / name for each in folders for name in written_by_us(each)}
    return [name for name in files_in(folder) if entered.isdisjoint([folder / name, *(folder / name).parents])]


def contents(place: Path, out: Path) -> dict[str, object]:
    """What is below a place, but for ``out``: contents of files, targets of links, kinds of others."""
    found: dict[str, object] = {}
    for path in place.rglob("*"):
        name = str(path.relative_to(place))
        if path == out or out in path.parents or path.name == ".lock":
            continue
        if path.is_symlink():
            found[name] = path.readlink()
        elif path.is_file():
            found[name] = path.read_bytes()
        else:
            found[name] = path.stat().st_mode
    return found


def how_it_ended(entry: Entry, ended: Ended) -> list[str]:
    """What is wrong with exit code, messages, time, memory, processes and ports."""
    found = []
    said = ended.stdout + ended.stderr
    if ended.timed_out:
        found.append(f"did not end within {SLOW_MACHINE * entry.seconds:g} s")
    if "Traceback (most recent call last)" in said:
        last = [line for line in said.splitlines() if line and not line.startswith(" ") and not PROGRESS.search(line)][-1]
        found.append(f"traceback: {last[:200]}")
    if ended.exit not in entry.exit:
        found.append(f"exit {ended.exit}")
    lines = [line for line in ended.stderr.splitlines() if line.strip() and not PROGRESS.search(line)]
    if "Traceback" not in said:
        if ended.exit == REFUSED and not entry.end[0]:
            errors = [line for line in lines if line.startswith(ERROR)]
            if len(errors) != 1 or any(not NOTED.search(line) for line in lines if line not in errors):
                found.append(f"{len(errors)} lines of error among {len(lines)}: {' | '.join(lines)[-200:]}")
            elif len(errors[0]) > 1500 or not errors[0].isprintable():
                found.append(f"an error of {len(errors[0])} characters: {errors[0][:60]!r}")
            if "pydantic.dev" in said or "weights_only=False" in said or "allow_pickle=True" in said:
                found.append("quotes a library's advice")
        if ended.exit == USAGE and not (lines and lines[-1].startswith(("Error: ", ERROR))):
            found.append("usage without a line of error")
        if entry.end[0] and len(lines) > 2:
            found.append(f"{len(lines)} lines at its end")
        if not ended.exit and not entry.end[0] and (warned := [line for line in lines if not TOLD.search(line)]):
            found.append(f"warns: {warned[0][:200]}")
    missing = [word for word in entry.says if not any(either in said for either in word.split("|"))]
    if missing:
        found.append(f"does not say {', '.join(missing)}")
    if ended.peak_bytes > entry.gibibytes * 2**30:
        found.append(f"took {ended.peak_bytes / 2**30:.1f} GiB")
    if ended.left_running:
        found.append(f"left {ended.left_running} processes running")
    if ended.open_to_network:
        found.append(f"open to the network: {', '.join(ended.open_to_network)}")
    return found


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laboratory]:
    folder = tmp_path_factory.mktemp("hostile")
    with Program(folder / "home") as program:
        yield Laboratory(folder, program)


def check(laboratory: Laboratory, entry: Entry) -> None:
    found = laboratory.problems(entry)
    said = "; ".join(found)
    if entry.known:
        assert any(part in said for part in entry.known.split("|")), f"{entry.name}: change or remove its line in KNOWN: {found}"
    else:
        assert not found, f"{entry.name}: twin {entry.call}: {said}"


def test_a_sample_of_the_hostile_calls_ends_well(laboratory: Laboratory) -> None:
    for entry in (entry for entry in CATALOGUE if entry.sample):
        check(laboratory, entry)


@pytest.mark.slow
@pytest.mark.parametrize("entry", [pytest.param(entry, id=entry.name) for entry in CATALOGUE])
def test_a_hostile_call_ends_well(laboratory: Laboratory, entry: Entry) -> None:
    check(laboratory, entry)


TWO_AT_ONCE = {  # calls that take seconds, in one folder
    "train": f"train --model vgnn --sensor {SENSOR} --data {{recording}} --epochs 40 --members 1 --no-kernel --out {{out}}",
    "dataset": f"dataset --experiment {{experiment}} --sensor {SENSOR} --count 40 --images none --elements 6 --workers 1 --out {{out}}",
    "preprocess": f"preprocess {{recording}} --sensor {SENSOR} --overlay --out {{out}}",
}


@pytest.mark.slow
@pytest.mark.parametrize("command", TWO_AT_ONCE)
def test_of_two_runs_in_one_folder_one_is_told_to_wait(laboratory: Laboratory, tmp_path: Path, command: str) -> None:
    names = {"out": tmp_path / "out", "recording": laboratory.good.recording, "experiment": laboratory.good.experiment}
    call = TWO_AT_ONCE[command].format_map(names).split()
    with Program(tmp_path / "home") as other, ThreadPoolExecutor(2) as pool:
        other.call("--help", folder=tmp_path)  # so that both are ready
        both = [pool.submit(program.call, *call, folder=tmp_path, limits=Limits(240)) for program in (laboratory.program, other)]
        ended = sorted((each.result() for each in both), key=lambda each: each.exit)
    exits, words = [each.exit for each in ended], ended[1].stderr
    assert exits == [0, 1] and "another run" in words and "Traceback" not in words, [each.stderr[-500:] for each in ended]


def test_every_command_has_entries() -> None:
    names = {command.name for group in commands.groups() for command in group.commands}
    tried = Counter(entry.command for entry in CATALOGUE if entry.kind != "usage")
    lists = {"doctor", "demo"}  # that take no input
    assert len(names) > 20
    assert not [name for name in names if not tried[name] and name not in lists], "a command without hostile calls: add some"
    assert not [name for name in tried if name not in names], "hostile calls of a command that is not there"
    assert {entry.command for entry in CATALOGUE if entry.kind == "usage"} == names


def test_names_are_unique_and_known_faults_are_of_entries() -> None:
    names = Counter(entry.name for entry in CATALOGUE)
    assert not [name for name, count in names.items() if count > 1]
    assert not [name for name in KNOWN if name not in names]


@pytest.mark.slow
def test_the_laws_refuse_what_they_should() -> None:
    """The evaluate itself: each kind of bad end is called one."""
    good = Ended(1, "", f"{ERROR}f_3.png: cut; copy it again\n", 1.0, 1.0, 2**28, False, 0)
    entry = Entry("pictures", "cut", f"predict {SENSOR} x", says=("f_3.png",))
    assert how_it_ended(entry, good) == []
    for change in (
        {"exit": 0},
        {"exit": -11},
        {"stderr": "Traceback (most recent call last):\n  File\nValueError: x\nf_3.png\n"},
        {"stderr": f"{ERROR}f_3.png\nsecond line\n"},
        {"stderr": f"{ERROR}something\n"},
        {"stderr": "Aborted!\nf_3.png\n"},
        {"timed_out": True},
        {"peak_bytes": 2**33},
        {"left_running": 2},
        {"open_to_network": ["any address"]},
    ):
        assert how_it_ended(entry, Ended(**(vars(good) | change))), change
