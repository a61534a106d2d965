"""Many contacts of one sensor, in parallel processes."""

from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import get_context

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import ContactError, MeshError
from twin.geometry.solid import Resolution
from twin.mechanics.balance import Friction
from twin.mechanics.path import ContactPath, ContactPose
from twin.mechanics.solver import SkinSolver
from twin.types import ContactState

_solver: SkinSolver | None = None


@dataclass(frozen=True)
class ContactJob:
    """One contact to solve (see ``SkinSolver.path``); ``every_state`` keeps the states on the way, too."""

    touched: ObjectSpec
    pose: ContactPose | ContactPath
    friction: float | Friction | None = None
    every_state: bool = False


@dataclass(frozen=True)
class ContactOutcome:
    """What became of a job.

    Attributes
    ----------
    number : int
        Which of the jobs.
    states : list of ContactState
        Converged states, the end of the path last; one unless all were wanted, none where it failed.
    error : str
        Why it failed ("" if it did not).
    """

    number: int
    states: list[ContactState]
    error: str = ""


def press_many(
    spec: SensorSpec, jobs: Sequence[ContactJob], *, processes: int = 1, resolution: Resolution | None = None
) -> Iterator[ContactOutcome]:
    """Solve contacts, in the order in which they end; the states do not depend on the number of processes.

    A contact that fails does not end the others: its outcome says why.

    Parameters
    ----------
    spec : SensorSpec
    jobs : sequence of ContactJob
    processes : int
        1: in this process. More: fresh (spawned) processes.
    """
    if processes < 1:
        raise ValueError(f"processes must be at least 1, got {processes}")
    if processes == 1:
        solver = SkinSolver(spec, resolution=resolution)
        for number, job in enumerate(jobs):
            yield _solve(solver, number, job)
        return
    with ProcessPoolExecutor(processes, get_context("spawn"), _start, (spec, resolution)) as pool:
        waiting = {pool.submit(_work, number, job) for number, job in enumerate(jobs)}
        try:
            while waiting:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _start(spec: SensorSpec, resolution: Resolution | None) -> None:
    global _solver
    _solver = SkinSolver(spec, resolution=resolution)


def _work(number: int, job: ContactJob) -> ContactOutcome:
    assert _solver is not None, "the process was not started by press_many"
    return _solve(_solver, number, job)


def _solve(solver: SkinSolver, number: int, job: ContactJob) -> ContactOutcome:
    try:
        states = [state for _, state in solver.path(job.touched, job.pose, friction=job.friction)]
    except (ContactError, MeshError) as error:
        return ContactOutcome(number, [], str(error))
    return ContactOutcome(number, states if job.every_state else states[-1:])
