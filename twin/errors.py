"""Errors and warnings for the user. The command line prints each of them as one line."""

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import MappingProxyType, ModuleType
from typing import Generic, TypeVar

E = TypeVar("E", bound=Exception)


def format_count(count: int, things: str) -> str:
    """A number of things in words: '3 rows of pins', '1 row of pins'. The first word of ``things`` is a plural that ends with s."""
    noun, space, rest = things.partition(" ")
    return f"{count} {noun.removesuffix('s') if count == 1 else noun}{space}{rest}"


class TwinError(Exception):
    """Base class of this program's own errors. The message states what was expected, what was found, and what to do."""


class OptionError(TwinError):
    """The value of an option, or a combination of options, is not valid for any files. The message names the option."""


class FrameError(TwinError):
    """A frame, video or recording can't be read, or does not fit the sensor."""


class ContactError(TwinError):
    """A contact can't be computed: it starts inside the object, is out of reach, or does not converge."""


class MeshError(TwinError):
    """An object's mesh can't be used: it is not closed, empty, or in a wrong unit."""


class RenderError(TwinError):
    """This machine can't render the requested picture."""


class StoreError(TwinError):
    """A result can't be written, a folder contains results of other code or inputs, or another run is using the folder.

    Attributes
    ----------
    unsaved : dict of str to str
        Text of each file that could not be written, by file name, if the result took long to compute. The command line prints these texts.
    """

    unsaved: Mapping[str, str] = MappingProxyType({})


class DatasetError(TwinError):
    """A data set can't be generated or continued."""


class WorkersError(TwinError):
    """Processes that share the work ended unexpectedly."""


class ExtraError(TwinError):
    """A library that is installed with an extra of this program is missing."""


@dataclass(frozen=True)
class ErrorsAs(Generic[E]):
    """Context in which errors of some kinds are raised as other errors, of which they are the cause."""

    kinds: type[E] | tuple[type[E], ...]
    other: Callable[[E], Exception]

    def __enter__(self) -> None:
        """Enter the context."""

    def __exit__(self, _: object, error: BaseException | None, trace: object) -> None:
        """Raise the other error."""
        if isinstance(error, self.kinds):
            raise self.other(error) from error


EXTRAS = {
    "cyclonedds": "ros2",
    "dask": "cluster",
    "distributed": "cluster",
    "gymnasium": "gym",
    "mcap": "records",
    "mujoco": "mujoco",
    "pyarrow": "records",
    "rerun": "rerun",
    "rosbags": "records",
    "stable_baselines3": "rl",
    "torch": "models",
    "viser": "studio",
    "websockets": "studio",
}
"""The extra that brings a library, by the name under which the library is imported."""


@contextmanager
def extras_named() -> Iterator[None]:
    """Context in which a missing library of an extra raises ``ExtraError``, which names the extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library not in EXTRAS:
            raise
        raise ExtraError(f"this needs {library}, which is not installed: pip install 'tactip-twin[{EXTRAS[library]}]'") from error


def library(name: str) -> ModuleType:
    """An optional library.

    Raises
    ------
    ExtraError
        It is not installed.
    """
    with extras_named():
        return import_module(name)


@cache
def warn_once(message: str) -> None:
    """Give a ``RuntimeWarning``. Each message is given only once per process."""
    warnings.warn(message, RuntimeWarning, stacklevel=3)
