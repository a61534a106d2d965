"""Small copies of runs, small enough to go with the package: ``config.json`` and ``weights.safetensors``.

The arrays are in the safetensors format (https://github.com/huggingface/safetensors), which holds no code. Large arrays are kept in half
precision. Those of a Gaussian process are not, because its terms nearly cancel. Each model decides itself which weights a small copy can
do without: see ``Model.pack``.
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from scenes.sensor import SensorSpec
from training.models import model_named
from training.recipes import TrainingError
from twin.pins import make_reference
from twin.store import write_bytes, write_text

WEIGHTS = "weights.safetensors"
SHIPPED = Path(__file__).parent / "weights"
LARGE = 1000  # numbers; a larger array is kept in half precision
NETWORKS = "networks"  # the networks' weights, in ``weights.pt``
BESIDE = "beside"  # the arrays of the Gaussian process beside the networks, in ``weights.pt``
NOT_PACKED = ("kernels", "kernel_labels", "parameters")  # entries of ``weights.pt`` that a small copy leaves out


def shipped_names() -> list[str]:
    """Sensors whose weights go with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob(f"*/{WEIGHTS}"))


def pack(run: Path, out: Path) -> int:
    """Write the small copy of a finished run without Gaussian processes beside its networks; returns its size in bytes.

    Raises
    ------
    TrainingError
        The run is a small copy already, has such processes, or is of a model that has no small copy.
    """
    if not (run / "weights.pt").is_file():
        raise TrainingError(f"{run}: a small copy already; give the run that it was made of")
    config = json.loads((run / "config.json").read_text())
    content = torch.load(run / "weights.pt", weights_only=True)
    if content["kernels"]:
        raise TrainingError(
            f"{run}: has Gaussian processes beside its networks, which a small copy does not hold; only runs with --no-kernel can be packed"
        )
    model = model_named(config["model"])
    kept = {key: value for key, value in content.items() if key not in NOT_PACKED}
    kept[NETWORKS] = [model.pack(weights) for weights in content[NETWORKS]]
    arrays = _flat(kept)
    whole = {key for key, value in arrays.items() if value.size <= LARGE or value.dtype == np.int64 or key.startswith(f"{BESIDE}.")}
    small = {key: value if key in whole else value.astype(np.float16) for key, value in arrays.items()}
    small["reference_px"] = content["reference_px"].numpy()  # whole: the graph is made from it
    out.mkdir(parents=True, exist_ok=True)
    write_bytes(out / WEIGHTS, save({key: np.ascontiguousarray(value) for key, value in small.items()}))
    about = {key: value for key, value in config.items() if key not in ("data", "problems")}
    write_text(out / "config.json", json.dumps(about) + "\n")
    return (out / WEIGHTS).stat().st_size


def unpack(config: dict, path: Path) -> dict:
    """The content of ``weights.pt`` from its small copy.

    Raises
    ------
    ValueError
        The file is damaged.
    """
    try:
        arrays = load_file(path)
    except SafetensorError as error:
        raise ValueError(f"{path.name}: {error}") from error
    content: dict = {"kernels": [], "kernel_labels": [], "aside": {}, NETWORKS: {}}
    for key, array in arrays.items():
        of_network = key.startswith(f"{NETWORKS}.")
        *above, last = key.split(".", 2) if of_network else key.split(".")
        place = content
        for part in above:
            place = place.setdefault(part, {})
        place[last] = torch.from_numpy(array.astype(np.float32 if of_network else np.float64))
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
