"""Making a data set: here, in processes of this machine, or on a cluster."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from training.generation.config import GenerationConfig
from training.generation.make import REST, make_contact
from training.generation.store import Store, refuse_foreign
from training.generation.work import outcomes
from twin.store import locked


@dataclass(frozen=True)
class Summary:
    """What a run made: contacts in the data set, frames, contacts that were there before, draws that failed in this run."""

    contacts: int
    frames: int
    before: int
    failed: int


def generate(
    folder: Path, config: GenerationConfig, count: int, *, workers: int = 1, scheduler: str = "", progress: Callable | None = None
) -> Summary:
    """Make a data set of ``count`` contacts, or go on with the one in the folder.

    What is made does not depend on ``workers``, ``scheduler``, or how often the work was broken off.

    Parameters
    ----------
    workers : int
        Processes on this machine; 1: in this very process.
    scheduler : str
        Address of a Dask scheduler whose workers do it instead.
    progress : callable, optional
        Called with (contacts done, contacts wanted).

    Raises
    ------
    DatasetError
        The folder holds another data set or more contacts than wanted, can't be written to, the workers are lost, or a
        contact can't be made.
    RenderError
        Nothing can be rendered there.
    StoreError
        Another run is at work in the folder, or another version of the program made what it holds.
    """
    refuse_foreign(folder)
    with locked(folder):
        store = Store(folder, config)
        done = store.finished()
        before = len(done - {REST})
        store.check_count(count)
        todo = [index for index in range(REST, count) if index not in done]
        made, failed = before, 0
        if progress:
            progress(made, count)
        for outcome in outcomes(make_contact, config.text(), todo, workers=workers, scheduler=scheduler):
            store.add(outcome)
            failed += len(outcome.failures)
            made += outcome.index != REST
            if progress:
                progress(made, count)
        return Summary(count, store.finish(count), before, failed)
