"""Handing out work: in this process, to processes of this machine, or to a cluster's workers (Dask)."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from twin.errors import DatasetError, TwinError
from twin.store import fingerprint

if TYPE_CHECKING:
    from distributed import Client, Future

AHEAD = 2
"""Tasks on the way for each worker: a free worker need not wait, and little is lost when the work is stopped."""
LOOK_S = 1.0
"""Seconds to wait for a task before the connection is looked at again."""
JOIN_S = 60.0
"""Seconds to wait for the scheduler's first worker."""
LOOPBACK = "127.0.0.1"
"""Address of this machine for itself."""
AGAIN = "what is done is kept, and the same command goes on from there"
"""End of every message about work that was broken off."""


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

    with dask.config.set({"distributed.comm.timeouts.connect": "10s"}), _silenced():
        if scheduler:
            try:
                client = Client(scheduler, timeout="10s")
            except (OSError, ValueError) as error:
                raise DatasetError(f"--scheduler {scheduler}: none answers there ({error}); start one with 'dask scheduler'") from error
            try:
                yield client
            finally:
                client.close(timeout=2)
            return
        # Dask serves HTTP even without its dashboard, and asks nobody who they are: nothing may listen beyond this machine.
        nobody = {"dashboard": False, "dashboard_address": f"{LOOPBACK}:0"}  # any free port: other clusters may run
        with (
            LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host=LOOPBACK,
                silence_logs=logging.CRITICAL + 10,
                scheduler_kwargs=nobody,
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client


@contextmanager
def _silenced() -> Iterator[None]:
    """Without Dask's own log, which tells of every lost connection in twenty lines: this program says it in one."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _by_cluster(client: "Client", make: Callable, text: str, todo: list[int], scheduler: str) -> Iterator:
    """What the workers made, in the order in which they end; only a few tasks are on the way at a time."""
    from distributed import CancelledError, wait

    where = f"scheduler {scheduler}" if scheduler else "the worker processes"
    try:
        client.wait_for_workers(1, timeout=JOIN_S)
    except TimeoutError as error:
        raise DatasetError(f"{where}: no worker has come within {JOIN_S:g} s; start some with 'dask worker {scheduler}'") from error
    waiting, own = list(reversed(todo)), fingerprint(make)
    flying: dict[Future, int] = {}
    while waiting or flying:
        try:
            room = AHEAD * max(1, len(client.scheduler_info(n_workers=-1)["workers"])) - len(flying)
            for _ in range(min(room, len(waiting))):
                index = waiting.pop()
                flying[client.submit(_checked, make, text, index, own, pure=False)] = index
            done = wait(list(flying), timeout=LOOK_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            done = ()
        except (CancelledError, OSError) as error:
            raise DatasetError(f"{where}: lost ({type(error).__name__}); {AGAIN}") from error
        if client.status != "running":
            raise DatasetError(f"{where}: the connection is lost; {AGAIN}")
        for future in done:
            index = flying.pop(future)
            yield _result(future, index, where)


def _result(future: "Future", index: int, where: str) -> object:
    """What a task made.

    Raises
    ------
    DatasetError
        The task or its worker failed.
    """
    from distributed.scheduler import KilledWorker

    if future.status == "finished":
        return future.result()
    if future.status != "error":
        raise DatasetError(f"{where}: lost (contact {index} is {future.status}); {AGAIN}")
    error = future.exception()
    if isinstance(error, KilledWorker):
        raise DatasetError(f"{where}: contact {index} ended its process again and again; is there enough memory? {AGAIN}") from error
    if isinstance(error, TwinError):
        raise error
    raise DatasetError(f"{where}: contact {index}: {type(error).__name__}: {error}; {AGAIN}") from error


def _checked(make: Callable, text: str, index: int, expected: str) -> object:
    """Make one thing on a worker that runs the same code as the caller."""
    if fingerprint(make) != expected:
        raise DatasetError("a worker runs another version of this program, its frames would differ; install the same one there")
    return make(text, index)
