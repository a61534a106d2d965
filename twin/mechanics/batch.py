"""Solution of many contacts of one sensor in parallel processes."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import ContactError, MeshError
from twin.geometry.solid import Resolution
from twin.mechanics.balance import Friction
from twin.mechanics.path import ContactPath, ContactPose
from twin.mechanics.solver import SkinSolver
from twin.types import ContactState
from twin.workers import in_processes


@dataclass(frozen=True)
class ContactJob:
    """One contact to solve (see ``SkinSolver.path``); ``every_state`` keeps the states of all load steps, not only the last one."""

    obj: ObjectSpec
    pose: ContactPose | ContactPath
    friction: float | Friction | None = None
    every_state: bool = False


@dataclass(frozen=True)
class ContactOutcome:
    """Result of a job.

    Attributes
    ----------
    number : int
        Index of the job.
    states : list of ContactState
        Converged states in the order of the path: all of them with ``every_state``, else the last one; none if the job failed.
    error : str
        Message of the failure, "" if the job succeeded.
    """

    number: int
    states: list[ContactState]
    error: str = ""


def press_many(
    spec: SensorSpec, jobs: Sequence[ContactJob], *, processes: int = 1, resolution: Resolution | None = None
) -> Iterator[ContactOutcome]:
    """Solve contacts and yield their outcomes as they finish; the states do not depend on the number of processes.

    A contact that fails does not stop the others: its outcome contains the message.

    Parameters
    ----------
    spec : SensorSpec
    jobs : sequence of ContactJob
    processes : int
        Number of processes (see ``in_processes``).

    Raises
    ------
    ValueError
        ``processes`` is less than 1.
    WorkersError
        Processes died repeatedly.
    """
    yield from in_processes(_begin, (spec, resolution), list(enumerate(jobs)), processes=processes)


def _begin(spec: SensorSpec, resolution: Resolution | None) -> Callable[[tuple[int, ContactJob]], ContactOutcome]:
    return partial(_solve, SkinSolver(spec, resolution=resolution))


def _solve(solver: SkinSolver, task: tuple[int, ContactJob]) -> ContactOutcome:
    number, job = task
    try:
        states = [state for _, state in solver.path(job.obj, job.pose, friction=job.friction)]
    except (ContactError, MeshError) as error:
        return ContactOutcome(number, [], str(error))
    return ContactOutcome(number, states if job.every_state else states[-1:])
