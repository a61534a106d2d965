"""Compiles, ahead of the first use, what commands need: functions of the skin's mechanics, the rasteriser and the pin pipeline.

Numba stores the machine code on disk (`twin.compiled`), so that later processes load it. Parts are compiled in processes of their own. As
a program, this module compiles what a picture needs: the first contact of all starts it beside itself.
"""

import os
from collections.abc import Callable

from scenes import load_object, load_sensor
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.pins import Pipeline, node_features
from twin.progress import Progress, silent, stage
from twin.simulator import Simulator
from twin.workers import in_processes

SENSOR = "mg400-127"
COARSE = Resolution(6, 1, 1)
"""A mesh that is solved in no time; its functions are those of any mesh."""


def compile_ahead(*, progress: Progress = silent) -> None:
    """Compile each part. This takes about half a minute of each of two cores the first time, and some seconds later."""
    parts = [_press, _look]
    with stage(progress, "compiling") as step:
        for done, _ in enumerate(in_processes(_begin, (), parts, processes=min(len(parts), os.cpu_count() or 1)), 1):
            step(done, len(parts))


def _begin() -> Callable[[Callable[[], None]], None]:
    """The function for all parts, see ``in_processes``."""
    return lambda part: part()


def _press() -> None:
    """A contact with friction, which sticks and slips."""
    pose = ContactPose(indent_mm=1.0, shear_mm=(0.5, 0.0))
    SkinSolver(load_sensor(SENSOR), resolution=COARSE).press(load_object("sphere"), pose)


def _look() -> None:
    """A rasterised frame through the pipeline."""
    simulator = Simulator(load_sensor(SENSOR), quality="rasterised", solver=SkinSolver(load_sensor(SENSOR), resolution=COARSE))
    frame = simulator.render_rest().frame
    pipeline = Pipeline(simulator.spec, frame.form)
    seen = pipeline(frame)
    if seen.graph is not None:
        node_features(seen.graph, pipeline.reference)


if __name__ == "__main__":
    _look()
