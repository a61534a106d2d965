"""The studio's path tracer in its own process: it never locks up, traces the newest, saves contacts, and its end is told."""

import time
from contextlib import closing

import numpy as np
import pytest

from scenes import load_object, load_sensor
from twin.mechanics.solver import SkinSolver
from twin.optics.preview import Shading
from twin.studio.camera import dome_window
from twin.studio.pose import PressedPose
from twin.studio.worker import Failed, Saved, Traced, Tracer
from twin.types import Form

SENSOR = load_sensor("mg400-127")
WAIT_S = 180.0


def await_outcomes(tracer, enough):
    found, end = [], time.monotonic() + WAIT_S
    while not enough(found):
        assert time.monotonic() < end, found
        found += tracer.outcomes()
        time.sleep(0.02)
    return found


@pytest.fixture(scope="module")
def tracer():
    with closing(Tracer(SENSOR)) as made:
        yield made


def test_many_jobs_and_nobody_who_listens_lock_nothing_up(tracer):
    """Both ends once waited for each other: the process to be heard, and the studio to be let in."""
    rest = SkinSolver(SENSOR).rest()
    begun = time.monotonic()
    for number in range(1, 41):
        tracer.trace(number, rest)
        time.sleep(0.05)
    assert time.monotonic() - begun < WAIT_S / 2
    found = await_outcomes(tracer, lambda all_: any(isinstance(each, Traced) and each.solved == 40 and not each.rough for each in all_))
    assert isinstance(found[0], Shading)
    traced = [each for each in found if isinstance(each, Traced)]
    places = [(each.solved, not each.rough) for each in traced]
    assert places == sorted(set(places)) and all((each.solved, False) in places for each in traced)
    x0, y0, x1, y1 = dome_window(SENSOR)
    assert traced[-1].light.shape == (y1 - y0, x1 - x0) and np.isfinite(traced[-1].light).all()


def test_a_contact_is_saved_as_twin_render_does(tracer, tmp_path):
    rest = SkinSolver(SENSOR).rest()
    tracer.save(tmp_path, load_object("sphere"), PressedPose(depth_mm=-2.0, indent_mm=-2.0), rest, Form.RAW)
    (saved,) = await_outcomes(tracer, lambda all_: any(isinstance(each, Saved | Failed) for each in all_))
    assert isinstance(saved, Saved), saved
    names = {path.name for path in saved.written}
    assert {"frame.png", "truth.npz", "truth.json", "skin.vtp"} <= names and all(path.is_file() for path in saved.written)


def test_the_end_of_the_process_is_told_once_and_later_jobs_are_dropped():
    with closing(Tracer(SENSOR)) as tracer:
        tracer.start()
        tracer._process.kill()
        (failed,) = await_outcomes(tracer, lambda all_: len(all_) > 0)
        assert isinstance(failed, Failed) and failed.tracing and "has ended" in failed.reason
        tracer.trace(1, SkinSolver(SENSOR).rest())
        assert tracer.outcomes() == []
