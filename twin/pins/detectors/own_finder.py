"""A user's own code that finds pins: a function in a Python file, from an image to places.

It is named ``FILE.py:FUNCTION``. The function takes the picture of a frame, (H, W) or (H, W, 3) RGB uint8, and returns the places (n, 2) of
the pins that it finds: x (column) and y (row) in px of the picture, in any order. Rows that are not finite count as not found.
"""

import hashlib
import importlib.util
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs, FrameError, OptionError
from twin.pins.detectors.detector_spec import OWN, DetectorSpec, shipped_detector
from twin.types import Form, Frame


def is_own(text: str) -> bool:
    """Whether a text names a function in a Python file."""
    return text.rpartition(":")[0].endswith(".py")


def own_name(text: str) -> str:
    """The function's name in ``FILE.py:FUNCTION``, which is there and can be called.

    Raises
    ------
    OptionError
        There is no such file or function, or the file raises an error when it is run.
    """
    path, name = _parts(text)
    _function(path, name, _digest(path))
    return name


def own_detector(text: str, spec: SensorSpec, form: Form) -> DetectorSpec:
    """The detector that uses the function ``FILE.py:FUNCTION``; its name is the function's.

    Its code counts as changed when the file has changed. Other files that it imports are not looked at.

    Raises
    ------
    OptionError
        As `own_name`.
    """
    path, name = _parts(text)
    digest = _digest(path)
    _function(path, name, digest)
    own = {"name": name, "method": OWN, "finder": f"{path}:{name}", "finder_digest": digest}
    return shipped_detector(spec, form).model_copy(update=own)


def own_places(detector: DetectorSpec, frame: Frame) -> np.ndarray:
    """Places (n, 2) that the user's function finds in a frame, px.

    Raises
    ------
    FrameError
        The function raises an error, or what it returns are not places.
    """
    path, name = _parts(detector.finder)
    function = _function(path, name, detector.finder_digest)
    with ErrorsAs(Exception, lambda error: FrameError(f"{name} failed: {type(error).__name__}: {error}")):
        returned = function(frame.image.copy())
    try:
        px = np.asarray(returned, float)
    except (TypeError, ValueError):
        px = np.zeros(0)
        returned = type(returned).__name__
    if px.size == 0 and np.ndim(returned):
        return np.zeros((0, 2))
    if px.ndim != 2 or px.shape[1] != 2:
        got = f"an array {px.shape}" if px.size else str(returned)
        raise FrameError(f"{name} returned {got}; return places (n, 2): x (column) and y (row) in px of the picture")
    return px[np.isfinite(px).all(axis=1)]


def _parts(text: str) -> tuple[Path, str]:
    file, _, name = text.rpartition(":")
    return Path(file).resolve(), name


def _digest(path: Path) -> str:
    """Of the file's content."""
    with ErrorsAs(OSError, lambda error: OptionError(f"{path} can't be read ({error.strerror}); give FILE.py:FUNCTION")):
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


@cache
def _function(path: Path, name: str, digest: str) -> Callable[[np.ndarray], Any]:
    """The function of a file, which is run once for each of its contents. What lies beside the file can be imported by it."""
    described = importlib.util.spec_from_file_location(f"tactip_own_{digest}", path)
    if described is None or described.loader is None:
        raise OptionError(f"{path}: is no Python file; give FILE.py:FUNCTION")
    if _digest(path) != digest:
        raise OptionError(f"{path}: was changed during the work; give the same command again")
    module = importlib.util.module_from_spec(described)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    try:
        described.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise OptionError(f"{path}: ended with {type(error).__name__}: {error}; repair it, and try 'python {path.name}'") from error
    function = getattr(module, name, None)
    if not callable(function):
        there = [key for key, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__ and callable(value)]
        raise OptionError(f"{path}: has no function '{name}'; it has: {', '.join(there) or 'none'}")
    return function
