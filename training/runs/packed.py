"""Copies of runs that are small enough to be shipped with the package: ``config.json`` and ``weights.safetensors``.

The arrays are in the safetensors format (https://github.com/huggingface/safetensors), which holds no code. Large arrays are stored in
half precision, except those of a Gaussian process, because its terms nearly cancel. Each model decides which weights its small copy
leaves out: see ``Model.pack``.
"""

import hashlib
import json
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load, save

from scenes.sensor import SensorSpec
from training.errors import TrainingError
from training.models import model_named
from training.runs.identity import ASIDE
from training.runs.run_files import BESIDE_FILES, CONFIG, TENSORS, read_config, read_tensors
from twin.pins import make_reference
from twin.store import write_bytes, write_text, writes

WEIGHTS = "weights.safetensors"
SHIPPED = Path(__file__).parents[1] / "weights"
MOST_ROWS = 2000  # most rows of a Gaussian process in a small copy: 1 MB
LARGE = 1000  # number of elements above which an array is stored in half precision
NETWORKS = "networks"  # the networks' weights, in ``weights.pt``
KERNELS = "kernels"  # the arrays of the Gaussian processes of the modes, one for each view, in ``weights.pt``
KERNEL_LABELS = "kernel_labels"  # the labels that these processes estimate
BESIDE = "beside"  # the arrays of the Gaussian process that is averaged with the networks, in ``weights.pt``
SHA256 = "weights_sha256"  # digest of the small copy's weights, in its configuration; older shipped copies have none
RECORDINGS = (
    "recordings"  # names of the folders from which the run learnt, in the small copy's configuration; ``rows`` has the number of frames
)
NOT_PACKED = (KERNELS, KERNEL_LABELS, "parameters", "learnt_from")  # entries of ``weights.pt`` that are left out or packed in another form


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
    arrays = _flat(kept)
    whole = {
        key
        for key, value in arrays.items()
        if value.size <= LARGE or value.dtype == np.int64 or key.startswith((f"{BESIDE}.", f"{KERNELS}."))
    }
    small = {key: value if key in whole else value.astype(np.float16) for key, value in arrays.items()}
    small["reference_px"] = content["reference_px"].numpy()  # in full precision, because the graph is made from it
    weights = save({key: np.ascontiguousarray(value) for key, value in small.items()})
    write_bytes(out / WEIGHTS, weights)
    about = {key: value for key, value in config.items() if key not in ASIDE} | {SHA256: hashlib.sha256(weights).hexdigest()}
    about |= {RECORDINGS: [Path(folder).name for folder in config.get("data", "").split(", ") if folder]}
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
    try:
        arrays = load(weights)
    except SafetensorError as error:
        raise ValueError(f"{path.name}: {error}") from error
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
