"""Distribution of work: in this process, to processes of this machine, or to the workers of a cluster (Dask)."""

import logging
import os
import pickle
import signal
import threading
import traceback
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

from twin.errors import DatasetError, ErrorsAs, TwinError, WorkersError, warn_once
from twin.store import fingerprint

if TYPE_CHECKING:
    from distributed import Client, Future

# Number of tasks that each worker of a cluster has at a time. With two, a worker does not wait after a finished task, and an interruption
# loses little work.
AHEAD = 2
# Largest number of attempts at a task. If its process is lost in all of them, the task is given up.
TRIES = 4
# Longest wait for a result of a cluster, in s. After it, the workers are counted again.
LOOK_S = 1.0
# Longest wait for the first worker of a scheduler, in s.
JOIN_S = 60.0
AGAIN = "what is done is kept, and the same command resumes from there"

Task = TypeVar("Task")
Made = TypeVar("Made")
Begin = Callable[..., Callable[[Task], Made]]
"""Function that returns the function for all tasks. It is defined in a module, so that another process can import it."""


def in_processes(begin: Begin[Task, Made], given: tuple[object, ...], tasks: Sequence[Task], *, processes: int) -> Iterator[Made]:
    """Yield ``begin(*given)(task)`` for each task, in the order in which the calls end.

    The processes end when this process ends, whatever the cause. Only this process reacts to Ctrl-C, and ends the others at once. A lost
    process is replaced, and its task is started again after the other tasks. If several processes give the same warning, this process gives
    it once.

    Parameters
    ----------
    begin : callable
        Returns the function for all tasks. Each process calls it once.
    given : tuple
        Arguments of ``begin``; they must be picklable.
    tasks : sequence
        Arguments of the function, one for each call; they must be picklable.
    processes : int
        Number of new (spawned) processes on this machine. With 1, all work is done in this process.

    Raises
    ------
    ValueError
        If ``processes`` is less than 1.
    WorkersError
        If a task lost its process ``TRIES`` times. All other tasks are done by then.
    """
    if processes < 1:
        raise ValueError(f"processes must be at least 1, got {processes}")
    if processes == 1 and tasks:
        yield from map(begin(*given), tasks)
        return
    pickled, waiting, lost = pickle.dumps((begin, given)), deque(range(len(tasks))), Counter[int]()
    busy: list[_Process] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < processes:
                busy.append(_Process(pickled))
                busy[-1].give(waiting[0], tasks[waiting.popleft()])
            ready = wait([process.pipe for process in busy])
            for process in [process for process in busy if process.pipe in ready]:
                try:
                    made, error, where, told = process.pipe.recv()
                except (EOFError, OSError):
                    busy.remove(process)
                    process.end()
                    lost[process.number] += 1
                    if lost[process.number] < TRIES:
                        waiting.append(process.number)
                    continue
                for message in told:
                    warn_once(message)
                if error is not None:
                    raise error from RuntimeError(f"in a process of its own:\n{where}")
                if waiting:
                    process.give(waiting[0], tasks[waiting.popleft()])
                else:
                    busy.remove(process)
                    process.end()
                yield pickle.loads(made)
    finally:
        for process in busy:
            process.end()
    if given_up := [number for number, times in lost.items() if times == TRIES]:
        ended = f"{len(given_up)} of {len(tasks)} tasks ended their process {TRIES} times"
        raise WorkersError(f"{ended}; is there enough memory for {processes}? {AGAIN}")


class _Process:
    """A new process that does one task at a time.

    Parameters
    ----------
    pickled : bytes
        ``begin`` and ``given`` of ``in_processes``. They are passed as bytes, because unpickling imports many modules: the process can
        start to watch its parent before that.
    """

    def __init__(self, pickled: bytes) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.number = -1
        self._process = context.Process(target=_serve, args=(theirs, pickled), daemon=True)
        try:
            with _deaf_to_ctrl_c():
                self._process.start()
        except BaseException:
            if self._process.pid is not None:
                self.end()
            raise
        theirs.close()

    def give(self, number: int, task: object) -> None:
        """Send the task with this number. If the process is already lost, reading from its pipe shows it later."""
        self.number = number
        with suppress(OSError):
            self.pipe.send(task)

    def end(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.join()
        self.pipe.close()


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Context in which SIGINT is delayed until its end. Processes that are started in it do not receive SIGINT."""
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()  # the first process would start it, and Python unblocks SIGINT after that
    heard: list[tuple[int, FrameType | None]] = []
    before = None
    if threading.current_thread() is threading.main_thread():  # another thread may receive SIGINT; Python would then raise it here
        before = signal.signal(signal.SIGINT, lambda number, frame: heard.append((number, frame)))
    masked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if hasattr(signal, "pthread_sigmask") else None  # not on Windows
    try:
        yield
    finally:
        if masked is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, masked)
        if before is not None:
            signal.signal(signal.SIGINT, before)
    if heard and callable(before):
        before(*heard[0])


def _serve(pipe: Connection, pickled: bytes) -> None:
    """Main loop of a separate process: for each task, send the result, or the error and its traceback, and the warnings."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    work: Callable[[Any], Any] | None = None
    while True:
        try:
            task = pipe.recv()
        except (EOFError, OSError):  # the parent process has ended
            return
        with warnings.catch_warnings(record=True) as caught:
            try:
                if work is None:
                    begin, given = pickle.loads(pickled)
                    work = begin(*given)
                made, error, where = pickle.dumps(work(task)), None, ""
            except Exception as arisen:
                made, error, where = pickle.dumps(None), _that_can_be_sent(arisen), traceback.format_exc()
        try:
            pipe.send((made, error, where, [str(each.message) for each in caught]))
        except OSError:
            return


def _end_with_parent() -> None:
    """End this process as soon as its parent has ended."""
    parent = parent_process()
    assert parent is not None, "this process was not started by another"
    wait([parent.sentinel])
    os._exit(1)


def _that_can_be_sent(error: Exception) -> Exception:
    """The error, or another one with the same text if it can't be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def outcomes(make: Callable[[str, int], Made], text: str, todo: list[int], *, workers: int, scheduler: str) -> Iterator[Made]:
    """Yield ``make(text, index)`` for each index, in the order in which the calls end.

    Parameters
    ----------
    make : callable
        A function of a module, so that another process can import it.
    text : str
        First argument of every call: the whole configuration as text.
    todo : list of int
        Second arguments of the calls.
    workers : int
        Number of processes of this machine (see ``in_processes``).
    scheduler : str
        Address of a Dask scheduler whose workers do the work; "" for processes of this machine.

    Raises
    ------
    WorkersError
        If a task lost its process on this machine ``TRIES`` times.
    DatasetError
        If the scheduler or its workers are lost, or if the workers run another version of this program.
    """
    if not todo:
        return
    if not scheduler:
        yield from in_processes(partial, (make, text), todo, processes=workers)
        return
    with _client(scheduler) as client:
        yield from _by_cluster(client, make, text, todo, scheduler)


def require_scheduler(address: str) -> None:
    """Raise ``DatasetError`` if no Dask scheduler answers. To be called before any file is written for its workers."""
    with _client(address):
        pass


@contextmanager
def _client(scheduler: str) -> Iterator["Client"]:
    """A client of a running scheduler."""
    import dask
    from distributed import Client

    def absent(error: Exception) -> DatasetError:
        return DatasetError(f"`scheduler` {scheduler}: no scheduler answers there ({error}); start one with 'dask scheduler'")

    with dask.config.set({"distributed.comm.timeouts.connect": "10s"}), _silence_dask():
        with ErrorsAs((OSError, ValueError), absent):
            client = Client(scheduler, timeout="10s")
        try:
            yield client
        finally:
            client.close(timeout=2)


@contextmanager
def _silence_dask() -> Iterator[None]:
    """Context without Dask's own log. It reports each lost connection in twenty lines; this program reports it in one."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]
    with ExitStack() as former:
        for logger in loggers:
            former.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL + 1)
        yield


def _by_cluster(client: "Client", make: Callable[[str, int], Made], text: str, todo: list[int], scheduler: str) -> Iterator[Made]:
    """The outcomes of a cluster. Only ``AHEAD`` tasks per worker are submitted at a time, so that tasks remain for new workers."""
    from distributed import CancelledError
    from distributed import wait as wait_for

    where = f"scheduler {scheduler}"
    absent = DatasetError(f"{where}: no worker has come within {JOIN_S:g} s; start some with 'dask worker {scheduler}'")
    with ErrorsAs(TimeoutError, lambda error: absent):
        client.wait_for_workers(1, timeout=JOIN_S)
    waiting, own = list(reversed(todo)), fingerprint(make)
    flying: dict[Future[Made], int] = {}
    while waiting or flying:
        try:
            room = AHEAD * max(1, len(client.scheduler_info(n_workers=-1)["workers"])) - len(flying)
            for _ in range(min(room, len(waiting))):
                index = waiting.pop()
                flying[client.submit(_make_with_same_code, make, text, index, own, pure=False)] = index
            done = set(wait_for(list(flying), timeout=LOOK_S, return_when="FIRST_COMPLETED").done)
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
    """Result of a call; raises the errors of ``outcomes`` if the call failed."""
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


def _make_with_same_code(make: Callable[[str, int], Made], text: str, index: int, expected: str) -> Made:
    """``make(text, index)`` on a worker; ``DatasetError`` if the worker's code differs from that of the client."""
    if fingerprint(make) != expected:
        raise DatasetError("a worker runs another version of this program, so its frames would differ; install the same version there")
    return make(text, index)
