"""What works where no extra is installed, and what a command says that needs one."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from small_generation import ACROSS, SENSOR, small_config

from training.generation import generate
from twin.store import code_of

CORE = Path(__file__).parents[1] / "helpers" / "core_alone.py"
WORKING = {
    "render": f"render --sensor {SENSOR} --object sphere --indent-mm 2 --quality rasterised --form processed --out frames",
    "preprocess": f"preprocess frames/frame.png --sensor {SENSOR} --out pins",
    "graph": f"graph frames/frame.png --sensor {SENSOR} --out graph",
    "new": "new frames/frame.png --layout hexagon:6 --out mine.toml",
    "tune": f"tune --frames frames/frame.png --sensor {SENSOR} --out tuned.toml",
    "check": f"check frames/frame.png --sensor {SENSOR}",
    "validate": f"validate --sensor {SENSOR} --frames taps --experiment gentle.toml --friction-frames 0 --elements {ACROSS} --out fit",
    "robustness": f"robustness --sensor {SENSOR} --pipeline twin --frames taps --conditions torn.toml --no-rendered --jobs 1 --out borne",
}
NEEDING = {
    "studio": "studio",
    "models": f"predict {SENSOR} frames/frame.png",
    "cluster": f"dataset --experiment surface-2d --sensor {SENSOR} --count 1 --scheduler tcp://127.0.0.1:1 --out set",
    "records": "convert taps --to mcap --out bags",
    "gym": f"learn --task EdgeFollow --sensor {SENSOR} --out learnt",
}


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """By command: its exit code and its errors. All run in one process, beside a small labelled recording."""
    work = tmp_path_factory.mktemp("core")
    generate(work / "taps", small_config(work, images="processed", quality="rasterised"), 4)
    (work / "torn.toml").write_text('steps = [1.0]\n[[condition]]\nname = "picture-torn"\n')
    commands = [*WORKING.values(), *NEEDING.values()]
    done = subprocess.run([sys.executable, str(CORE), *commands], cwd=work, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return dict(zip(commands, json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("name", WORKING)
def test_the_core_is_enough_for(ended, name):
    code, said = ended[WORKING[name]]
    assert code == 0, said


def test_calibration_needs_no_library_of_an_extra():
    """It takes minutes; the code behind it, with all that it imports, names none."""
    assert "torch" not in code_of("twin.calibration.optics", "twin.calibration.contact.calibrate", "twin.calibration.go_on").libraries


@pytest.mark.parametrize("extra", NEEDING)
def test_a_command_that_needs_an_extra_names_it_in_one_line(ended, extra):
    code, said = ended[NEEDING[extra]]
    assert code == 1 and said.count("\n") == 1
    assert said.endswith(f"pip install 'tactip-twin[{extra}]'\n")
