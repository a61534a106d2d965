"""The sensor's body as hexahedra, for views, files and the renderer: the same nodes for every contact.

The nodes stand on a square grid bent over the dome (``chart``), in straight columns through the skin and
the gel down to the lens. What moves them is the spline solid of ``solid``.
"""

from dataclasses import dataclass

import numpy as np

from scenes.sensor import GeometrySpec
from twin.geometry.chart import Chart, Focus
from twin.geometry.solid import body_points
from twin.types import ComplexArray, FloatArray, IntArray

SKIN, GEL = 0, 1
_ACROSS, _SKIN_LAYERS, _GEL_LAYERS = 21, 1, 4
_HEX_CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))


@dataclass(frozen=True)
class SensorMesh:
    """Volume mesh of skin and gel at rest, in the sensor frame.

    Nodes are numbered layer by layer from the outside in (layer 0 is the outer surface, layer
    ``skin_layers`` the skin's inside, the last one the lens), each layer row by row over the square grid.

    Attributes
    ----------
    nodes_mm : (n, 3) float
        Outer and inner surface nodes lie exactly on their spheres.
    hexes : (m, 8) int
        VTK order, positive volumes.
    material : (m,) int
        ``SKIN`` or ``GEL``.
    outer_quads, inner_quads : (q, 4) int
        Outside and inside of the skin. Both wind counter-clockwise seen from *outside* the dome:
        normals point away from the dome's centre (the camera sees the back of ``inner_quads``).
        Quad k of both belongs to the same column of elements.
    disc : (k,) complex
        Where on the dome each column of nodes stands (see ``chart``).
    grid : (3,) int
        Layers of nodes, and nodes along each side of the square.
    skin_layers : int
    """

    nodes_mm: FloatArray
    hexes: IntArray
    material: IntArray
    outer_quads: IntArray
    inner_quads: IntArray
    disc: ComplexArray
    grid: tuple[int, int, int]
    skin_layers: int


def build_mesh(geometry: GeometrySpec) -> SensorMesh:
    """Mesh a sensor at rest: 21x21 columns, one layer of skin, four of gel."""
    side, layers = _ACROSS, _SKIN_LAYERS + _GEL_LAYERS
    v, u = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side), indexing="ij")
    largest = float(np.arccos(geometry.skin.rim_z_mm / (geometry.skin.outer_radius_mm - geometry.skin.thickness_mm)))
    disc = Chart(Focus(radius_rad=0.62 * largest), largest).disc(np.stack([u.ravel(), v.ravel()], axis=1))
    depths = np.concatenate([np.linspace(0, 1, _SKIN_LAYERS + 1), 1 + np.linspace(0, 1, _GEL_LAYERS + 1)[1:]])
    grid = (layers + 1, side, side)
    index = np.arange(np.prod(grid)).reshape(grid)
    cells = [index[c : layers + c, b : side - 1 + b, a : side - 1 + a] for a, b, c in _HEX_CORNERS]
    quads = np.stack([c[0] for c in cells[:4]], axis=-1).reshape(-1, 4)
    return SensorMesh(
        nodes_mm=np.concatenate([body_points(geometry, disc, depth) for depth in depths]),
        # layers run inwards: swap the two faces, so that the first four corners are the inner ones
        hexes=np.stack(cells[4:] + cells[:4], axis=-1).reshape(-1, 8),
        material=np.repeat(np.where(np.arange(layers) < _SKIN_LAYERS, SKIN, GEL), (side - 1) ** 2),
        outer_quads=quads,
        inner_quads=quads + _SKIN_LAYERS * side * side,
        disc=disc,
        grid=grid,
        skin_layers=_SKIN_LAYERS,
    )
