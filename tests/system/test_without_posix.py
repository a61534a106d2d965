"""Everything but the pseudo-terminal works without what only POSIX systems have, in child processes too."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from free_ports import free_offset

NO_POSIX = Path(__file__).parents[1] / "helpers" / "no_posix"
QUICK, SLOW = ("folders", "terminals", "press"), ("imports", "commands", "trace", "studio", "train", "servo")
WORK = [*QUICK, *(pytest.param(work, marks=pytest.mark.slow) for work in SLOW)]


@pytest.mark.parametrize("work", WORK)
def test_without_posix(work, tmp_path):
    paths = [str(NO_POSIX), str(Path(__file__).parents[2])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(NO_POSIX / "everyday.py"), work, str(free_offset())]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.rstrip().endswith("done"), done.stderr
