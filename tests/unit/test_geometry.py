"""The mesh is a valid solid on its spheres, and the pins follow the skin."""

import numpy as np
import pytest

from scenes.load import list_sensors, load_sensor
from twin.geometry.export import skin_surface, to_pyvista
from twin.geometry.mesh import GEL, SKIN, Resolution, build_mesh, pin_pose
from twin.geometry.pins import rest_pins
from twin.mechanics.elements import element_table

ROUNDING_MM = 1e-9


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("mg400-127")


@pytest.fixture(scope="module")
def mesh(sensor):
    return build_mesh(sensor, resolution=Resolution(across=13))


def rotation(axis, angle_rad):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) - np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * cross @ cross


@pytest.mark.parametrize("across, skin_layers", [(5, 1), (12, 2), (21, 1), (33, 2)])
def test_every_element_has_positive_volume_at_its_gauss_points(sensor, across, skin_layers):
    mesh = build_mesh(sensor, resolution=Resolution(across=across, skin_layers=skin_layers))
    ones = np.ones(len(mesh.hexes))
    table = element_table(mesh.nodes_mm, mesh.hexes, ones, ones)
    assert table.weights_mm3.min() > 0
    assert set(np.unique(mesh.material)) == {SKIN, GEL}
    assert np.count_nonzero(mesh.material == SKIN) == skin_layers * (across - 1) ** 2


def test_surfaces_lie_on_their_spheres_and_quads_face_away_from_the_centre(sensor, mesh):
    outer = sensor.skin.outer_radius_mm
    for quads, radius in ((mesh.outer_quads, outer), (mesh.inner_quads, outer - sensor.skin.thickness_mm)):
        corners = mesh.nodes_mm[quads]
        assert np.abs(np.linalg.norm(corners, axis=2) - radius).max() < ROUNDING_MM
        normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        assert (np.einsum("qi,qi->q", normal, corners.mean(axis=1)) > 0).all()


def test_rim_wall_and_lens_are_clamped_and_nothing_else_is(sensor, mesh):
    z = mesh.nodes_mm[:, 2]
    on_rim = np.abs(z - sensor.skin.rim_z_mm) < ROUNDING_MM
    across = np.hypot(*mesh.nodes_mm[:, :2].T)
    on_wall = np.abs(across - (sensor.skin.outer_radius_mm - sensor.skin.thickness_mm)) < ROUNDING_MM
    on_lens = np.abs(z - sensor.lens.z_mm) < ROUNDING_MM
    assert mesh.fixed[on_lens].all()
    assert mesh.fixed[on_wall].all()
    outer = np.linalg.norm(mesh.nodes_mm, axis=1) > sensor.skin.outer_radius_mm - ROUNDING_MM
    assert np.array_equal(mesh.fixed[outer], on_rim[outer])


def test_volume_converges_to_the_dome_and_its_cylinder(sensor):
    skin, lens = sensor.skin, sensor.lens
    inner = skin.outer_radius_mm - skin.thickness_mm
    exact = 2 / 3 * np.pi * skin.outer_radius_mm**3 + np.pi * inner**2 * (skin.rim_z_mm - lens.z_mm)
    error = []
    for across in (9, 17):
        mesh = build_mesh(sensor, resolution=Resolution(across=across))
        ones = np.ones(len(mesh.hexes))
        error.append(exact - element_table(mesh.nodes_mm, mesh.hexes, ones, ones).weights_mm3.sum())
    assert 3 < error[0] / error[1] < 5  # second order in the element's size


@pytest.mark.parametrize("name", list_sensors())
def test_pins_at_rest_are_the_specification_s(name):
    spec = load_sensor(name)
    mesh = build_mesh(spec, resolution=Resolution(across=11))
    pins = rest_pins(spec)
    base, axis, caps = pin_pose(mesh, mesh.nodes_mm)
    for got, wanted in ((base, pins.base_mm), (axis, pins.axis), (caps, pins.cap_mm)):
        assert np.abs(got - wanted).max() < ROUNDING_MM


def test_pins_rotate_with_a_rigid_motion(mesh):
    turn, shift = rotation([1, 2, -0.5], 0.7), np.array([1.0, -2.0, 3.0])
    base, axis, caps = pin_pose(mesh, mesh.nodes_mm)
    moved = pin_pose(mesh, mesh.nodes_mm @ turn.T + shift)
    assert np.abs(moved[0] - (base @ turn.T + shift)).max() < ROUNDING_MM
    assert np.abs(moved[1] - axis @ turn.T).max() < ROUNDING_MM
    assert np.abs(moved[2] - (caps @ turn.T + shift)).max() < ROUNDING_MM


def test_caps_follow_the_slope_of_a_smooth_bulge(sensor):
    """On x -> x + bump(x), the axis is minus the exact normal of the bumped sphere."""
    mesh = build_mesh(sensor, resolution=Resolution(across=21))

    def bump(points):
        return points * (1 - 0.05 * np.exp(-(points[:, 0] ** 2 + points[:, 1] ** 2) / 60))[:, None]

    base, axis, _ = pin_pose(mesh, bump(mesh.nodes_mm))
    rest, step = rest_pins(sensor).base_mm, 1e-5
    helper = np.where(np.abs(rest[:, [2]]) < 10, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(rest, helper) / 19
    second = np.cross(rest, first) / 19
    normal = np.cross(bump(rest + step * first) - bump(rest - step * first), bump(rest + step * second) - bump(rest - step * second))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= -np.sign(np.einsum("ni,ni->n", normal, rest))[:, None]
    assert np.abs(base - bump(rest)).max() < 0.01  # mm
    assert np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", axis, normal), -1, 1))).max() < 0.5


def test_pin_weights_place_the_feet_on_their_quads(mesh, sensor):
    assert np.abs(mesh.pin_weights.sum(axis=1) - 1).max() < 1e-12
    assert mesh.pin_weights.min() > -1e-9
    foot = np.einsum("nc,nci->ni", mesh.pin_weights, mesh.nodes_mm[mesh.inner_quads[mesh.pin_quad]])
    assert np.abs(foot - rest_pins(sensor).base_mm).max() < 0.3  # mm: the sagitta of a quad


def test_exported_skin_is_a_closed_surface(mesh, sensor):
    skin = skin_surface(mesh, point_data={"height": mesh.nodes_mm[:, 2]})
    assert skin.is_manifold
    assert np.allclose(skin.points, mesh.nodes_mm[skin.point_data["node"]])
    assert np.allclose(skin.point_data["height"], skin.points[:, 2])
    grid = to_pyvista(mesh)
    assert grid.n_cells == len(mesh.hexes)
    assert grid.compute_cell_sizes().cell_data["Volume"].min() > 0


def test_a_mesh_too_coarse_is_refused():
    with pytest.raises(ValueError, match="across >= 5"):
        Resolution(across=3)
