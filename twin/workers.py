"""Handing out work: in this process, to processes of this machine, or to a cluster's workers (Dask)."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from twin.errors import DatasetError, TwinError
from twin.store import fingerprint

if TYPE_CHECKING:
    from distributed import Client, Future

# Tasks that each worker has at a time. With two, a worker that ends one does not wait for the next, and an interruption loses little.
AHEAD = 2
# Longest wait for a result, in s, before the workers are counted again.
LOOK_S = 1.0
# Longest wait for the first worker of a scheduler, in s.
JOIN_S = 60.0
LOOPBACK = "127.0.0.1"
AGAIN = "what is done is kept, and the same command goes on from there"

Made = TypeVar("Made")


def outcomes(make: Callable[[str, int], Made], text: str, todo: list[int], *, workers: int, scheduler: str) -> Iterator[Made]:
    """Yield ``make(text, index)`` for each index, in the order in which the calls end.

    Parameters
    ----------
    make : callable
        A function of a module, so that another process can import it.
    text : str
        What every call is given: the whole configuration as text.
    todo : list of int
        What tells the calls apart.
    workers : int
        Processes of this machine. With 1 everything happens in this process.
    scheduler : str
        Address of a Dask scheduler whose workers do the work; "" for processes of this machine.

    Raises
    ------
    DatasetError
        The workers or the scheduler are lost, or they run another version of this program.
    """
    if not todo:
        return
    if workers == 1 and not scheduler:
        for index in todo:
            yield make(text, index)
        return
    with _client(min(workers, len(todo)), scheduler) as client:
        yield from _by_cluster(client, make, text, todo, scheduler)


def require_scheduler(address: str) -> None:
    """Raise ``DatasetError`` where no Dask scheduler answers, before anything is written for its workers."""
    with _client(1, address):
        pass


@contextmanager
def _client(workers: int, scheduler: str) -> Iterator["Client"]:
    """A client of a running scheduler, or of a cluster on this machine that ends with the context."""
    import dask
    from distributed import Client, LocalCluster

    with dask.config.set({"distributed.comm.timeouts.connect": "10s"}), _silenced():
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
        # Dask serves HTTP even without its dashboard, and does not ask for a password. So it may listen on this machine only.
        # Port 0 is any free port, because other clusters may run.
        local_only = {"dashboard": False, "dashboard_address": f"{LOOPBACK}:0"}
        with (
            LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host=LOOPBACK,
                silence_logs=logging.CRITICAL + 10,
                scheduler_kwargs=local_only,
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client


@contextmanager
def _silenced() -> Iterator[None]:
    """Context without Dask's own log. It reports each lost connection in twenty lines; this program reports it in one."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _by_cluster(client: "Client", make: Callable[[str, int], Made], text: str, todo: list[int], scheduler: str) -> Iterator[Made]:
    """The outcomes of a cluster: no worker is given more than ``AHEAD`` tasks, so that new workers find some, too."""
    from distributed import CancelledError, wait

    where = f"scheduler {scheduler}" if scheduler else "the worker processes"
    try:
        client.wait_for_workers(1, timeout=JOIN_S)
    except TimeoutError as error:
        raise DatasetError(f"{where}: no worker has come within {JOIN_S:g} s; start some with 'dask worker {scheduler}'") from error
    waiting, own = list(reversed(todo)), fingerprint(make)
    flying: dict[Future[Made], int] = {}
    while waiting or flying:
        try:
            room = AHEAD * max(1, len(client.scheduler_info(n_workers=-1)["workers"])) - len(flying)
            for _ in range(min(room, len(waiting))):
                index = waiting.pop()
                flying[client.submit(_checked, make, text, index, own, pure=False)] = index
            done = set(wait(list(flying), timeout=LOOK_S, return_when="FIRST_COMPLETED").done)
        except TimeoutError:
            done = set()
        except (CancelledError, OSError) as error:
            raise DatasetError(f"{where}: lost ({type(error).__name__}); {AGAIN}") from error
        if client.status != "running":
            raise DatasetError(f"{where}: the connection is lost; {AGAIN}")
        for future in done:
            index = flying.pop(future)
            yield _result(future, index, where)


def _result(future: "Future[Made]", index: int, where: str) -> Made:
    """What a call returned; the errors of ``outcomes`` where it did not return."""
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


def _checked(make: Callable[[str, int], Made], text: str, index: int, expected: str) -> Made:
    """``make(text, index)`` on a worker, if the worker's code is the same as ours."""
    if fingerprint(make) != expected:
        raise DatasetError("a worker runs another version of this program, so its frames would differ; install the same version there")
    return make(text, index)
