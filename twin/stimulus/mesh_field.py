"""Closed triangle meshes as smooth signed-distance fields: sampled once, read by a tricubic spline."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numba
import numpy as np
import pyvista as pv
import trimesh
from scipy.ndimage import spline_filter

from scenes.object import MeshShape
from twin.errors import MeshError
from twin.stimulus.analytic import project_on_xy

_UNIT_REMEDY = "scale the file to mm, or name its unit in a TOML: shape = { kind = 'mesh', file = ..., unit = ... } (mm, cm, m or inch)"
_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
_SMALLEST_MM, _LARGEST_MM = 1.0, 2000.0
_REACH_MM = 40.0  # half width of the sampled region around the origin: the dome and its shear
_MARGIN_MM = 4.0
_NODES = 250_000  # of the sampled grid: about 4 s, 2 MB
_FINEST_MM = 0.25


@dataclass(frozen=True)
class MeshField:
    """Signed distance on a regular grid, interpolated by the tricubic B-spline through its nodes (C2).

    Outside the grid the distance to the grid is added: positive, and never too small.

    Attributes
    ----------
    corner_mm : (3,) float
        First node.
    spacing_mm : float
    coefficients : (a, b, c) float
        B-spline coefficients.
    """

    corner_mm: np.ndarray
    spacing_mm: float
    coefficients: np.ndarray

    def distance(self, points_mm: np.ndarray) -> np.ndarray:
        return self._evaluate(points_mm)[0]

    def gradient(self, points_mm: np.ndarray) -> np.ndarray:
        slope = self._evaluate(points_mm)[1]
        return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)

    def unroll(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return project_on_xy(points_mm)

    def _evaluate(self, points_mm):
        last = self.corner_mm + self.spacing_mm * (np.array(self.coefficients.shape) - 3)
        inside = np.clip(points_mm, self.corner_mm + 2 * self.spacing_mm, last)
        values = _tricubic(self.coefficients, (inside - self.corner_mm) / self.spacing_mm)
        away = points_mm - inside
        gap = np.linalg.norm(away, axis=1)
        slope = np.where(away == 0, values[:, 1:] / self.spacing_mm, 0.0) + away / np.maximum(gap, 1e-12)[:, None]
        return values[:, 0] + gap, slope


def load_mesh_field(shape: MeshShape) -> MeshField:
    """Read, check, place and sample a mesh; the same file and placement is sampled only once.

    Raises
    ------
    MeshError
        If the file is unreadable, empty, not closed, or its size suggests another unit.
    """
    path = Path(shape.file)
    if not path.is_file():
        raise MeshError(f"{path}: no such mesh file; give the path of an existing STL, OBJ or PLY")
    return _sampled(str(path), path.stat().st_mtime_ns, shape.unit, shape.rotation_deg)


@lru_cache(maxsize=8)
def _sampled(file: str, _modified_ns: int, unit: str, rotation_deg: tuple) -> MeshField:
    return sample_mesh(place_mesh(read_mesh(file, unit=unit), rotation_deg=rotation_deg))


def read_mesh(file: str, *, unit: str = "mm") -> trimesh.Trimesh:
    """A closed mesh in mm, faces wound outwards; errors as ``load_mesh_field``."""
    try:
        mesh = trimesh.load(file, force="mesh", process=True)
    except Exception as error:  # trimesh's readers raise whatever their parsers raise
        raise MeshError(f"{file}: not readable as a triangle mesh ({error}); give an STL, OBJ or PLY file") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MeshError(f"{file}: no triangles in it; export a closed surface")
    mesh.apply_scale(_MM[unit])
    size_mm = float(mesh.extents.max())
    if not np.isfinite(size_mm) or size_mm < _SMALLEST_MM:
        raise MeshError(f"{file}: largest side is {size_mm:.3g} mm with unit = '{unit}': too small; {_UNIT_REMEDY}")
    if size_mm > _LARGEST_MM:
        raise MeshError(f"{file}: largest side is {size_mm:.3g} mm with unit = '{unit}': too large; {_UNIT_REMEDY}")
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
    return mesh


def place_mesh(mesh: trimesh.Trimesh, *, rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """Turn a mesh (intrinsic x, y, z), then centre it in x and y and put its lowest point over x = y = 0 at the origin.

    A mesh with a hole there is put down on its lowest vertex.
    """
    mesh = mesh.copy()
    mesh.apply_transform(trimesh.transformations.euler_matrix(*np.radians(rotation_deg), axes="rxyz"))
    middle = mesh.bounds.mean(axis=0)
    mesh.apply_translation([-middle[0], -middle[1], 0.0])
    triangles = mesh.triangles
    lowest = triangles[:, :, 2].min()
    crossing = _heights_at_origin(triangles)
    mesh.apply_translation([0.0, 0.0, -(crossing.min() if len(crossing) else lowest)])
    return mesh


def _heights_at_origin(triangles: np.ndarray) -> np.ndarray:
    """z where the line x = y = 0 crosses the triangles (k, 3, 3)."""
    a, b, c = triangles[:, 0, :2], triangles[:, 1, :2], triangles[:, 2, :2]

    def cross(p, q):
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    shares = np.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1)
    area = shares.sum(axis=1)
    scale = np.abs(area) > 1e-12
    shares = shares[scale] / area[scale, None]
    hit = (shares >= -1e-9).all(axis=1)
    return (shares[hit] * triangles[scale][hit][:, :, 2]).sum(axis=1)


def sample_mesh(mesh: trimesh.Trimesh) -> MeshField:
    """Sample a placed mesh around the origin, as fine as ``_NODES`` allows."""
    low = np.maximum(mesh.bounds[0], [-_REACH_MM, -_REACH_MM, -_REACH_MM]) - _MARGIN_MM
    high = np.minimum(mesh.bounds[1], [_REACH_MM, _REACH_MM, _REACH_MM]) + _MARGIN_MM
    spacing = max(_FINEST_MM, float(np.prod(high - low) / _NODES) ** (1 / 3))
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    axes = [low[k] + spacing * np.arange(counts[k]) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    surface = pv.PolyData.from_regular_faces(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    values = pv.PolyData(points).compute_implicit_distance(surface)["implicit_distance"]
    coefficients = spline_filter(np.asarray(values, float).reshape(counts), order=3, mode="mirror")
    return MeshField(low, spacing, coefficients)


@numba.njit(cache=True)
def _tricubic(coefficients, at):
    """Value and index-space gradient (k, 4) of the cubic B-spline at points (k, 3), in units of nodes."""
    out = np.zeros((len(at), 4))
    weight, slope = np.zeros((3, 4)), np.zeros((3, 4))
    start = np.zeros(3, np.int64)
    for k in range(len(at)):
        for d in range(3):
            cell = int(np.floor(at[k, d]))
            cell = min(max(cell, 1), coefficients.shape[d] - 3)
            t = at[k, d] - cell
            start[d] = cell - 1
            s = 1 - t
            weight[d, 0], weight[d, 3] = s**3 / 6, t**3 / 6
            weight[d, 1] = (4 - 6 * t**2 + 3 * t**3) / 6
            weight[d, 2] = (4 - 6 * s**2 + 3 * s**3) / 6
            slope[d, 0], slope[d, 3] = -(s**2) / 2, t**2 / 2
            slope[d, 1] = (-12 * t + 9 * t**2) / 6
            slope[d, 2] = (12 * s - 9 * s**2) / 6
        for a in range(4):
            for b in range(4):
                for c in range(4):
                    value = coefficients[start[0] + a, start[1] + b, start[2] + c]
                    out[k, 0] += weight[0, a] * weight[1, b] * weight[2, c] * value
                    out[k, 1] += slope[0, a] * weight[1, b] * weight[2, c] * value
                    out[k, 2] += weight[0, a] * slope[1, b] * weight[2, c] * value
                    out[k, 3] += weight[0, a] * weight[1, b] * slope[2, c] * value
    return out
