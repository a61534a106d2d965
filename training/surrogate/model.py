"""The surrogate: a linear skin with exact contact and friction, and two small networks that correct it for large deformations.

The first network, the bending, corrects the skin while its contact is solved. The body is elastic. So the displacements u of the skin's
nodes depend on the present nodal forces f alone, not on their history:

    u = C f + modes (straight x + g(x) net(x)),   x = R f / scale,   g = tanh(mean(x^2) / AMPLE)

C f is the linear skin's displacement, and R f its displacement in the modes of the pins. The gate g goes to zero with the forces, so the
network adds only terms of higher order. The scale of C is fitted to all contacts; the matrix ``straight`` corrects C for light contacts.
Because the correction acts inside the solution, nodes stick and slip at the forces of the true skin.

The second network corrects what the pins do and what is felt. From f follow

    pins = rest + modes (R f + gate(depth) net(R f, V g, features)),   force = -sum f + gate net

V g describes where the object is: the distances g of the nodes at rest from it,
in their principal directions. The gate goes to zero with the depth, so a sensor without contact is exactly at rest. The features are depth,
friction, number of pressing nodes, share of sliding nodes, used share of Coulomb's bound, force and torque of the nodal forces. Only f
depends on the history of the contact, so the network has no memory of its own that could drift.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenes.sensor import SensorSpec
from training.surrogate.compliance import NODE_RINGS, POLAR_DEG
from training.surrogate.symmetry import ring_directions, symmetries
from twin.compiled import compiled
from twin.errors import ContactError, TwinError
from twin.geometry.pins import rest_pins
from twin.store import ArrayFile, Layers, layers_from, layers_to, silu, through_layers
from twin.types import FloatArray, IntArray

SHIPPED = Path(__file__).parents[1] / "surrogates"
SUFFIX = ".safetensors"
AMPLE = 0.1
"""Mean square of the scaled inputs at which the gate of the bending's network is three quarters open."""
LOOSE = {"reassoc", "contract", "arcp", "nsz"}
"""What the compiler may assume about sums and products of the networks."""
TAKEN = 0.5
"""Relaxation factor of an update of the bending. With 1, solutions of deep contacts oscillate: a skin that bends more bears less force."""
GATE_MM = 0.3
"""Depth at which the gate of the network is three quarters open."""
MECHANICS = ("skin", "gel", "lens", "pins")
"""Sections of a specification that a surrogate depends on. Camera, light and rig may differ."""
OPTICAL = ("refractive_index", "absorption_per_mm", "haze", "haze_sigma_px", "thickness_mm", "diameter_mm", "cap_diameter_mm")
"""Keys of the sections ``MECHANICS`` that only the optics need. The skin's thickness is the exception: it decides the mechanics."""
UNFELT = ("stiffness_factor",)
"""Keys that give the uncertainty of others. No contact depends on them."""
FEATURES = 13
"""Number of the network's inputs besides the modes and the views of the object."""
VIEWS = 32
"""Number of principal directions of the object's distances among the network's inputs."""
VIEW_MM = 1.0
"""Distance from the undeformed skin beyond which the network does not see an object."""
WRENCH_SCALE = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
"""Scales of force (N) and torque (N mm) as inputs of the network."""
BLOCK = 4
"""Rows of a product of matrices. The order in which BLAS sums depends on their number."""
Network = tuple[FloatArray, ...]
"""Arrays of a network for compiled functions: see ``Bending.kernel`` and ``Surrogate.kernel``."""
BESIDE = 8
"""Number of the network's outputs besides the modes: force, torque, area in 100 mm2, sliding share."""


class SurrogateError(TwinError):
    """A surrogate's file cannot be used, or there is no surrogate for a sensor."""


NAMED = ("modes", "read", "view", "mean", "scale", "out_scale")
"""Arrays of a file that are attributes of a surrogate."""
WHOLE = ("mean", "scale", "offset")
"""Ends of the names of arrays that are not rounded to half precision."""
FILE = ArrayFile("surrogate", "twin surrogate", version=3, error=SurrogateError)


@dataclass(frozen=True)
class Bending:
    """The network of a skin with M nodes, K inputs and O modes.

    Attributes
    ----------
    scale : (K,) float32
        Scale of each input.
    straight : (O, K) float32
        Linear part of the correction.
    layers : tuple of ((o, i), (o,)) float32
        Three layers: weights and offsets.
    modes : (O, M, 3) float32
        Displacements of the nodes, mm.
    """

    scale: FloatArray
    straight: FloatArray
    layers: Layers
    modes: FloatArray

    def kernel(self, read: FloatArray) -> Network:
        """The arrays that ``bend`` takes, in its memory layout; ``read`` (K, 3 M) is the linear skin's answer in the modes of the pins."""
        seen = (read / self.scale[:, None]).T.reshape(-1, 3, len(read))
        (first, a), (second, b), (third, c) = self.layers
        given = seen, first.T, a, second.T, b, third.T, c, self.straight.T, self.modes.transpose(0, 2, 1)
        return tuple(np.ascontiguousarray(values, np.float32) for values in given)


def ample(x: FloatArray) -> FloatArray:
    """The gate of the network, (S,), from 0 to 1, for scaled inputs (S, K)."""
    return np.tanh((x**2).mean(axis=1) / AMPLE)


@compiled(nogil=True, fastmath=LOOSE)
def add_product(x: FloatArray, matrix: FloatArray, out: FloatArray) -> None:
    """Add ``x`` (i,) times a matrix (i, o) to ``out`` (o,)."""
    for k in range(len(x)):
        row, value = matrix[k], x[k]
        for o in range(len(out)):
            out[o] += row[o] * value


@compiled(nogil=True, fastmath=LOOSE)
def _apply_silu(x: FloatArray) -> None:
    """Apply the activation of the layers to ``x`` (i,)."""
    for k in range(len(x)):
        x[k] = x[k] / (np.float32(1.0) + np.exp(-x[k]))


@compiled(nogil=True, fastmath=LOOSE)
def three_layers(x: FloatArray, network: Network) -> FloatArray:
    """Output (o,) of a network of three layers for ``x`` (i,): each layer's weights (i, o), then its offset."""
    first, a, second, b, third, c = network
    one, two, out = a.copy(), b.copy(), c.copy()
    add_product(x, first, one)
    _apply_silu(one)
    add_product(one, second, two)
    _apply_silu(two)
    add_product(two, third, out)
    return out


@compiled(nogil=True, fastmath=LOOSE)
def bend(force: FloatArray, bent: FloatArray, moved: FloatArray, network: Network) -> float:
    """Update the bending ``bent`` (3, M) float32 toward that of the forces (M, 3), and the displacements ``moved`` (M, 3) by the same.

    ``network`` is as ``Bending.kernel`` gives it. Returns the largest change along an axis, mm.
    """
    read, straight, modes = network[0], network[7], network[8]
    seen = read.shape[2]
    x = np.zeros(seen, np.float32)
    for i in range(len(force)):
        if force[i, 0] == 0 and force[i, 1] == 0 and force[i, 2] == 0:
            continue
        f0, f1, f2 = np.float32(force[i, 0]), np.float32(force[i, 1]), np.float32(force[i, 2])
        r = read[i]
        for k in range(seen):
            x[k] += r[0, k] * f0 + r[1, k] * f1 + r[2, k] * f2
    size = np.float32(0.0)
    for k in range(seen):
        size += x[k] * x[k]
    gate = np.float32(np.tanh(size / seen / AMPLE))
    out = three_layers(x, network[1:7])
    for o in range(len(out)):
        out[o] *= gate
    add_product(x, straight, out)
    most = np.float32(0.0)
    for p in range(3):
        whole = np.zeros(bent.shape[1], np.float32)
        add_product(out, modes[:, p], whole)
        for j in range(len(whole)):
            change = np.float32(TAKEN) * (whole[j] - bent[p, j])
            most = max(most, abs(change))
            moved[j, p] += change
            bent[p, j] += change
    return float(most)


@dataclass(frozen=True)
class Surrogate:
    """A surrogate of one sensor's mechanics.

    Attributes
    ----------
    about : dict
        Its sensor and mechanics, its training data, the limits of its domain and its errors (JSON).
    node_mm : (M, 3) float
        Nodes of the linear skin at rest.
    answer : (M, M, 3, 3) float32
        The linear skin's displacement of node j (second) for a force at node i (first), mm/N.
    modes : (K, N, 2, 3) float32
        Displacements of the pins' feet, mm, and changes of their axes.
    read : (K, 3 M) float32
        The linear skin's answer in the modes.
    view : (VIEWS, M) float32
        Principal directions of the object's distances, inputs of the network.
    bending : Bending
        Correction of the nodes' displacements for large deformations.
    mean, scale : (K + FEATURES + VIEWS,) float32
        Mean and scale of the network's inputs.
    layers : tuple of ((o, i), (o,)) float32
        The network's weights and offsets.
    out_scale : (K + BESIDE,) float32
        Scale of the network's outputs.
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
        """Upper limits of its domain: depth (mm), angle from the apex (deg) and friction."""
        return {key: float(value) for key, value in self.about["domain"].items()}

    def correct(self, force_n: FloatArray, beside: FloatArray, gap_mm: FloatArray, depth_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coefficients of the modes (R, K), and corrections of force, torque, area and sliding share (R, BESIDE).

        ``force_n`` (R, M, 3) are the forces at the nodes, ``beside`` (R, FEATURES) the ``features``, ``gap_mm`` (R, M) the distances of the
        object from the nodes at rest, and ``depth_mm`` (R,) its depths.
        """
        linear = by_row(force_n.reshape(len(force_n), -1).astype(np.float32), self.read.T)
        seen = by_row(within(gap_mm), self.view.T)
        x = (np.concatenate([linear, beside.astype(np.float32), seen], axis=1) - self.mean) / self.scale
        found = through_layers(self.layers, x, silu, by_row) * (self.out_scale * gate(depth_mm)[:, None]).astype(np.float32)
        return linear + found[:, : len(self.modes)], found[:, len(self.modes) :]

    def kernel(self) -> Network:
        """The arrays that ``answer_each`` takes, in its memory layout."""
        (first, a), (second, b), (third, c) = self.layers
        seen = self.read.T.reshape(-1, 3, len(self.read))
        given = seen, self.view.T, self.mean, self.scale, first.T, a, second.T, b, third.T, c, self.out_scale
        return tuple(np.ascontiguousarray(values, np.float32) for values in given)

    def save(self, path: Path) -> int:
        """Write it to a file and return the size in bytes.

        Large arrays are stored in half precision. Of symmetric nodes only one compliance is stored.
        """
        return FILE.write(path, self._arrays(), self.about)

    def as_kept(self) -> "Surrogate":
        """The surrogate as it is read back from a file: rounded to half precision."""
        return _of_arrays(self.about, {key: value.astype(np.float32) for key, value in self._arrays().items()})

    def _arrays(self) -> dict[str, FloatArray]:
        found = {name: getattr(self, name) for name in NAMED} | {"answer": self.answer[representatives(self.phase_deg)]}
        found |= {f"bending.{name}": getattr(self.bending, name) for name in ("scale", "straight", "modes")}
        found |= layers_to(self.layers) | layers_to(self.bending.layers, "bending")
        return {key: value.astype(np.float32 if key.endswith(WHOLE) else np.float16) for key, value in found.items()}


@compiled(fastmath=LOOSE)
def answer_each(rows: IntArray, state: tuple[Any, ...], turns: FloatArray, network: Network, found: FloatArray) -> None:
    """Write to ``found`` (B, K + BESIDE) float32 what some sensors feel: coefficients of the modes, force, torque, area, sliding share.

    It is ``Surrogate.correct`` without matrices of all rows. ``state`` is of all contacts: the nodes' forces (B, M, 3), whether they press
    and slide (B, M), friction and used share (B,), distances (B, M). ``turns`` (3 M, 6) are forces and torques by a node's force, and
    ``network`` is that of ``Surrogate.kernel``.
    """
    force_n, held, slides, friction, used, gap_mm = state
    read, view, mean, scale, out_scale = network[0], network[1], network[2], network[3], network[10]
    count = read.shape[2]
    for row in rows:
        gap, mu, x, wrench, deepest = gap_mm[row], friction[row], np.zeros(len(mean), np.float32), np.zeros(6), np.inf
        pressed, slid = 0, 0
        for i in range(len(gap)):
            pressed, slid, deepest = pressed + held[row, i], slid + slides[row, i], min(deepest, gap[i])
            for q in range(3):
                force = force_n[row, i, q]
                if force != 0:
                    for k in range(count):
                        x[k] += read[i, q, k] * np.float32(force)
                    for k in range(6):
                        wrench[k] += turns[3 * i + q, k] * force
            if gap[i] < VIEW_MM:
                for k in range(VIEWS):
                    x[count + FEATURES + k] += view[i, k] * np.float32(VIEW_MM - gap[i])
        depth, slip = max(-deepest, 0.0), slid / max(pressed, 1)
        beside = depth, depth**2 / 5.0, np.log(max(mu, 0.01)), min(mu, 1.5) * depth, pressed / 10.0, slip, used[row]
        for k in range(7):
            x[count + k] = beside[k]
        for k in range(6):
            x[count + 7 + k] = wrench[k] / WRENCH_SCALE[k]
        out = found[row]
        out[:count] = x[:count]
        for k in range(6):
            out[count + k] = wrench[k]
        out[count + 6], out[count + 7] = 0.0, slip
        for k in range(len(x)):
            x[k] = (x[k] - mean[k]) / scale[k]
        last = three_layers(x, network[4:10])
        share = np.float32(np.tanh(depth / GATE_MM))
        for k in range(len(out)):
            out[k] += last[k] * out_scale[k] * share


def by_row(x: FloatArray, matrix: FloatArray) -> FloatArray:
    """``x @ matrix`` for rows (R, k), each of which comes out the same whatever R is: only products of ``BLOCK`` rows are made."""
    rows = len(x)
    if rows % BLOCK:
        x = np.concatenate([x, np.zeros((-rows % BLOCK, x.shape[1]), x.dtype)])
    return (x.reshape(-1, BLOCK, x.shape[1]) @ matrix).reshape(len(x), -1)[:rows]


def features(
    depth_mm: FloatArray, friction: FloatArray, held: FloatArray, slip: FloatArray, used: FloatArray, wrench: FloatArray
) -> FloatArray:
    """Inputs of the network besides the modes and the views of the object, (R, FEATURES)."""
    rub, drag = np.log(np.maximum(friction, 0.01)), np.minimum(friction, 1.5) * depth_mm
    return np.column_stack([depth_mm, depth_mm**2 / 5.0, rub, drag, held / 10.0, slip, used, wrench / WRENCH_SCALE])


def within(gap_mm: FloatArray) -> FloatArray:
    """Closeness of the object to the nodes at rest, (R, M) float32: 0 from ``VIEW_MM`` on."""
    return np.maximum(VIEW_MM - gap_mm, 0.0).astype(np.float32)


def gate(depth_mm: FloatArray) -> FloatArray:
    """The gate of the network: 0 without contact, 1 in deep contact."""
    return np.tanh(np.maximum(depth_mm, 0.0) / GATE_MM)


def representatives(phase_deg: float) -> list[int]:
    """Nodes from which the lattice's symmetries reach all others."""
    return sorted(set(np.min([g.places(NODE_RINGS) for g in symmetries(phase_deg)], axis=0).tolist()))


def unfold_compliance(kept: FloatArray, phase_deg: float) -> FloatArray:
    """The compliance (M, M, 3, 3) of all nodes from that of the representatives."""
    count = kept.shape[1]
    out = np.zeros((count, count, 3, 3), np.float32)
    for g in symmetries(phase_deg):
        places, turn = g.places(NODE_RINGS), g.matrix.astype(np.float32)
        turned = np.einsum("pr,ijrs,qs->ijpq", turn, kept, turn, optimize=True)
        for row, i in enumerate(representatives(phase_deg)):
            out[places[i], places] = turned[row]
    return out


def load_surrogate(path: Path) -> Surrogate:
    """Read a surrogate from a file.

    Raises
    ------
    SurrogateError
        There is no such file, or it is not a surrogate of this version.
    """
    with FILE.open_arrays(path) as (about, arrays):
        return _of_arrays(about, arrays)


def _of_arrays(about: dict[str, Any], arrays: Mapping[str, FloatArray]) -> Surrogate:
    """The surrogate of a file's arrays, as float32."""
    radius = float(about["mechanics"]["skin"]["outer_radius_mm"])
    phase = float(about["mechanics"]["pins"]["phase_deg"])
    nodes, answer = radius * ring_directions(NODE_RINGS, POLAR_DEG, phase), unfold_compliance(arrays["answer"], phase)
    bending = Bending(arrays["bending.scale"], arrays["bending.straight"], layers_from(arrays, "bending"), arrays["bending.modes"])
    wide = lambda w: np.asfortranarray(w) if len(w) >= w.shape[1] else w  # noqa: E731  (faster, equal bits)
    layers = tuple((wide(weights), offset) for weights, offset in layers_from(arrays))
    return Surrogate(about, nodes, answer, bending=bending, layers=layers, **{name: arrays[name] for name in NAMED})


def mechanics_of(sensor: SensorSpec) -> dict[str, Any]:
    """The sections of a specification that decide its mechanics, without the keys that only the optics need."""
    plain = {part: getattr(sensor, part).model_dump(mode="json") for part in MECHANICS}
    return {part: {key: value for key, value in plain[part].items() if is_mechanical(part, key)} for part in MECHANICS}


def unlike_parts(saved: Mapping[str, Any], sensor: SensorSpec) -> list[str]:
    """Sections in which a surrogate's saved mechanics are not those of a sensor. An earlier version saved more keys with their defaults."""
    sections = {part: type(getattr(sensor, part)).model_validate(saved[part]) for part in MECHANICS}
    told, wanted = mechanics_of(sensor.model_copy(update=sections)), mechanics_of(sensor)
    return [part for part in MECHANICS if told[part] != wanted[part]]


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
    if file is not None:
        found = load_surrogate(Path(file))
        if parts := "], [".join(unlike_parts(found.about["mechanics"], sensor)):
            raise SurrogateError(f"{file}: of a sensor with another [{parts}]; make one of {sensor.name} with 'twin surrogate'")
        return found
    for path in sorted(SHIPPED.glob(f"*{SUFFIX}")):
        if not unlike_parts(FILE.about(path)["mechanics"], sensor):
            return load_surrogate(path)
    raise SurrogateError(
        f"no surrogate of {sensor.name} goes with the package; make one: twin surrogate --sensor NAME_OR_FILE --out FILE, "
        "and give it as `surrogate` (TactileScene: surrogates={NAME: FILE}) or, outside robot scenes, use backend='fem'"
    )


def rest_of(sensor: SensorSpec) -> FloatArray:
    """Feet and axes of a sensor's pins at rest, (N, 2, 3)."""
    rest = rest_pins(sensor.geometry)
    return np.stack([rest.base_mm, rest.axis], axis=1)


def outside(reason: str) -> ContactError:
    """The error for a contact that the surrogate was not trained for."""
    return ContactError(f"outside the surrogate's domain: {reason}; use backend='fem', or a surrogate that was trained for it")
