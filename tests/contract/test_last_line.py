"""The last line of a command that lost its arm is short and true; signals have their own exit codes, at the start too."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from arms import bench

from hardware.errors import DeviceError, in_short
from hardware.servo.following import Followed
from hardware.servo.timing import TimeSpread, Timing
from hardware.servo.trajectory import Measures

LONGEST = 160
ENDS = """
import sys
from hardware.errors import DeviceError
from twin import cli
def fail(**_):
    lost = "MG400 at 1: the connection was lost; disconnect() and connect() again; "
    error = DeviceError(lost + 30 * "more " + "; can't be stopped and may move.")
    error.add_note("stop failed: the arm closed the connection")
    raise error
cli.command_line = lambda: fail
cli.main()
"""


def test_a_long_error_is_one_short_line_and_the_rest_is_in_a_file():
    ended = subprocess.run([sys.executable, "-c", ENDS], capture_output=True, text=True)
    (line,) = ended.stderr.splitlines()
    assert ended.returncode == 1 and len(line) <= LONGEST and "MAY STILL MOVE" in line.upper() and "connect()" not in line
    assert "stop failed" in Path(line.rpartition("details: ")[2]).read_text()


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("X: not connected; call connect() first", "X: not connected"),
        (
            "X: the port vanished. Switch it off if it moves!",
            "X: the port vanished. Switch it off if it moves!; the arm may still move: SWITCH IT OFF",
        ),
        ("X: can't be stopped and may move.", "X: can't be stopped and may move.; the arm may still move: PRESS ITS EMERGENCY STOP"),
    ],
)
def test_a_line_tells_what_the_arm_may_do_and_gives_no_advice_to_programs(text, line):
    assert in_short(text, LONGEST) == line
    assert len(in_short(text + 99 * " more", 90)) <= 90


def test_a_run_that_ended_early_says_so_in_a_short_line():
    nan = float("nan")
    spread, failure = TimeSpread(nan, nan, nan), "MG400 at 1: the connection was lost; call connect() again; " + 30 * "more " + "may move"
    run = Followed(Measures(*[nan] * len(fields(Measures))), Timing(0, 0, 0, spread, spread, spread, 0), None, None, failure, [])
    *_, line = run.lines()
    assert len(line) <= LONGEST and line.startswith("ended early: MG400") and line.endswith("PRESS ITS EMERGENCY STOP") and "()" not in line


SLOW_IMPORT = "import os, time\nprint('begun', flush=True)\ntime.sleep(30)\n"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_while_libraries_are_imported_ends_with_one_line(tmp_path, number, code):
    (tmp_path / "typer.py").write_text(SLOW_IMPORT, encoding="utf-8")
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": os.environ | {"PYTHONPATH": path}}
    with subprocess.Popen([sys.executable, "-m", "twin", "doctor"], **options) as process:
        process.stdout.readline()
        process.send_signal(number)
        process.send_signal(number)
        assert process.wait(timeout=10) == code and process.stderr.read().splitlines() == ["twin: interrupted"]


def test_a_pulled_cable_is_told_by_every_later_call():
    with bench("magician", time_scale=1.0) as at:
        at.arm.connect()
        at.arm.enable()
        at.arm.move_linear(at.home + np.array([0, 50.0, 0, 0, 0, 0]), wait=False)
        at.device.unplug()
        for call in (at.arm.state, at.arm.stop, at.arm.state):
            with pytest.raises(DeviceError, match="(?i)switch it off"):
                call()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_during_the_start_ends_with_one_line(number, code):
    wait = "(print('begun', flush=True), time.sleep(30))"
    start = f"import time; from twin import cli; cli.command_line = lambda: {wait}; cli.main()"
    with subprocess.Popen([sys.executable, "-c", start], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.readline()
        process.send_signal(number)
        time.sleep(0.05)
        process.send_signal(number)
        assert process.wait(timeout=10) == code and process.stderr.read().splitlines() == ["twin: interrupted"]
