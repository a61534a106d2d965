"""The mesh as VTK data sets, for views and files."""

from collections.abc import Mapping

import numpy as np
import pyvista as pv

from twin.geometry.mesh import SKIN, SensorMesh
from twin.types import FloatArray, IntArray


def to_pyvista(
    mesh: SensorMesh, *, nodes_mm: FloatArray | None = None, point_data: Mapping[str, FloatArray | IntArray] | None = None
) -> pv.UnstructuredGrid:
    """Skin and gel as one unstructured grid with cell data ``material``.

    Parameters
    ----------
    nodes_mm : (n, 3) float, optional
        Deformed nodes (default: at rest).
    point_data : dict of str to (n,) or (n, 3) float, optional
    """
    nodes = mesh.nodes_mm if nodes_mm is None else nodes_mm
    cells = np.column_stack([np.full(len(mesh.hexes), 8), mesh.hexes])
    grid = pv.UnstructuredGrid(cells, np.full(len(mesh.hexes), pv.CellType.HEXAHEDRON), nodes)
    grid.cell_data["material"] = mesh.material
    for name, values in (point_data or {}).items():
        grid.point_data[name] = values
    return grid


def skin_surface(
    mesh: SensorMesh, *, nodes_mm: FloatArray | None = None, point_data: Mapping[str, FloatArray | IntArray] | None = None
) -> pv.PolyData:
    """Closed surface of the skin alone (outside, inside, rim), ready to be written as ``.vtp``.

    Point data ``node`` is each point's index in ``mesh.nodes_mm``.
    """
    grid = to_pyvista(mesh, nodes_mm=nodes_mm, point_data={"node": np.arange(len(mesh.nodes_mm)), **(point_data or {})})
    skin = grid.extract_cells(mesh.material == SKIN).extract_surface(algorithm="dataset_surface")
    for name in ("vtkOriginalPointIds", "vtkOriginalCellIds"):
        for data in (skin.point_data, skin.cell_data):
            if name in data:
                del data[name]
    return skin
