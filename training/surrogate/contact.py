"""Contact and friction on the skin: exact Coulomb contact at a few hundred nodes, with friction's memory.

Forces f at the nodes displace the skin by u = C f (see ``compliance``) plus the bending of ``model``. At every pose of the object the
solver looks for forces with which each node is in one of three states: it is clear of the object; it presses and sticks to its anchor; or
it presses and slides at Coulomb's bound. It starts from the forces of the last pose, corrects one node at a time while it keeps the others
fixed, and repeats this until no force changes (projected Gauss-Seidel: Jourdan, Alart & Jean 1998). Then it evaluates the bending again.
An anchor is a point of the object: where the node first touched it, or where the node stopped sliding. So the memory neither drifts nor
fades, and it ends with the contact.

A motion is solved in short load steps, because friction's memory and the normals at a sharp edge depend on the path. In each step the arm
turns under the force so far; at the end of the motion this is repeated until the arm is at rest.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from training.surrogate.model import LOOSE, Network, bend
from training.surrogate.solids import distances_to
from twin.compiled import compiled
from twin.objects.analytic import CompiledSolid
from twin.rig.contact import ArmTurning
from twin.types import BoolArray, FloatArray, IntArray

STEP_MM = 0.4
"""Largest motion across the dome in one load step. With longer steps the error of the force on an edge is up to a sixth."""
BENT_MM = 0.02
"""Convergence threshold of the bending in a motion's last load step: a tenth of a pixel, and a hundredth of a usual indentation."""
REACH_MM = 0.8
"""Largest distance from the object at which a node takes part in a solution."""
SWEEPS = (12, 6, 6)
"""Largest number of sweeps over the nodes after each evaluation of the distances and the bending. Every load step has the first
evaluation; only the last load step of a motion has the others."""
TOLERANCE_N = 5e-4
"""Convergence threshold: largest change of a node's force in a sweep, a hundredth of the force at a node in a usual contact."""
YIELDING_MM_PER_N = 2e-3
"""Additional normal compliance of each node. It makes nodes on sharp edges well-behaved and costs 0.5 % of the stiffness."""
SLIDES = 0.999
"""Share of Coulomb's bound from which a node counts as sliding."""
STILL_N = 1e-7
"""Smallest force, and smallest change of a force, that counts as more than zero."""
ROWS_OF_A_THREAD = 8
"""Smallest number of contacts for each thread: with fewer a thread is not worth its cost."""
MOST_THREADS = 2
"""Largest number of threads. More gain little, because the rest of the program runs on one core."""
NO_TURN = 1e-9
"""Sine up to which an angle counts as zero."""
SIZES = 4
"""Largest number of parameters that give a solid's size."""
SETTLED_MM = 0.02
"""Motion across the dome up to which a compliant arm counts as at rest."""
MOST_SETTLING = 2
"""Largest number of extra load steps at the end of a motion, until a compliant arm is at rest."""


class Laws(NamedTuple):
    """What B contacts obey, and their poses and friction: the attributes of ``LinearContacts`` of these names."""

    kind: IntArray
    sizes: FloatArray
    friction: FloatArray
    compliance_mm_per_n: FloatArray
    turning: FloatArray
    taken: FloatArray
    used: FloatArray


class Nodes(NamedTuple):
    """State of the nodes of all contacts, or of one contact: the attributes of ``LinearContacts`` of these names."""

    force_n: FloatArray
    moved_mm: FloatArray
    bent_mm: FloatArray
    anchor_mm: FloatArray
    seen_mm: FloatArray
    gap_mm: FloatArray
    held: BoolArray
    slides: BoolArray


class Touching(NamedTuple):
    """The q nodes near an object, their displacements (q, 3, 3, q) float32 for forces at each other (see ``_solve``), the object's turn
    (3, 3), and the places, distances and normals of all nodes in its frame."""

    near: IntArray
    among: FloatArray
    turn: FloatArray
    here: FloatArray
    gap: FloatArray
    normal: FloatArray


class Kept(NamedTuple):
    """The near nodes (k, M + 1) of each contact's last load step, -1 behind them, and their ``Touching.among`` (k, 9 M^2) laid flat.

    With many contacts k is 0: they would need too much memory.
    """

    near: IntArray
    among: FloatArray


class LinearContacts:
    """B contacts of one linear skin with M nodes; at first nothing is touched.

    Parameters
    ----------
    node_mm : (M, 3) float
        Nodes at rest.
    answer : (M, M, 3, 3) float
        As of ``Surrogate``; stored as (M, 3, 3, M) float32: displacement (third) of node j (last) for a force along an axis (second) at
        node i (first), mm/N.
    count : int
        B.
    bending : tuple of float32 arrays
        Arrays of the network that corrects the linear skin (see ``Bending.kernel``).
    still_mm : float
        Change of the bending between two motions up to which one evaluation of it is enough for a load step. With more than 0, a motion in
        very small steps costs half.

    Attributes
    ----------
    radius_mm : float
        Radius of the dome.
    kind : (B,) int
        Kinds of the solids (see ``twin.objects.analytic.solid``).
    sizes : (B, SIZES) float
        Parameters that give the solids' sizes.
    friction, compliance_mm_per_n : (B,) float
        Coulomb's coefficient; compliance of object and holder along z.
    turning : (B, 10) float
        Compliance of the arms (see ``ArmTurning``): across, axis, tool point, and rad/N.
    taken : (B, 4, 4) float
        Actual poses of the objects: the commanded poses, turned by the compliance of the arms.
    force_n, moved_mm : (B, M, 3) float
        Forces on the skin and displacements, sensor frame.
    anchor_mm, seen_mm : (B, M, 3) float
        Friction's anchors, and the nodes at the last pose, in the object's frame.
    bent_mm : (B, 3, M) float32
        The network's part of the displacements.
    gap_mm : (B, M) float
        Distances at the last pose; infinite before the first.
    held, slides : (B, M) bool
        Nodes that press, and those of them that slide.
    used : (B,) float
        Share of Coulomb's bound that the pressing nodes bear together.
    """

    def __init__(self, node_mm: FloatArray, answer: FloatArray, count: int, *, bending: Network, still_mm: float = 0.0) -> None:
        size = len(node_mm)
        self.node_mm, self.answer = node_mm, np.ascontiguousarray(answer.transpose(0, 3, 2, 1), np.float32)
        self.radius_mm = float(np.linalg.norm(node_mm[0]))
        self.bending, self.still_mm = bending, still_mm
        self.kind, self.sizes, self.turning = np.zeros(count, np.int64), np.zeros((count, SIZES)), np.zeros((count, 10))
        self.friction, self.compliance_mm_per_n, self.used = np.zeros((3, count))
        self.taken = np.tile(np.eye(4), (count, 1, 1))
        self.force_n, self.moved_mm, self.anchor_mm, self.seen_mm = np.zeros((4, count, size, 3))
        self.bent_mm, self.gap_mm = np.zeros((count, 3, size), np.float32), np.full((count, size), np.inf)
        self.held, self.slides = np.zeros((2, count, size), bool)
        self._state = tuple(kind(*(getattr(self, name) for name in kind._fields)) for kind in (Laws, Nodes))
        few = count if count <= ROWS_OF_A_THREAD else 0
        self._kept = Kept(np.full((few, size + 1), -1), np.empty((few, 9 * size**2), np.float32))

    def begin(
        self, row: int, thing: CompiledSolid, friction: float, *, compliance_mm_per_n: float = 0.0, turning: ArmTurning | None = None
    ) -> None:
        """Set the object, friction and compliance of one sensor, and set it to rest."""
        sizes = thing.sizes
        self.kind[row], self.sizes[row, : len(sizes)] = thing.kind, sizes
        self.friction[row], self.compliance_mm_per_n[row] = friction, compliance_mm_per_n
        self.turning[row] = 0.0
        if turning is not None:
            self.turning[row] = [*turning.across, *turning.axis, *turning.tool_mm, np.radians(turning.deg_per_n)]
        self.free(row)

    def free(self, row: int | Sequence[int] | IntArray) -> None:
        """Remove the contacts of some rows with their friction memory."""
        for values in (self.force_n, self.moved_mm, self.bent_mm, self.held, self.slides, self.used):
            values[row] = 0
        self.gap_mm[row] = np.inf

    def move(self, rows: IntArray, start: FloatArray, stop: FloatArray) -> None:
        """Move the objects of some rows (R,) from poses ``start`` (R, 4, 4) to ``stop``: in a straight line, with a turn about one axis."""
        skin = self.node_mm, self.answer, self.bending, self.still_mm

        def follow(which: slice) -> None:
            given = [np.ascontiguousarray(values[which]) for values in (rows, start, stop)]
            _follow(*given, skin, *self._state, self._kept)

        threads = min(len(rows) // ROWS_OF_A_THREAD, MOST_THREADS)
        if threads < 2:
            follow(slice(None))
            return
        with ThreadPoolExecutor(threads) as pool:  # rows do not touch each other's state, so the result does not depend on the threads
            list(pool.map(follow, [slice(number, None, threads) for number in range(threads)]))

    def distances(self, rows: IntArray, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances of objects at ``T`` (R, 4, 4) from the undeformed domes.

        Returns
        -------
        gap_mm : (R, M) float
            Distances of the nodes at rest from the object.
        centre : (R, 2) float
            Distance of the dome's centre from the object, and the cosine of the angle between the apex and the dome's place nearest to the
            object. They give the depth exactly, also where the deepest place lies between or beyond the nodes.
        """
        return _distances(rows, np.ascontiguousarray(T), self.node_mm, self.kind, self.sizes)


@compiled()
def between(start: FloatArray, stop: FloatArray, steps: int) -> FloatArray:
    """Poses (steps, 4, 4) after each of equal steps of a path: the origin moves in a straight line, the object turns about a fixed axis."""
    T = np.empty((steps, 4, 4))
    T[:] = stop
    if steps == 1:
        return T
    turn = start[:3, :3].copy() @ stop[:3, :3].T.copy()
    cross = (turn - turn.T) / 2  # with the axis, times the sine of the angle (less than a right one)
    sine = np.sqrt(cross[2, 1] ** 2 + cross[0, 2] ** 2 + cross[1, 0] ** 2)
    angle = np.arctan2(sine, (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1) / 2)
    there = stop[:3, :3].copy()
    for k in range(steps - 1):
        left = 1 - (k + 1) / steps
        T[k, :3, 3] += left * (start[:3, 3] - stop[:3, 3])
        if sine > NO_TURN:
            axis = cross / sine
            T[k, :3, :3] += (np.sin(angle * left) * axis + (1 - np.cos(angle * left)) * (axis @ axis)) @ there  # Rodrigues' formula
    return T


@compiled()
def _distances(rows: IntArray, T: FloatArray, node: FloatArray, kind: IntArray, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    gap, centre = np.empty((len(rows), len(node))), np.empty((len(rows), 2))
    points, middle = np.empty_like(node), np.empty((1, 3))
    still, origin = np.zeros_like(node), np.zeros((1, 3))
    for r in range(len(rows)):
        row, turn, place = rows[r], T[r, :3, :3], T[r, :3, 3]
        _to_object_frame(node, still, turn, place, points)
        found, _ = distances_to(points, kind[row], sizes[row])
        gap[r] = found
        _to_object_frame(origin, origin, turn, place, middle)
        distance, outward = distances_to(middle, kind[row], sizes[row])
        centre[r, 0] = distance[0]
        centre[r, 1] = -(turn[2, 0] * outward[0, 0] + turn[2, 1] * outward[0, 1] + turn[2, 2] * outward[0, 2])
    return gap, centre


@compiled(nogil=True)
def _follow(rows: IntArray, start: FloatArray, stop: FloatArray, skin: tuple[Any, ...], laws: Laws, nodes: Nodes, kept: Kept) -> None:
    """Solve each row's motion from ``start`` to ``stop`` (R, 4, 4) in load steps.

    The arrays of all B rows are those of ``LinearContacts``; ``skin`` are its nodes, their compliance, its bending and ``still_mm``.
    """
    node, answer, bending, still_mm = skin
    here = np.empty_like(node)
    shift = np.empty((3, len(node)), np.float32)
    near = np.empty(len(node), np.int64)
    force, moved, bent, anchor, seen, before, held, slides = nodes
    for r in range(len(rows)):
        row = rows[r]
        steps = max(int(np.ceil(moved_mm(start[r], stop[r], node[0, 2]) / STEP_MM)), 1)
        mu, soft, last = laws.friction[row], laws.compliance_mm_per_n[row], steps - 1
        way = between(start[r], stop[r], steps)
        mine = Nodes(force[row], moved[row], bent[row], anchor[row], seen[row], before[row], held[row], slides[row])
        for step in range(steps + MOST_SETTLING):
            T = _deflect_arm(way[min(step, last)], laws.turning[row], mine.force_n)
            if step > last and moved_mm(laws.taken[row], T, node[0, 2]) <= SETTLED_MM:
                break
            laws.taken[row] = T
            turn, place = T[:3, :3], T[:3, 3]
            count, change, off = 0, np.inf, np.inf
            gap = before[row]
            among = np.empty((0, 3, 3, 0), np.float32)
            for part in range(len(SWEEPS) if step >= last else 1):
                if part and (not count or (change < still_mm and off < TOLERANCE_N)):
                    break
                change = bend(mine.force_n, mine.bent_mm, mine.moved_mm, bending)
                if part > 1 and change < BENT_MM:
                    break
                _to_object_frame(node, mine.moved_mm, turn, place, here)
                gap, normal = distances_to(here, laws.kind[row], laws.sizes[row])
                if part == 0:
                    for i in range(len(node)):
                        if gap[i] < REACH_MM or held[row, i]:
                            near[count] = i
                            count += 1
                            if not held[row, i]:
                                _anchor(here[i], gap[i], anchor[row, i], seen[row, i], before[row, i])
                    among = _among(answer, near[:count], row, kept)
                if count:
                    off = _solve(answer, Touching(near[:count], among, turn, here, gap, normal), mine, shift, mu, soft, part)
            if count:
                _to_object_frame(node, mine.moved_mm, turn, place, here)
                laws.used[row] = _record_friction(Touching(near[:count], among, turn, here, gap, normal), mine, mu)
            before[row], seen[row] = gap, here


@compiled()
def _deflect_arm(T: FloatArray, turning: FloatArray, force: FloatArray) -> FloatArray:
    """The object's pose (4, 4) after an arm has turned under the skin's forces (M, 3); see ``ArmTurning``."""
    if turning[9] == 0:
        return T
    angle = 0.0
    for p in range(3):
        angle += turning[9] * turning[p] * force[:, p].sum()
    sine, rest = np.sin(angle), 1 - np.cos(angle)
    x, y, z = turning[3], turning[4], turning[5]
    turn = np.array(
        [
            [1 - rest * (y * y + z * z), rest * x * y - sine * z, rest * x * z + sine * y],
            [rest * x * y + sine * z, 1 - rest * (x * x + z * z), rest * y * z - sine * x],
            [rest * x * z - sine * y, rest * y * z + sine * x, 1 - rest * (x * x + y * y)],
        ]
    )
    there = np.zeros((4, 4))
    there[3, 3] = 1.0
    for p in range(3):
        there[p, 3] = turning[6 + p]
        for q in range(3):
            there[p, 3] += turn[p, q] * (T[q, 3] - turning[6 + q])
            for k in range(3):
                there[p, q] += turn[p, k] * T[k, q]
    return there


@compiled()
def moved_mm(start: FloatArray, stop: FloatArray, radius_mm: float) -> float:
    """Upper bound of an object's motion across a dome, mm, between two poses (4, 4)."""
    trace, off = 0.0, 0.0
    for p in range(3):
        here = stop[p, 3]
        for q in range(3):
            turn = 0.0
            for k in range(3):
                turn += stop[p, k] * start[q, k]
            trace += turn if p == q else 0.0
            here -= turn * start[q, 3]
        off += here * here
    return np.sqrt(off) + np.arccos(min(max((trace - 1) / 2, -1.0), 1.0)) * radius_mm


@compiled()
def _to_object_frame(node: FloatArray, moved: FloatArray, turn: FloatArray, place: FloatArray, here: FloatArray) -> None:
    """Write the nodes' positions in the object's frame to ``here`` (M, 3)."""
    for i in range(len(node)):
        x, y, z = node[i, 0] + moved[i, 0] - place[0], node[i, 1] + moved[i, 1] - place[1], node[i, 2] + moved[i, 2] - place[2]
        for p in range(3):
            here[i, p] = x * turn[0, p] + y * turn[1, p] + z * turn[2, p]


@compiled()
def _anchor(here: FloatArray, gap: float, anchor: FloatArray, seen: FloatArray, before: float) -> None:
    """Anchor a free node where it is, or where it crossed the object's surface in this step."""
    share = 1.0
    if gap < 0 < before and before < np.inf:
        share = before / (before - gap)
    for k in range(3):
        anchor[k] = here[k] if share == 1.0 else seen[k] + share * (here[k] - seen[k])


@compiled()
def _among(answer: FloatArray, near: IntArray, row: int, kept: Kept) -> FloatArray:
    """The displacements (q, 3, 3, q) float32 of a row's near nodes (q,) for forces at each other."""
    count = len(near)
    if row < len(kept.near):
        c = kept.among[row, : 9 * count**2].reshape(count, 3, 3, count)
        if kept.near[row, count] == -1 and (kept.near[row, :count] == near).all():
            return c
        kept.near[row, :count] = near
        kept.near[row, count] = -1
    else:
        c = np.empty((count, 3, 3, count), np.float32)
    for a in range(count):
        rows = answer[near[a]]
        for q in range(3):
            for p in range(3):
                for b in range(count):
                    c[a, q, p, b] = rows[q, p, near[b]]
    return c


@compiled(fastmath=LOOSE)
def _solve(answer: FloatArray, at: Touching, nodes: Nodes, shift: FloatArray, friction: float, compliance: float, part: int) -> float:
    """Solve for the forces (M, 3) of the near nodes (q,) and the displacements (M, 3) of all nodes.

    Distances and normals are linearised at ``here`` (M, 3). The displacements are the linear skin's plus ``bent_mm`` (3, M) float32;
    ``shift`` (3, M) float32 is working memory. Returns the largest change of a force in the last sweep.
    """
    near, c, turn, here, gap, normal = at
    force, moved, bent, anchor, _, _, _, _ = nodes
    count = len(near)
    n, lag = np.empty((count, 3)), np.empty((count, 3))
    across, along = np.empty(count), np.empty(count)
    moving = np.zeros((3, count), np.float32)
    sunk = 0.0  # displacement of the compliant object along z
    for a in range(count):
        i = near[a]
        x, y, z = here[i, 0] - anchor[i, 0], here[i, 1] - anchor[i, 1], here[i, 2] - anchor[i, 2]
        for p in range(3):
            n[a, p] = turn[p, 0] * normal[i, 0] + turn[p, 1] * normal[i, 1] + turn[p, 2] * normal[i, 2]
            lag[a, p] = turn[p, 0] * x + turn[p, 1] * y + turn[p, 2] * z
        total, trace = compliance * n[a, 2] * n[a, 2], compliance
        for p in range(3):
            trace += c[a, p, p, a]
            for q in range(3):
                total += n[a, p] * c[a, q, p, a] * n[a, q]
        across[a] = total + YIELDING_MM_PER_N
        along[a] = (trace - total) / 2
    worst = 0.0
    for _ in range(SWEEPS[part]):
        worst = 0.0
        for a in range(count):
            i = near[a]
            n0, n1, n2 = n[a, 0], n[a, 1], n[a, 2]
            f0, f1, f2 = force[i, 0], force[i, 1], force[i, 2]
            s0, s1, s2 = float(moving[0, a]), float(moving[1, a]), moving[2, a] + sunk
            press = n0 * f0 + n1 * f1 + n2 * f2
            off = gap[i] + n0 * s0 + n1 * s1 + n2 * s2 + YIELDING_MM_PER_N * press
            pressed = press - off / across[a]
            if pressed <= 0:
                if f0 == 0 and f1 == 0 and f2 == 0:
                    continue
                d0, d1, d2 = -f0, -f1, -f2
            else:
                x, y, z = lag[a, 0] + s0, lag[a, 1] + s1, lag[a, 2] + s2
                up = n0 * x + n1 * y + n2 * z
                t0 = f0 - press * n0 - (x - up * n0) / along[a]
                t1 = f1 - press * n1 - (y - up * n1) / along[a]
                t2 = f2 - press * n2 - (z - up * n2) / along[a]
                size, most = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2), friction * pressed
                keep = most / size if size > most else 1.0
                d0, d1, d2 = pressed * n0 + keep * t0 - f0, pressed * n1 + keep * t1 - f1, pressed * n2 + keep * t2 - f2
            change = abs(d0) + abs(d1) + abs(d2)
            if change < STILL_N:
                continue
            worst = max(worst, change)
            force[i, 0], force[i, 1], force[i, 2] = f0 + d0, f1 + d1, f2 + d2
            sunk += compliance * d2
            e0, e1, e2 = np.float32(d0), np.float32(d1), np.float32(d2)
            k = c[a]
            for p in range(3):
                for b in range(count):
                    moving[p, b] += k[0, p, b] * e0 + k[1, p, b] * e1 + k[2, p, b] * e2
        if worst < TOLERANCE_N:
            break
    shift[:] = 0.0
    sunk = 0.0
    for a in range(count):
        i = near[a]
        e0, e1, e2 = np.float32(force[i, 0]), np.float32(force[i, 1]), np.float32(force[i, 2])
        if e0 != 0 or e1 != 0 or e2 != 0:
            sunk += compliance * force[i, 2]
            rows = answer[i]
            for p in range(3):
                for j in range(shift.shape[1]):
                    shift[p, j] += rows[0, p, j] * e0 + rows[1, p, j] * e1 + rows[2, p, j] * e2
    for j in range(len(moved)):
        moved[j, 0], moved[j, 1], moved[j, 2] = shift[0, j] + bent[0, j], shift[1, j] + bent[1, j], shift[2, j] + bent[2, j] + sunk
    return worst


@compiled()
def _record_friction(at: Touching, nodes: Nodes, friction: float) -> float:
    """Record which nodes press and which slide, and move the anchors of sliding nodes with them.

    Returns the ratio of the tangential forces to Coulomb's bound, each summed over the pressing nodes.
    """
    near, _, turn, here, _, normal = at
    force, _, _, anchor, _, _, held, slides = nodes
    held[:] = False
    slides[:] = False
    bound, borne = 0.0, 0.0
    for i in near:
        press, size = 0.0, 0.0
        for p in range(3):
            press += force[i, p] * (turn[p, 0] * normal[i, 0] + turn[p, 1] * normal[i, 1] + turn[p, 2] * normal[i, 2])
        for p in range(3):
            size += (force[i, p] - press * (turn[p, 0] * normal[i, 0] + turn[p, 1] * normal[i, 1] + turn[p, 2] * normal[i, 2])) ** 2
        if press > STILL_N:
            held[i] = True
            bound += friction * press
            borne += np.sqrt(size)
            slides[i] = friction > 0 and np.sqrt(size) >= SLIDES * friction * press
            if slides[i]:
                anchor[i] = here[i]
    return borne / bound if bound > 0 else 0.0
