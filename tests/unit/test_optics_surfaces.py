"""Render surfaces: closed, well oriented, and smooth followers of what the mechanics says."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from scenes import load_sensor
from twin.camera.projection import distort
from twin.geometry.pins import rest_pins
from twin.optics.glass import WIDEST_FISHEYE, ray_table, valid_radius
from twin.optics.surfaces import SkinSurface, caps, stems, vertex_normals


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume (mm^3) inside closed triangles, positive for outward normals."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_caps_are_discs_about_their_centres_open_below(sensor):
    sensor = sensor.model_copy(update={"appearance": sensor.appearance.model_copy(update={"cap_shapes": (), "cap_offsets": ()})})
    rest, pins = rest_pins(sensor.geometry), sensor.pins
    surface = caps(sensor.pins, sensor.appearance, rest.caps_mm, rest.axis)
    disc_mm3 = pins.count * np.pi * (pins.cap_diameter_mm / 2) ** 2 * pins.cap_height_mm
    bevel = 0.05  # relative; the outline has the disc's area
    each = surface.vertices_mm.reshape(pins.count, -1, 3)
    lowest = rest.caps_mm - 0.5 * pins.cap_height_mm * rest.axis
    from_below = (each - lowest[:, None]).reshape(-1, 3)  # seen from there the missing bottoms have no volume
    assert volume(from_below, surface.faces) == pytest.approx(disc_mm3, rel=bevel)
    height = np.einsum("nvk,nk->nv", each - rest.caps_mm[:, None], rest.axis)
    np.testing.assert_allclose([height.min(), height.max()], [-pins.cap_height_mm / 2, pins.cap_height_mm / 2], atol=1e-9)
    across = np.linalg.norm(each - rest.caps_mm[:, None] - height[..., None] * rest.axis[:, None], axis=2)
    corner = 0.015  # relative: the outline of 16 corners has the disc's area
    np.testing.assert_allclose(across.max(axis=1), pins.cap_diameter_mm / 2, rtol=corner)


def test_stems_reach_from_the_skin_to_the_cap(sensor):
    rest = rest_pins(sensor.geometry)
    each = stems(sensor.pins, rest.base_mm, rest.axis).vertices_mm.reshape(sensor.pins.count, -1, 3)
    height = np.einsum("nvk,nk->nv", each - rest.base_mm[:, None], rest.axis)
    assert (height.min(axis=1) < 0).all(), "a gap between skin and stem"
    np.testing.assert_allclose(height.max(axis=1), sensor.pins.length_mm, atol=1e-9)


def test_the_skin_rests_on_its_sphere_and_faces_the_camera(sensor):
    rest = rest_pins(sensor.geometry)
    skin = SkinSurface(sensor.skin, rest.base_mm)
    vertices = skin.vertices(rest.base_mm)
    inner_mm = sensor.skin.outer_radius_mm - sensor.skin.thickness_mm
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), inner_mm, atol=1e-9)
    a, b, c = (vertices[skin.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", normal, a) < 0).all(), "a facet looks outwards"


def test_the_skin_passes_through_its_control_points_and_is_smooth_between_them(sensor):
    """A dent given at the pins' feet appears on the fine grid as the same dent."""
    rest = rest_pins(sensor.geometry)
    skin = SkinSurface(sensor.skin, rest.base_mm)

    def dent_mm(points):
        return -2.0 * np.exp(-(points[:, 0] ** 2 + points[:, 1] ** 2) / 8.0**2)[:, None] * [0.0, 0.0, 1.0]

    vertices = skin.vertices(rest.base_mm + dent_mm(rest.base_mm))
    interpolation_mm = 0.05  # of a 2 mm dent, between pins 2-3 mm apart
    inside = np.arccos(np.clip(skin.rest_mm[:, 2] / np.linalg.norm(skin.rest_mm, axis=1), -1, 1)) < np.radians(55)
    assert np.abs(vertices - skin.rest_mm - dent_mm(skin.rest_mm))[inside].max() < interpolation_mm


def test_the_clamped_rim_does_not_move():
    spec = load_sensor("ur5-331")
    rest = rest_pins(spec.geometry)
    skin = SkinSurface(spec.skin, rest.base_mm)
    rim = np.abs(skin.rest_mm[:, 2] - spec.skin.rim_z_mm) < 1e-9
    moved = skin.vertices(rest.base_mm + [0.0, 0.0, -1.0])
    clamping_mm = 0.02
    assert rim.any() and np.abs(moved - skin.rest_mm)[rim].max() < clamping_mm


def test_the_ray_table_inverts_the_projection(sensor):
    camera = sensor.camera
    table = ray_table(camera, (40, 20, 600, 460))
    assert table.shape == (441, 561, 3)
    tangents = table[..., :2] / table[..., 2:]
    x, y = np.meshgrid(np.arange(40, 601) - 0.5, np.arange(20, 461) - 0.5)
    back = distort(camera, tangents) * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
    valid = np.linalg.norm(tangents, axis=-1) < 0.9 * min(valid_radius(camera), WIDEST_FISHEYE)
    inversion_px = 1e-3
    assert valid.mean() > 0.2 and np.abs(back - np.stack([x, y], axis=-1))[valid].max() < inversion_px


def test_rays_go_on_outwards_where_the_distortion_folds_back():
    camera = load_sensor("ur5-331").camera
    folding = camera.model_copy(update={"k1": 0.14, "k2": -0.2})
    assert np.isfinite(valid_radius(folding)) and valid_radius(camera.model_copy(update={"k1": 0.0, "k2": 0.0})) == np.inf
    row = ray_table(folding, (0, 0, 640, 480))[211, 330:, 0]
    assert (np.diff(row) > 0).all()


def test_a_vertex_normal_does_not_depend_on_how_flat_sides_are_cut():
    """A cube's corner has one normal, however its sides are cut into triangles, because faces count by their angles."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    box = ConvexHull(corners).simplices
    outwards = np.sum(
        np.cross(corners[box[:, 1]] - corners[box[:, 0]], corners[box[:, 2]] - corners[box[:, 0]]) * corners[box[:, 0]], axis=1
    )
    box[outwards < 0] = box[outwards < 0][:, ::-1]
    np.testing.assert_allclose(vertex_normals(corners, box), corners / np.sqrt(3), atol=1e-12)
    lone = np.concatenate([corners, [[5.0, 5.0, 5.0]]])  # a vertex of no face has none
    assert not vertex_normals(lone, box)[-1].any()
