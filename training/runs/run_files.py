"""Files of a run. They are written as a whole, and checked when they are read: a damaged or wrong file is an error that names the file.

``pack`` writes a copy of a run that is small enough to be shipped with the package: ``config.json`` and ``weights.safetensors``. The arrays
are in the safetensors format (https://github.com/huggingface/safetensors), which holds no code. Large arrays are stored in half precision,
except those of a Gaussian process, because its terms nearly cancel. Each model decides which weights its small copy leaves out: see
``Model.pack``.
"""

import hashlib
import json
import zipfile
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from pickle import UnpicklingError
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load, save

from scenes.files import read_regular
from scenes.load import explain_problems
from scenes.sensor import SensorSpec
from training.errors import TrainingError
from training.models import model_named
from training.runs.config import ASIDE
from twin.errors import ErrorsAs
from twin.pins import make_reference
from twin.store import write_bytes, write_text, write_with, writes
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
WEIGHTS = "weights.safetensors"
SHIPPED = Path(__file__).parents[1] / "weights"
MOST_ROWS = 2000  # most rows of a Gaussian process in a small copy: 1 MB
LARGE = 1000  # number of elements above which an array is stored in half precision
NETWORKS = "networks"  # the networks' weights, in ``weights.pt``
KERNELS = "kernels"  # the arrays of the Gaussian processes of the modes, one for each view, in ``weights.pt``
KERNEL_LABELS = "kernel_labels"  # the labels that these processes estimate
BESIDE = "beside"  # the arrays of the Gaussian process that is averaged with the networks, in ``weights.pt``
SHA256 = "weights_sha256"  # digest of the small copy's weights, in its configuration; older shipped copies have none
# Names of the folders from which the run learnt, in the small copy's configuration. ``rows`` has the number of frames.
RECORDINGS = "recordings"
NOT_PACKED = (KERNELS, KERNEL_LABELS, "parameters", "learnt_from")  # entries of ``weights.pt`` that are left out or packed in another form


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
    with ErrorsAs(ValidationError, lambda error: damage_error(path, explain_problems(error, _Config))):
        _Config.model_validate(config)
    with ErrorsAs(TrainingError, lambda error: damage_error(path, str(error))):
        model_named(config["model"])
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
        return dict(torch.load(path, weights_only=True, map_location="cpu"))
    except OSError as error:
        raise TrainingError(f"{path}: can't be read ({error.strerror or error}); {remedy}") from error
    except zipfile.BadZipFile as error:
        raise damage_error(path, "cut, changed, or no file of weights", remedy) from error
    except UnpicklingError as error:
        raise damage_error(path, "holds more than numbers, and is not loaded for that reason", remedy) from error
    except (RuntimeError, ValueError, KeyError, EOFError, TypeError, AttributeError, IndexError) as error:
        raise damage_error(path, "no file of weights", remedy) from error


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


def shipped_names() -> list[str]:
    """Names of the sensors whose weights are shipped with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob(f"*/{WEIGHTS}"))


def folder_of(run: str | Path) -> Path:
    """The folder of a run: the given one, or that of the shipped weights if there is no such folder and ``run`` is a sensor's name."""
    return SHIPPED / run if not Path(run).exists() and str(run) in shipped_names() else Path(run)


def instead_of(run: Path) -> str:
    """Suggestion for a folder that holds no model: the shipped or neighbouring model with the most similar name, if there is one."""
    shipped = shipped_names()
    beside = [folder.name for folder in run.parent.iterdir() if (folder / "config.json").is_file()] if run.parent.is_dir() else []
    near = get_close_matches(run.name, [*(shipped if run.name == str(run) else []), *beside], n=1)
    if near:
        return f"did you mean '{near[0] if near[0] in shipped and near[0] not in beside else run.with_name(near[0])}'?"
    return f"'twin train' writes one; weights for {', '.join(shipped)} go with the package: give the name instead"


@writes(WEIGHTS, CONFIG, *BESIDE_FILES)
def pack(run: Path, out: Path) -> int:
    """Write the small copy of a finished run, and return its size in bytes.

    Raises
    ------
    TrainingError
        The run is a small copy already, has Gaussian processes of more than ``MOST_ROWS`` rows, or has a model without small copies.
    """
    if not (run / TENSORS).is_file():
        raise TrainingError(f"{run}: a small copy already; give the run that it was made of")
    config, content = read_config(run), read_tensors(run / TENSORS)
    rows = max((len(arrays["inputs"]) for arrays in content[KERNELS]), default=0)
    if rows > MOST_ROWS:
        raise TrainingError(
            f"{run}: has Gaussian processes of {rows} frames beside its networks, and a small copy holds {MOST_ROWS} at most; "
            "train with `kernel=False`"
        )
    model = model_named(config["model"])
    kept = {key: value for key, value in content.items() if key not in NOT_PACKED}
    kept[NETWORKS] = [model.pack(weights) for weights in content[NETWORKS]]
    if rows:
        kept |= {KERNELS: content[KERNELS], KERNEL_LABELS: torch.tensor(content[KERNEL_LABELS])}
    small = {}
    for key, value in _flat(kept).items():
        whole = value.size <= LARGE or value.dtype == np.int64 or key.startswith((f"{BESIDE}.", f"{KERNELS}."))
        small[key] = np.ascontiguousarray(value if whole else value.astype(np.float16))
    small["reference_px"] = content["reference_px"].numpy()  # in full precision, because the graph is made from it
    weights = save(small)
    write_bytes(out / WEIGHTS, weights)
    about = {key: value for key, value in config.items() if key not in ASIDE} | {SHA256: hashlib.sha256(weights).hexdigest()}
    about[RECORDINGS] = [Path(folder).name for folder in config.get("data", "").split(", ") if folder]
    write_text(out / CONFIG, json.dumps(about) + "\n")
    for name in BESIDE_FILES:
        if (run / name).is_file():
            write_bytes(out / name, (run / name).read_bytes())
    return (out / WEIGHTS).stat().st_size


def unpack(config: dict, path: Path) -> dict:
    """The content of ``weights.pt`` from its small copy.

    Raises
    ------
    ValueError
        The file is damaged.
    """
    weights = path.read_bytes()
    if SHA256 in config and hashlib.sha256(weights).hexdigest() != config[SHA256]:
        raise ValueError(f"{path.name}: changed since it was written")  # the format has no checksums
    with ErrorsAs(SafetensorError, lambda error: ValueError(f"{path.name}: {error}")):
        arrays = load(weights)
    content: dict = {KERNELS: {}, KERNEL_LABELS: torch.zeros(0), "aside": {}, NETWORKS: {}}
    for key, array in arrays.items():
        of_network = key.startswith(f"{NETWORKS}.")
        *above, last = key.split(".", 2) if of_network else key.split(".")
        place = content
        for part in above:
            place = place.setdefault(part, {})
        place[last] = torch.from_numpy(array.astype(np.float32 if of_network else np.float64))
    content[KERNELS] = [arrays for _, arrays in sorted(content[KERNELS].items())]
    content[KERNEL_LABELS] = content[KERNEL_LABELS].long().tolist()
    reference = make_reference(content["reference_px"].numpy(), SensorSpec.model_validate(config["sensor"]).pins)
    model = model_named(config["model"])
    blank = model.build(reference, len(content["shift"]), config["size"]).state_dict()
    return content | {NETWORKS: [model.unpack(weights, blank) for _, weights in sorted(content[NETWORKS].items())]}


def _flat(value: torch.Tensor | Mapping | list, name: str = "") -> dict[str, np.ndarray]:
    """Nested arrays by the path to each: ``networks.0.enter.weight``."""
    if isinstance(value, torch.Tensor):
        return {name: value.numpy()}
    items = value.items() if isinstance(value, Mapping) else enumerate(value)
    return {k: v for key, part in items for k, v in _flat(part, f"{name}.{key}" if name else str(key)).items()}
