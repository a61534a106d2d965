"""Triangle meshes from files: read, checked, in mm, put down on the origin."""

import numpy as np
import trimesh

from twin.errors import MeshError
from twin.types import FloatArray

_UNIT_REMEDY = "scale the file to mm, or name its unit in a TOML: shape = { kind = 'mesh', file = ..., unit = ... } (mm, cm, m or inch)"
_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
_SMALLEST_MM = 1.0
"""An object whose largest side is shorter was most likely given in another unit."""
_LARGEST_MM = 2000.0
"""An object whose largest side is longer was most likely given in another unit."""


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
    x, y, z = np.radians(rotation_deg)
    mesh.apply_transform(trimesh.transformations.euler_matrix(x, y, z, axes="rxyz"))
    middle = mesh.bounds.mean(axis=0)
    mesh.apply_translation([-middle[0], -middle[1], 0.0])
    triangles = mesh.triangles
    lowest = triangles[:, :, 2].min()
    crossing = _heights_at_origin(triangles)
    mesh.apply_translation([0.0, 0.0, -(crossing.min() if len(crossing) else lowest)])
    return mesh


def _heights_at_origin(triangles: FloatArray) -> FloatArray:
    """z where the line x = y = 0 crosses the triangles (k, 3, 3)."""
    a, b, c = triangles[:, 0, :2], triangles[:, 1, :2], triangles[:, 2, :2]

    def cross(p: FloatArray, q: FloatArray) -> FloatArray:
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    shares = np.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1)
    area = shares.sum(axis=1)
    scale = np.abs(area) > 1e-12
    shares = shares[scale] / area[scale, None]
    hit = (shares >= -1e-9).all(axis=1)
    return (shares[hit] * triangles[scale][hit][:, :, 2]).sum(axis=1)
