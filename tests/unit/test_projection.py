"""The camera's projection and its inverse."""

import numpy as np
import pytest

from scenes import load_sensor
from twin.geometry.pins import pin_lattice, rest_pins
from twin.projection import distort, pixel_rays, project, sensor_to_camera, undistort

ROUND_TRIP_PX = 1e-6


def test_projection_and_rays_are_inverse(sensor):
    caps = rest_pins(sensor).cap_mm
    T = sensor_to_camera(sensor.camera)
    in_camera = caps @ T[:3, :3].T + T[:3, 3]
    rays = pixel_rays(sensor.camera, project(sensor.camera, caps))
    expected = in_camera / np.linalg.norm(in_camera, axis=1, keepdims=True)
    focal = sensor.camera.fx_px
    assert np.abs(rays - expected).max() * focal < ROUND_TRIP_PX


def test_undistort_inverts_distort_with_every_coefficient():
    camera = load_sensor("mg400-331").camera.model_copy(update={"k1": 0.1, "k2": -0.05, "p1": 0.01, "p2": -0.02})
    xy = np.random.default_rng(0).uniform(-0.7, 0.7, (500, 2))
    assert np.abs(undistort(camera, distort(camera, xy)) - xy).max() < 1e-9


def test_the_camera_looks_out_of_the_tip_with_x_right_and_y_down(sensor):
    apex = np.array([0.0, 0.0, sensor.skin.outer_radius_mm])
    origin, right, down = project(sensor.camera, apex + np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    assert right[0] > origin[0] + 1 and abs(right[1] - origin[1]) < 0.2
    assert down[1] > origin[1] + 1 and abs(down[0] - origin[0]) < 0.2


@pytest.mark.parametrize(("layout", "rings", "count"), [("rings", 10, 331), ("hexagon", 6, 127)])
def test_lattice_counts_symmetry_and_spacing(layout, rings, count):
    lattice = pin_lattice(layout, rings)
    assert lattice.shape == (count, 2) and lattice[:, 0].max() == pytest.approx(1)
    z = lattice[:, 0] * np.exp(1j * lattice[:, 1])
    turned = z * np.exp(1j * np.pi / 3)
    gaps = np.abs(turned[:, None] - z[None]).min(axis=1)
    assert gaps.max() < 1e-12  # a sixth of a turn maps the pattern onto itself


def test_caps_hang_inside_the_skin_along_its_normal(sensor):
    pins = rest_pins(sensor)
    assert np.allclose(np.linalg.norm(pins.axis, axis=1), 1)
    assert np.allclose(np.linalg.norm(pins.base_mm, axis=1), sensor.skin.outer_radius_mm - sensor.skin.thickness_mm)
    reach = np.linalg.norm(pins.cap_mm - pins.base_mm, axis=1)
    assert np.allclose(reach, sensor.pins.length_mm + sensor.pins.cap_height_mm / 2)
