"""One run at a time in a folder."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from twin.errors import StoreError
from twin.store.atomic import unwritten

LOCK = ".lock"  # the file that the operating system's lock is on; it may stay behind


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder (made if missing) for this run alone; a run that is killed lets go of it.

    Raises
    ------
    StoreError
        Another run holds it, or it can't be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK)
        lock.acquire(blocking=False)
    except Timeout as error:
        raise StoreError(f"{folder}: another run is at work there; wait until it has ended, or give another --out") from error
    except OSError as error:
        raise unwritten(folder, error) from error
    try:
        yield
    finally:
        lock.release()
