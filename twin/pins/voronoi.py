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


@compiled()
def polygon_area(polygon: np.ndarray, count: int) -> float:
    """Signed area (shoelace) of the first ``count`` vertices, relative to the first vertex, which avoids cancellation of digits."""
    total = 0.0
    x0, y0 = polygon[0, 0], polygon[0, 1]
    for k in range(1, count - 1):
        total += (polygon[k, 0] - x0) * (polygon[k + 1, 1] - y0) - (polygon[k + 1, 0] - x0) * (polygon[k, 1] - y0)
    return 0.5 * total


@compiled()
def _clip_half_plane(polygon: np.ndarray, count: int, a: float, b: float, c: float, out: np.ndarray) -> int:
    """The part of a polygon with a x + b y <= c (Sutherland and Hodgman 1974); returns its vertex count."""
    kept = 0
    px, py = polygon[count - 1, 0], polygon[count - 1, 1]
    previous = a * px + b * py - c
    for k in range(count):
        x, y = polygon[k, 0], polygon[k, 1]
        here = a * x + b * y - c
        if (here <= 0) != (previous <= 0):
            t = previous / (previous - here)
            out[kept, 0] = px + t * (x - px)
            out[kept, 1] = py + t * (y - py)
            kept += 1
        if here <= 0:
            out[kept, 0] = x
            out[kept, 1] = y
            kept += 1
        px, py, previous = x, y, here
    return kept


@compiled()
def _cells(
    nodes: np.ndarray, start: np.ndarray, neighbours: np.ndarray, region: np.ndarray, center: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Area of every cell, the vertices of all cells in one array, and where each cell's vertices begin.

    Cutting starts from the region's bounding box, which has few vertices. The region contains a disc; only a cell that extends beyond it is
    cut again, starting from the region itself.
    """
    n, m = len(nodes), len(region)
    area, first = np.zeros(n), np.zeros(n + 1, np.int64)
    store, here = np.empty((16 * n + 4 * m, 2)), np.empty((2 * m + 2 * n + 8, 2))
    there = np.empty_like(here)
    left, right, top, bottom = region[:, 0].min(), region[:, 0].max(), region[:, 1].min(), region[:, 1].max()
    box = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    for i in range(n):
        count = 0
        for outline in (box, region):
            count = len(outline)
            for k in range(count):
                here[k, 0], here[k, 1] = outline[k, 0], outline[k, 1]
            for e in range(start[i], start[i + 1]):
                j = neighbours[e]
                a, b = nodes[j, 0] - nodes[i, 0], nodes[j, 1] - nodes[i, 1]
                c = 0.5 * (nodes[j, 0] ** 2 + nodes[j, 1] ** 2 - nodes[i, 0] ** 2 - nodes[i, 1] ** 2)
                count = _clip_half_plane(here, count, a, b, c, there)
                here, there = there, here
                if count == 0:
                    break
            inside = count > 2
            for k in range(count):
                inside = inside and (here[k, 0] - center[0]) ** 2 + (here[k, 1] - center[1]) ** 2 < radius**2
            if inside:
                break
        if count > 2:
            area[i] = polygon_area(here, count)
        while first[i] + count > len(store):
            store = np.concatenate((store, np.empty_like(store)))
        for k in range(count):
            store[first[i] + k, 0], store[first[i] + k, 1] = here[k, 0], here[k, 1]
        first[i + 1] = first[i] + count
    return area, store[: first[n]], first


def _tile(nodes: np.ndarray, start: np.ndarray, neighbours: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The result of `_cells`, for the largest disc about the region's middle."""
    center = region.mean(axis=0)
    radius = WITHIN * cv2.pointPolygonTest(region.astype(np.float32), center.tolist(), measureDist=True)
    return _cells(nodes, start, neighbours, region, center, radius)


@compiled()
def _star_shaped(polygon: np.ndarray) -> bool:
    """Whether a closed polygon about the origin winds around it once, always in the same direction."""
    x, y = polygon[:, 0], polygon[:, 1]
    x0, y0 = np.roll(x, 1), np.roll(y, 1)
    cross = x0 * y - y0 * x
    turn = np.arctan2(cross, x0 * x + y0 * y).sum()
    return ((cross > 0).all() or (cross < 0).all()) and abs(abs(turn) - 2 * np.pi) < 1e-6


def _outline_region(nodes: np.ndarray, outmost: np.ndarray | None) -> np.ndarray | None:
    """The outmost nodes' polygon, enlarged and counter-clockwise (y up); None if it is not usable."""
    if outmost is None or len(outmost) < 3:
        return None
    polygon = nodes[outmost]
    center = polygon.mean(axis=0)
    if not _star_shaped(polygon - center):
        return None
    region = center + BOUNDARY_SCALE * (polygon - center)
    return region if polygon_area(region, len(region)) > 0 else np.ascontiguousarray(region[::-1])


def _hull_region(nodes: np.ndarray) -> np.ndarray:
    """The enlarged convex hull; for nodes on a line, a strip around them."""
    center = nodes.mean(axis=0)
    spread = nodes - center
    _, size, axes = np.linalg.svd(spread, full_matrices=True)
    if len(nodes) >= 3 and size[-1] > 1e-9 * max(size[0], 1.0):
        hull = nodes[ConvexHull(nodes).vertices]
        middle = hull.mean(axis=0)
        return np.ascontiguousarray(middle + BOUNDARY_SCALE * (hull - middle))
    along = spread @ axes[0]
    margin = max(STRIP_SHARE * np.ptp(along), LEAST_STRIP_PX) / 2
    low, high = along.min() - margin, along.max() + margin
    corners = np.array([[low, -margin], [high, -margin], [high, margin], [low, margin]])
    region = center + corners @ axes
    return region if polygon_area(region, 4) > 0 else np.ascontiguousarray(region[::-1])


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
