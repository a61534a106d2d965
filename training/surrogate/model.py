"""The surrogate: a skin with exact contact and friction, and two small networks that add what large deformations change.

The first bends the skin while its contact is solved (see ``bending``). Of the forces f at the nodes that are found so,

    pins = rest + modes (R f + gate(depth) net(R f, V g, features)),   force = -sum f + gate net,

where R is the linear skin's answer in the modes, V g tells where the object is (its distances from the nodes at rest, in their main
directions), and the gate goes to zero with the depth: a sensor that touches nothing is exactly at rest. The features are depth, friction,
nodes that press and slide, the share of Coulomb's bound that is borne, force and torque of the nodes' forces. What happened before is in f
alone, so the network has no memory of its own that could drift.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenes.sensor import SensorSpec
from training.surrogate.bending import Bending
from training.surrogate.compliance import NODE_RINGS, POLAR_DEG
from training.surrogate.symmetry import ring_directions, symmetries
from twin.errors import ContactError, TwinError
from twin.geometry.pins import rest_pins
from twin.store import ArrayFile, Layers, layers_from, layers_to
from twin.types import FloatArray

SHIPPED = Path(__file__).parents[1] / "surrogates"
SUFFIX = ".safetensors"
GATE_MM = 0.3
"""Depth at which the network has three quarters of its say."""
MECHANICS = ("skin", "gel", "lens", "pins")
"""Sections of a specification that a surrogate stands for; camera, light and rig may differ."""
OPTICAL = ("refractive_index", "absorption_per_mm", "haze", "haze_sigma_px", "thickness_mm", "diameter_mm", "cap_diameter_mm")
"""Keys of these sections that only the optics need; the skin's thickness is not among them."""
UNFELT = ("stiffness_factor",)
"""Keys that say how sure the others are: no contact depends on them."""
FEATURES = 13
"""Numbers beside the modes that the network sees."""
VIEWS = 32
"""Directions of the object's distances that it sees."""
VIEW_MM = 1.0
"""Parts of an object farther than this from the undeformed skin are not seen."""
WRENCH_SCALE = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
"""N and N mm that count as 1."""
BESIDE = 8
"""Numbers beside the modes that it gives: force, torque, area in 100 mm2, share that slides."""


class SurrogateError(TwinError):
    """A surrogate's file can't be used, or no surrogate is known for a sensor."""


FILE = ArrayFile("surrogate", "twin surrogate", version=3, error=SurrogateError)


@dataclass(frozen=True)
class Surrogate:
    """A surrogate of one sensor's mechanics.

    Attributes
    ----------
    about : dict
        What it was made of, the ends of its domain and its errors (JSON).
    node_mm : (M, 3) float
        Nodes of the linear skin at rest.
    answer : (M, M, 3, 3) float32
        The linear skin's displacement of node j (second) for a force at node i (first), mm/N.
    modes : (K, N, 2, 3) float32
        Displacements of the pins' feet, mm, and changes of their axes.
    read : (K, 3 M) float32
        The linear skin's answer in the modes.
    view : (VIEWS, M) float32
        Directions in which the network sees the object.
    bending : Bending
        What large deformations add to the displacements of the nodes.
    mean, scale : (K + FEATURES + VIEWS,) float32
        Of the network's inputs.
    layers : tuple of ((o, i), (o,)) float32
        The network's weights and offsets.
    out_scale : (K + BESIDE,) float32
    """

    about: dict[str, Any]
    node_mm: FloatArray
    answer: FloatArray
    modes: FloatArray
    read: FloatArray
    view: FloatArray
    bending: Bending
    mean: FloatArray
    scale: FloatArray
    layers: Layers
    out_scale: FloatArray

    @property
    def phase_deg(self) -> float:
        """Azimuth of the first node of each ring."""
        return float(self.about["mechanics"]["pins"]["phase_deg"])

    @property
    def domain(self) -> dict[str, float]:
        """Ends of what it was trained on: depth (mm), angle from the apex (deg) and friction."""
        return {key: float(value) for key, value in self.about["domain"].items()}

    def correct(self, force_n: FloatArray, beside: FloatArray, gap_mm: FloatArray, depth_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coefficients of the modes (R, K), and what is added to the others (R, BESIDE).

        ``force_n`` (R, M, 3): at the nodes; ``gap_mm`` (R, M): distances of the object from the nodes at rest.
        """
        linear = force_n.reshape(len(force_n), -1).astype(np.float32) @ self.read.T
        x = (np.concatenate([linear, beside.astype(np.float32), within(gap_mm) @ self.view.T], axis=1) - self.mean) / self.scale
        for number, (weights, offset) in enumerate(self.layers):
            x = x @ weights.T + offset
            if number < len(self.layers) - 1:
                x = x / (1.0 + np.exp(-x))  # SiLU
        x = x * (self.out_scale * gate(depth_mm)[:, None]).astype(np.float32)
        return linear + x[:, : len(self.modes)], x[:, len(self.modes) :]

    def save(self, path: Path) -> int:
        """Write it to a file; its size in bytes. Large arrays have half precision, and the answers of symmetric nodes are left out."""
        return FILE.write(path, self._arrays(), self.about)

    def as_kept(self) -> "Surrogate":
        """The surrogate that a file of this one gives back."""
        return _of_arrays(self.about, {key: value.astype(np.float32) for key, value in self._arrays().items()})

    def _arrays(self) -> dict[str, FloatArray]:
        whole = {"mean": self.mean, "scale": self.scale, "out_scale": self.out_scale, "bending.scale": self.bending.scale}
        half = {
            "modes": self.modes,
            "read": self.read,
            "view": self.view,
            "answer": self.answer[representatives(self.phase_deg)],
            "bending.straight": self.bending.straight,
            "bending.modes": self.bending.modes,
        }
        for key, value in (layers_to(self.layers) | layers_to(self.bending.layers, "bending")).items():
            (half if key.endswith("weights") else whole)[key] = value
        return {key: value.astype(np.float32) for key, value in whole.items()} | {
            key: value.astype(np.float16) for key, value in half.items()
        }


def features(
    depth_mm: FloatArray, friction: FloatArray, held: FloatArray, slip: FloatArray, used: FloatArray, wrench: FloatArray
) -> FloatArray:
    """What the network sees beside the modes, (R, FEATURES)."""
    rub = np.log(np.maximum(friction, 0.01))
    return np.column_stack(
        [depth_mm, depth_mm**2 / 5.0, rub, np.minimum(friction, 1.5) * depth_mm, held / 10.0, slip, used, wrench / WRENCH_SCALE]
    )


def within(gap_mm: FloatArray) -> FloatArray:
    """How far the object is within sight of the nodes at rest, (R, M) float32."""
    return np.maximum(VIEW_MM - gap_mm, 0.0).astype(np.float32)


def gate(depth_mm: FloatArray) -> FloatArray:
    """How much the network has to say, 0 without contact."""
    return np.tanh(np.maximum(depth_mm, 0.0) / GATE_MM)


def representatives(phase_deg: float) -> list[int]:
    """Nodes from which all others are reached by the lattice's symmetries."""
    return sorted(set(np.min([g.places(NODE_RINGS) for g in symmetries(phase_deg)], axis=0).tolist()))


def unfolded(kept: FloatArray, phase_deg: float) -> FloatArray:
    """The answers (M, M, 3, 3) of all nodes from those of the representatives."""
    count = kept.shape[1]
    out = np.zeros((count, count, 3, 3), np.float32)
    for g in symmetries(phase_deg):
        places, turn = g.places(NODE_RINGS), g.matrix.astype(np.float32)
        turned = np.einsum("pr,ijrs,qs->ijpq", turn, kept, turn, optimize=True)
        for row, i in enumerate(representatives(phase_deg)):
            out[places[i], places] = turned[row]
    return out


def load_surrogate(path: Path) -> Surrogate:
    """Read a surrogate.

    Raises
    ------
    SurrogateError
        There is no such file, or it is no surrogate of this version.
    """
    with FILE.opened(path) as (about, arrays):
        return _of_arrays(about, arrays)


def _of_arrays(about: dict[str, Any], arrays: Mapping[str, FloatArray]) -> Surrogate:
    """The surrogate of a file's arrays, as float32."""
    radius = float(about["mechanics"]["skin"]["outer_radius_mm"])
    phase = float(about["mechanics"]["pins"]["phase_deg"])
    return Surrogate(
        about,
        radius * ring_directions(NODE_RINGS, POLAR_DEG, phase),
        unfolded(arrays["answer"], phase),
        arrays["modes"],
        arrays["read"],
        arrays["view"],
        Bending(arrays["bending.scale"], arrays["bending.straight"], layers_from(arrays, "bending"), arrays["bending.modes"]),
        arrays["mean"],
        arrays["scale"],
        layers_from(arrays),
        arrays["out_scale"],
    )


def mechanics_of(sensor: SensorSpec) -> dict[str, Any]:
    """The sections of a specification that decide its mechanics, without what only the optics need."""
    plain = sensor.model_dump(mode="json")
    return {part: {key: value for key, value in plain[part].items() if is_mechanical(part, key)} for part in MECHANICS}


def is_mechanical(section: str, key: str) -> bool:
    """Whether a number of a specification decides its mechanics."""
    return section in MECHANICS and ((section, key) == ("skin", "thickness_mm") or key not in OPTICAL + UNFELT)


def surrogate_of(sensor: SensorSpec, file: str | Path | None = None) -> Surrogate:
    """The surrogate of a sensor: the given file, or the shipped one of the same skin, gel and pins.

    Raises
    ------
    SurrogateError
        The file is of another sensor, or none is shipped for this one.
    """
    wanted = mechanics_of(sensor)
    if file is not None:
        found = load_surrogate(Path(file))
        if found.about["mechanics"] != wanted:
            parts = [part for part in MECHANICS if found.about["mechanics"][part] != wanted[part]]
            raise SurrogateError(
                f"{file}: of a sensor with another [{'], ['.join(parts)}]; make one of {sensor.name} with 'twin surrogate'"
            )
        return found
    for path in sorted(SHIPPED.glob(f"*{SUFFIX}")):
        if FILE.about(path)["mechanics"] == wanted:
            return load_surrogate(path)
    raise SurrogateError(
        f"no surrogate of {sensor.name} goes with the package; make one: twin surrogate --sensor {sensor.name} --out FILE, "
        "and give it as surrogate=FILE, or use backend='fem'"
    )


def rest_of(sensor: SensorSpec) -> FloatArray:
    """Feet and axes of a sensor's pins at rest, (N, 2, 3)."""
    rest = rest_pins(sensor.geometry)
    return np.stack([rest.base_mm, rest.axis], axis=1)


def outside(reason: str) -> ContactError:
    """The error for a contact that the surrogate was not trained for."""
    return ContactError(f"outside the surrogate's domain: {reason}; use backend='fem', or a surrogate that was trained for it")
