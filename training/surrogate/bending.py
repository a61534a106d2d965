"""Correction of the linear skin for large deformations: a small network that is evaluated while a contact is solved.

The body is elastic. So the displacements u of the skin's nodes depend on the present nodal forces f alone, not on their history:

    u = C f + modes (straight x + g(x) net(x)),   x = R f / scale,   g = tanh(mean(x^2) / AMPLE)

C f is the linear skin's displacement, and R f its displacement in the modes of the pins. The gate g goes to zero with the forces, so the
network adds only terms of higher order. The scale of C is fitted to all contacts; the matrix ``straight`` corrects C for light contacts.
Because the correction acts inside the solution, nodes stick and slip at the forces of the true skin.
"""

from dataclasses import dataclass

import numpy as np

from twin.compiled import compiled
from twin.store import Layers, silu, through_layers
from twin.types import FloatArray

AMPLE = 0.1
"""Mean square of the scaled inputs at which the gate of the network is three quarters open."""
LOOSE = {"reassoc", "contract", "arcp", "nsz"}
"""What the compiler may assume about sums and products of this module."""
TAKEN = 0.5
"""Relaxation factor of an update of the bending. With 1, solutions of deep contacts oscillate: a skin that bends more bears less force."""


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

    def of(self, linear: FloatArray) -> FloatArray:
        """Displacements (S, M, 3) mm to add to the linear skin's. ``linear`` (S, K) is the linear skin's answer in the pins' modes."""
        x = linear / self.scale
        gated = ample(x)[:, None] * through_layers(self.layers, x, silu)
        return np.tensordot(x @ self.straight.T + gated, self.modes, axes=1)

    def kernel(self, read: FloatArray) -> tuple[FloatArray, ...]:
        """The arrays that ``bend`` takes, in its memory layout; ``read`` (K, 3 M) is the linear skin's answer in the modes of the pins."""
        seen = (read / self.scale[:, None]).T.reshape(-1, 3, len(read))
        (first, a), (second, b), (third, c) = self.layers
        given = seen, first.T, a, second.T, b, third.T, c, self.straight.T, self.modes.transpose(0, 2, 1)
        return tuple(np.ascontiguousarray(values, np.float32) for values in given)


def ample(x: FloatArray) -> FloatArray:
    """The gate of the network, (S,), from 0 to 1, for scaled inputs (S, K)."""
    return np.tanh((x**2).mean(axis=1) / AMPLE)


def unbent(nodes: int) -> tuple[FloatArray, ...]:
    """The arrays that ``bend`` takes for a linear skin: it then adds nothing."""
    shapes = (nodes, 3, 1), (1, 1), (1,), (1, 1), (1,), (1, 0), (0,), (1, 0), (0, 3, nodes)
    return tuple(np.zeros(shape, np.float32) for shape in shapes)


@compiled(nogil=True, fastmath=LOOSE)
def add_product(x: FloatArray, matrix: FloatArray, out: FloatArray) -> None:
    """Add ``x`` (i,) times a matrix (i, o) to ``out`` (o,)."""
    for k in range(len(x)):
        row, value = matrix[k], x[k]
        for o in range(len(out)):
            out[o] += row[o] * value


@compiled(nogil=True, fastmath=LOOSE)
def apply_silu(x: FloatArray) -> None:
    """Apply the activation of the layers to ``x`` (i,)."""
    for k in range(len(x)):
        x[k] = x[k] / (np.float32(1.0) + np.exp(-x[k]))


@compiled(nogil=True, fastmath=LOOSE)
def bend(force: FloatArray, bent: FloatArray, moved: FloatArray, network: tuple[FloatArray, ...]) -> float:
    """Update the bending ``bent`` (3, M) float32 toward that of the forces (M, 3), and the displacements ``moved`` (M, 3) by the same.

    ``network`` is as ``Bending.kernel`` gives it. Returns the largest change along an axis, mm.
    """
    read, first, a, second, b, third, c, straight, modes = network
    count = len(c)
    if count == 0:
        return 0.0
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
    one, two, out = a.copy(), b.copy(), c.copy()
    add_product(x, first, one)
    apply_silu(one)
    add_product(one, second, two)
    apply_silu(two)
    add_product(two, third, out)
    for o in range(count):
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
