"""Delaunay triangles of pins that moved, from the triangles at rest by flips of edges (Lawson 1977): few change, so it is fast.

One more node lies at infinity. It makes a triangle with each side of the outline, so that the same flips also make the outline convex.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.compiled import compiled

AMBIGUOUS = 1e-9
"""Least distance of a node from a circle, relative to its size. The order of nearer ones depends on rounding."""
MOST_FLIPS = 50
"""Largest number of flips for each triangle."""


@dataclass(frozen=True)
class Net:
    """Triangles of n nodes, with node n at infinity.

    Attributes
    ----------
    triangles : (t, 3) int
    beyond : (t, 3) int
        The triangle beyond the side opposite to each corner.
    px : (n, 2) float or None
        The nodes of which these are the Delaunay triangles, if they were tested.
    """

    triangles: np.ndarray
    beyond: np.ndarray
    px: np.ndarray | None = None

    @cached_property
    def edges(self) -> np.ndarray:
        """Directed edges (E, 2) of the triangles, as ``directed_edges`` gives them."""
        return directed_edges(self.triangles, self.triangles.max())

    def move(self, px: np.ndarray) -> "Net | None":
        """The net of the Delaunay triangles of nodes (n, 2) that moved.

        None if one of the net's triangles is turned over, or if four nodes on a circle or three on the outline make them ambiguous.
        """
        if self.px is not None and np.array_equal(px, self.px):
            return self
        triangles, beyond, flips = _flip(px, self.triangles, self.beyond)
        if flips < 0:
            return None
        found = Net(triangles, beyond, px)
        if not flips:
            found.__dict__["edges"] = self.edges
        return found


def directed_edges(triangles: np.ndarray, n: int) -> np.ndarray:
    """Directed edges (E, 2), sorted: both directions of each side of the triangles over ``n`` nodes. Nodes from ``n`` on are left out."""
    corners = triangles[(triangles < n).all(axis=1)].astype(np.int64)
    starts, ends = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    joined = np.zeros(n * n, bool)
    joined[starts * n + ends] = joined[ends * n + starts] = True
    return np.column_stack(np.divmod(np.flatnonzero(joined), n))


def net_of(triangles: np.ndarray, n: int) -> Net | None:
    """The net of triangles (t, 3) over ``n`` nodes, all with the same orientation; None if they leave a node out, or are no disc."""
    sides = {(int(a), int(b)): k for k, triangle in enumerate(triangles) for a, b in zip(triangle, np.roll(triangle, -1), strict=True)}
    outer = [(a, b) for a, b in sides if (b, a) not in sides]
    whole = np.array([*triangles.tolist(), *((b, a, n) for a, b in outer)])
    once = len(sides) == 3 * len(triangles) and len({a for a, _ in outer}) == len(outer)
    if not once or len(whole) != 2 * n - 2 or len(np.unique(whole)) <= n:
        return None
    sides = {(int(t[k]), int(t[(k + 1) % 3])): number for number, t in enumerate(whole) for k in range(3)}
    beyond = [[sides[int(t[(k + 2) % 3]), int(t[(k + 1) % 3])] for k in range(3)] for t in whole]
    return Net(whole, np.array(beyond))


@compiled()
def double_area(px: np.ndarray, a: int, b: int, c: int) -> float:
    """Twice the signed area of a triangle of three of the points (N, 2)."""
    return (px[b, 0] - px[a, 0]) * (px[c, 1] - px[a, 1]) - (px[b, 1] - px[a, 1]) * (px[c, 0] - px[a, 0])


@compiled()
def _inside(px: np.ndarray, p: int, q: int, r: int, s: int) -> float:
    """How far node s lies inside the circle through p, q, r, relative to the size of both: positive if the side q r has to be flipped."""
    n = len(px)
    if p == n or s == n:
        return -1.0
    ax, ay = px[p, 0] - px[s, 0], px[p, 1] - px[s, 1]
    if q == n or r == n:  # the circle is a straight line
        area = double_area(px, p, s, r) if q == n else double_area(px, p, q, s)
        return area / (ax * ax + ay * ay)
    bx, by, cx, cy = px[q, 0] - px[s, 0], px[q, 1] - px[s, 1], px[r, 0] - px[s, 0], px[r, 1] - px[s, 1]
    a2, b2, c2 = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    return (ax * (by * c2 - b2 * cy) - ay * (bx * c2 - b2 * cx) + a2 * (bx * cy - by * cx)) / (a2 + b2 + c2) ** 2


@compiled()
def _flip(px: np.ndarray, triangles: np.ndarray, beyond: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Triangles and neighbours (t, 3) of a net after flips that make it Delaunay, and the number of flips: -1 if that is not possible."""
    n = len(px)
    triangles, beyond = triangles.copy(), beyond.copy()
    for a, b, c in triangles:
        if max(a, b, c) < n and double_area(px, a, b, c) <= 0:
            return triangles, beyond, -1
    doubtful = [(t, k) for t in range(len(triangles)) for k in range(3) if t < beyond[t, k]]
    flips = 0
    while doubtful:
        t, i = doubtful.pop()
        u = beyond[t, i]
        j = 0
        while beyond[u, j] != t:
            j += 1
        p, q, r, s = triangles[t, i], triangles[t, (i + 1) % 3], triangles[t, (i + 2) % 3], triangles[u, j]
        inside = _inside(px, p, q, r, s)
        if abs(inside) < AMBIGUOUS or flips > MOST_FLIPS * len(triangles):
            return triangles, beyond, -1
        if inside < 0:
            continue
        flips += 1
        beside_t, opposite = beyond[t, (i + 1) % 3], beyond[u, (j + 1) % 3]  # beyond r p, and beyond q s
        triangles[t, (i + 2) % 3], triangles[u, (j + 2) % 3] = s, p
        beyond[t, i], beyond[u, j] = opposite, beside_t
        beyond[t, (i + 1) % 3], beyond[u, (j + 1) % 3] = u, t
        for one, other, new in ((opposite, u, t), (beside_t, t, u)):
            for k in range(3):
                if beyond[one, k] == other:
                    beyond[one, k] = new
                    break
        doubtful += [(number, k) for k in range(3) for number in (t, u)]
    return triangles, beyond, flips
