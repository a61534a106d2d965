"""Delaunay triangles of the pins, and their Voronoi areas, clipped to the enlarged outline of the outmost pins.

Triangles: those of pins that moved follow from the triangles at rest by flips of edges (Lawson 1977): few change, so it is fast. One more
node lies at infinity. It makes a triangle with each side of the outline, so that the same flips also make the outline convex.

Boundary: the release adds the pins of the convex hull, scaled by 1.1 about the centre, as further sites. Its outer cells therefore end
half way, at 1.05. Its hexagon is not convex and needs additional virtual sites. Here the cells are clipped to the polygon through the
outmost pins, scaled by 1.05 about its centroid. The polygon has the layout's order, so it follows the concave sides of a hexagon. The
boundary is at the same place as in the release, but needs no virtual sites, and does not change suddenly when a pin joins or leaves the
convex hull. If the polygon is not usable, the convex hull is used.

A cell is the part of the region on the pin's side of the bisectors to all its Delaunay neighbours. Signed areas add up under cutting, so
the areas of the cells sum to that of the region up to rounding errors, for a region of any shape.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError

from twin.compiled import compiled

AMBIGUOUS = 1e-9
"""Least distance of a node from a circle, relative to its size. The order of nearer ones depends on rounding."""
MOST_FLIPS = 50
"""Largest number of flips for each triangle."""
# Factor by which the outline is enlarged about its centroid: half way to the release's additional sites, which lie at 1.1.
BOUNDARY_SCALE = 1.05
# The strip that replaces the hull of nodes on a line reaches beyond them by half this share of their length, and at least by half this
# many px.
STRIP_SHARE, LEAST_STRIP_PX = 0.05, 1.0
# Radius of the disc within a region, relative to the distance of its middle from its sides, which OpenCV gives with 7 digits.
WITHIN = 0.99999


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
        triangles, beyond = self.triangles.copy(), self.beyond.copy()
        flips = _flip(px, triangles, beyond, np.ones(len(triangles), bool))
        if flips < 0:
            return None
        found = Net(triangles, beyond, px)
        if not flips:
            found.__dict__["edges"] = self.edges
        return found


def directed_edges(triangles: np.ndarray, n: int) -> np.ndarray:
    """Directed edges (E, 2), sorted: both directions of each side of the triangles over ``n`` nodes. Nodes from ``n`` on are left out."""
    corners = triangles[(triangles < n).all(axis=1)].astype(np.int64)
    starts, ends = corners.ravel(), corners[:, (1, 2, 0)].ravel()
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
def _flip(px: np.ndarray, triangles: np.ndarray, beyond: np.ndarray, due: np.ndarray) -> int:
    """Make a net Delaunay by flips, in its triangles and neighbours (t, 3), and count them: -1 if that is not possible.

    A side is tested as soon as one of its triangles is no longer ``due`` (t,) bool: at first all are. A flip makes both due again.
    """
    n, flips, changed = len(px), 0, True
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if max(a, b, c) < n and (px[b, 0] - px[a, 0]) * (px[c, 1] - px[a, 1]) <= (px[b, 1] - px[a, 1]) * (px[c, 0] - px[a, 0]):
            return -1
    while changed:
        changed = False
        for t in range(len(triangles)):
            i = 0 if due[t] else 3
            due[t] = False
            while i < 3:
                first, second = i, i + 1 if i < 2 else 0
                third, u = 3 - first - second, beyond[t, i]
                i += 1
                if due[u]:
                    continue
                j = 0
                while beyond[u, j] != t:
                    j += 1
                p, q, r, s = triangles[t, first], triangles[t, second], triangles[t, third], triangles[u, j]
                inside = -1.0  # how far s lies inside the circle through p, q, r, relative to the size of both
                if p < n and s < n:
                    ax, ay = px[p, 0] - px[s, 0], px[p, 1] - px[s, 1]
                    a2 = ax * ax + ay * ay
                    if q == n:  # the circle is a straight line
                        inside = (ay * (px[r, 0] - px[s, 0]) - ax * (px[r, 1] - px[s, 1])) / a2
                    elif r == n:
                        inside = (ax * (px[q, 1] - px[s, 1]) - ay * (px[q, 0] - px[s, 0])) / a2
                    else:
                        bx, by, cx, cy = px[q, 0] - px[s, 0], px[q, 1] - px[s, 1], px[r, 0] - px[s, 0], px[r, 1] - px[s, 1]
                        b2, c2 = bx * bx + by * by, cx * cx + cy * cy
                        inside = ax * (by * c2 - b2 * cy) - ay * (bx * c2 - b2 * cx) + a2 * (bx * cy - by * cx)
                        inside /= (a2 + b2 + c2) * (a2 + b2 + c2)
                if abs(inside) < AMBIGUOUS or flips > MOST_FLIPS * len(triangles):
                    return -1
                if inside < 0:
                    continue
                flips += 1
                after = j + 1 if j < 2 else 0
                beside, opposite = beyond[t, second], beyond[u, after]  # beyond r p, and beyond q s
                triangles[t, third], triangles[u, 3 - j - after] = s, p
                beyond[t, first], beyond[u, j], beyond[t, second], beyond[u, after] = opposite, beside, u, t
                for k in range(3):
                    if beyond[opposite, k] == u:
                        beyond[opposite, k] = t
                    if beyond[beside, k] == t:
                        beyond[beside, k] = u
                due[t] = due[u] = changed = True
                break
    return flips


class Polygons(Sequence[np.ndarray]):
    """Polygons whose corners are in one array.

    Parameters
    ----------
    corners : (V, 2) float
    first : (n + 1,) int
        Where each polygon's corners begin.
    """

    def __init__(self, corners: np.ndarray, first: np.ndarray) -> None:
        self._corners, self._first = corners, first

    def __len__(self) -> int:
        return len(self._first) - 1

    def __getitem__(self, k: Any) -> Any:
        if isinstance(k, slice):
            return [self[i] for i in range(len(self))[k]]
        k = range(len(self))[k]
        return self._corners[self._first[k] : self._first[k + 1]]


@dataclass(frozen=True)
class Tessellation:
    """Cells of N nodes.

    Attributes
    ----------
    area_px2 : (N,) float
    cells : sequence of (k, 2) float
        Cell polygons. Nodes at the same place have the same cell, and each has an equal part of its area.
    region_px : (m, 2) float
        The polygon that the cells tile.
    """

    area_px2: np.ndarray
    cells: Sequence[np.ndarray]
    region_px: np.ndarray


def triangulate(nodes_px: np.ndarray) -> np.ndarray | None:
    """Delaunay triangles (t, 3) of the nodes (N, 2); None if there are none (nodes are collinear, coincide, or are fewer than 3)."""
    if len(nodes_px) < 3:
        return None
    try:
        mesh = Delaunay(nodes_px)
    except QhullError:
        return None
    return None if len(mesh.coplanar) else mesh.simplices


@compiled(error_model="numpy")
def _cut(
    nodes: np.ndarray,
    start: np.ndarray,
    neighbours: np.ndarray,
    outlines: np.ndarray,
    disc: np.ndarray,
    work: np.ndarray,
    area: np.ndarray,
    first: np.ndarray,
    corners: np.ndarray,
) -> None:
    """Cut every cell out of the region: its area (n,), its corners in one array, and where they begin, (n + 1,).

    Cutting (Sutherland and Hodgman 1974) starts from the region's bounding box, which has few corners: the first 4 of ``outlines``, before
    those of the region. The region contains a ``disc``: x, y, radius. Only a cell that extends beyond it is cut again, starting from the
    region itself. Corners that are too many for their array are only counted.
    """
    for i in range(len(area)):
        for attempt in range(2):
            count, now = 4 if attempt == 0 else len(outlines) - 4, 0
            for k in range(count):
                work[0, k, 0], work[0, k, 1] = outlines[4 * attempt + k, 0], outlines[4 * attempt + k, 1]
            for e in range(start[i], start[i + 1]):
                j = neighbours[e]
                a, b = nodes[j, 0] - nodes[i, 0], nodes[j, 1] - nodes[i, 1]
                c = 0.5 * (nodes[j, 0] ** 2 + nodes[j, 1] ** 2 - nodes[i, 0] ** 2 - nodes[i, 1] ** 2)
                kept = 0
                px, py = work[now, count - 1, 0], work[now, count - 1, 1]
                previous = a * px + b * py - c
                for k in range(count):
                    x, y = work[now, k, 0], work[now, k, 1]
                    here = a * x + b * y - c
                    if (here <= 0) != (previous <= 0):
                        t = previous / (previous - here)
                        work[1 - now, kept, 0], work[1 - now, kept, 1] = px + t * (x - px), py + t * (y - py)
                        kept += 1
                    if here <= 0:
                        work[1 - now, kept, 0], work[1 - now, kept, 1] = x, y
                        kept += 1
                    px, py, previous = x, y, here
                count, now = kept, 1 - now
                if count == 0:
                    break
            inside = count > 2
            for k in range(count):
                inside = inside and (work[now, k, 0] - disc[0]) ** 2 + (work[now, k, 1] - disc[1]) ** 2 < disc[2] ** 2
            if inside:
                break
        total, x, y = 0.0, work[now, 0, 0], work[now, 0, 1]  # relative to the first corner, which avoids cancellation of digits
        for k in range(1, count - 1):
            total += (work[now, k, 0] - x) * (work[now, k + 1, 1] - y) - (work[now, k + 1, 0] - x) * (work[now, k, 1] - y)
        area[i] = 0.5 * total
        for k in range(count):
            if first[i] + k < len(corners):
                corners[first[i] + k, 0], corners[first[i] + k, 1] = work[now, k, 0], work[now, k, 1]
        first[i + 1] = first[i] + count


def _tile(nodes: np.ndarray, start: np.ndarray, neighbours: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Area (n,) of every cell, the corners of all cells in one array, and where each cell's corners begin (n + 1,)."""
    n, m = len(nodes), len(region)
    x, y = region.mean(axis=0).tolist()
    radius = WITHIN * cv2.pointPolygonTest(region.astype(np.float32), (x, y), measureDist=True)
    (left, top), (right, bottom) = region.min(axis=0), region.max(axis=0)
    outlines = np.concatenate([[(left, top), (right, top), (right, bottom), (left, bottom)], region])
    area, first, corners = np.empty(n), np.zeros(n + 1, np.int64), np.empty((16 * n + 4 * m, 2))
    disc, work = np.array([x, y, radius]), np.empty((2, 2 * m + 2 * n + 8, 2))
    _cut(nodes, start, neighbours, outlines, disc, work, area, first, corners)
    if first[n] > len(corners):
        corners = np.empty((first[n], 2))
        _cut(nodes, start, neighbours, outlines, disc, work, area, first, corners)
    return area, corners[: first[n]], first


def _outline_region(nodes: np.ndarray, outmost: np.ndarray | None) -> np.ndarray | None:
    """The outmost nodes' polygon, enlarged and counter-clockwise (y up); None if it is not star-shaped about its middle."""
    if outmost is None or len(outmost) < 3:
        return None
    polygon = nodes[outmost]
    center = polygon.mean(axis=0)
    around = polygon - center
    (x, y), (x0, y0) = around.T, np.concatenate([around[-1:], around[:-1]]).T
    across = x0 * y - y0 * x
    turn = np.arctan2(across, x0 * x + y0 * y).sum()
    if across.min() * across.max() <= 0 or abs(abs(turn) - 2 * np.pi) > 1e-6:
        return None
    region = center + BOUNDARY_SCALE * around
    return region if turn > 0 else region[::-1]


def _hull_region(nodes: np.ndarray) -> np.ndarray:
    """The enlarged convex hull; for nodes on a line, a strip around them."""
    center = nodes.mean(axis=0)
    spread = nodes - center
    _, size, axes = np.linalg.svd(spread, full_matrices=True)
    if len(nodes) >= 3 and size[-1] > 1e-9 * max(size[0], 1.0):
        hull = nodes[ConvexHull(nodes).vertices]
        middle = hull.mean(axis=0)
        return middle + BOUNDARY_SCALE * (hull - middle)
    along = spread @ axes[0]
    margin = max(STRIP_SHARE * np.ptp(along), LEAST_STRIP_PX) / 2
    low, high = along.min() - margin, along.max() + margin
    corners = np.array([[low, -margin], [high, -margin], [high, margin], [low, margin]])
    region = center + corners @ axes
    return region if np.linalg.det(axes) > 0 else region[::-1]


def voronoi(nodes_px: np.ndarray, *, outmost: np.ndarray | None = None, edges: np.ndarray | None = None) -> Tessellation:
    """Voronoi cells of nodes, clipped to the enlarged outline (see the module).

    Parameters
    ----------
    nodes_px : (N, 2) float
        Finite positions, N >= 1; coincident or collinear ones are allowed.
    outmost : (m,) int, optional
        The outmost nodes, in order around the layout; their polygon is used if it is star-shaped.
    edges : (E, 2) int, optional
        The nodes' Delaunay edges as ``directed_edges`` gives them, if the caller has them.

    Raises
    ------
    ValueError
        ``nodes_px`` is not (N, 2), N >= 1, or not finite.
    """
    nodes_px = np.ascontiguousarray(nodes_px, float)
    if nodes_px.ndim != 2 or not len(nodes_px) or not np.isfinite(nodes_px).all():
        raise ValueError("nodes_px must be (N, 2), N >= 1, all finite")
    origin = nodes_px.mean(axis=0)
    nodes = sites = nodes_px - origin
    share, back = None, None
    if edges is None and (triangles := triangulate(nodes)) is not None:
        edges = directed_edges(triangles, len(nodes))
    if edges is None:  # all others are a site's neighbours
        sites, back, share = np.unique(nodes, axis=0, return_inverse=True, return_counts=True)
        edges = np.argwhere(~np.eye(len(sites), dtype=bool))
    start, neighbours = np.searchsorted(edges[:, 0], np.arange(len(sites) + 1)), np.ascontiguousarray(edges[:, 1])
    region = _outline_region(nodes, outmost)
    if region is not None:
        area, store, first = _tile(sites, start, neighbours, region)
    if region is None or not (area > 0).all():
        region = _hull_region(nodes)
        area, store, first = _tile(sites, start, neighbours, region)
    cells: Sequence[np.ndarray] = Polygons(store + origin, first)
    if back is not None:
        area, cells = (area / share)[back], [cells[k] for k in back]
    return Tessellation(area, cells, region + origin)
