"""Hexahedral mesh of the sensor's body, for views, files and the renderer. The mesh is the same for every contact.

A square grid is mapped to the skin (``shapes``). At each of its points a straight column of nodes passes through the skin and
the gel to the lens. The mechanics use the spline solid (``solid``); `NodeView` computes the positions of the nodes from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scenes.sensor import GeometrySpec
from twin.geometry.shapes import Chart, Focus, RectangleChart, shape_of
from twin.geometry.solid import Solid, body_points, surface_operators
from twin.types import ComplexArray, FloatArray, IntArray

if TYPE_CHECKING:
    import pyvista as pv

SKIN, GEL = 0, 1
"""Codes of an element's material."""
_ACROSS = 21
"""Number of nodes along each side of the square."""
_SKIN_LAYERS = 1
"""Number of layers of elements in the skin."""
_GEL_LAYERS = 4
"""Number of layers of elements in the gel."""
_FOCUS_SHARE = 0.62
"""Radius of the fine part of the mesh around the apex, relative to the largest polar angle."""
_HEX_CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
"""Corners of a hexahedron in VTK's order, as steps along the grid."""


@dataclass(frozen=True)
class SensorMesh:
    """Volume mesh of skin and gel at rest, in the sensor frame.

    Nodes are numbered layer by layer from the outside inwards (layer 0 is the outer surface, layer ``skin_layers`` the skin's inside,
    the last one the lens), and each layer row by row over the square grid.

    Attributes
    ----------
    nodes_mm : (n, 3) float
        Outer and inner surface nodes lie exactly on the skin's surfaces.
    hexes : (m, 8) int
        VTK order, positive volumes.
    material : (m,) int
        ``SKIN`` or ``GEL``.
    inner_quads : (q, 4) int
        Inside of the skin, one quad for each column of elements. Seen from *outside* the dome the corners run counter-clockwise, so
        normals point away from the dome's centre and the camera sees the back of these quads.
    disc : (k,) complex
        Place of each column of nodes on the skin (see ``shapes``).
    grid : (3,) int
        Number of layers of nodes, and of nodes along each side of the square.
    skin_layers : int
    """

    nodes_mm: FloatArray
    hexes: IntArray
    material: IntArray
    inner_quads: IntArray
    disc: ComplexArray
    grid: tuple[int, int, int]
    skin_layers: int

    @property
    def outer_count(self) -> int:
        """Number of nodes on the outer surface; they are the first ones."""
        return self.grid[1] * self.grid[2]


def build_mesh(geometry: GeometrySpec) -> SensorMesh:
    """Mesh a sensor at rest: 21x21 columns, one layer of skin, four of gel."""
    side, layers = _ACROSS, _SKIN_LAYERS + _GEL_LAYERS
    v, u = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side), indexing="ij")
    disc = outer_chart(geometry).disc(np.stack([u.ravel(), v.ravel()], axis=1))
    depths = np.concatenate([np.linspace(0, 1, _SKIN_LAYERS + 1), 1 + np.linspace(0, 1, _GEL_LAYERS + 1)[1:]])
    grid = (layers + 1, side, side)
    index = np.arange(np.prod(grid)).reshape(grid)
    cells = [index[c : layers + c, b : side - 1 + b, a : side - 1 + a] for a, b, c in _HEX_CORNERS]
    quads = np.stack([c[0] for c in cells[:4]], axis=-1).reshape(-1, 4)
    return SensorMesh(
        nodes_mm=np.concatenate([body_points(geometry, disc, depth) for depth in depths]),
        # the two faces are swapped, because the layers are numbered inwards: the first four corners must be the inner ones
        hexes=np.stack(cells[4:] + cells[:4], axis=-1).reshape(-1, 8),
        material=np.repeat(np.where(np.arange(layers) < _SKIN_LAYERS, SKIN, GEL), (side - 1) ** 2),
        inner_quads=quads + _SKIN_LAYERS * side * side,
        disc=disc,
        grid=grid,
        skin_layers=_SKIN_LAYERS,
    )


def outer_chart(geometry: GeometrySpec) -> Chart | RectangleChart:
    """The chart of the mesh: its columns are at evenly spaced points of the chart's square."""
    shape = shape_of(geometry.skin)
    return shape.chart(Focus(radius_rad=_FOCUS_SHARE * shape.largest_rad))


def to_pyvista(
    mesh: SensorMesh, *, nodes_mm: FloatArray | None = None, point_data: Mapping[str, FloatArray | IntArray] | None = None
) -> "pv.UnstructuredGrid":
    """Skin and gel as one unstructured grid with cell data ``material``.

    Parameters
    ----------
    nodes_mm : (n, 3) float, optional
        Deformed nodes (default: at rest).
    point_data : dict of str to (n,) or (n, 3) float, optional
    """
    import pyvista as pv  # takes a quarter of a second

    nodes = mesh.nodes_mm if nodes_mm is None else nodes_mm
    cells = np.column_stack([np.full(len(mesh.hexes), 8), mesh.hexes])
    grid = pv.UnstructuredGrid(cells, np.full(len(mesh.hexes), pv.CellType.HEXAHEDRON), nodes)
    grid.cell_data["material"] = mesh.material
    for name, values in (point_data or {}).items():
        grid.point_data[name] = values
    return grid


def skin_surface(
    mesh: SensorMesh, *, nodes_mm: FloatArray | None = None, point_data: Mapping[str, FloatArray | IntArray] | None = None
) -> "pv.PolyData":
    """Closed surface of the skin alone (outside, inside, rim), ready to be written as ``.vtp``.

    Point data ``node`` is each point's index in ``mesh.nodes_mm``.
    """
    grid = to_pyvista(mesh, nodes_mm=nodes_mm, point_data={"node": np.arange(len(mesh.nodes_mm)), **(point_data or {})})
    skin = grid.extract_cells(mesh.material == SKIN, pass_point_ids=False, pass_cell_ids=False)
    return skin.extract_surface(pass_pointid=False, pass_cellid=False, algorithm="dataset_surface")


class NodeView:
    """Linear map from the controls of one spline solid of a sensor to the mesh's nodes."""

    def __init__(self, mesh: SensorMesh, solid: Solid) -> None:
        self._mesh_mm, self._rest_mm = mesh.nodes_mm, solid.control_mm
        at = solid.chart.square(mesh.disc)
        self._fine, self._coarse = surface_operators(solid.basis, at)[0], surface_operators(solid.coarse, at)[0]
        layers = np.linspace(0, 1, mesh.skin_layers + 1)
        count = solid.inner.stop // solid.basis.count**2
        self._skin = np.maximum(1 - np.abs(layers[:, None] * (count - 1) - np.arange(count)), 0)
        self._gel = solid.through.values(1 + np.linspace(0, 1, mesh.grid[0] - mesh.skin_layers)[1:])

    def nodes(self, control_mm: FloatArray) -> FloatArray:
        """Nodes (n, 3) of the deformed body."""
        moved = control_mm - self._rest_mm
        upper = self._skin.shape[1] * self._fine.shape[1]
        skin = np.einsum("kc,lcx->lkx", self._fine, moved[:upper].reshape(self._skin.shape[1], -1, 3), optimize=True)
        deep = np.einsum("kc,lcx->lkx", self._coarse, moved[upper:].reshape(-1, self._coarse.shape[1], 3), optimize=True)
        layers = np.concatenate([np.tensordot(self._skin, skin, 1), np.tensordot(self._gel, np.concatenate([skin[-1:], deep]), 1)])
        return self._mesh_mm + layers.reshape(-1, 3)
