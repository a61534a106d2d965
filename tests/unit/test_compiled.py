"""Compiled functions work where nothing can be kept, and say so once."""

import errno
import importlib.util
import os
import subprocess
import sys
import warnings

import numba
import pytest

from twin.compiled import compiled
from twin.errors import warn_once

SOURCE = "def doubled(x):\n    return 2 * x\n\n\ndef tripled(x):\n    return 3 * x\n"


@pytest.fixture
def functions(tmp_path, monkeypatch):
    """Functions of a module of their own, as numba keeps code by files."""
    (tmp_path / "functions.py").write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("functions", tmp_path / "functions.py")
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    warn_once.cache_clear()
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kept"))
    yield found.doubled, found.tripled
    warn_once.cache_clear()


def test_machine_code_is_kept(functions, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compiled()(functions[0])(2) == 4
    assert list((tmp_path / "kept").rglob("*.nbc"))


GENERATOR = """
import sys
from twin.compiled import compiled
@compiled()
def below(n):
    for k in range(n):
        yield k
@compiled()
def total(n):
    found = 0
    for k in below(n):
        found += k
    return found
print(sum(below(4)) if "generator" in sys.argv else total(4))
"""


def test_a_generator_that_another_process_compiled_can_be_called_by_compiled_code(tmp_path):
    (tmp_path / "generator.py").write_text(GENERATOR)
    for what in ("generator", "caller", "caller"):
        command = [sys.executable, "generator.py", what]
        env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        assert subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=True).stdout == "6\n"


def test_where_no_folder_can_be_written_it_is_compiled_all_the_same(functions, tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_LOCATOR_CLASSES", "ZipCacheLocator")  # of numba's places one that is none here
    with pytest.warns(RuntimeWarning, match="can't be kept .*no folder.*NUMBA_CACHE_DIR") as told:
        twice, thrice = (compiled(fastmath=True)(function) for function in functions)
    assert len(told) == 1 and (twice(2), thrice(2)) == (4, 6)


def test_a_full_disk_costs_the_kept_code_alone(functions, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    with pytest.warns(RuntimeWarning, match="kept.*No space left on device") as told:
        twice, thrice = (compiled()(function) for function in functions)
        assert (twice(2), thrice(2)) == (4, 6)
    assert len(told) == 1


def test_other_errors_of_the_compiler_are_not_taken_for_it(functions, monkeypatch):
    def broken(**_):
        raise RuntimeError("no such option")

    monkeypatch.setattr(numba, "njit", broken)
    with pytest.raises(RuntimeError, match="no such option"):
        compiled()(functions[0])


BESIDE = """
import subprocess, sys, time
from pathlib import Path
from functions import doubled
from twin.compiled import begin_compiling, compiled
class Counted(subprocess.Popen):
    def __init__(self, *given, **how):
        super().__init__(*given, **how)
        print("started", self.pid)
subprocess.Popen = Counted
function = compiled()(doubled)
if sys.argv[1] == "stored": function(2)
begin_compiling("beside", function)
begin_compiling("beside", function)
while sys.argv[1] == "new" and not Path("begun").exists(): time.sleep(0.01)
"""
ENDLESS = "import pathlib, time\npathlib.Path('begun').touch()\ntime.sleep(600)"


@pytest.mark.parametrize("how", ["new", "stored"])
def test_a_module_compiles_beside_what_is_not_stored_and_ends_with_the_program(how, functions, tmp_path):
    (tmp_path / "beside.py").write_text(ENDLESS)
    there = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]), "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    command = [sys.executable, "-c", BESIDE, how]
    done = subprocess.run(command, cwd=tmp_path, env=there, check=True, timeout=60, capture_output=True, text=True)
    started = [int(line.split()[1]) for line in done.stdout.splitlines()]
    assert len(started) == (how == "new")
    for process in started:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)
