"""Time rendering, training and data sets with a GPU beside the same work without it, on the same few cores of one machine, in one run.

Run: PYTHONPATH=.:tests/helpers:tests/bench python tests/bench/bench_gpu.py [--cores 2] [--contacts 8]. Each measurement is a process of its
own that may use only these cores, because a Mitsuba variant, threads and a training device last as long as a process. Times are medians of
wall-clock time. The pictures of both are compared, too: the GPU must show the same light.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

BACKENDS = {"cpu": "llvm", "gpu": "cuda"}
SENSORS = ("mg400-331", "ur5-331")
SAMPLES, CONVERGED = (4, 64), 256  # samples per pixel: a data set's, a picture's; and of the pictures that are compared
MODELS = ("tac-vgnn", "vgnn", "cnn-v2")
BATCH, FRAMES = 128, 3763
REPEATS = 7


def limited(cores: int) -> None:
    """This process, and all that it starts, keep to the first cores. It is called before a library counts them."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(cores)


def rendering(side: str, work: Path, cores: int, sensor: str) -> dict[str, float]:
    """Ms of a new frame of a pressed sensor, by samples; leaves its converged picture, and another of other samples, in ``work``."""
    import drjit as dr
    import numpy as np
    from bench_render import Bench
    from image_error import timed_ms

    bench, found = Bench(sensor, REPEATS), {}
    for spp in SAMPLES:
        renderer = bench.renderer(spp)
        bench.frame(renderer, 0)
        dr.set_thread_count(cores)
        found[f"{spp}_samples"] = timed_ms(partial(bench.frame, renderer), bench.repeats)[0]
    renderer = bench.renderer(CONVERGED)
    np.save(work / f"{sensor}.{side}.npy", [renderer.render(bench.states[1], seed=seed) for seed in (1, 2)])
    return found


def training(side: str, work: Path, cores: int) -> dict[str, float]:
    """Seconds that each model takes for an epoch."""
    import torch
    from bench_training import drawn_table, inputs_of

    from training.studies.tac_vgnn.models import measure_training

    torch.set_num_threads(cores)
    pins = drawn_table("mg400-331", FRAMES)
    device = "cuda" if side == "gpu" else "cpu"
    timed = {model: measure_training(model, pins, inputs_of(model, pins), BATCH, device=device) for model in MODELS}
    return {model: found["ms_per_frame"] * FRAMES / 1e3 for model, found in timed.items()}


def dataset(side: str, work: Path, cores: int, contacts: int) -> dict[str, float]:
    """Labelled frames a second of a data set, all states of each contact, with a worker a core; their start counts."""
    from scenes import load_experiment, load_object, load_randomisation, load_sensor
    from training.generation import GenerationConfig, generate
    from twin.rig.kinematics import rig_of

    spec, plan = load_sensor("mg400-331"), load_experiment("surface-2d")
    config = GenerationConfig(
        sensor=spec, object=load_object(plan.object), experiment=plan, randomisation=load_randomisation("contact"),
        friction=rig_of(spec).friction, images="gray", states="all",
    )  # fmt: skip
    generate(work / f"warm.{side}", config, cores, workers=cores)  # kernels are compiled
    started = perf_counter()
    made = generate(work / f"data.{side}", config.model_copy(update={"seed": 1}), contacts, workers=cores)
    return {"frames_a_second": made.frames / (perf_counter() - started)}


PARTS = {"rendering": rendering, "training": training, "dataset": dataset}


def gpu_name() -> str:
    """What PyTorch calls the GPU; "" without one."""
    import torch

    return torch.cuda.get_device_name() if torch.cuda.is_available() else ""


def measured(part: str, side: str, work: Path, cores: int, **options: object) -> dict[str, float]:
    """The result of one measurement, in a process of its own."""
    command = [sys.executable, __file__, "--part", part, "--side", side, "--work", work, "--cores", cores, "--options", json.dumps(options)]
    environment = os.environ | {"TACTIP_VARIANT": BACKENDS[side]}
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, env=environment)
    if done.returncode:
        raise RuntimeError(f"{part} on the {side}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def measure(part: str, cores: int = 2, contacts: int = 8) -> dict[str, float]:
    """Print the rows of a part, and return their numbers by name: what each side needs, and for pictures how far they are apart."""
    found: dict[str, float] = {}

    def rows(unit: str, of: str = "", **options: object) -> None:
        """Measure on both sides; print and keep a row for each number."""
        without, using = (measured(part, side, Path(work), cores, **options) for side in BACKENDS)
        for key, before in without.items():
            name = ".".join(filter(None, (of, key)))
            faster = using[key] / before if unit == "1/s" else before / using[key]
            print(f"{part} {name:{37 - len(part)}s}{unit:>6s}{before:12.4g}{using[key]:10.4g}{faster:8.2f}", flush=True)
            found.update({f"{name}.cpu": before, f"{name}.gpu": using[key], f"{name}.faster": faster})

    with TemporaryDirectory() as work:
        if part == "training":
            rows("s")
        elif part == "dataset":
            rows("1/s", contacts=contacts)
        else:
            for sensor in SENSORS:
                rows("ms", sensor, sensor=sensor)
                found.update(differences(Path(work), sensor))
    return found


def differences(work: Path, sensor: str) -> dict[str, float]:
    """Gray levels and centroids (px), rms, of pictures of other samples off the processor's picture: its own, and the GPU's."""
    import numpy as np
    from bench_render import Bench

    pictures = {side: np.load(work / f"{sensor}.{side}.npy") for side in BACKENDS}
    truth, found = Bench(sensor, 1).truth(pictures["cpu"][0]), {}
    for side in BACKENDS:
        gray, rms, _ = truth.errors(pictures[side][1])
        print(f"{sensor}: other samples of the {side} off the cpu's picture: gray {gray:.3f} rms, centroids {rms:.4f} px", flush=True)
        found[f"{sensor}.off_gray.{side}"], found[f"{sensor}.off_px.{side}"] = gray, rms
    return found


def main() -> None:
    """Print the table; or, in a process that ``measured`` starts, a line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--contacts", type=int, default=8, help="of the data set")
    for hidden in ("--part", "--side", "--work", "--options"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    given = parser.parse_args()
    limited(given.cores)
    if given.part:
        options = json.loads(given.options)
        print(json.dumps(PARTS[given.part](given.side, Path(given.work), given.cores, **options)))
    elif not gpu_name():
        sys.exit("bench_gpu: PyTorch finds no GPU here")
    else:
        print(
            f"{platform.machine()}, {gpu_name()}; {given.cores} cores\n{'':44s}{'without GPU':>12s}{'with':>10s}{'faster':>8s}", flush=True
        )
        for part in PARTS:
            measure(part, given.cores, given.contacts)


if __name__ == "__main__":
    main()
