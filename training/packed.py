"""Small copies of runs, small enough to go with the package: ``config.json`` and ``weights.safetensors``.

The file is in the safetensors format (https://github.com/huggingface/safetensors): 8 bytes with the length of a JSON
header, the header with type, shape and place of each array, the arrays. Nothing in it can be run. Large arrays are kept in
half precision, but for a Gaussian process, whose terms cancel; what the network's graph tells anyway, and attention between
pins that are no neighbours, is left out.
"""

import json
import struct
from pathlib import Path

import numpy as np
import torch

from scenes.sensor import SensorSpec
from training.networks import build_network
from training.recipes import TrainingError
from twin.preprocess import make_reference
from twin.store import write_bytes, write_text

WEIGHTS = "weights.safetensors"
SHIPPED = Path(__file__).parent / "weights"
DERIVED = ("adjacency", "smoothing")  # not the waves: those of equal frequency are any basis, another on another machine
LARGE = 1000  # numbers, from which an array is kept in half precision
TYPES = {"F16": np.float16, "F32": np.float32, "F64": np.float64, "I64": np.int64}
PLAIN_KEYS = ("kernels", "kernel_labels", "parameters")  # no arrays, or none that are packed


def shipped_names() -> list[str]:
    """Sensors whose weights go with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob(f"*/{WEIGHTS}"))


def pack(run: Path, out: Path) -> int:
    """Write the small copy of a finished run of ``vgnn`` without kernel; returns its size in bytes.

    Raises
    ------
    TrainingError
        The run is another one.
    """
    if not (run / "weights.pt").is_file():
        raise TrainingError(f"{run}: a small copy already; give the run that it was made of")
    config = json.loads((run / "config.json").read_text())
    content = torch.load(run / "weights.pt", weights_only=True)
    if config["model"] != "vgnn" or content["kernels"]:
        raise TrainingError(f"{run}: only runs of vgnn with --no-kernel can be packed")
    arrays = _flat({key: value for key, value in content.items() if key not in PLAIN_KEYS})
    for key in [key for key in arrays if key.split(".")[-1] in DERIVED]:
        if key.endswith("adjacency") and key.replace("adjacency", "attention") in arrays:
            attention = key.replace("adjacency", "attention")
            arrays[attention] = arrays[attention][arrays[key] > 0]
        del arrays[key]
    whole = {key for key, value in arrays.items() if value.size <= LARGE or value.dtype == np.int64 or key.startswith("beside.")}
    small = {key: value if key in whole else value.astype(np.float16) for key, value in arrays.items()}
    small["reference_px"] = content["reference_px"].numpy()  # the graph is made from it
    out.mkdir(parents=True, exist_ok=True)
    write_arrays(out / WEIGHTS, small)
    kept = {key: value for key, value in config.items() if key not in ("data", "problems")}
    write_text(out / "config.json", json.dumps(kept) + "\n")
    return (out / WEIGHTS).stat().st_size


def unpack(config: dict, path: Path) -> dict:
    """The content of ``weights.pt`` from its small copy."""
    content: dict = {"kernels": [], "kernel_labels": []}
    for key, array in read_arrays(path).items():
        *above, last = key.split(".", 2) if key.startswith("networks.") else key.split(".")
        place = content
        for part in above:
            place = place.setdefault(part, {})
        place[last] = torch.from_numpy(array.astype(np.float32 if key.startswith("networks.") else np.float64))
    reference = make_reference(content["reference_px"].numpy(), SensorSpec.model_validate(config["sensor"]).pins.rings)
    blank = build_network("vgnn", reference, len(content["shift"]), config["size"]).state_dict()
    networks = []
    for _, weights in sorted(content["networks"].items()):
        if "attention" in weights:
            attention = torch.zeros_like(blank["attention"])
            attention[blank["adjacency"] > 0] = weights["attention"]
            weights["attention"] = attention
        networks.append(weights | {key: blank[key] for key in DERIVED if key in blank})
    return content | {"networks": networks}


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a safetensors file."""
    codes = {np.dtype(kind): code for code, kind in TYPES.items()}
    header, start = {}, 0
    for key, array in sorted(arrays.items()):
        header[key] = {"dtype": codes[array.dtype], "shape": list(array.shape), "data_offsets": [start, start + array.nbytes]}
        start += array.nbytes
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    data = b"".join(np.ascontiguousarray(arrays[key]).tobytes() for key in sorted(arrays))
    write_bytes(path, struct.pack("<Q", len(text)) + text + data)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read a safetensors file.

    Raises
    ------
    ValueError
        It is damaged.
    """
    data = path.read_bytes()
    if len(data) < 8 or (begin := 8 + struct.unpack("<Q", data[:8])[0]) > len(data):
        raise ValueError("cut off")
    found = {}
    for key, about in json.loads(data[8:begin]).items():
        if key != "__metadata__":
            first, last = about["data_offsets"]
            if begin + last > len(data):
                raise ValueError("cut off")
            found[key] = np.frombuffer(data[begin + first : begin + last], TYPES[about["dtype"]]).reshape(about["shape"])
    return found


def _flat(value, name: str = "") -> dict[str, np.ndarray]:
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {k: v for key, part in items for k, v in _flat(part, f"{name}.{key}" if name else str(key)).items()}
    return {name: value.numpy()}
