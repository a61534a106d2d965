"""What is compiled ahead is all that a press, a rasterised frame and its pins need."""

import os
import subprocess
import sys

import pytest


@pytest.mark.slow
def test_nothing_is_left_to_compile(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}

    def run(*arguments):
        subprocess.run([sys.executable, "-m", "twin", *arguments], env=environment, check=True, cwd=tmp_path)
        return {path.name for path in (tmp_path / "kept").rglob("*.nbi")}

    ahead = run("doctor", "--prepare")
    contact = ("--sensor", "mg400-331", "--object", "edge", "--indent-mm", "2", "--quality", "rasterised")
    assert ahead and run("render", *contact, "--out", "a") == ahead
