"""Exact signed distance to a closed triangle mesh, computed with a tree of boxes over its triangles.

The triangles are divided into halves repeatedly, each time along the longest side of the box around their centres. The boxes form a
complete binary tree (node i has the children 2 i and 2 i + 1), whose leaves have equally many triangles. The sign follows from the
angle-weighted normal of the nearest face, edge or corner (Baerentzen & Aanaes, "Signed distance computation using the angle weighted
pseudonormal", 2005).
"""

import numpy as np
import trimesh

from twin.compiled import compiled
from twin.objects.level_set import Triple
from twin.types import FloatArray, IntArray

_LEAF = 4
"""Largest number of triangles in a leaf of the tree."""
_FLAT_MM2 = 1e-12
"""Area below which a triangle is ignored. It has no usable normal, and its neighbours cover the same place."""


def signed_distance(mesh: trimesh.Trimesh, points_mm: FloatArray) -> FloatArray:
    """Distance of points to a closed mesh whose faces are wound outwards.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        In mm.
    points_mm : (k, 3) float
        The search is fastest if neighbours in the list are near each other in space.

    Returns
    -------
    (k,) float
        In mm, positive outside.
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    triangles = vertices[faces]
    normals, area_mm2 = _feature_normals(triangles, faces)
    solid = area_mm2 > _FLAT_MM2
    triangles, normals = triangles[solid], normals[solid]
    order, leaves = _halved(triangles.mean(axis=1))
    triangles = np.ascontiguousarray(triangles[order])
    low, high = _boxes(triangles, leaves)
    return _search(triangles, np.ascontiguousarray(normals[order]), low, high, np.ascontiguousarray(points_mm, dtype=float))


def _feature_normals(triangles: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray]:
    """Normals (f, 7, 3), not normalised, of each triangle, its corners a, b, c and its edges ab, bc, ca; and the areas (f,).

    They are computed from the corners. The normals that trimesh stores come from the file, and do not change when a mesh is inverted.
    """
    face = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    size = np.linalg.norm(face, axis=1)
    face /= np.maximum(size, 1e-300)[:, None]
    corner = np.zeros((faces.max() + 1, 3))
    np.add.at(corner, faces, face[:, None, :] * trimesh.triangles.angles(triangles)[:, :, None])
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, edge_of = np.unique(ends, axis=0, return_inverse=True)
    edge = np.zeros((edge_of.max() + 1, 3))
    np.add.at(edge, edge_of.ravel(), np.repeat(face, 3, axis=0))
    return np.concatenate([face[:, None], corner[faces], edge[edge_of].reshape(-1, 3, 3)], axis=1), size / 2


def _halved(centres: FloatArray) -> tuple[IntArray, int]:
    """Indices of points (f, 3) in an order in which each half, quarter, ... of the list is compact, and the number of leaves.

    Some points occur twice, so that all leaves are full.
    """
    leaves = 1
    while leaves * _LEAF < len(centres):
        leaves *= 2
    order = np.resize(np.arange(len(centres)), leaves * -(-len(centres) // leaves))
    groups = 1
    while groups < leaves:
        member = order.reshape(groups, -1)
        at = centres[member]
        longest = np.ptp(at, axis=1).argmax(axis=1)
        along = np.take_along_axis(at, longest[:, None, None], axis=2)[:, :, 0]
        order = np.take_along_axis(member, along.argsort(axis=1), axis=1).ravel()
        groups *= 2
    return order, leaves


def _boxes(triangles: FloatArray, leaves: int) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corners (2 leaves, 3) of the tree's boxes: root at 1, leaves from ``leaves`` on."""
    low, high = np.empty((2 * leaves, 3)), np.empty((2 * leaves, 3))
    corners = triangles.reshape(leaves, -1, 3)
    low[leaves:], high[leaves:] = corners.min(axis=1), corners.max(axis=1)
    while leaves > 1:
        below, leaves = leaves, leaves // 2
        low[leaves:below] = low[below : 2 * below].reshape(-1, 2, 3).min(axis=1)
        high[leaves:below] = high[below : 2 * below].reshape(-1, 2, 3).max(axis=1)
    return low, high


@compiled(error_model="numpy")
def _dot(p: Triple, q: Triple) -> float:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@compiled(error_model="numpy")
def _minus(p: Triple, q: Triple, s: float, u: Triple, t: float, v: Triple) -> Triple:
    """p - q - s u - t v"""
    return p[0] - q[0] - s * u[0] - t * v[0], p[1] - q[1] - s * u[1] - t * v[1], p[2] - q[2] - s * u[2] - t * v[2]


@compiled(error_model="numpy")
def _from_triangle(p: Triple, corners: FloatArray, k: int) -> tuple[Triple, int]:
    """Vector from triangle k's nearest point to p, and the kind of that point: 0 face, 1-3 corner, 4-6 edge (Ericson 2005, 5.1.5)."""
    a = (corners[k, 0, 0], corners[k, 0, 1], corners[k, 0, 2])
    ab = (corners[k, 1, 0] - a[0], corners[k, 1, 1] - a[1], corners[k, 1, 2] - a[2])
    ac = (corners[k, 2, 0] - a[0], corners[k, 2, 1] - a[1], corners[k, 2, 2] - a[2])
    ap = _minus(p, a, 0.0, ab, 0.0, ac)
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0 and d2 <= 0:
        return ap, 1
    bp = _minus(p, a, 1.0, ab, 0.0, ac)
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0 and d4 <= d3:
        return bp, 2
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        return _minus(p, a, d1 / (d1 - d3), ab, 0.0, ac), 4
    cp = _minus(p, a, 0.0, ab, 1.0, ac)
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0 and d5 <= d6:
        return cp, 3
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        return _minus(p, a, 0.0, ab, d2 / (d2 - d6), ac), 6
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 >= d3 and d5 >= d6:
        share = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return _minus(p, a, 1 - share, ab, share, ac), 5
    return _minus(p, a, vb / (va + vb + vc), ab, vc / (va + vb + vc), ac), 0


@compiled(error_model="numpy")
def _from_box(p: Triple, low: FloatArray, high: FloatArray, k: int) -> float:
    """Squared distance of p to box k."""
    x = max(low[k, 0] - p[0], p[0] - high[k, 0], 0.0)
    y = max(low[k, 1] - p[1], p[1] - high[k, 1], 0.0)
    z = max(low[k, 2] - p[2], p[2] - high[k, 2], 0.0)
    return x * x + y * y + z * z


@compiled(error_model="numpy")
def _search(triangles: FloatArray, normals: FloatArray, low: FloatArray, high: FloatArray, points: FloatArray) -> FloatArray:
    leaves = len(low) // 2
    leaf = len(triangles) // leaves
    stack, bound = np.empty(64, np.int64), np.empty(64)
    distance = np.empty(len(points))
    nearest = 0
    for k in range(len(points)):
        p = (points[k, 0], points[k, 1], points[k, 2])
        # the start is the triangle nearest to the last point, so that most boxes are too far away from the beginning
        way, feature = _from_triangle(p, triangles, nearest)
        best = _dot(way, way)
        stack[0], bound[0], size = 1, 0.0, 1
        while size > 0:
            size -= 1
            box = stack[size]
            if bound[size] >= best:
                continue
            if box < leaves:
                near, far = 2 * box, 2 * box + 1
                near_reach, far_reach = _from_box(p, low, high, near), _from_box(p, low, high, far)
                if far_reach < near_reach:
                    near, far, near_reach, far_reach = far, near, far_reach, near_reach
                stack[size], bound[size] = far, far_reach
                stack[size + 1], bound[size + 1] = near, near_reach
                size += 2
                continue
            first = leaf * (box - leaves)
            for t in range(first, first + leaf):
                other, place = _from_triangle(p, triangles, t)
                square = _dot(other, other)
                if square < best:
                    best, way, feature, nearest = square, other, place, t
        inside = normals[nearest, feature, 0] * way[0] + normals[nearest, feature, 1] * way[1] + normals[nearest, feature, 2] * way[2] < 0
        distance[k] = -np.sqrt(best) if inside else np.sqrt(best)
    return distance
