"""The sensor's body as hexahedra: skin, gel, and the feet of the pins on the skin's inside.

Topology: a square grid of columns is bent over the dome (squared disc, so no element collapses
at the apex); each column runs through the skin and the gel down to the lens. The square becomes
a disc by the elliptical map x = u sqrt(1 - v^2 / 2), y = v sqrt(1 - u^2 / 2)
(Fong, "Analytical methods for squaring the disc", 2015); the disc's radius is the polar angle
(finer at the apex), its azimuth the azimuth.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from scenes.sensor import SensorSpec
from twin.geometry.pins import rest_pins

SKIN, GEL = 0, 1
_APEX_FINENESS = 0.72  # polar step at the apex relative to an even one; contacts live there
_HEX_CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))


@dataclass(frozen=True)
class Resolution:
    """How fine the mesh is.

    Attributes
    ----------
    across : int
        Nodes along each side of the square grid over the dome (at least 5).
    skin_layers, gel_layers : int
        Elements through the skin and from the skin to the lens.
    """

    across: int = 21
    skin_layers: int = 1
    gel_layers: int = 4

    def __post_init__(self):
        if self.across < 5 or self.skin_layers < 1 or self.gel_layers < 1:
            raise ValueError(f"a mesh needs across >= 5, skin_layers >= 1 and gel_layers >= 1, got {self}")


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
        VTK order, positive Jacobians.
    material : (m,) int
        ``SKIN`` or ``GEL``.
    outer_quads, inner_quads : (q, 4) int
        Outside and inside of the skin. Both wind counter-clockwise seen from *outside* the dome:
        normals point away from the dome's centre (the camera sees the back of ``inner_quads``).
        Quad k of both belongs to the same column of elements.
    fixed : (n,) bool
        Clamped: rim plane, wall and lens.
    pin_quad : (N,) int
        Inner quad under each pin's foot.
    pin_weights : (N, 4) float
        Bilinear weights of that quad's corners at the foot.
    grid : (3,) int
        Layers of nodes, and nodes along each side of the square.
    skin_layers : int
    pin_value, pin_slope_u, pin_slope_v : (N, across^2) float
        Position and derivatives of the bicubic spline through the inner surface's nodes, at the feet.
    pin_base_mm, pin_axis : (N, 3) float
        Feet and axes at rest.
    pin_cap_length_mm : float
        Foot to cap centre.
    """

    nodes_mm: np.ndarray
    hexes: np.ndarray
    material: np.ndarray
    outer_quads: np.ndarray
    inner_quads: np.ndarray
    fixed: np.ndarray
    pin_quad: np.ndarray
    pin_weights: np.ndarray
    grid: tuple[int, int, int]
    skin_layers: int
    pin_value: np.ndarray
    pin_slope_u: np.ndarray
    pin_slope_v: np.ndarray
    pin_base_mm: np.ndarray
    pin_axis: np.ndarray
    pin_cap_length_mm: float

    @property
    def inner_nodes(self) -> slice:
        """Nodes of the skin's inside, row by row over the square grid."""
        per_layer = self.grid[1] * self.grid[2]
        return slice(self.skin_layers * per_layer, (self.skin_layers + 1) * per_layer)


def build_mesh(spec: SensorSpec, *, resolution: Resolution | None = None) -> SensorMesh:
    """Mesh a sensor at rest.

    Parameters
    ----------
    spec : SensorSpec
    resolution : Resolution, optional
        Default: 21 nodes across, one layer of skin, four of gel.
    """
    resolution = resolution or Resolution()
    side = resolution.across
    outer_mm = spec.skin.outer_radius_mm
    inner_mm = outer_mm - spec.skin.thickness_mm
    v, u = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side), indexing="ij")
    square = np.stack([u.ravel(), v.ravel()], axis=1)

    layers = []
    for depth in np.linspace(0, 1, resolution.skin_layers + 1):
        layers.append(_dome(square, outer_mm + depth * (inner_mm - outer_mm), spec.skin.rim_z_mm))
    inner = layers[-1]
    wall_mm = np.hypot(inner[0, 0], inner[0, 1])
    disc = _squared_disc(square)
    # graded as the dome, which also keeps the flat corner columns the right way round
    disc *= (_polar_fraction(radius := np.linalg.norm(disc, axis=1)) / np.maximum(radius, 1e-300))[:, None]
    lens = np.column_stack([wall_mm * disc, np.full(len(square), spec.lens.z_mm)])
    for depth in np.linspace(0, 1, resolution.gel_layers + 1)[1:]:
        layers.append((1 - depth) * inner + depth * lens)
    grid = (len(layers), side, side)

    index = np.arange(np.prod(grid)).reshape(grid)
    cells = [index[c : grid[0] - 1 + c, b : side - 1 + b, a : side - 1 + a] for a, b, c in _HEX_CORNERS]
    # layers run inwards: swap the two faces, so that the first four corners are the inner ones
    hexes = np.stack(cells[4:] + cells[:4], axis=-1).reshape(-1, 8)
    layer_of_hex = np.repeat(np.arange(grid[0] - 1), (side - 1) ** 2)
    quads = np.stack([c[0] for c in cells[:4]], axis=-1).reshape(-1, 4)
    per_layer = side * side
    fixed = np.zeros(grid, bool)
    fixed[:, [0, -1], :] = fixed[:, :, [0, -1]] = fixed[-1] = True

    pins = rest_pins(spec)
    pin_square = _undome(pins.base_mm, inner_mm, spec.skin.rim_z_mm)
    pin_quad, pin_weights = _locate(pin_square, side)
    value, slope_u, slope_v = _spline_operators(pin_square, side)
    return SensorMesh(
        nodes_mm=np.concatenate(layers),
        hexes=hexes,
        material=np.where(layer_of_hex < resolution.skin_layers, SKIN, GEL),
        outer_quads=quads,
        inner_quads=quads + resolution.skin_layers * per_layer,
        fixed=fixed.ravel(),
        pin_quad=pin_quad,
        pin_weights=pin_weights,
        grid=grid,
        skin_layers=resolution.skin_layers,
        pin_value=value,
        pin_slope_u=slope_u,
        pin_slope_v=slope_v,
        pin_base_mm=pins.base_mm,
        pin_axis=pins.axis,
        pin_cap_length_mm=spec.pins.length_mm + spec.pins.cap_height_mm / 2,
    )


def pin_pose(mesh: SensorMesh, nodes_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Feet, axes and cap centres of the pins on a deformed skin.

    The skin's inside is the bicubic spline through its nodes. Its tangents and unit normal at a
    foot, at rest and deformed, give F = [t_u t_v n] [T_u T_v N]^-1; the pin turns with the rotation
    of F's polar decomposition, which takes N to n. At rest this is exactly ``rest_pins``; a rigid
    motion of the nodes is a rigid motion of the pins.

    Parameters
    ----------
    nodes_mm : (n, 3) float
        Deformed nodes.

    Returns
    -------
    base_mm, axis, caps_mm : (N, 3) float
    """
    rest_foot, rest_frame = _surface(mesh, mesh.nodes_mm)
    foot, frame = _surface(mesh, nodes_mm)
    left, _, right = np.linalg.svd(frame @ np.linalg.inv(rest_frame))
    turn = left @ right
    base = foot + np.einsum("kij,kj->ki", turn, mesh.pin_base_mm - rest_foot)
    axis = np.einsum("kij,kj->ki", turn, mesh.pin_axis)
    return base, axis, base + mesh.pin_cap_length_mm * axis


def _surface(mesh: SensorMesh, nodes_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Foot (N, 3) and frame [t_u t_v n] (N, 3, 3) of the smooth inner surface under each pin."""
    inner = nodes_mm[mesh.inner_nodes]
    along_u, along_v = mesh.pin_slope_u @ inner, mesh.pin_slope_v @ inner
    normal = np.cross(along_u, along_v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return mesh.pin_value @ inner, np.stack([along_u, along_v, normal], axis=2)


def _squared_disc(square: np.ndarray) -> np.ndarray:
    """Square [-1, 1]^2 to the unit disc, (k, 2)."""
    u, v = square.T
    return np.column_stack([u * np.sqrt(1 - v * v / 2), v * np.sqrt(1 - u * u / 2)])


def _squared_disc_inverse(disc: np.ndarray) -> np.ndarray:
    """Unit disc to the square, (k, 2) (Fong 2015, with u^2 - v^2 = x^2 - y^2)."""
    x, y = disc.T
    root = 2 * np.sqrt(2)

    def half(a, b):
        plus = np.sqrt(np.maximum(2 + a * a - b * b + root * a, 0))
        minus = np.sqrt(np.maximum(2 + a * a - b * b - root * a, 0))
        return (plus - minus) / 2

    return np.column_stack([half(x, y), half(y, x)])


def _polar_fraction(radius: np.ndarray) -> np.ndarray:
    """Disc radius (0 to 1) to the fraction of the largest polar angle."""
    return _APEX_FINENESS * radius + (1 - _APEX_FINENESS) * radius**3


def _radius_of_fraction(fraction: np.ndarray) -> np.ndarray:
    """Inverse of ``_polar_fraction``, by Newton's method (the function is convex and rising)."""
    radius = np.array(fraction, dtype=float)
    for _ in range(30):
        slope = _APEX_FINENESS + 3 * (1 - _APEX_FINENESS) * radius**2
        radius -= (_polar_fraction(radius) - fraction) / slope
    return radius


def _dome(square: np.ndarray, radius_mm: float, rim_z_mm: float) -> np.ndarray:
    """Square grid to the spherical cap of a radius that ends in the rim plane, (k, 3)."""
    disc = _squared_disc(square)
    radius = np.linalg.norm(disc, axis=1)
    polar = np.arccos(rim_z_mm / radius_mm) * _polar_fraction(np.minimum(radius, 1.0))
    direction = disc / np.maximum(radius, 1e-300)[:, None]
    return radius_mm * np.column_stack([np.sin(polar)[:, None] * direction, np.cos(polar)])


def _undome(points_mm: np.ndarray, radius_mm: float, rim_z_mm: float) -> np.ndarray:
    """Inverse of ``_dome`` for points on its sphere, (k, 2)."""
    across = np.hypot(points_mm[:, 0], points_mm[:, 1])
    polar = np.arctan2(across, points_mm[:, 2])
    radius = _radius_of_fraction(polar / np.arccos(rim_z_mm / radius_mm))
    return _squared_disc_inverse(points_mm[:, :2] / np.maximum(across, 1e-300)[:, None] * radius[:, None])


def _locate(square: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Quad index (k,) and bilinear corner weights (k, 4) of points of the square."""
    position = (square + 1) / 2 * (side - 1)
    cell = np.clip(position.astype(int), 0, side - 2)
    a, b = (position - cell).T
    weights = np.column_stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b])
    return cell[:, 1] * (side - 1) + cell[:, 0], weights


def _spline_operators(square: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (k, side^2) that give value, d/du and d/dv of the bicubic interpolating spline at points of the square."""
    knots_at = np.linspace(-1, 1, side)
    cardinal = make_interp_spline(knots_at, np.eye(side), k=3)
    slope: BSpline = cardinal.derivative()

    def outer(along_v, along_u):
        return np.einsum("ki,kj->kij", along_v, along_u).reshape(len(square), -1)

    u, v = square.T
    return outer(cardinal(v), cardinal(u)), outer(cardinal(v), slope(u)), outer(slope(v), cardinal(u))
