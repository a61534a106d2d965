"""Files of a run. They are written as a whole, and checked when they are read: a damaged or wrong file is an error that names the file."""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from scenes.files import read_regular
from scenes.load import explain_problems
from scenes.sensor import SensorSpec
from training.errors import TrainingError
from training.models import model_named
from twin.store import write_with
from twin.types import Form

CONFIG = "config.json"  # the resolved configuration of a run
TENSORS = "weights.pt"  # the trained networks
CHECKPOINT = "checkpoint.pt"  # the state of training while the run is in progress
MAPS = "maps.safetensors"  # the model of contact maps
SLIP = "slip.safetensors"  # the model of slip
DISPLACEMENTS = "displacements.safetensors"  # the model of the pins' possible displacements
DOMAIN = "domain.safetensors"  # the patterns of pins that the run was trained on
BESIDE_FILES = (MAPS, SLIP, DISPLACEMENTS, DOMAIN)  # files that a run has beside its networks, if it learnt these models
LARGEST_CONFIG = 100_000_000  # bytes; a configuration names the frames kept out of training, and a million names take 20 MB
AGAIN = "train again, or copy the run's folder again"


class _Pipeline(BaseModel):
    form: Form
    graph: str


class _Config(BaseModel):
    """The part of ``config.json`` that a model needs. The rest describes its training."""

    model_config = ConfigDict(extra="ignore")

    model: str
    labels: str
    columns: Annotated[list[str], Field(min_length=1)]
    units: list[str]
    split: int | None
    size: dict[str, Annotated[int, Field(ge=0, le=100_000)]]
    rows: dict[str, object]
    sensor: SensorSpec
    pipeline: _Pipeline


def read_config(run: Path) -> dict[str, Any]:
    """The configuration of a run.

    Raises
    ------
    TrainingError
        The file can't be read, or a model can't be made from it.
    """
    path = run / CONFIG
    try:
        config = json.loads(read_regular(path, LARGEST_CONFIG).decode())
    except (OSError, ValueError, RecursionError) as error:
        raise damage_error(path, getattr(error, "strerror", None) or "no readable JSON") from error
    try:
        _Config.model_validate(config)
    except ValidationError as error:
        raise damage_error(path, explain_problems(error, _Config)) from error
    try:
        model_named(config["model"])
    except TrainingError as error:
        raise damage_error(path, str(error)) from error
    return config


def require_together(run: Path, config: Mapping[str, Any], content: Mapping[str, Any]) -> None:
    """Refuse weights that do not belong to the configuration beside them.

    Raises
    ------
    TrainingError
        The weights have other pins or another number of labels.
    """
    sensor = SensorSpec.model_validate(config["sensor"])
    pins, labels = len(content["reference_px"]), len(content.get("circular", content["shift"]))
    if pins != sensor.pins.count:
        raise damage_error(run / CONFIG, f"a sensor of {sensor.pins.count} pins, the weights are of {pins}")
    if not labels == len(config["columns"]) == len(config["units"]):
        raise damage_error(run / CONFIG, f"{len(config['columns'])} columns and {len(config['units'])} units, the weights are of {labels}")


def read_tensors(path: Path, remedy: str = AGAIN) -> dict[str, Any]:
    """Read a dict that ``write_tensors`` wrote.

    PyTorch itself does not compare the checksums in the file, so a single changed byte would change weights without an error.

    Parameters
    ----------
    remedy : str
        The remedy in the message if the file can't be used.

    Raises
    ------
    TrainingError
        The file can't be read, is damaged, or was not written by ``write_tensors``.
    """
    try:
        with zipfile.ZipFile(path) as file:
            changed = file.testzip()
        if changed:
            raise zipfile.BadZipFile("a checksum is wrong")
        content = torch.load(path, weights_only=True, map_location="cpu")
    except OSError as error:
        raise TrainingError(f"{path}: can't be read ({error.strerror or error}); {remedy}") from error
    except zipfile.BadZipFile as error:
        raise damage_error(path, "cut, changed, or no file of weights", remedy) from error
    except UnpicklingError as error:
        raise damage_error(path, "holds more than numbers, and is not loaded for that reason", remedy) from error
    except (RuntimeError, ValueError, KeyError, EOFError, TypeError, AttributeError, IndexError) as error:
        raise damage_error(path, "no file of weights", remedy) from error
    if not isinstance(content, dict):
        raise damage_error(path, "no file of weights", remedy)
    return content


def damage_error(path: Path, how: str, remedy: str = AGAIN) -> TrainingError:
    """The error for a file of a run that can't be used: it names the file, the damage, and the remedy."""
    return TrainingError(f"{path}: not of a run of this version, or damaged ({how}); {remedy}")


def write_tensors(path: Path, content: dict) -> None:
    """Write a dict of numbers, text, lists, arrays and tensors in the form that ``read_tensors`` reads."""
    write_with(path, lambda file: torch.save(_as_tensors(content), file))


def _as_tensors(value: object) -> object:
    """The same content with arrays as tensors, because PyTorch reads tensors without running code that a file may hold."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value)
    if isinstance(value, dict):
        return {key: _as_tensors(part) for key, part in value.items()}
    return [_as_tensors(part) for part in value] if isinstance(value, list) else value
