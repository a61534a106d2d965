"""Contact of the outer skin with an object: a penalty on the signed distance, and Coulomb friction.

At contact points of rest area A with signed distance d, outward object normal n and penetration
g = max(-d, 0), the force on the skin is (Wriggers, "Computational Contact Mechanics", ch. 5)

    f = A (p n - min(mu p, tau) phi(|s| / delta) s / |s|),    phi(x) = 2 x - x^2 for x < 1 (stick), else 1 (slip)

p is the pressure k (g - eps / 2) with the penalty k; for g < eps it is k g^2 / 2 eps, so that the force begins smoothly. s is the
tangential travel from the point's anchor. The anchor is fixed to the object: it is the place where the point first
touched the object, and after a slip it is moved so that |s| = delta. tau is the largest shear stress that the
interface can bear at any pressure (as between rubbers; Orowan's friction). A sticking point creeps by less than
delta, and no point leaves Coulomb's cone. Everything here is in the object's frame.
"""

from dataclasses import dataclass

import numpy as np

from twin.compiled import compiled
from twin.geometry.shapes import SkinShape
from twin.geometry.solid import Solid
from twin.objects import ObjectField
from twin.objects.level_set import Probe
from twin.types import BoolArray, ComplexArray, FloatArray, IntArray

SMOOTH_GAP_MM = 0.006
"""eps: penetration (mm) below which the pressure grows with the square of the penetration, so that contact begins smoothly."""
STICK_CREEP_MM = 0.01
"""delta: travel (mm) from the anchor at which a sticking point starts to slip; about a hundredth of a usual shear."""
TOUCHING_MM = 0.05
"""Distance (mm) below which skin counts as touching a pressed object. Within a contact patch the skin lifts by some micrometres where the
pressure is almost zero, so an area defined by the pressure alone depends on the mesh."""
POINTS_PER_ELEMENT = 4
"""Number of contact points along each side of an outer element."""


@dataclass(frozen=True)
class ContactPoints:
    """Points at which the outer skin is tested for contact: a regular grid of 4x4 points on each outer element.

    At rest a point lies on the exact outer surface: its position is that of the spline surface plus a constant ``lift_mm``.

    Attributes
    ----------
    controls : (p, 9) int
        Controls of the outer layer that carry a point.
    weights : (p, 9) float
        Weights of these controls; they sum to 1.
    lift_mm : (p, 3) float
        Offset of the exact outer surface from the spline surface at rest.
    area_mm2 : (p,) float
        Rest area of the skin that belongs to each point; the areas tile the skin.
    element : (p,) int
        Element that contains the point.
    place : (p,) complex
        Place on the skin (see ``twin.geometry.shapes``).
    """

    controls: IntArray
    weights: FloatArray
    lift_mm: FloatArray
    area_mm2: FloatArray
    element: IntArray
    place: ComplexArray

    def positions(self, control_mm: FloatArray) -> FloatArray:
        """(p, 3) in mm."""
        return positions(self.controls, self.weights, self.lift_mm, control_mm)


def contact_points(solid: Solid, shape: SkinShape) -> ContactPoints:
    """Contact points of a solid whose skin has the given shape."""
    basis = solid.basis
    count = basis.elements * POINTS_PER_ELEMENT
    step = (basis.breaks[-1] - basis.breaks[0]) / count
    at = basis.breaks[0] + (np.arange(count) + 0.5) * step
    outer = solid.control_mm[: basis.count**2].reshape(basis.count, basis.count, 3)
    value, slope = basis.values(at), basis.values(at, derivative=1)

    def surface(rows: FloatArray, columns: FloatArray) -> FloatArray:
        return np.einsum("ri,cj,ijx->rcx", rows, columns, outer, optimize=True).reshape(-1, 3)

    flat = surface(value, value)
    growth = np.cross(surface(value, slope), surface(slope, value))
    first = basis.element_of(at)
    local = np.take_along_axis(value, first[:, None] + np.arange(3), axis=1)
    element = (first[:, None] * basis.elements + first).ravel()
    return ContactPoints(
        controls=solid.skin.controls[element, :9],
        weights=np.einsum("ri,cj->rcij", local, local).reshape(-1, 9),
        lift_mm=np.ascontiguousarray(shape.on_outside(flat) - flat),
        area_mm2=np.linalg.norm(growth, axis=1) * step**2,
        element=element,
        place=solid.chart.disc(np.stack([np.tile(at, count), np.repeat(at, count)], axis=1)),
    )


def touching_mm2(points: ContactPoints, gap_mm: FloatArray) -> float:
    """Rest area of the skin whose gap to the object is less than ``TOUCHING_MM``; ``gap_mm`` (p,) is the gap at the points.

    The points form a square grid. The gap is interpolated linearly between them, so that the area changes continuously.
    """
    side = round(len(gap_mm) ** 0.5)
    along = np.gradient(gap_mm.reshape(side, side))
    change = np.maximum(np.abs(along[0]) + np.abs(along[1]), 1e-12).ravel()  # change of the gap across a point's own cell
    return float(np.clip(0.5 + (TOUCHING_MM - gap_mm) / change, 0, 1) @ points.area_mm2)


def positions(controls: IntArray, weights: FloatArray, lift: FloatArray, control: FloatArray) -> FloatArray:
    """Positions (p, 3) of points that are carried by nine controls each."""
    _carry(controls, weights, control, out := lift.copy())
    return out


@compiled()
def _carry(controls: IntArray, weights: FloatArray, control: FloatArray, out: FloatArray) -> None:
    for p in range(len(controls)):
        for a in range(9):
            for i in range(3):
                out[p, i] += weights[p, a] * control[controls[p, a], i]


@dataclass(frozen=True)
class ContactForces:
    """Contact forces of the object on the skin, in the object's frame.

    Attributes
    ----------
    normal : (p, 3) float
        The object's outward normal.
    force_n : (p, 3) float
        Force on the skin at each point.
    normal_n : (p,) float
        Magnitude of the normal component.
    penetration_mm : (p,) float
        Depth of each point inside the object, 0 outside.
    slipping : (p,) bool
    stiffness : (p, 3, 3) float
        Minus the derivative of the force with respect to the point's position, N/mm.
    anchor_mm : (p, 3) float
        New anchors of the points in contact, for the case that this state is accepted.
    """

    normal: FloatArray
    force_n: FloatArray
    normal_n: FloatArray
    penetration_mm: FloatArray
    slipping: BoolArray
    stiffness: FloatArray
    anchor_mm: FloatArray


def contact_forces(
    field: ObjectField, at: FloatArray, stiff: FloatArray, anchor: FloatArray, friction: FloatArray, bound: FloatArray, soften: float = 1.0
) -> ContactForces:
    """Contact forces and their stiffness with the contact points at ``at`` (p, 3) in mm, object frame.

    Parameters
    ----------
    stiff : (p,) float
        Penalty times area, N/mm.
    anchor : (p, 3) float
        Friction anchor of each point, mm.
    friction : (p,) float
        Coefficient of friction at each point.
    bound : (p,) float
        Largest friction force of each point (tau A).
    soften : float
        A value below 1 gives softened contact, as an intermediate problem on the way to the solution. The penalty is multiplied by it,
        ``SMOOTH_GAP_MM`` and ``STICK_CREEP_MM`` are divided by it.
    """
    probe, count = field.probe(at), len(at)
    force, pressing, depth, slipping = np.zeros((count, 3)), np.zeros(count), np.zeros(count), np.zeros(count, bool)
    law = force, pressing, depth, slipping, np.zeros((count, 3, 3)), at.copy()
    _law(at, probe, soften * stiff, anchor, friction, bound, soften, np.empty(3), *law)
    return ContactForces(probe[1], *law)


@compiled()
def _law(
    at: FloatArray,
    probe: Probe,
    stiff: FloatArray,
    anchor: FloatArray,
    friction: FloatArray,
    bound: FloatArray,
    soften: float,
    way: FloatArray,
    force: FloatArray,
    pressing: FloatArray,
    depth: FloatArray,
    slipping: BoolArray,
    k: FloatArray,
    moved: FloatArray,
) -> None:
    """Write the law at the points in contact into the arrays of ``ContactForces``; ``way`` (3,) is work space."""
    (distance, normal, hessian), eps, delta = probe, SMOOTH_GAP_MM / soften, STICK_CREEP_MM / soften
    for p in range(len(at)):
        g = -distance[p]
        if not g > 0:
            continue
        press, rise = stiff[p] * (g - eps / 2), stiff[p]
        if g < eps:
            press, rise = stiff[p] * g * g / (2 * eps), stiff[p] * g / eps
        depth[p], pressing[p] = g, press
        along, length = 0.0, 0.0
        for i in range(3):
            force[p, i] = press * normal[p, i]
            along += (at[p, i] - anchor[p, i]) * normal[p, i]
            for j in range(3):
                k[p, i, j] = rise * normal[p, i] * normal[p, j] - press * hessian[p, i, j]
        limit, growth = friction[p] * press, friction[p] * rise
        if limit > bound[p]:
            limit, growth = bound[p], 0.0
        if limit == 0:
            continue
        for i in range(3):
            way[i] = at[p, i] - anchor[p, i] - along * normal[p, i]
            length += way[i] ** 2
        length = np.sqrt(length)
        x = min(length / delta, 1.0)
        slipping[p] = x == 1
        hold, ahead = (2 - x) * x, limit * 2 * (1 - x) / delta
        across = limit * hold / length if length > 0 else limit * 2 / delta
        for i in range(3):
            way[i] /= length if length > 0 else 1.0
            force[p, i] -= limit * hold * way[i]
            moved[p, i] = at[p, i] - delta * way[i] if slipping[p] else anchor[p, i]
        # the normal turns when the point moves: d travel = (I - n n) dx - along dn - n (path . dn), dn = h dx
        for j in range(3):
            turned, bent = normal[p, j], 0.0
            for m in range(3):
                turned += (at[p, m] - anchor[p, m]) * hessian[p, m, j]
                bent += way[m] * hessian[p, m, j]
            lengthways = (ahead - across) * (way[j] - along * bent) - growth * hold * normal[p, j]
            for i in range(3):
                straight = 1.0 if i == j else 0.0
                k[p, i, j] += across * (straight - normal[p, i] * turned - along * hessian[p, i, j]) + way[i] * lengthways


@compiled()
def spread_forces(controls: IntArray, weights: FloatArray, force: FloatArray, out: FloatArray) -> None:
    """Add point forces (p, 3) to the controls that carry the points, (n, 3)."""
    for p in range(len(controls)):
        if force[p, 0] != 0.0 or force[p, 1] != 0.0 or force[p, 2] != 0.0:
            for a in range(9):
                for i in range(3):
                    out[controls[p, a], i] += weights[p, a] * force[p, i]


@compiled()
def spread_stiffness(controls: IntArray, weights: FloatArray, stiffness: FloatArray, out: FloatArray) -> None:
    """Add point stiffnesses (p, 3, 3) to the matrix (3 n, 3 n) of the controls' unknowns; controls numbered n or more are omitted."""
    count = len(out) // 3
    for p in range(len(controls)):
        size = 0.0
        for i in range(3):
            size += abs(stiffness[p, i, 0]) + abs(stiffness[p, i, 1]) + abs(stiffness[p, i, 2])
        for a in range(9 if size > 0 else 0):
            for b in range(9):
                row, column, share = controls[p, a], controls[p, b], weights[p, a] * weights[p, b]
                if row < count and column < count:
                    for i in range(3):
                        for j in range(3):
                            out[3 * row + i, 3 * column + j] += share * stiffness[p, i, j]
