"""Contact of the outer skin with an object: penalty against the signed distance, Coulomb friction.

At contact points p of rest area A with signed distance d, outward object normal n and penetration
g = max(-d, 0), the force on the skin is (Wriggers, "Computational Contact Mechanics", ch. 5)

    f = A (k g n + t),    t* = -k s,    t = t* if |t*| <= mu k g (stick), else mu k g t* / |t*| (slip)

with the penalty k in MPa/mm and s the tangential travel since the point's anchor, which is fixed to
the object: where the point touched it, moved after a slip so that |s| = mu g. Everything here is in
the object's frame.

With the friction limits frozen (``frozen_limit_mm`` in place of mu g) the forces have a potential,

    sum A k (g^2 / 2 + h(|s|)),    h(s) = s^2 / 2 for s <= limit, else limit s - limit^2 / 2

which a robust minimiser can use (Li et al., "Incremental Potential Contact", 2020).
"""

from dataclasses import dataclass

import numba
import numpy as np

from twin.geometry.mesh import SensorMesh

_GAUSS = ((-np.sqrt(0.6), 5 / 9), (0.0, 8 / 9), (np.sqrt(0.6), 5 / 9))
_HESSIAN_STEP_MM = 1e-4


@dataclass(frozen=True)
class ContactPoints:
    """Where the outer skin is tested for contact: 3x3 Gauss points of each quad, and the free nodes.

    A Gauss point lies on the true sphere at rest: it is its quad's bilinear point plus a fixed ``lift_mm``.

    Attributes
    ----------
    nodes : (p, 4) int
        Nodes that carry a point; ``weights (p, 4)`` their shares (sum 1), ``lift_mm (p, 3)``.
    area_mm2 : (p,) float
        Rest area; the nodes repeat it (they only act under edges that fit between Gauss points).
    element : (p,) int
        Element that the point's stiffness is added to, at its corners ``corner (p, 4)``.
    counted : (p,) bool
        True for Gauss points, whose areas tile the skin.
    """

    nodes: np.ndarray
    weights: np.ndarray
    lift_mm: np.ndarray
    area_mm2: np.ndarray
    element: np.ndarray
    corner: np.ndarray
    counted: np.ndarray

    def positions(self, nodes_mm: np.ndarray) -> np.ndarray:
        """(p, 3) in mm."""
        return np.einsum("pa,pai->pi", self.weights, nodes_mm[self.nodes]) + self.lift_mm


@dataclass(frozen=True)
class Anchors:
    """Friction's memory: the anchor of each point in the object's frame, (p, 3), and which points have one, (p,)."""

    position_mm: np.ndarray
    held: np.ndarray


@dataclass(frozen=True)
class ContactForces:
    """What the object does to the skin, in the object's frame.

    Attributes
    ----------
    force_n : (p, 3) float
        Force on the skin at each point.
    normal_n : (p,) float
        Size of the normal part.
    penetration_mm : (p,) float
    slipping : (p,) bool
    stiffness : (p, 3, 3) float or None
        Minus the force's derivative by the point's position, N/mm.
    anchors : Anchors
        The anchors if this state is accepted.
    energy_nmm : float
        The potential; meaningful with frozen friction limits or without friction.
    """

    force_n: np.ndarray
    normal_n: np.ndarray
    penetration_mm: np.ndarray
    slipping: np.ndarray
    stiffness: np.ndarray | None
    anchors: Anchors
    energy_nmm: float


def contact_points(mesh: SensorMesh, radius_mm: float) -> ContactPoints:
    """Contact points of a mesh whose outer surface is a sphere of a radius."""
    quads = mesh.outer_quads
    count = len(quads)
    corners = mesh.nodes_mm[quads]
    top = np.arange(count)  # the outer layer's elements come first, in the quads' order
    corner_of = np.argmax(mesh.hexes[top][:, None, :] == quads[:, :, None], axis=2)
    nodes, weights, areas = [], [], []
    for eta, weight_eta in _GAUSS:
        for xi, weight_xi in _GAUSS:
            share = np.array([(1 - xi) * (1 - eta), (1 + xi) * (1 - eta), (1 + xi) * (1 + eta), (1 - xi) * (1 + eta)]) / 4
            along = np.array([-(1 - eta), 1 - eta, 1 + eta, -(1 + eta)]) / 4
            across = np.array([-(1 - xi), -(1 + xi), 1 + xi, 1 - xi]) / 4
            normal = np.cross(np.einsum("a,qai->qi", along, corners), np.einsum("a,qai->qi", across, corners))
            nodes.append(quads)
            weights.append(np.tile(share, (count, 1)))
            areas.append(weight_xi * weight_eta * np.linalg.norm(normal, axis=1))
    weights = np.stack(weights, axis=1).reshape(-1, 4)
    gauss_nodes = np.repeat(quads, 9, axis=0)
    flat = np.einsum("pa,pai->pi", weights, mesh.nodes_mm[gauss_nodes])
    lift = flat * (radius_mm / np.linalg.norm(flat, axis=1, keepdims=True) - 1)
    area = np.stack(areas, axis=1).ravel()

    free = np.unique(quads[~mesh.fixed[quads]])
    flat_quads, flat_nodes = quads.ravel(), np.zeros(len(mesh.nodes_mm))
    np.add.at(flat_nodes, flat_quads, np.repeat(np.stack(areas, axis=1).sum(axis=1) / 4, 4))
    first = np.array([np.flatnonzero(flat_quads == node)[0] for node in free])
    owner, place = first // 4, first % 4
    return ContactPoints(
        nodes=np.concatenate([gauss_nodes, quads[owner]]),
        weights=np.concatenate([weights, np.eye(4)[place]]),
        lift_mm=np.concatenate([lift, np.zeros((len(free), 3))]),
        area_mm2=np.concatenate([area, flat_nodes[free]]),
        element=np.concatenate([np.repeat(top, 9), top[owner]]),
        corner=np.concatenate([np.repeat(corner_of, 9, axis=0), corner_of[owner]]),
        counted=np.arange(len(area) + len(free)) < len(area),
    )


def no_anchors(points: ContactPoints) -> Anchors:
    """Nothing touched yet."""
    return Anchors(np.zeros((len(points.area_mm2), 3)), np.zeros(len(points.area_mm2), bool))


def contact_forces(
    points: ContactPoints,
    at_mm: np.ndarray,
    stimulus,
    anchors: Anchors,
    *,
    friction: float,
    penalty_mpa_mm: float,
    frozen_limit_mm: np.ndarray | None = None,
    with_stiffness: bool = False,
) -> ContactForces:
    """Forces, and on request their stiffness, with the contact points at ``at_mm`` (p, 3), object frame.

    ``frozen_limit_mm`` (p,): elastic travel that friction can hold, in place of mu g.
    """
    count = len(at_mm)
    distance = stimulus.distance(at_mm)
    frozen = frozen_limit_mm is not None
    touched = distance < 0
    active = np.flatnonzero(touched | (anchors.held & (frozen_limit_mm > 0)) if frozen else touched)
    at, depth = at_mm[active], np.maximum(-distance[active], 0)
    inside = depth > 0
    n = stimulus.gradient(at)
    stiff = penalty_mpa_mm * points.area_mm2[active]
    f = (stiff * depth)[:, None] * n
    k = None
    if with_stiffness:
        bend = _surface_curvature(stimulus, at, n)
        k = (stiff * inside)[:, None, None] * (n[:, :, None] * n[:, None, :] - depth[:, None, None] * bend)

    path = (at - anchors.position_mm[active]) * anchors.held[active][:, None]
    along_n = np.einsum("pi,pi->p", path, n)
    travel = path - along_n[:, None] * n
    length = np.linalg.norm(travel, axis=1)
    limit = frozen_limit_mm[active] if frozen else friction * depth
    slip = length > limit
    stick = anchors.held[active] & ~slip & (limit > 0)
    direction = travel / np.maximum(length, 1e-300)[:, None]
    held_length = np.minimum(length, limit)
    f -= (stiff * held_length)[:, None] * direction
    if with_stiffness:
        plane = np.eye(3) - n[:, :, None] * n[:, None, :]
        turning = plane - direction[:, :, None] * direction[:, None, :]
        k += (stiff * stick)[:, None, None] * plane
        k += (stiff * slip * limit / np.maximum(length, 1e-300))[:, None, None] * turning
        if not frozen:
            # as the point moves, the normal turns: d s = (I - n n) dx - (n . path) dn - n (path . dn), dn = bend dx
            turning = np.eye(3) - direction[:, :, None] * direction[:, None, :]
            bent = along_n[:, None, None] * bend + n[:, :, None] * np.einsum("pi,pij->pj", path, bend)[:, None, :]
            k -= (stiff * slip * limit / np.maximum(length, 1e-300))[:, None, None] * (turning @ bent)
            k -= (stiff * slip * friction)[:, None, None] * direction[:, :, None] * n[:, None, :]

    def scattered(values, shape=()):
        out = np.zeros((count, *shape))
        out[active] = values
        return out

    return ContactForces(
        force_n=scattered(f, (3,)),
        normal_n=scattered(stiff * depth),
        penetration_mm=scattered(depth),
        slipping=scattered(slip & (limit > 0)) > 0,
        stiffness=scattered(k, (3, 3)) if with_stiffness else None,
        anchors=Anchors(scattered(at - held_length[:, None] * direction, (3,)), touched),
        energy_nmm=float((stiff * (depth**2 / 2 + held_length * (length - held_length / 2))).sum()),
    )


def _surface_curvature(stimulus, at_mm: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Second derivative of the distance (k, 3, 3) in 1/mm, by differences of the gradient."""
    bend = np.stack([(stimulus.gradient(at_mm + _HESSIAN_STEP_MM * e) - normal) / _HESSIAN_STEP_MM for e in np.eye(3)], axis=2)
    size = np.abs(bend).max(axis=(1, 2), keepdims=True)
    bend = np.where(size > 0.1 / _HESSIAN_STEP_MM, 0.0, bend)  # across a crease there is no curvature
    return (bend + bend.transpose(0, 2, 1)) / 2


@numba.njit(cache=True)
def spread_forces(nodes, weights, force, out):
    """Add point forces (p, 3) to the nodes that carry the points, (n, 3)."""
    for p in range(len(nodes)):
        if force[p, 0] != 0.0 or force[p, 1] != 0.0 or force[p, 2] != 0.0:
            for a in range(4):
                for i in range(3):
                    out[nodes[p, a], i] += weights[p, a] * force[p, i]


@numba.njit(cache=True)
def spread_stiffness(element, corner, weights, stiffness, active, out):
    """Add point stiffnesses (p, 3, 3) to element blocks (m, 24, 24)."""
    for k in range(len(active)):
        p = active[k]
        for a in range(4):
            for b in range(4):
                share = weights[p, a] * weights[p, b]
                for i in range(3):
                    for j in range(3):
                        out[element[p], 3 * corner[p, a] + i, 3 * corner[p, b] + j] += share * stiffness[p, i, j]
