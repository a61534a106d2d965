"""How fast a GPU renders, trains and makes data sets, beside two cores of the same machine, in one run."""

from functools import partial
from pathlib import Path

import bench_gpu

from figures.jobs import Measured, Value, job

CORES = 2
CODE = {
    "rendering": ("bench_gpu", "bench_render"),
    "training": ("bench_gpu", "bench_training", "training.studies.tac_vgnn.models"),
    "dataset": ("bench_gpu", "training.generation"),
}


def beside_cores(work: Path, *, part: str) -> Measured:
    """All rows of the bench's table: what each side needs, how many times faster the GPU is, and how far the pictures are apart."""
    return {name: Value(value) for name, value in bench_gpu.measure(part, CORES).items()}


for _part, _code in CODE.items():
    job(f"gpu.{_part}", f"tests/bench/bench_gpu.py --cores {CORES}", sensors=bench_gpu.SENSORS, code=_code, minutes=2, gpu=True)(
        partial(beside_cores, part=_part)
    )
