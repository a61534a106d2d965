"""Whoever asks is told how far work is: stages in their order, bars on a terminal, lines elsewhere."""

import io
import time

import pytest
from rich.console import Console

from twin.cli.progress import GOES_ON, Bars, Lines, show_progress
from twin.progress import silent, stage


class Heard:
    """A ``Progress`` that keeps what it is told."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []

    def __call__(self, stage, done, total, note="") -> None:
        self.calls.append((stage, done, total, note))


def test_a_stage_begins_unknown_and_tells_each_step_under_its_title():
    heard = Heard()
    with stage(heard, "frames") as step:
        step(1, 3)
        step(3, 3, "good")
    assert heard.calls == [("frames", 0, 0, ""), ("frames", 1, 3, ""), ("frames", 3, 3, "good")]


def test_a_stage_without_reports_counts_as_one_finished_item():
    heard = Heard()
    with stage(heard, "render"):
        pass
    assert heard.calls[-1] == ("render", 1, 1, "")


def test_a_stage_that_fails_is_not_told_as_done():
    heard = Heard()
    with pytest.raises(ValueError, match="no light"), stage(heard, "render"):
        raise ValueError("no light")
    assert heard.calls == [("render", 0, 0, "")]


def test_progress_is_optional():
    with stage(silent, "frames") as step:
        step(0.5)


def test_without_a_terminal_a_line_is_printed_every_ten_seconds_and_no_more_often():
    now_s, out = [0.0], io.StringIO()
    lines = Lines(out, clock=lambda: now_s[0])
    with stage(lines, "contacts") as step:
        for done in range(1, 41):
            now_s[0] += 1.0
            step(done, 40, "0.1 px")
    assert out.getvalue().splitlines() == [f"contacts: {n} of 40, 0.1 px" for n in (10, 20, 30, 40)]
    now_s[0] += 10.0
    lines("press", 0.25, 1.0)
    assert out.getvalue().splitlines()[-1] == "press: 25%"


def test_a_long_stage_is_a_line_for_each_tenth():
    now_s, out = [0.0], io.StringIO()
    lines = Lines(out, clock=lambda: now_s[0])
    with stage(lines, "contacts") as step:
        for done in range(1, 301):
            now_s[0] += 9.0
            step(done, 300, f"{done} px")
    said = out.getvalue().splitlines()
    assert len(said) == len(set(said)) == 11 and said[0].startswith("contacts: 2 of 300") and said[-1].startswith("contacts: 300 of 300"), (
        said
    )


def test_a_line_is_printed_also_while_nothing_is_reported():
    out = io.StringIO()
    with Lines(out, every_s=0.02) as lines:
        lines("mesh", 0, 0)
        wait_until(lambda: "mesh: begun" in out.getvalue())
        time.sleep(0.1)
        assert out.getvalue() == "mesh: begun\n", "no line comes twice"
        with stage(lines, "contacts") as step:
            step(3, 40)
            wait_until(lambda: "contacts: 3 of 40" in out.getvalue())
    said = out.getvalue()
    time.sleep(0.06)
    assert out.getvalue() == said, "a line after the end"


def wait_until(true):
    """Wait until something is true, at most for ten seconds."""
    ends = time.monotonic() + 10
    while not true() and time.monotonic() < ends:
        time.sleep(0.005)
    assert true()


def test_each_stage_has_a_bar_also_when_its_title_comes_again():
    console = Console(file=io.StringIO(), force_terminal=True, width=120, legacy_windows=False)
    bars = Bars(console)
    for _ in range(2):
        with stage(bars, "render for the caps") as step:
            step(2, 2)
    with stage(bars, "train") as step:
        step(1, 2, "0.0123")
    bars.close()
    shown = console.file.getvalue()
    assert shown.count("\n") >= 3 and "2/2" in shown and "train 0.0123" in shown and "1/2" in shown


@pytest.mark.parametrize("goes_on", [True, False])
def test_an_interrupted_command_says_whether_the_same_one_goes_on(goes_on):
    with pytest.raises(KeyboardInterrupt) as ended, show_progress(goes_on=goes_on):
        raise KeyboardInterrupt
    assert getattr(ended.value, "__notes__", []) == [GOES_ON] * goes_on
