"""How fast the studio answers a client of its page."""

from functools import partial
from pathlib import Path

import bench_studio

from figures.jobs import FiguresError, Measured, Value, job

SECONDS = 60.0


def dragged(work: Path, *, sensor: str) -> Measured:
    """Random drags of a ball: the bench's figures. The studio is started before, so that what is kept between runs is there."""
    bench_studio.measure(sensor, "sphere", 5.0, work / "first")
    found = bench_studio.measure(sensor, "sphere", SECONDS, work / "studio")
    if found["stale"] or found["rests_without_their_pose"] or not found["in_order"]:
        raise FiguresError(f"the studio of {sensor} showed something stale: {found}")
    return {
        "answers_per_s": Value(found["answers_per_s"], "1/s"),
        "move_to_page_ms": Value(found["move_to_page_ms"][0], "ms"),
        "move_to_page_95_ms": Value(found["move_to_page_ms"][1], "ms"),
        "still_to_traced_s": Value(found["still_to_traced_s"][0], "s"),
        "still_to_traced_95_s": Value(found["still_to_traced_s"][1], "s"),
        "last_move_to_traced_s": Value(found["last_move_to_traced_s"][0], "s"),
        "first_picture_s": Value(found["first_picture_s"], "s"),
        "memory_mb": Value(max(found["memory_mb"]), "MB"),
        "load": Value(found["load"]),
    }


for name in ("mg400-331", "ur5-331"):
    job(
        f"studio.{name}",
        f"python tests/bench/bench_studio.py --sensor {name} --seconds {SECONDS:g}",
        sensors=(name,),
        code=("bench_studio", "twin.studio"),
        minutes=2,
    )(partial(dragged, sensor=name))
