"""The splines, the charts and the solid are what they claim, and the pins and the mesh follow the skin."""

import numpy as np
import pytest
from block import rotation
from scipy.spatial import cKDTree

from scenes.body import SkinSpec
from scenes.load import list_specifications, load_sensor
from twin.geometry.mesh import GEL, SKIN, NodeView, build_mesh, skin_surface, to_pyvista
from twin.geometry.pins import rest_pins
from twin.geometry.shapes import Chart, Focus, RectangularPad, shape_of, square_of_disc
from twin.geometry.solid import Basis, Resolution, body_points, build_solid, pin_pose, rotations, surface_operators

ROUNDING_MM = 1e-9
SPLINE_MM = 0.075  # how far a spline surface of 16 elements across lies from its sphere of 20 mm (measured 0.069)
NODE_MM = 0.15, 0.4  # how far from its place in a solid of 16 elements across a node of the skin, of the gel lies (0.10, 0.31)
SMOOTH_ORDER = 2**2.3  # gain of halving the elements: quadratic splines are of third order in the end
FOCI = [Focus(), Focus(0.5, 0.0), Focus(0.7, 2.0, 0.4, 0.3), Focus(1.4, -2.5, 0.9, 2.0), Focus(0.0, 0.0, 2.0), Focus(0.2, 1.0, 0.1, -1.0)]


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("mg400-127")


@pytest.fixture(scope="module")
def mesh(sensor):
    return build_mesh(sensor.geometry)


@pytest.fixture(scope="module")
def solid(sensor):
    return build_solid(sensor.geometry, resolution=Resolution(across=8), focus=Focus(0.4, 1.0))


def square_points(count=300, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 2))


def chart_of(focus):
    return Chart(focus, np.pi / 2)


def all_cells(solid):
    return [solid.skin, solid.gel_top, solid.gel_deep]


# --- splines


@pytest.fixture(params=[1, 2])
def basis(request):
    return Basis(np.array([-1.0, -0.7, -0.1, 0.2, 0.9, 1.5]), request.param)


def test_splines_sum_to_one_and_are_not_negative(basis):
    values = basis.values(np.linspace(-1, 1.5, 101))
    assert values.shape == (101, basis.count) == (101, 5 + basis.degree)
    assert np.abs(values.sum(axis=1) - 1).max() < 1e-14
    assert values.min() >= 0
    assert np.abs(basis.values(np.linspace(-1, 1.5, 101), derivative=1).sum(axis=1)).max() < 1e-12


def test_a_linear_function_s_coefficients_are_its_values_at_the_greville_points(basis):
    at = np.linspace(-1, 1.5, 57)
    assert np.abs(basis.values(at) @ (3 * basis.greville - 2) - (3 * at - 2)).max() < 1e-14


def test_the_first_and_last_coefficient_are_the_ends_values(basis):
    ends = basis.values(basis.breaks[[0, -1]])
    assert np.allclose(ends, np.eye(basis.count)[[0, -1]], atol=1e-15)


def test_spline_derivative_is_the_limit_of_differences(basis):
    at, step = np.array([-0.9, -0.3, 0.05, 0.6, 1.3]), 1e-6
    differences = (basis.values(at + step) - basis.values(at - step)) / (2 * step)
    assert np.abs(basis.values(at, derivative=1) - differences).max() < 1e-8


@pytest.mark.parametrize("degree, smooth", [(1, False), (2, True)])
def test_the_slope_of_quadratic_splines_is_continuous_at_the_breaks_and_of_linear_ones_is_not(degree, smooth):
    basis = Basis(np.array([-1.0, -0.7, -0.1, 0.2, 0.9, 1.5]), degree)
    inner, step = basis.breaks[1:-1], 1e-9
    jump = np.abs(basis.values(inner + step, derivative=1) - basis.values(inner - step, derivative=1)).max()
    assert (jump < 1e-6) == smooth


def test_gauss_points_integrate_cubics_on_every_element_and_lie_in_it(basis):
    at, weights = basis.gauss(2)
    exact = np.diff(basis.breaks**4) / 4
    assert np.allclose((at**3 * weights).sum(axis=1), exact, rtol=1e-12)
    assert np.array_equal(basis.element_of(at.ravel()), np.repeat(np.arange(5), 2))


# --- charts


@pytest.mark.parametrize("focus", FOCI)
def test_the_chart_s_inverse_undoes_it(focus):
    chart, at = chart_of(focus), square_points()
    assert np.abs(chart.square(chart.disc(at)) - at).max() < 1e-9  # rounding, magnified near the square's corners
    disc = np.sqrt(np.random.default_rng(1).random(300)) * np.exp(2j * np.pi * np.random.default_rng(2).random(300))
    assert np.abs(chart.disc(chart.square(disc)) - disc).max() < 1e-9


@pytest.mark.parametrize("focus", FOCI)
def test_the_square_s_edge_goes_to_the_rim_once_around(focus):
    along = np.linspace(-1, 1, 41)[:-1]
    one = np.ones_like(along)
    edge = np.concatenate([np.column_stack(side) for side in ((along, -one), (one, along), (-along, one), (-one, -along))])
    disc = chart_of(focus).disc(edge)
    assert np.abs(np.abs(disc) - 1).max() < 1e-12
    steps = np.angle(np.roll(disc, -1) / disc)
    assert (steps > 0).all() and steps.sum() == pytest.approx(2 * np.pi)


@pytest.mark.parametrize("focus", FOCI)
def test_the_chart_keeps_orientation_and_its_inside_within_the_disc(focus):
    chart, at, step = chart_of(focus), square_points() * 0.99, 1e-6
    along_u = (chart.disc(at + [step, 0]) - chart.disc(at - [step, 0])) / (2 * step)
    along_v = (chart.disc(at + [0, step]) - chart.disc(at - [0, step])) / (2 * step)
    assert (np.imag(np.conj(along_u) * along_v) > 0).all()
    assert (np.abs(chart.disc(at)) < 1).all()


@pytest.mark.parametrize("focus", [Focus(), Focus(0.5, 0.0), Focus(0.7, 2.0, 0.4, 0.3)])
def test_lines_gather_around_the_focus(focus):
    """The fine part, 3/4 of the square's side, reaches about as far as asked, and its elements are smaller than an even grid's."""
    chart = chart_of(focus)
    here = focus.polar_rad / (np.pi / 2) * np.exp(1j * focus.azimuth_rad)
    centre = DOME.directions(np.array([here]))[0]
    grid = np.linspace(-1, 1, 201)
    v, u = (g.ravel() for g in np.meshgrid(grid, grid, indexing="ij"))
    disc = chart.disc(np.column_stack([u, v]))
    assert abs(chart.disc(np.zeros((1, 2)))[0] - here) < 1e-12
    away = np.arccos(np.clip(DOME.directions(disc) @ centre, -1, 1))
    inside = np.mean(away < focus.radius_rad)
    cap = 1 - np.cos(focus.radius_rad)  # its share of the half sphere
    assert inside > 1.2 * cap


def test_a_focus_turned_about_the_axis_turns_the_chart():
    at = square_points()
    turned = chart_of(Focus(0.6, 0.3 + 1.1, turn_rad=0.2 + 1.1)).disc(at)
    assert np.abs(turned - chart_of(Focus(0.6, 0.3, turn_rad=0.2)).disc(at) * np.exp(1.1j)).max() < 1e-14


SKINS = {
    "dome": SkinSpec(),
    "shallow cap": SkinSpec(outer_radius_mm=40.0, rim_z_mm=35.0),
    "more than a hemisphere": SkinSpec(outer_radius_mm=12.0, rim_z_mm=-4.0),
    "round pad": SkinSpec(shape="round-pad", outer_radius_mm=15.0),
    "round pad with a rounded edge": SkinSpec(shape="round-pad", outer_radius_mm=15.0, rim_z_mm=-3.0),
    "rectangular pad": SkinSpec(shape="rectangular-pad", width_mm=40.0, height_mm=26.0, thickness_mm=1.5),
    "rectangular pad with a rounded edge": SkinSpec(shape="rectangular-pad", width_mm=40.0, height_mm=26.0, rim_z_mm=-4.0),
}
DOME = shape_of(SkinSpec())


@pytest.fixture(params=SKINS.values(), ids=SKINS)
def shape(request):
    return shape_of(request.param)


def places_of(shape):
    return shape.chart(FOCI[2]).disc(square_points() * 0.999)


def test_the_place_of_a_point_undoes_the_point_of_a_place(shape):
    place = places_of(shape)
    assert np.abs(shape.place(shape.inside(place)) - place).max() < 1e-9
    back = square_of_disc(shape.disc(place)) @ [1, 1j] if isinstance(shape, RectangularPad) else shape.disc(place)
    assert np.abs(back - place).max() < 1e-9


def test_the_rim_lies_in_its_plane_and_all_else_in_front_of_it(shape):
    rim, within = shape.rim(200), places_of(shape)
    assert shape.rim_share(rim) == pytest.approx(1) and shape.rim_share(within).max() < 1
    assert np.abs(shape.outside(rim)[:, 2] - shape.skin.rim_z_mm).max() < ROUNDING_MM
    assert shape.outside(within)[:, 2].min() >= shape.skin.rim_z_mm - ROUNDING_MM
    assert shape.outside(np.zeros(1, complex))[0] == pytest.approx([0, 0, shape.skin.apex_mm])
    reach = np.abs(shape.outside(np.concatenate([rim, within])))[:, :2].max(axis=0)
    assert reach == pytest.approx(shape.skin.half_size_mm, rel=0.01) or shape.skin.rim_z_mm < 0


def test_the_inside_lies_a_thickness_beneath_the_outside(shape):
    place, thickness = places_of(shape), shape.skin.thickness_mm
    inside = shape.inside(place)
    apart = np.linalg.norm(inside - shape.on_outside(inside), axis=1)
    assert apart[shape.rim_share(place) < 0.5] == pytest.approx(thickness)
    assert 0.999 * thickness < apart.min() and apart.max() < 3 * thickness


def test_the_normals_are_square_to_the_inside(shape):
    place = places_of(shape)
    normal = shape.normals(shape.inside(place))
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1) and (normal[shape.rim_share(place) < 0.5, 2] > 0).all()
    for step in (1e-6, 1e-6j):
        along = shape.inside(place + step) - shape.inside(place - step)
        assert np.abs(np.sum(normal * along, axis=1) / np.linalg.norm(along, axis=1)).max() < 1e-3


def test_a_point_lifted_off_the_outside_comes_back_to_it(shape):
    place = places_of(shape)
    outside = shape.outside(place)
    assert np.abs(shape.on_outside(outside) - outside).max() < 1e-6
    lifted = shape.on_outside(outside + 0.05 * np.random.default_rng(0).standard_normal(outside.shape))
    assert np.abs(shape.on_outside(lifted) - lifted).max() < 1e-6  # it lies on it


def test_even_places_cover_the_outside_evenly(shape):
    outside = shape.outside(shape.even(2000))
    neighbour = cKDTree(outside).query(outside, k=2)[0][:, 1]
    assert neighbour.max() < 2.5 * np.median(neighbour)
    turned = shape.even(2000, turn_rad=0.3)
    assert len(turned) == len(outside) and shape.rim_share(turned).max() <= 1


def test_directions_of_a_dome_are_those_of_its_points_and_of_others_cover_a_hemisphere(shape):
    assert DOME.directions(places_of(DOME)) == pytest.approx(DOME.outside(places_of(DOME)) / 20)
    rim = shape.directions(shape.rim(100))
    assert rim[:, 2] == pytest.approx(np.cos(shape.largest_rad), abs=1e-12) and shape.largest_rad >= np.pi / 2


@pytest.mark.parametrize("focus", FOCI)
def test_the_chart_of_a_rectangle_keeps_its_sides_and_has_an_inverse(focus):
    chart, at = shape_of(SKINS["rectangular pad"]).chart(focus), square_points()
    assert np.abs(chart.square(chart.disc(at)) - at).max() < 1e-9
    for side in (np.column_stack([np.ones(20), np.linspace(-1, 1, 20)]), np.column_stack([np.linspace(-1, 1, 20), -np.ones(20)])):
        fixed = 0 if side[0, 0] == side[1, 0] else 1
        assert chart.square(chart.disc(side))[:, fixed] == pytest.approx(side[:, fixed])


# --- the solid


@pytest.mark.parametrize("across, skin_layers, gel_layers", [(10, 2, 1), (16, 1, 3)])
@pytest.mark.parametrize("polar_deg", [0, 30, 60, 90])
@pytest.mark.parametrize("turn_deg", [0, 20, 45])
def test_every_element_has_positive_volume(sensor, across, skin_layers, gel_layers, polar_deg, turn_deg):
    focus = Focus(np.radians(polar_deg), 0.7, turn_rad=0.7 + np.radians(turn_deg))
    solid = build_solid(sensor.geometry, resolution=Resolution(across, skin_layers, gel_layers), focus=focus)
    assert all(cells.weights_mm3.min(initial=1) > 0 for cells in all_cells(solid))
    counts = [len(cells.controls) for cells in all_cells(solid)]
    assert counts == [skin_layers * across**2, across**2, (gel_layers - 1) * (across // 2) ** 2]
    assert [len(boxes) for boxes in solid.boxes] == counts


def test_volumes_converge_to_the_shell_s_and_the_gel_s(sensor):
    skin, lens = sensor.skin, sensor.lens
    inner = skin.outer_radius_mm - skin.thickness_mm
    shell = 2 / 3 * np.pi * (skin.outer_radius_mm**3 - inner**3)
    gel = 2 / 3 * np.pi * inner**3 + np.pi * inner**2 * (skin.rim_z_mm - lens.z_mm)
    errors = []
    for across in (8, 16, 32):
        cells = all_cells(build_solid(sensor.geometry, resolution=Resolution(across=across), focus=Focus(0.4, 1.0)))
        volumes = [c.weights_mm3.sum() for c in cells]
        errors.append([volumes[0] / shell - 1, (volumes[1] + volumes[2]) / gel - 1])
    errors = np.abs(errors)
    assert errors[0].max() < 2e-3 and errors[1].max() < 5e-4
    assert (errors[1] / errors[2] > SMOOTH_ORDER).all()


@pytest.mark.parametrize("depth, layer", [(0, 0), (1, 1)])
def test_the_skin_s_surfaces_lie_on_their_spheres(sensor, depth, layer):
    radius = sensor.skin.outer_radius_mm - depth * sensor.skin.thickness_mm
    off = []
    for across in (16, 32):
        solid = build_solid(sensor.geometry, resolution=Resolution(across=across), focus=Focus(0.4, 1.0))
        controls = solid.control_mm.reshape(-1, 3)[layer * solid.basis.count**2 :][: solid.basis.count**2]
        value, slope_u, slope_v = surface_operators(solid.basis, square_points() * 0.95)
        places = value @ controls
        off.append(np.abs(np.linalg.norm(places, axis=1) - radius).max())
        normal = np.cross(slope_u @ controls, slope_v @ controls)
        assert (np.einsum("ki,ki->k", normal, places) > 0).all()
    assert off[0] < SPLINE_MM
    assert off[0] / off[1] > SMOOTH_ORDER


def test_every_layer_passes_through_the_body_at_its_greville_points(sensor, solid):
    v, u = np.meshgrid(solid.coarse.greville, solid.coarse.greville, indexing="ij")
    at = np.column_stack([u.ravel(), v.ravel()])
    below = solid.control_mm[solid.inner.stop :].reshape(len(solid.through.greville) - 1, -1, 3)
    for depth, controls in zip(solid.through.greville[1:], below, strict=True):
        wanted = body_points(sensor.geometry, solid.chart.disc(at), depth)
        assert np.abs(surface_operators(solid.coarse, at)[0] @ controls - wanted).max() < ROUNDING_MM


def test_rim_wall_and_lens_are_clamped_and_nothing_else_is(sensor, solid):
    """Clamped controls carry exactly what lies in the rim, at the wall or on the lens: splines interpolate at their ends."""
    skin = sensor.skin
    clamped, moving = solid.control_mm[solid.fixed], solid.control_mm[~solid.fixed]
    assert clamped[:, 2].max() < skin.rim_z_mm + 0.01
    assert moving[:, 2].min() > sensor.lens.z_mm + 0.1
    wall = np.hypot(*clamped[:, :2].T) > skin.outer_radius_mm - skin.thickness_mm - 0.01
    assert (wall | (np.abs(clamped[:, 2] - sensor.lens.z_mm) < 1e-6)).all()
    side, coarse = solid.basis.count, solid.coarse.count
    layers = len(solid.through.greville) - 1
    assert np.count_nonzero(~solid.fixed) == 2 * (side - 2) ** 2 + (layers - 1) * (coarse - 2) ** 2


def test_a_solid_too_coarse_or_odd_is_refused():
    for wrong in ({"across": 2}, {"across": 9}, {"skin_layers": 0}, {"gel_layers": 0}):
        with pytest.raises(ValueError, match="even across >= 4"):
            Resolution(**wrong)


# --- pins


@pytest.mark.parametrize("name", list_specifications("sensors"))
@pytest.mark.parametrize("focus", [Focus(), Focus(0.9, 2.0, turn_rad=1.0)])
def test_pins_at_rest_are_the_specification_s(name, focus):
    spec = load_sensor(name)
    solid = build_solid(spec.geometry, resolution=Resolution(across=16), focus=focus)
    pins = rest_pins(spec.geometry)
    base, axis, caps = pin_pose(solid, solid.control_mm)
    for got, wanted in ((base, pins.base_mm), (axis, pins.axis), (caps, pins.caps_mm)):
        assert np.abs(got - wanted).max() < ROUNDING_MM


def test_pins_rotate_with_a_rigid_motion(solid):
    turn, shift = rotation([1, 2, -0.5], 0.7), np.array([1.0, -2.0, 3.0])
    base, axis, caps = pin_pose(solid, solid.control_mm)
    moved = pin_pose(solid, solid.control_mm @ turn.T + shift)
    assert np.abs(moved[0] - (base @ turn.T + shift)).max() < ROUNDING_MM
    assert np.abs(moved[1] - axis @ turn.T).max() < ROUNDING_MM
    assert np.abs(moved[2] - (caps @ turn.T + shift)).max() < ROUNDING_MM


def test_caps_follow_the_slope_of_a_smooth_bulge(sensor):
    """On x -> x + bump(x), the axis is minus the exact normal of the bumped sphere."""
    solid = build_solid(sensor.geometry, resolution=Resolution(across=16))

    def bump(points):
        return points * (1 - 0.05 * np.exp(-(points[:, 0] ** 2 + points[:, 1] ** 2) / 60))[:, None]

    v, u = np.meshgrid(solid.basis.greville, solid.basis.greville, indexing="ij")
    value = surface_operators(solid.basis, np.column_stack([u.ravel(), v.ravel()]))[0]
    moved = solid.control_mm.copy()
    moved[solid.inner] = np.linalg.solve(value, bump(value @ solid.control_mm[solid.inner]))
    base, axis, _ = pin_pose(solid, moved)
    rest, step = rest_pins(sensor.geometry).base_mm, 1e-5
    helper = np.where(np.abs(rest[:, [2]]) < 10, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(rest, helper) / 19
    second = np.cross(rest, first) / 19
    normal = np.cross(bump(rest + step * first) - bump(rest - step * first), bump(rest + step * second) - bump(rest - step * second))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= -np.sign(np.einsum("ni,ni->n", normal, rest))[:, None]
    assert np.abs(base - bump(rest)).max() < 0.01  # mm: what 16 elements make of a bump 8 mm wide
    assert np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", axis, normal), -1, 1))).max() < 0.5


# --- the mesh and its motion


def test_the_mesh_s_surfaces_lie_on_their_spheres_and_quads_face_away_from_the_centre(sensor, mesh):
    outer = sensor.skin.outer_radius_mm
    outer_quads = mesh.inner_quads - mesh.skin_layers * mesh.grid[1] * mesh.grid[2]  # nodes are numbered layer by layer from the outside
    for quads, radius in ((outer_quads, outer), (mesh.inner_quads, outer - sensor.skin.thickness_mm)):
        corners = mesh.nodes_mm[quads]
        assert np.abs(np.linalg.norm(corners, axis=2) - radius).max() < ROUNDING_MM
        normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        assert (np.einsum("qi,qi->q", normal, corners.mean(axis=1)) > 0).all()
    assert set(np.unique(mesh.material)) == {SKIN, GEL}
    assert len(mesh.nodes_mm) == np.prod(mesh.grid)


@pytest.mark.parametrize("gel_layers, skin_layers", [(2, 1), (1, 2)])
def test_nodes_rest_exactly_and_follow_an_affine_motion(sensor, mesh, gel_layers, skin_layers):
    """A stretch moves a node by the place that the splines give it, which differs from its own by the geometry's error."""
    shift, slope = np.array([0.3, -0.1, 0.2]), 0.1 * rotation([1, 2, 3], 0.8)
    off = []
    for across in (16, 32):
        solid = build_solid(sensor.geometry, resolution=Resolution(across, skin_layers, gel_layers), focus=Focus(0.4, 1.0))
        view = NodeView(mesh, solid)
        assert np.array_equal(view.nodes(solid.control_mm), mesh.nodes_mm)
        assert np.abs(view.nodes(solid.control_mm + shift) - (mesh.nodes_mm + shift)).max() < ROUNDING_MM
        moved = view.nodes(solid.control_mm + solid.control_mm @ slope.T) - (mesh.nodes_mm + mesh.nodes_mm @ slope.T)
        off.append(np.linalg.norm(moved, axis=1).reshape(mesh.grid[0], -1).max(axis=1) / 0.1)
    assert off[0][:2].max() < NODE_MM[0] and off[0].max() < NODE_MM[1]
    assert (off[0] / off[1] > 2**2).all()  # the coarse grid is further from its final order


def test_nodes_in_the_rim_on_the_wall_and_on_the_lens_never_move(sensor, mesh, solid):
    view = NodeView(mesh, solid)
    moved = solid.control_mm + np.where(solid.fixed, 0, 1)[:, None] * np.random.default_rng(0).normal(size=solid.control_mm.shape)
    motion = np.linalg.norm(view.nodes(moved) - mesh.nodes_mm, axis=1).reshape(mesh.grid)
    assert motion[-1].max() == 0
    edge = np.concatenate([motion[:, 0], motion[:, -1], motion[:, :, 0], motion[:, :, -1]])
    assert edge.max() < 1e-6  # mm: the rim's square points are found to rounding
    assert motion[:-1, 1:-1, 1:-1].min() > 1e-3


def test_exported_skin_is_a_closed_surface(mesh):
    skin = skin_surface(mesh, point_data={"height": mesh.nodes_mm[:, 2]})
    assert skin.is_manifold
    assert np.allclose(skin.points, mesh.nodes_mm[skin.point_data["node"]])
    assert np.allclose(skin.point_data["height"], skin.points[:, 2])
    grid = to_pyvista(mesh)
    assert grid.n_cells == len(mesh.hexes)
    assert grid.compute_cell_sizes().cell_data["Volume"].min() > 0


def test_rotations_are_those_of_the_polar_decomposition():
    matrices = np.eye(3) + 0.4 * np.random.default_rng(5).normal(size=(300, 3, 3))
    matrices = matrices[np.linalg.det(matrices) > 0.05]
    left, _, right = np.linalg.svd(matrices)
    assert np.abs(rotations(matrices) - left @ right).max() < 1e-12
