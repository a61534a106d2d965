"""Closed triangle meshes from files as smooth signed-distance fields.

A mesh is read, checked, scaled to mm and placed at the origin. Its distance is sampled once on a grid, and interpolated by a tricubic
spline, whose code loops over tuples and plain numbers, because slices of arrays would take more time than the sums.
"""

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import numpy as np
import trimesh
from scipy.ndimage import spline_filter

from scenes.object import MeshShape
from twin.compiled import compiled
from twin.errors import ErrorsAs, MeshError
from twin.objects.level_set import Probe, Wrapped, rows, unit_normals
from twin.store import cached_arrays
from twin.types import FloatArray

Four: TypeAlias = tuple[float, float, float, float]

_SUMS = {"contract", "reassoc"}
"""Permissions for the compiler: to reorder sums and to fuse products. They nearly halve the time. NaN stays NaN."""
_UNIT_REMEDY = "scale the file to mm, or name its unit in a TOML: shape = { kind = 'mesh', file = ..., unit = ... } (mm, cm, m or inch)"
"""Advice in the message for a file whose size suggests another unit."""
_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
"""Length of each unit of a file, mm."""
_SMALLEST_MM = 1.0
"""Length of an object's largest side below which the file is most likely in another unit."""
_LARGEST_MM = 2000.0
"""Length of an object's largest side above which the file is most likely in another unit."""
_THINNEST_MM = 0.6
"""Least mean thickness of an object, twice its volume by its area. The contact points of the skin stand 0.3 to 0.5 mm apart, and those that
are driven into a thinner wall leave it on its other side."""
_REACH_MM = 40.0
"""Distance from the origin along each axis up to which the mesh is sampled: the dome's radius and its largest shear."""
_MARGIN_MM = 4.0
"""Width of the part of the grid around the sampled part of the mesh."""
_FLAT_MM2 = 1e-12
"""Area below which a triangle is ignored. It has no usable normal, and its neighbours cover the same place."""
_NODES = 250_000
"""Number of nodes of the grid. Sampling takes some 10 s, and the grid 2 MB of memory."""
_FINEST_MM = 0.25
"""Smallest spacing of the grid."""


@compiled(error_model="numpy", fastmath=_SUMS)
def _basis(t: float) -> tuple[Four, Four, Four]:
    """Weights of four nodes at the place ``t`` (0 to 1) between the second and the third: of the value, the slope and the bend."""
    s = 1 - t
    weights = s**3 / 6, (4 - 6 * t**2 + 3 * t**3) / 6, (4 - 6 * s**2 + 3 * s**3) / 6, t**3 / 6
    slopes = -(s**2) / 2, (3 * t - 4) * t / 2, (4 - 3 * s) * s / 2, t**2 / 2
    return weights, slopes, (1 - t, 3 * t - 2, 1 - 3 * t, t)


@compiled(error_model="numpy", fastmath=_SUMS)
def _step_in(point: float, low: float, spacing: float, count: int) -> tuple[int, float, float]:
    """The node below a coordinate that is limited to the grid, its distance from this node (in nodes), and that from the grid in mm.

    The node has one neighbour before it and two after it.
    """
    inside = min(max(point, low + 2 * spacing), low + (count - 3) * spacing)
    at = (inside - low) / spacing
    cell = min(max(int(np.floor(at)), 1), count - 3)
    return cell, at - cell, point - inside


@compiled(error_model="numpy", fastmath=_SUMS)
def spline_probe(
    coefficients: FloatArray,
    corner: FloatArray,
    spacing: float,
    points: FloatArray,
    value: FloatArray,
    slope: FloatArray,
    hessian: FloatArray,
) -> None:
    """Write values (k,), slopes (k, 3) and second derivatives (k, 3, 3) at points (k, 3). Outside the grid the distance to it is added."""
    counts, per_mm = coefficients.shape, 1 / spacing
    for k in range(len(points)):
        i, tx, away_x = _step_in(points[k, 0], corner[0], spacing, counts[0])
        j, ty, away_y = _step_in(points[k, 1], corner[1], spacing, counts[1])
        m, tz, away_z = _step_in(points[k, 2], corner[2], spacing, counts[2])
        (wx, sx, bx), (wy, sy, by), (wz, sz, bz) = _basis(tx), _basis(ty), _basis(tz)
        f = fx = fy = fz = fxx = fxy = fxz = fyy = fyz = fzz = 0.0
        for a in range(4):
            g = gy = gz = gyy = gyz = gzz = 0.0  # summed over y and z
            for b in range(4):
                h = hz = hzz = 0.0
                for c in range(4):
                    value_c = coefficients[i - 1 + a, j - 1 + b, m - 1 + c]
                    h, hz, hzz = h + wz[c] * value_c, hz + sz[c] * value_c, hzz + bz[c] * value_c
                g, gz, gzz = g + wy[b] * h, gz + wy[b] * hz, gzz + wy[b] * hzz
                gy, gyz, gyy = gy + sy[b] * h, gyz + sy[b] * hz, gyy + by[b] * h
            f, fy, fz = f + wx[a] * g, fy + wx[a] * gy, fz + wx[a] * gz
            fyy, fyz, fzz = fyy + wx[a] * gyy, fyz + wx[a] * gyz, fzz + wx[a] * gzz
            fx, fxy, fxz, fxx = fx + sx[a] * g, fxy + sx[a] * gy, fxz + sx[a] * gz, fxx + bx[a] * g
        value[k] = f
        slope[k, 0], slope[k, 1], slope[k, 2] = fx * per_mm, fy * per_mm, fz * per_mm
        square = per_mm * per_mm
        hessian[k, 0, 0], hessian[k, 1, 1], hessian[k, 2, 2] = fxx * square, fyy * square, fzz * square
        hessian[k, 0, 1] = hessian[k, 1, 0] = fxy * square
        hessian[k, 0, 2] = hessian[k, 2, 0] = fxz * square
        hessian[k, 1, 2] = hessian[k, 2, 1] = fyz * square
        if away_x != 0 or away_y != 0 or away_z != 0:
            away, gap = (away_x, away_y, away_z), np.sqrt(away_x**2 + away_y**2 + away_z**2)
            value[k] += gap
            for n in range(3):  # outside the grid the spline is constant along these axes
                if away[n] != 0:
                    slope[k, n] = away[n] / gap
                for c in range(3):
                    if away[n] != 0 and away[c] != 0:
                        hessian[k, n, c] = ((n == c) - away[n] * away[c] / gap**2) / gap
                    elif away[n] != 0 or away[c] != 0:
                        hessian[k, n, c] = 0.0


@dataclass(frozen=True)
class MeshField(Wrapped):
    """Signed distance on a regular grid, interpolated by the tricubic B-spline through its nodes (C2).

    Outside the grid, the distance to the grid is added to the value at its border. The result is positive and not smaller than the
    true distance.

    Attributes
    ----------
    corner_mm : (3,) float
        First node.
    spacing_mm : float
    coefficients : (a, b, c) float
        B-spline coefficients.
    """

    corner_mm: FloatArray
    spacing_mm: float
    coefficients: FloatArray

    def probe(self, points_mm: FloatArray) -> Probe:
        found = np.empty(len(points_mm)), np.empty((len(points_mm), 3)), np.empty((len(points_mm), 3, 3))
        spline_probe(self.coefficients, self.corner_mm, self.spacing_mm, rows(points_mm), *found)
        unit_normals(*found[1:])
        return found


def load_mesh_field(shape: MeshShape) -> MeshField:
    """Read, check, place and sample a mesh. Samples of the same file and placement are stored on disk and used again.

    Raises
    ------
    MeshError
        If the file is unreadable, empty, not closed, has another content than ``shape`` says, or its size suggests another unit.
    """
    path = Path(shape.file)
    if not path.is_file():
        raise MeshError(f"{path}: no such mesh file; give the path of an existing STL, OBJ or PLY")
    with ErrorsAs(OSError, lambda error: MeshError(f"{path}: not readable ({error.strerror}); give a file that may be read")):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if shape.sha256 not in ("", digest):
        raise MeshError(
            f"{path}: has changed since it was loaded or simulated; put the former file back, or give the object and `out` again"
        )
    return _sample_field(str(path), digest, shape.unit, shape.rotation_deg)


@lru_cache(maxsize=8)
def _sample_field(file: str, digest: str, unit: str, rotation_deg: tuple[float, float, float]) -> MeshField:
    key = {
        "file": [digest, Path(file).suffix.lower()],
        "placement": [unit, list(rotation_deg)],
        "grid": [_REACH_MM, _MARGIN_MM, _NODES, _FINEST_MM],
    }

    def sample() -> dict[str, FloatArray]:
        return vars(sample_mesh(place_mesh(read_mesh(file, unit=unit), rotation_deg=rotation_deg)))

    kept = cached_arrays("mesh-field", key, sample)
    return MeshField(kept["corner_mm"], float(kept["spacing_mm"]), kept["coefficients"])


def signed_distance(mesh: trimesh.Trimesh, points_mm: FloatArray) -> FloatArray:
    """Distances (k,) in mm, positive outside, of points (k, 3) to a closed mesh whose faces are wound outwards."""
    import pyvista as pv  # takes a quarter of a second

    solid = trimesh.triangles.area(mesh.triangles) > _FLAT_MM2
    surface = pv.PolyData.from_regular_faces(mesh.vertices, mesh.faces[solid])
    distance: FloatArray = pv.PolyData(rows(points_mm)).compute_implicit_distance(surface)["implicit_distance"]
    return np.asarray(distance)


def sample_mesh(mesh: trimesh.Trimesh) -> MeshField:
    """Sample a placed mesh around the origin, as fine as ``_NODES`` allows."""
    low, high = np.clip(mesh.bounds, [[-_REACH_MM], [-np.inf]], [[np.inf], [_REACH_MM]]) + [[-_MARGIN_MM], [_MARGIN_MM]]
    spacing = max(_FINEST_MM, float(np.prod(high - low) / _NODES) ** (1 / 3))
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    axes = [low[k] + spacing * np.arange(counts[k]) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    coefficients = spline_filter(signed_distance(mesh, points).reshape(counts), order=3, mode="mirror")
    return MeshField(low, spacing, coefficients)


def read_mesh(file: str, *, unit: str = "mm") -> trimesh.Trimesh:
    """Read a closed mesh in mm with faces wound outwards; raises as ``load_mesh_field``."""
    # trimesh's readers raise exceptions of any type
    with ErrorsAs(Exception, lambda error: MeshError(f"{file}: not readable as a triangle mesh ({error}); give an STL, OBJ or PLY file")):
        mesh = trimesh.load(file, force="mesh", process=True)
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MeshError(f"{file}: no triangles in it; export a closed surface")
    mesh.apply_scale(_MM[unit])
    size_mm = float(mesh.extents.max())
    if not _SMALLEST_MM <= size_mm <= _LARGEST_MM:
        wrong = "large" if size_mm > _LARGEST_MM else "small"
        raise MeshError(f"{file}: largest side is {size_mm:.3g} mm with unit = '{unit}': too {wrong}; {_UNIT_REMEDY}")
    if not mesh.is_watertight:
        _, uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        raise MeshError(
            f"{file}: not watertight: {np.count_nonzero(uses != 2)} open edges; close it (Blender: 3D-Print toolbox > Make Manifold; "
            f"or trimesh.repair.fill_holes) and try again"
        )
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    if mesh.volume < 0:
        mesh.invert()
    thick_mm = 2 * float(mesh.volume / mesh.area)
    if thick_mm < _THINNEST_MM:
        raise MeshError(
            f"{file}: its walls are {thick_mm:.2g} mm thick, and the skin's mesh would pass through walls thinner than "
            f"{_THINNEST_MM:g} mm; make the object solid, or thicker"
        )
    return mesh


def place_mesh(mesh: trimesh.Trimesh, *, rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """Turn a mesh (intrinsic x, y, z), centre it in x and y, and move it so that its lowest point on the z axis is the origin.

    If the mesh has a hole there, its lowest vertex is moved to z = 0.
    """
    mesh = mesh.copy()
    x, y, z = np.radians(rotation_deg)
    mesh.apply_transform(trimesh.transformations.euler_matrix(x, y, z, axes="rxyz"))
    middle = mesh.bounds.mean(axis=0)
    mesh.apply_translation([-middle[0], -middle[1], 0.0])
    crossing = _heights_at_origin(mesh.triangles)
    mesh.apply_translation([0.0, 0.0, -(crossing.min() if len(crossing) else mesh.bounds[0, 2])])
    return mesh


def _heights_at_origin(triangles: FloatArray) -> FloatArray:
    """z where the line x = y = 0 crosses the triangles (k, 3, 3)."""
    flat = triangles * [1.0, 1.0, 0.0]
    wide = trimesh.triangles.area(flat) > 5e-13
    shares = trimesh.triangles.points_to_barycentric(flat[wide], np.zeros((wide.sum(), 3)), method="cross")
    hit = (shares >= -1e-9).all(axis=1)
    return (shares[hit] * triangles[wide][hit][:, :, 2]).sum(axis=1)
