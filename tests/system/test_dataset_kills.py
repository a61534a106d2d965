"""Killed at any moment, a data set in the making loses what was on its way and nothing else."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from command import run_twin
from small_generation import ACROSS, EXPERIMENT, SENSOR, contents

ROOT = Path(__file__).parents[2]
COUNT, SLOW_COUNT, SLOW_MOMENTS = 10, 30, 20
PATIENCE_S = 120.0
ADDRESS = "tcp://127.0.0.1:{port}"


class Job:
    """A ``twin dataset`` command over one folder, which can be started again and again."""

    def __init__(self, home: Path, count: int) -> None:
        self.out, self.count = home / "set", count
        self.experiment = home / "gentle.toml"
        self.experiment.write_text(EXPERIMENT)

    def arguments(self, workers: int, *options: str) -> list[str]:
        """Of ``twin``."""
        fixed = ["dataset", "--experiment", self.experiment, "--sensor", SENSOR, "--images", "none", "--randomise", "contact"]
        sized = ["--count", self.count, "--elements", ACROSS, "--out", self.out]
        return [str(part) for part in (*fixed, *sized, "--workers", workers, *options)]

    def start(self, *options: str, workers: int = 1) -> subprocess.Popen:
        """In a process of its own, which can be killed."""
        command = "from twin.cli import main; main()"
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(
            [sys.executable, "-c", command, *self.arguments(workers, *options)], env=environment, stderr=subprocess.PIPE, text=True
        )

    def complete(self) -> None:
        """In this process and undisturbed."""
        done = run_twin(*self.arguments(1))
        assert done.returncode == 0, done.stderr

    def done(self) -> int:
        return len(list((self.out / "records").glob("*.npz")))

    def wait_for(self, count: int, process: subprocess.Popen) -> None:
        ends = time.monotonic() + PATIENCE_S
        while self.done() < count and process.poll() is None and time.monotonic() < ends:
            time.sleep(0.02)
        assert self.done() >= count, process.stderr.read() if process.poll() is not None else "too slow"

    def check_records(self) -> None:
        """Every record that is there is whole."""
        for path in (self.out / "records").glob("*.npz"):
            with np.load(path) as file:
                assert all(file[key].size for key in file.files)


def finish(process: subprocess.Popen, code: int = 0) -> str:
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, said
    return said


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    made = {}

    def get(count):
        if count not in made:
            job = Job(tmp_path_factory.mktemp("undisturbed"), count)
            job.complete()
            made[count] = contents(job.out)
        return made[count]

    return get


@pytest.mark.slow
def test_killed_twice_it_goes_on_to_the_same_bytes(tmp_path, undisturbed):
    job = Job(tmp_path, COUNT)
    for moment, workers in ((2, 1), (5, 2)):
        process = job.start(workers=workers)
        job.wait_for(moment, process)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        job.check_records()
        assert moment <= job.done() < COUNT and not (job.out / "targets.csv").exists()
    job.complete()
    assert contents(job.out) == undisturbed(COUNT)


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_a_killed_main_takes_its_workers_along(tmp_path, undisturbed):
    job = Job(tmp_path, COUNT)
    process = job.start(workers=2)
    job.wait_for(2, process)
    workers = [p for p in psutil.Process(process.pid).children(recursive=True) if "spawn_main" in " ".join(p.cmdline())]
    assert len(workers) == 2
    workers[0].kill()
    job.wait_for(5, process)
    alive = psutil.Process(process.pid).children(recursive=True)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    _, left = psutil.wait_procs(alive, timeout=PATIENCE_S)
    assert not left
    job.check_records()
    job.complete()
    assert contents(job.out) == undisturbed(COUNT)


@pytest.mark.slow
def test_a_lost_scheduler_ends_the_run_in_one_line(tmp_path, undisturbed):
    job, running = Job(tmp_path, COUNT), []
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}

    def dask(*arguments):
        command = [sys.executable, "-m", *arguments, "--dashboard-address", ":0"]
        running.append(subprocess.Popen(command, env=environment, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        return running[-1]

    address_file = tmp_path / "scheduler.json"
    try:
        scheduler = dask("distributed.cli.dask_scheduler", "--port", "0", "--host", "127.0.0.1", "--scheduler-file", str(address_file))
        worker = dask("distributed.cli.dask_worker", "--scheduler-file", str(address_file), "--nthreads", "1", "--death-timeout", "30")
        ends = time.monotonic() + PATIENCE_S
        while not address_file.exists() and time.monotonic() < ends:
            time.sleep(0.1)
        import json

        time.sleep(0.5)
        address = json.loads(address_file.read_text())["address"]
        process = job.start("--scheduler", address)
        job.wait_for(2, process)
        scheduler.kill()
        said = finish(process, 1)
        assert "Traceback" not in said and f"scheduler {address}: " in said and "goes on from there" in said
        worker.kill()
        job.check_records()
        said = finish(job.start("--scheduler", address), 1)
        assert "no scheduler answers there" in said
    finally:
        for process in running:
            process.kill()
    finish(job.start())
    assert contents(job.out) == undisturbed(COUNT)


@pytest.mark.slow
def test_killed_at_twenty_moments(tmp_path, undisturbed):
    job, generator = Job(tmp_path, SLOW_COUNT), np.random.default_rng(0)
    for moment in range(SLOW_MOMENTS):
        process = job.start(workers=1 + moment % 2)
        job.wait_for(min(job.done() + 1, SLOW_COUNT), process)
        time.sleep(generator.uniform(0, 0.4))
        process.kill()
        process.wait()
        job.check_records()
    finish(job.start())
    assert contents(job.out) == undisturbed(SLOW_COUNT)
