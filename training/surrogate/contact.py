"""Contact and friction on the linear skin: exact Coulomb contact at some hundred nodes, with all that friction remembers.

The skin's answer to forces f at its nodes is u = C f (see ``compliance``). At every pose of the object the forces are sought for which
each node either is clear of the object, or presses without entering it and sticks to its anchor, or slides at Coulomb's bound. Node
after node is put right, the others held, until nothing changes (projected Gauss-Seidel: Jourdan, Alart & Jean 1998), beginning with the
forces of the last pose. Anchors are places of the object: where a node touched it first, or where it stopped sliding. So what is
remembered neither drifts nor fades, and ends with the contact.
"""

from dataclasses import dataclass

import numpy as np

from twin.compiled import compiled
from twin.objects import ObjectField
from twin.types import BoolArray, FloatArray, IntArray

REACH_MM = 0.8
"""Nodes farther than this from the object are left out of a solution."""
SWEEPS = (12, 6)
"""Most sweeps over the nodes, before and after the distances are looked up anew."""
TOLERANCE_N = 5e-4
"""A solution ends when no node's force changes by more in a sweep: a hundredth of a usual contact's force at a node."""
YIELDING_MM_PER_N = 2e-3
"""Each node gives way by this beside the skin: it makes nodes on sharp edges well-behaved and costs 0.5 % of the stiffness."""
SLIDES = 0.999
"""A node slides when it bears this share of Coulomb's bound."""


@dataclass
class LinearContacts:
    """B contacts of one linear skin with M nodes.

    Attributes
    ----------
    node_mm : (M, 3) float
        At rest.
    answer : (M, M, 3, 3) float32
        Displacement of node j (second) for a force at node i (first), mm/N, ordered (displacement, force).
    force_n, moved_mm : (B, M, 3) float
        Forces on the skin and displacements, sensor frame.
    anchor_mm, seen_mm : (B, M, 3) float
        Friction's anchors, and the nodes at the last pose, in the object's frame.
    gap_mm : (B, M) float
        Distances at the last pose; infinite before the first.
    held, slides : (B, M) bool
        Nodes that press, and those of them that slide.
    """

    node_mm: FloatArray
    answer: FloatArray
    force_n: FloatArray
    moved_mm: FloatArray
    anchor_mm: FloatArray
    seen_mm: FloatArray
    gap_mm: FloatArray
    held: BoolArray
    slides: BoolArray

    @classmethod
    def at_rest(cls, node_mm: FloatArray, answer: FloatArray, count: int) -> "LinearContacts":
        """The contacts of ``count`` sensors that touch nothing."""
        size = len(node_mm)
        force, moved, anchor, seen = np.zeros((4, count, size, 3))
        held, slides = np.zeros((2, count, size), bool)
        return cls(node_mm, answer, force, moved, anchor, seen, np.full((count, size), np.inf), held, slides)

    def free(self, row: int) -> None:
        """Forget a contact."""
        for values in (self.force_n, self.moved_mm, self.held, self.slides):
            values[row] = 0
        self.gap_mm[row] = np.inf

    def move(self, row: int, field: ObjectField, T: FloatArray, friction: float, compliance_mm_per_n: float) -> None:
        """Bring the object to ``T`` (4, 4); it gives way along z by ``compliance_mm_per_n`` of the force."""
        turn, shift = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
        state = (self.force_n[row], self.moved_mm[row], self.anchor_mm[row], self.seen_mm[row], self.gap_mm[row])
        for part, sweeps in enumerate(SWEEPS):
            here = (self.node_mm + self.moved_mm[row] - shift) @ turn
            gap, normal, _ = field.probe(here)
            if part == 0:
                near = np.flatnonzero((gap < REACH_MM) | self.held[row])
                _anchor(near, self.held[row], here, gap, *state[2:])
            if len(near):
                _solve(self.answer, near, turn, here, gap, normal, *state[:3], friction, compliance_mm_per_n, sweeps)
        if len(near):
            here = (self.node_mm + self.moved_mm[row] - shift) @ turn
            _remember(near, turn, here, gap, normal, *state, friction, self.held[row], self.slides[row])
        else:
            self.seen_mm[row], self.gap_mm[row] = here, gap


@compiled()
def _anchor(
    near: IntArray, held: BoolArray, here: FloatArray, gap: FloatArray, anchor: FloatArray, seen: FloatArray, before: FloatArray
) -> None:
    """Anchor free nodes where they stand, or where they met the surface on the way."""
    for i in near:
        if not held[i]:
            share = 1.0
            if gap[i] < 0 < before[i] and np.isfinite(before[i]):
                share = before[i] / (before[i] - gap[i])
            for k in range(3):
                anchor[i, k] = here[i, k] if share == 1.0 else seen[i, k] + share * (here[i, k] - seen[i, k])


@compiled(fastmath=True, nogil=True)
def _solve(
    answer: FloatArray,
    near: IntArray,
    turn: FloatArray,
    here: FloatArray,
    gap: FloatArray,
    normal: FloatArray,
    force: FloatArray,
    moved: FloatArray,
    anchor: FloatArray,
    friction: float,
    compliance: float,
    sweeps: int,
) -> None:
    """Forces (M, 3) and displacements (M, 3) of the near nodes (q,), whose distances and normals are linearised at ``here`` (M, 3)."""
    count = len(near)
    c = np.empty((count, count, 3, 3), np.float32)
    n, lag, shift = np.empty((count, 3)), np.empty((count, 3)), np.zeros((count, 3))
    across, along = np.empty(count), np.empty(count)
    for a in range(count):
        i = near[a]
        for b in range(count):
            block = answer[i, near[b]]
            for p in range(3):
                for q in range(3):
                    c[a, b, p, q] = block[p, q]
            c[a, b, 2, 2] += compliance
        for p in range(3):
            n[a, p] = turn[p, 0] * normal[i, 0] + turn[p, 1] * normal[i, 1] + turn[p, 2] * normal[i, 2]
            lag[a, p] = (
                turn[p, 0] * (here[i, 0] - anchor[i, 0])
                + turn[p, 1] * (here[i, 1] - anchor[i, 1])
                + turn[p, 2] * (here[i, 2] - anchor[i, 2])
            )
        total = 0.0
        for p in range(3):
            for q in range(3):
                total += n[a, p] * c[a, a, p, q] * n[a, q]
        across[a] = total + YIELDING_MM_PER_N
        along[a] = (c[a, a, 0, 0] + c[a, a, 1, 1] + c[a, a, 2, 2] - total) / 2
    for _ in range(sweeps):
        worst = 0.0
        for a in range(count):
            i = near[a]
            n0, n1, n2 = n[a, 0], n[a, 1], n[a, 2]
            f0, f1, f2 = force[i, 0], force[i, 1], force[i, 2]
            press = n0 * f0 + n1 * f1 + n2 * f2
            off = gap[i] + n0 * shift[a, 0] + n1 * shift[a, 1] + n2 * shift[a, 2] + YIELDING_MM_PER_N * press
            pressed = press - off / across[a]
            if pressed <= 0:
                if f0 == 0 and f1 == 0 and f2 == 0:
                    continue
                d0, d1, d2 = -f0, -f1, -f2
            else:
                x, y, z = lag[a, 0] + shift[a, 0], lag[a, 1] + shift[a, 1], lag[a, 2] + shift[a, 2]
                up = n0 * x + n1 * y + n2 * z
                t0 = f0 - press * n0 - (x - up * n0) / along[a]
                t1 = f1 - press * n1 - (y - up * n1) / along[a]
                t2 = f2 - press * n2 - (z - up * n2) / along[a]
                size, most = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2), friction * pressed
                keep = most / size if size > most else 1.0
                d0, d1, d2 = pressed * n0 + keep * t0 - f0, pressed * n1 + keep * t1 - f1, pressed * n2 + keep * t2 - f2
            change = abs(d0) + abs(d1) + abs(d2)
            if change < 1e-7:
                continue
            worst = max(worst, change)
            force[i, 0], force[i, 1], force[i, 2] = f0 + d0, f1 + d1, f2 + d2
            for b in range(count):
                k = c[a, b]
                shift[b, 0] += k[0, 0] * d0 + k[0, 1] * d1 + k[0, 2] * d2
                shift[b, 1] += k[1, 0] * d0 + k[1, 1] * d1 + k[1, 2] * d2
                shift[b, 2] += k[2, 0] * d0 + k[2, 1] * d1 + k[2, 2] * d2
        if worst < TOLERANCE_N:
            break
    moved[:] = 0.0
    for a in range(count):
        i = near[a]
        f0, f1, f2 = force[i, 0], force[i, 1], force[i, 2]
        if f0 != 0 or f1 != 0 or f2 != 0:
            for j in range(len(moved)):
                k = answer[i, j]
                moved[j, 0] += k[0, 0] * f0 + k[0, 1] * f1 + k[0, 2] * f2
                moved[j, 1] += k[1, 0] * f0 + k[1, 1] * f1 + k[1, 2] * f2
                moved[j, 2] += k[2, 0] * f0 + k[2, 1] * f1 + k[2, 2] * f2 + compliance * f2


@compiled()
def _remember(
    near: IntArray,
    turn: FloatArray,
    here: FloatArray,
    gap: FloatArray,
    normal: FloatArray,
    force: FloatArray,
    moved: FloatArray,
    anchor: FloatArray,
    seen: FloatArray,
    before: FloatArray,
    friction: float,
    held: BoolArray,
    slides: BoolArray,
) -> None:
    """Which nodes press and slide; the anchors of sliding nodes go with them."""
    held[:] = False
    slides[:] = False
    for i in near:
        press, size = 0.0, 0.0
        for p in range(3):
            press += force[i, p] * (turn[p, 0] * normal[i, 0] + turn[p, 1] * normal[i, 1] + turn[p, 2] * normal[i, 2])
        for p in range(3):
            size += (force[i, p] - press * (turn[p, 0] * normal[i, 0] + turn[p, 1] * normal[i, 1] + turn[p, 2] * normal[i, 2])) ** 2
        if press > 1e-7:
            held[i] = True
            slides[i] = np.sqrt(size) >= SLIDES * friction * press
            if slides[i]:
                for p in range(3):
                    anchor[i, p] = here[i, p]
    before[:] = gap
    seen[:] = here
