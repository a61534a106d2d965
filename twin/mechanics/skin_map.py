"""Force and area maps of a contact, on a grid over the skin that is the same for every contact of a sensor.

The solver's contact points have different positions in every contact, because its mesh is fine where the object presses. Here their forces
are distributed over the nodes of a fixed grid on the outer skin at rest. The force of a point goes to the four nodes around it with
bilinear weights, so the sum over the nodes equals the sum over the points. Divided by the area of a node, the forces become tractions.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from scenes.sensor import GeometrySpec
from twin.geometry.mesh import outer_chart
from twin.geometry.shapes import shape_of
from twin.types import BoolArray, ComplexArray, ContactState, FloatArray

SIDE = 41
"""Number of nodes along each side of the grid. Every second node is a node of ``SensorMesh``. On a dome of 20 mm the nodes are about 1.2 mm
apart."""
PATCH_SHARE = 0.1
"""Threshold of the contact patch: smallest pressure of its nodes relative to the largest pressure. Skin with less pressure moves no pin."""
LEAST_PRESSURE_MPA = 1e-4
"""Smallest pressure that counts as contact. On the whole tip it would be a force of 0.1 N."""
LEAST_ARM_MM2 = 0.25
"""Lower limit of the mean square distance of the pressed nodes from their centre. A torque is divided by this distance, and a contact at a
single point cannot bear a torque."""


@dataclass(frozen=True)
class SkinGrid:
    """The grid over the outer skin of one sensor, at rest.

    Attributes
    ----------
    nodes_mm : (G, 3) float
        Positions of the G = ``SIDE``^2 nodes, row by row, sensor frame.
    area_mm2 : (G,) float
        Area of the skin that belongs to each node. The areas sum to the area of the skin.
    """

    geometry: GeometrySpec
    nodes_mm: FloatArray
    area_mm2: FloatArray

    def distribute_values(self, place: ComplexArray, values: FloatArray) -> FloatArray:
        """Values (c, k) at places (c,) of the skin (see ``twin.geometry.shapes``), distributed over the nodes and summed there: (G, k)."""
        at = (outer_chart(self.geometry).square(place) + 1) / 2 * (SIDE - 1)
        low = np.clip(np.floor(at).astype(int), 0, SIDE - 2)
        share = np.clip(at - low, 0, 1)
        found = np.zeros((SIDE * SIDE, values.shape[1]))
        for right in (0, 1):
            for down in (0, 1):
                weight = np.abs(1 - right - share[:, 0]) * np.abs(1 - down - share[:, 1])
                np.add.at(found, (low[:, 1] + down) * SIDE + low[:, 0] + right, weight[:, None] * values)
        return found

    def smooth_values(self, values: FloatArray, sigma_mm: float) -> FloatArray:
        """Values (M, G) of the nodes, smoothed with a Gaussian of standard deviation ``sigma_mm``; their sum does not change."""
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
        Magnitude of its normal component.
    touched_mm2, slipping_mm2 : (G,) float
        Area in contact, and the part of it that slips, both on the skin at rest.
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
        Positions of the grid's nodes on the deformed outer skin.
    area_mm2 : (G,) float
        Area of the skin at rest that belongs to each node.
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
        return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)

    @property
    def pressure_mpa(self) -> FloatArray:
        """Pressure (G,), N per mm2 of skin at rest; a node that pulls has the pressure 0."""
        return np.maximum((self.force_n * self.normal).sum(axis=1), 0.0) / self.area_mm2

    @property
    def traction_mpa(self) -> FloatArray:
        """Shear traction (G, 3) of the skin on the object, tangential to the skin, N per mm2 of skin at rest."""
        along = (self.force_n * self.normal).sum(axis=1, keepdims=True)
        return (self.force_n - along * self.normal) / self.area_mm2[:, None]

    @property
    def least_mpa(self) -> float:
        """Smallest pressure that counts as contact (see ``PATCH_SHARE`` and ``LEAST_PRESSURE_MPA``)."""
        return max(PATCH_SHARE * float(self.pressure_mpa.max()), LEAST_PRESSURE_MPA)

    @property
    def patch(self) -> BoolArray:
        """Mask (G,) of the nodes in contact."""
        return self.pressure_mpa >= self.least_mpa

    @property
    def resultant_n(self) -> FloatArray:
        """Sum (3,) of the forces."""
        return self.force_n.sum(axis=0)

    @property
    def torque_z_nmm(self) -> float:
        """Torque of the forces about the sensor's axis."""
        return float(np.cross(self.nodes_mm, self.force_n)[:, 2].sum())

    def with_resultants(self, force_n: FloatArray | None = None, torque_z_nmm: float | None = None) -> "ContactMaps":
        """The maps, corrected to a given total force (3,) and to a given torque about the sensor's axis.

        The missing force is distributed over the nodes in proportion to the pressure. The missing torque is added as forces around the
        centre of pressure, also in proportion to the pressure. Without any contact the maps do not change.
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
    """The grid of a sensor: ``SIDE`` x ``SIDE`` evenly spaced places in the square of the chart of ``SensorMesh``."""
    nodes_mm = _outer_points(geometry, np.linspace(-1, 1, SIDE))
    finer = _outer_points(geometry, np.linspace(-1, 1, 4 * (SIDE - 1) + 1)).reshape(4 * (SIDE - 1) + 1, -1, 3)
    first, second = finer[1:, 1:] - finer[:-1, :-1], finer[1:, :-1] - finer[:-1, 1:]
    quads_mm2 = np.linalg.norm(np.cross(first, second), axis=-1) / 2
    of_quad = (np.arange(4 * (SIDE - 1)) + 2) // 4  # index of the node nearest to each quad's centre
    area = np.zeros((SIDE, SIDE))
    np.add.at(area, (of_quad[:, None], of_quad[None, :]), quads_mm2)
    return SkinGrid(geometry, nodes_mm, area.ravel())


def skin_map(geometry: GeometrySpec, state: ContactState) -> SkinMap:
    """Forces and areas of a contact on the sensor's grid."""
    force_n = state.tangential_n - state.normal_n[:, None] * state.normal
    values = np.column_stack([force_n, state.normal_n, state.point_area_mm2, state.point_area_mm2 * state.slipping])
    found = skin_grid(geometry).distribute_values(state.contact_place, values)
    return SkinMap(found[:, :3], found[:, 3], found[:, 4], found[:, 5])


def between_nodes(coarse: FloatArray) -> FloatArray:
    """Values (..., G, k) on the grid, interpolated from values (..., c, k) at the outer nodes of ``SensorMesh``: every second grid node."""
    side = (SIDE + 1) // 2
    given = coarse.reshape(*coarse.shape[:-2], side, side, coarse.shape[-1])
    found = np.zeros((*coarse.shape[:-2], SIDE, SIDE, coarse.shape[-1]), coarse.dtype)
    found[..., ::2, ::2, :] = given
    found[..., 1::2, ::2, :] = (given[..., 1:, :, :] + given[..., :-1, :, :]) / 2
    found[..., :, 1::2, :] = (found[..., :, 2::2, :] + found[..., :, :-1:2, :]) / 2
    return found.reshape(*coarse.shape[:-2], SIDE * SIDE, coarse.shape[-1])


def _outer_points(geometry: GeometrySpec, at: FloatArray) -> FloatArray:
    """Points (k^2, 3) of the outer skin at k x k places of the chart's square, with coordinates ``at`` (k,)."""
    v, u = np.meshgrid(at, at, indexing="ij")
    return shape_of(geometry.skin).outside(outer_chart(geometry).disc(np.stack([u.ravel(), v.ravel()], axis=1)))
