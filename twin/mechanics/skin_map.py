"""Maps of a contact on the skin, on a grid that is the same for every contact of a sensor.

The solver's contact points lie elsewhere for every contact, because its mesh is fine where the object presses. Here their forces are
spread over the nodes of a fixed grid over the outer skin at rest. A point's force goes to the four nodes around it by bilinear shares, so
the sum over the nodes is the sum over the points. Divided by a node's area the forces are tractions.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from scenes.sensor import GeometrySpec
from twin.geometry.mesh import outer_chart
from twin.geometry.shapes import shape_of
from twin.types import BoolArray, ComplexArray, ContactState, FloatArray

SIDE = 41
"""Nodes along each side of the grid. Every second one is a node of ``SensorMesh``; on a dome of 20 mm they are about 1.2 mm apart."""
PATCH_SHARE = 0.1
"""A node belongs to the contact patch if its pressure is at least this share of the largest: skin that hardly presses moves no pin."""
LEAST_PRESSURE_MPA = 1e-4
"""Largest pressure below which nothing is in contact: over the whole tip it is a tenth of a newton."""
LEAST_ARM_MM2 = 0.25
"""Least mean square distance of the pressed nodes from their middle by which a torque is divided: a point bears no torque."""


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

    def averaged(self, values: FloatArray, sigma_mm: float) -> FloatArray:
        """Sums (M, G) of nodes, each spread over its neighbours by a Gaussian of the given width; the total stays the same."""
        apart_mm2 = ((self.nodes_mm[:, None] - self.nodes_mm[None]) ** 2).sum(axis=-1)
        weights = np.exp(-apart_mm2 / (2 * sigma_mm**2)).astype(np.float32)
        return values @ (weights / weights.sum(axis=0)).T


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


@dataclass(frozen=True)
class ContactMaps:
    """Pressure and shear over the skin of one contact, on a ``SkinGrid`` whose skin is deformed. All in the sensor frame.

    Attributes
    ----------
    nodes_mm : (G, 3) float
        Places of the grid's nodes on the deformed outer skin.
    area_mm2 : (G,) float
        Area of the skin at rest that each node stands for.
    force_n : (G, 3) float
        Force of the skin on the object.
    """

    nodes_mm: FloatArray
    area_mm2: FloatArray
    force_n: FloatArray

    @cached_property
    def normal(self) -> FloatArray:
        """Outward unit normals (G, 3) of the deformed skin."""
        places = self.nodes_mm.reshape(SIDE, SIDE, 3)
        across = np.cross(np.gradient(places, axis=1), np.gradient(places, axis=0)).reshape(-1, 3)
        unit: FloatArray = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        return unit

    @property
    def pressure_mpa(self) -> FloatArray:
        """Pressure (G,), N/mm2 of skin at rest; nothing pulls."""
        pressure: FloatArray = np.maximum((self.force_n * self.normal).sum(axis=1), 0.0) / self.area_mm2
        return pressure

    @property
    def traction_mpa(self) -> FloatArray:
        """Shear traction of the skin on the object (G, 3), along the skin, N/mm2 of skin at rest."""
        along = (self.force_n * self.normal).sum(axis=1, keepdims=True)
        traction: FloatArray = (self.force_n - along * self.normal) / self.area_mm2[:, None]
        return traction

    @property
    def least_mpa(self) -> float:
        """Pressure from which on skin counts as in contact; see ``PATCH_SHARE``."""
        return max(PATCH_SHARE * float(self.pressure_mpa.max()), LEAST_PRESSURE_MPA)

    @property
    def patch(self) -> BoolArray:
        """(G,) bool: the nodes in contact."""
        patch: BoolArray = self.pressure_mpa >= self.least_mpa
        return patch

    @property
    def resultant_n(self) -> FloatArray:
        """(3,) sum of the forces."""
        total: FloatArray = self.force_n.sum(axis=0)
        return total

    @property
    def torque_z_nmm(self) -> float:
        """Torque of the forces about the sensor's axis."""
        return float(np.cross(self.nodes_mm, self.force_n)[:, 2].sum())

    def with_resultants(self, force_n: FloatArray | None = None, torque_z_nmm: float | None = None) -> "ContactMaps":
        """The same maps with another total force (3,), and another torque about the sensor's axis if it is given.

        What is missing is added where the skin presses, in proportion to the pressure: a force, and a turn about the middle of the
        pressure. Where nothing presses the maps stay as they are.
        """
        share = self.pressure_mpa * self.area_mm2
        if share.max(initial=0.0) <= LEAST_PRESSURE_MPA * self.area_mm2.mean():
            return self
        share = share[:, None] / share.sum()
        found = self if force_n is None else replace(self, force_n=self.force_n + share * (np.asarray(force_n, float) - self.resultant_n))
        if torque_z_nmm is None:
            return found
        arm = self.nodes_mm - (share * self.nodes_mm).sum(axis=0)
        turn = np.column_stack([-arm[:, 1], arm[:, 0], np.zeros(len(arm))])
        square = max(float((share * turn**2).sum()), LEAST_ARM_MM2)
        return replace(found, force_n=found.force_n + share * turn * (torque_z_nmm - found.torque_z_nmm) / square)


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


def between_nodes(coarse: FloatArray) -> FloatArray:
    """Values (..., G, k) on the grid of values at the outer nodes of ``SensorMesh`` (..., c, k), which are every second node of it."""
    side = (SIDE + 1) // 2
    given = coarse.reshape(*coarse.shape[:-2], side, side, coarse.shape[-1])
    found = np.zeros((*coarse.shape[:-2], SIDE, SIDE, coarse.shape[-1]), coarse.dtype)
    found[..., ::2, ::2, :] = given
    found[..., 1::2, ::2, :] = (given[..., 1:, :, :] + given[..., :-1, :, :]) / 2
    found[..., :, 1::2, :] = (found[..., :, 2::2, :] + found[..., :, :-1:2, :]) / 2
    return found.reshape(*coarse.shape[:-2], SIDE * SIDE, coarse.shape[-1])


def _outer_points(geometry: GeometrySpec, at: FloatArray) -> FloatArray:
    """Places (k^2, 3) of the outer skin at k x k places of the chart's square."""
    v, u = np.meshgrid(at, at, indexing="ij")
    return shape_of(geometry.skin).outside(outer_chart(geometry).disc(np.stack([u.ravel(), v.ravel()], axis=1)))
