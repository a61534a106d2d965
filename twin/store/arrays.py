"""Files of arrays with a description, in the safetensors format, which contains no code.

See https://github.com/huggingface/safetensors. The format has no checksums, so the metadata contain a digest of the arrays.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from scenes.files import require_regular
from twin.errors import TwinError
from twin.store.atomic import write_bytes
from twin.store.output import output_file
from twin.types import FloatArray

ABOUT = "about"
"""Key of the arrays' description (JSON) in the metadata."""
DIGEST = "sha256"
"""Key of the arrays' digest in the metadata. Files of earlier versions have none."""

Layers = tuple[tuple[FloatArray, FloatArray], ...]
"""Weights (o, i) and offsets (o,) of a network's layers."""


@dataclass(frozen=True)
class ArrayFile:
    """A kind of file: its content, and the error for files that can't be used.

    Attributes
    ----------
    thing : str
        Name of the content, for messages.
    command : str
        Command that makes such a file.
    version : int
        Version of the content; a file of another version is refused.
    error : type of TwinError
        Type of the error if a file can't be used.
    again : str
        Remedy for a damaged file or a file of another version. Default: to make the file again with the command.
    """

    thing: str
    command: str
    version: int
    error: type[TwinError]
    again: str = ""

    def write(self, path: Path, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> int:
        """Write arrays and their description; returns the file's size in bytes."""
        whole = {key: np.ascontiguousarray(value) for key, value in arrays.items()}
        content = save(whole, {ABOUT: json.dumps({**about, "version": self.version}, sort_keys=True), DIGEST: _digest(whole)})
        with output_file(path):
            write_bytes(path, content)
        return len(content)

    def about(self, path: Path) -> dict[str, Any]:
        """The description of a file's arrays. The arrays are not read.

        Raises
        ------
        TwinError
            Of the type ``error``, if there is no such file, or if the file is not of this kind and version.
        """
        with self._convert_errors(path), safe_open(path, framework="numpy") as file:
            return self._about(path, file.metadata() or {})

    @contextmanager
    def open_arrays(self, path: Path) -> Iterator[tuple[dict[str, Any], dict[str, FloatArray]]]:
        """Context that yields the description of a file's arrays, and the arrays as float32.

        If the body of the context does not find a key or array that it needs, the file counts as damaged.

        Raises
        ------
        TwinError
            Of the type ``error``: as ``about``, and if the file is damaged.
        """
        with self._convert_errors(path):
            with safe_open(path, framework="numpy") as file:
                metadata = file.metadata() or {}
                about = self._about(path, metadata)
                arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (no mapping)
            if metadata.get(DIGEST, digest := _digest(arrays)) != digest:
                raise ValueError("changed since it was written")
            yield about, {key: array.astype(np.float32) for key, array in arrays.items()}

    def _about(self, path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
        about: dict[str, Any] = dict(json.loads(metadata[ABOUT]))
        if about.pop("version") != self.version:
            raise self.error(f"{path}: of another version of this program; {self._remedy}")
        return about

    @property
    def _remedy(self) -> str:
        return self.again or f"make it again with '{self.command}'"

    @contextmanager
    def _convert_errors(self, path: Path) -> Iterator[None]:
        """Context that converts the errors of a file to errors of the type ``error``, on one line and with the remedy."""
        try:
            require_regular(path)
            yield
        except FileNotFoundError:
            raise self.error(f"{path}: no such file; make one with '{self.command}'") from None
        except OSError as error:
            raise self.error(f"{path}: can't be read ({error.strerror or error}); give a file of '{self.command}'") from error
        except (SafetensorError, KeyError, IndexError, ValueError, TypeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise self.error(f"{path}: damaged, or no {self.thing} ({reason}); {self._remedy}") from error


def through_layers(
    layers: Layers, x: FloatArray, activation: Callable[[FloatArray], FloatArray], product: Callable[..., FloatArray] = np.matmul
) -> FloatArray:
    """Output (B, o) of a network for inputs (B, i), with ``activation`` between its layers; ``product`` multiplies two matrices."""
    for number, (weights, offset) in enumerate(layers):
        x = product(x, weights.T) + offset
        if number < len(layers) - 1:
            x = activation(x)
    return x


def silu(x: FloatArray) -> FloatArray:
    """The activation x times the logistic function of x."""
    return x / (1 + np.exp(-x))


def layers_to(layers: Layers, name: str = "layers") -> dict[str, np.ndarray]:
    """A network's layers as arrays by name."""
    return {f"{name}.{n}.{part}": array for n, layer in enumerate(layers) for part, array in zip(("weights", "offset"), layer, strict=True)}


def layers_from(arrays: Mapping[str, FloatArray], name: str = "layers") -> Layers:
    """The layers that ``layers_to`` stored among ``arrays`` under a name; empty if there are none.

    Raises
    ------
    KeyError
        If a part of a layer is missing.
    """
    count = sum(key.startswith(f"{name}.") and key.endswith(".weights") for key in arrays)
    return tuple((arrays[f"{name}.{n}.weights"], arrays[f"{name}.{n}.offset"]) for n in range(count))


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    found = hashlib.sha256()
    for key in sorted(arrays):
        found.update(f"{key} {arrays[key].dtype.str} {arrays[key].shape} ".encode())
        found.update(np.ascontiguousarray(arrays[key]).tobytes())
    return found.hexdigest()
