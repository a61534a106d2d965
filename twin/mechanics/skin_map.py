"""What a contact does to the skin, on a grid that is the same for every contact of a sensor.

The solver's contact points lie elsewhere for every contact, because its mesh is fine where the object presses. Here their forces are
spread over the nodes of a fixed grid over the outer skin at rest. A point's force goes to the four nodes around it by bilinear shares, so
the sum over the nodes is the sum over the points. Divided by a node's area the forces are tractions.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from scenes.sensor import GeometrySpec
from twin.geometry.mesh import outer_chart
from twin.geometry.shapes import shape_of
from twin.types import ComplexArray, ContactState, FloatArray

SIDE = 41
"""Nodes along each side of the grid. Every second one is a node of ``SensorMesh``; on a dome of 20 mm they are about 1.2 mm apart."""
PATCH_SHARE = 0.5
"""A node belongs to the contact patch if at least this share of its area touches."""


@dataclass(frozen=True)
class SkinGrid:
    """The grid over the outer skin of one sensor, at rest.

    Attributes
    ----------
    nodes_mm : (G, 3) float
        Places of its ``SIDE``^2 nodes, row by row, sensor frame.
    area_mm2 : (G,) float
        Area of the skin that each node stands for; together they are the skin's area.
    """

    geometry: GeometrySpec
    nodes_mm: FloatArray
    area_mm2: FloatArray

    def spread(self, place: ComplexArray, values: FloatArray) -> FloatArray:
        """Sums (G, k) over the nodes of values (c, k) at places (c,) of the skin (see ``twin.geometry.shapes``)."""
        at = (outer_chart(self.geometry).square(place) + 1) / 2 * (SIDE - 1)
        low = np.clip(np.floor(at).astype(int), 0, SIDE - 2)
        share = np.clip(at - low, 0, 1)
        found = np.zeros((SIDE * SIDE, values.shape[1]))
        for right in (0, 1):
            for down in (0, 1):
                weight = np.abs(1 - right - share[:, 0]) * np.abs(1 - down - share[:, 1])
                np.add.at(found, (low[:, 1] + down) * SIDE + low[:, 0] + right, weight[:, None] * values)
        return found


@dataclass(frozen=True)
class SkinMap:
    """A contact on a ``SkinGrid``; each array has a row for each of its G nodes.

    Attributes
    ----------
    force_n : (G, 3) float
        Force of the skin on the object, sensor frame; the sum is ``ContactState.force_n``.
    normal_n : (G,) float
        Magnitude of the part of it that presses.
    touched_mm2, slipping_mm2 : (G,) float
        Area at rest that is pressed, and of it the area that slides.
    """

    force_n: FloatArray
    normal_n: FloatArray
    touched_mm2: FloatArray
    slipping_mm2: FloatArray


@lru_cache(maxsize=4)
def skin_grid(geometry: GeometrySpec) -> SkinGrid:
    """The grid of a sensor: the chart of ``SensorMesh`` at ``SIDE`` x ``SIDE`` even places."""
    nodes_mm = _outer_points(geometry, np.linspace(-1, 1, SIDE))
    finer = _outer_points(geometry, np.linspace(-1, 1, 4 * (SIDE - 1) + 1)).reshape(4 * (SIDE - 1) + 1, -1, 3)
    first, second = finer[1:, 1:] - finer[:-1, :-1], finer[1:, :-1] - finer[:-1, 1:]
    quads_mm2 = np.linalg.norm(np.cross(first, second), axis=-1) / 2
    of_quad = (np.arange(4 * (SIDE - 1)) + 2) // 4  # the node nearest to each quad's middle
    area = np.zeros((SIDE, SIDE))
    np.add.at(area, (of_quad[:, None], of_quad[None, :]), quads_mm2)
    return SkinGrid(geometry, nodes_mm, area.ravel())


def skin_map(geometry: GeometrySpec, state: ContactState) -> SkinMap:
    """A contact's forces and areas on the sensor's grid."""
    force_n = state.tangential_n - state.normal_n[:, None] * state.normal
    values = np.column_stack([force_n, state.normal_n, state.point_area_mm2, state.point_area_mm2 * state.slipping])
    found = skin_grid(geometry).spread(state.contact_place, values)
    return SkinMap(found[:, :3], found[:, 3], found[:, 4], found[:, 5])


def _outer_points(geometry: GeometrySpec, at: FloatArray) -> FloatArray:
    """Places (k^2, 3) of the outer skin at k x k places of the chart's square."""
    v, u = np.meshgrid(at, at, indexing="ij")
    return shape_of(geometry.skin).outside(outer_chart(geometry).disc(np.stack([u.ravel(), v.ravel()], axis=1)))
