"""The camera's projection and its inverse."""

import numpy as np
import pytest

from scenes import load_sensor
from scenes.pins import PinsSpec
from twin.camera.projection import distort, pixel_rays, project, undistort
from twin.geometry.pins import pin_lattice, rest_pins

ROUND_TRIP_MM = 1e-12


def test_projection_and_rays_are_inverse(sensor):
    caps = rest_pins(sensor.geometry).caps_mm
    place, direction = pixel_rays(sensor.view, project(sensor.view, caps))
    along = (caps[:, 2:] - place[:, 2:]) / direction[:, 2:]
    assert np.abs(place + along * direction - caps).max() < ROUND_TRIP_MM
    assert np.allclose(place[:, 2], sensor.lens.z_mm) and np.allclose(np.linalg.norm(direction, axis=1), 1)


def test_rays_obey_snell_at_both_faces_of_the_window(sensor):
    """The tangential part of index times direction is the same in air and gel, whatever the window between them."""
    pixels = np.random.default_rng(1).uniform([200, 150], [420, 330], (200, 2))
    _, in_gel = pixel_rays(sensor.view, pixels)
    bare = sensor.model_copy(
        update={
            "lens": sensor.lens.model_copy(update={"refractive_index": 1.0}),
            "gel": sensor.gel.model_copy(update={"refractive_index": 1.0}),
        }
    )
    _, in_air = pixel_rays(bare.view, pixels)
    assert np.allclose(sensor.gel.refractive_index * in_gel[:, :2], in_air[:, :2], atol=1e-12)


def test_the_way_through_the_window_takes_least_time(sensor):
    """Fermat: moving the points of entry does not shorten the optical path from pupil to cap."""
    caps = rest_pins(sensor.geometry).caps_mm[::7]
    pupil = np.array([0.0, 0.0, -sensor.camera.distance_mm])
    front, direction = pixel_rays(sensor.view, project(sensor.view, caps))
    within = direction[:, :2] * sensor.gel.refractive_index / sensor.lens.refractive_index
    back = front[:, :2] - within / np.sqrt(1 - (within**2).sum(axis=1, keepdims=True)) * sensor.lens.thickness_mm

    def optical_mm(shift_back, shift_front):
        first = np.column_stack([back + shift_back, np.full(len(caps), sensor.lens.back_mm)])
        second = front + [*shift_front, 0]
        legs = np.linalg.norm(first - pupil, axis=1), np.linalg.norm(second - first, axis=1), np.linalg.norm(caps - second, axis=1)
        return legs[0] + sensor.lens.refractive_index * legs[1] + sensor.gel.refractive_index * legs[2]

    least = optical_mm(np.zeros(2), np.zeros(2))
    for shift in np.random.default_rng(2).normal(size=(20, 4)) * 0.05:
        assert (optical_mm(shift[:2], shift[2:]) > least).all()


@pytest.mark.parametrize(("k1", "k2"), [(0.0, 0.0), (0.05, 0.02), (-0.03, 0.0)])
def test_fisheye_distortion_and_its_inverse(k1, k2):
    camera = load_sensor("mg400-331").camera.model_copy(update={"projection": "fisheye", "k1": k1, "k2": k2})
    angle = np.linspace(0.01, 1.45, 50)
    tangents = np.tan(angle)[:, None] * [[0.6, 0.8]]
    seen = distort(camera, tangents)
    assert np.allclose(np.linalg.norm(seen, axis=1), angle * (1 + k1 * angle**2 + k2 * angle**4))
    assert np.allclose(np.arctan(np.linalg.norm(undistort(camera, seen), axis=1)), angle, atol=1e-9)


def test_undistort_inverts_distort_with_every_coefficient():
    camera = load_sensor("ur5-331").camera.model_copy(update={"k1": 0.1, "k2": -0.05, "p1": 0.01, "p2": -0.02})
    xy = np.random.default_rng(0).uniform(-0.7, 0.7, (500, 2))
    assert np.abs(undistort(camera, distort(camera, xy)) - xy).max() < 1e-12


def test_the_camera_looks_out_of_the_tip_with_x_right_and_y_down(sensor):
    apex = np.array([0.0, 0.0, sensor.skin.outer_radius_mm])
    origin, right, down = project(sensor.view, apex + np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    assert right[0] > origin[0] + 3.7 and abs(right[1] - origin[1]) < 0.0023
    assert down[1] > origin[1] + 3.7 and abs(down[0] - origin[0]) < 0.0023


@pytest.mark.parametrize(("layout", "rings", "count"), [("rings", 10, 331), ("hexagon", 6, 127)])
def test_lattice_counts_symmetry_and_spacing(layout, rings, count):
    lattice = pin_lattice(PinsSpec(layout=layout, rings=rings)).places
    assert lattice.shape == (count, 2) and np.linalg.norm(lattice, axis=1).max() == pytest.approx(1)
    z = lattice @ [1, 1j]
    turned = z * np.exp(1j * np.pi / 3)
    gaps = np.abs(turned[:, None] - z[None]).min(axis=1)
    assert gaps.max() < 1e-12  # a sixth of a turn maps the pattern onto itself


def test_caps_hang_inside_the_skin_along_its_normal(sensor):
    pins = rest_pins(sensor.geometry)
    assert np.allclose(np.linalg.norm(pins.axis, axis=1), 1)
    assert np.allclose(np.linalg.norm(pins.base_mm, axis=1), sensor.skin.outer_radius_mm - sensor.skin.thickness_mm)
    reach = np.linalg.norm(pins.caps_mm - pins.base_mm, axis=1)
    assert np.allclose(reach, sensor.pins.length_mm + sensor.pins.cap_height_mm / 2)
