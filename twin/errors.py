"""Errors and warnings that a user can act on; the command line prints each as one line."""

import warnings
from collections.abc import Mapping
from functools import cache
from types import MappingProxyType


class TwinError(Exception):
    """Base of the errors that are raised on purpose. The message says what was expected, what came, and what to do."""


class OptionError(TwinError):
    """An option's value, or options together, can't be meant, whatever the files hold. The message names the option."""


class FrameError(TwinError):
    """A frame, video or recording can't be read, or does not fit the sensor."""


class ContactError(TwinError):
    """A contact can't be computed: it starts inside the object, is out of reach, or does not converge."""


class MeshError(TwinError):
    """An object's mesh can't be used: it is not closed, empty, or in a wrong unit."""


class RenderError(TwinError):
    """This machine can't render what is asked for."""


class StoreError(TwinError):
    """A result can't be written, a folder holds results that were made otherwise, or another run works in it.

    Attributes
    ----------
    unsaved : dict of str to str
        Texts by the names of their files, where a result that took long could not be written; the command line prints them.
    """

    unsaved: Mapping[str, str] = MappingProxyType({})


class DatasetError(TwinError):
    """A data set can't be made or continued."""


class WorkersError(TwinError):
    """Processes that share work are lost."""


@cache
def warn_once(message: str) -> None:
    """Give a ``RuntimeWarning``, each message once in a process."""
    warnings.warn(message, RuntimeWarning, stacklevel=3)
