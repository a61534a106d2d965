"""Handing out work: in this process, to processes of this machine, or to a cluster's workers (Dask)."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from training.generation.config import DatasetError
from twin.errors import TwinError

AHEAD = 2  # tasks for each worker on the way: a free one need not wait, and little is lost when all ends
LOOK_S = 1.0
JOIN_S = 60.0  # for the scheduler's first worker
PACKAGES = ("scenes", "twin", "training")
AGAIN = "what is done is kept, and the same command goes on from there"


def outcomes(make: Callable, text: str, todo: list[int], *, workers: int, scheduler: str) -> Iterator:
    """``make(text, index)`` for each index, in the order in which they end.

    Raises
    ------
    DatasetError
        The workers or the scheduler are lost, or are of another version of this program.
    """
    if not todo:
        return
    if workers == 1 and not scheduler:
        for index in todo:
            yield make(text, index)
        return
    with _client(min(workers, len(todo)), scheduler) as client:
        yield from _by_cluster(client, make, text, todo, scheduler)


@contextmanager
def _client(workers: int, scheduler: str) -> Iterator:
    import dask
    from distributed import Client, LocalCluster

    with dask.config.set({"distributed.comm.timeouts.connect": "10s"}):
        if scheduler:
            try:
                client = Client(scheduler, timeout="10s")
            except (OSError, ValueError) as error:
                raise DatasetError(
                    f"--scheduler {scheduler}: no scheduler answers there ({error}); start one with 'dask scheduler'"
                ) from error
            try:
                yield client
            finally:
                client.close(timeout=2)
            return
        options = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None, "silence_logs": 60}
        with LocalCluster(**options) as cluster, Client(cluster) as client:
            yield client


def _by_cluster(client, make: Callable, text: str, todo: list[int], scheduler: str) -> Iterator:
    from distributed import FIRST_COMPLETED, CancelledError, KilledWorker, TimeoutError, wait
    from distributed.comm import CommClosedError

    where = f"scheduler {scheduler}" if scheduler else "the worker processes"
    try:
        client.wait_for_workers(1, timeout=JOIN_S)
    except TimeoutError as error:
        raise DatasetError(f"{where}: no worker has come within {JOIN_S:g} s; start some with 'dask worker {scheduler}'") from error
    waiting, flying, own = list(reversed(todo)), {}, fingerprint()
    try:
        while waiting or flying:
            room = AHEAD * max(1, len(client.scheduler_info(n_workers=-1)["workers"])) - len(flying)
            for _ in range(min(room, len(waiting))):
                index = waiting.pop()
                flying[client.submit(_checked, make, text, index, own, pure=False)] = index
            try:
                done, _ = wait(list(flying), timeout=LOOK_S, return_when=FIRST_COMPLETED)
            except TimeoutError:
                if client.status != "running":
                    raise CommClosedError("connection lost") from None
                continue
            for future in done:
                outcome = future.result()
                del flying[future]
                yield outcome
    except KilledWorker as error:
        raise DatasetError(f"{where}: one contact ended its process several times ({error}); is there enough memory? {AGAIN}") from error
    except (CancelledError, CommClosedError, OSError) as error:
        if isinstance(error, TwinError):
            raise
        raise DatasetError(f"{where}: lost ({str(error) or type(error).__name__}); {AGAIN}") from error


def _checked(make: Callable, text: str, index: int, expected: str):
    if fingerprint() != expected:
        raise DatasetError("a worker runs another version of this program, its frames would differ; install the same one there")
    return make(text, index)


@cache
def fingerprint() -> str:
    """Hash of this program's own text: workers of another version would make other frames."""
    root = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(str(path.relative_to(root)).encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()
