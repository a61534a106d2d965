"""Laws of the lens's blur: the circles' size, and what a disc keeps."""

import numpy as np
import pytest
from plain_sensor import changed, plain

from twin.calibration.light.response import apparent_mm, defocus_px
from twin.optics.preview import circles_px, defocused


def test_on_the_axis_a_circle_is_that_of_the_apparent_distance():
    """The paraxial formula, of points before and behind the focus."""
    spec = changed(plain(), camera={"aperture_mm": 0.4, "focus_mm": 55.0, "k1": 0.0})
    z_mm = np.array([1.0, 8.0, 18.0])
    distance = apparent_mm(z_mm, spec.camera.distance_mm, spec.lens, spec.gel.refractive_index)
    expected = defocus_px(np.sqrt(0.5 * (spec.camera.fx_px**2 + spec.camera.fy_px**2)), 0.4, 55.0, distance)
    found, shift = circles_px(spec.view, np.stack([0 * z_mm, 0 * z_mm, z_mm], axis=1))
    third_order = 1e-3
    np.testing.assert_allclose(found, expected, rtol=third_order)
    np.testing.assert_allclose(shift, 0, atol=1e-9)


@pytest.mark.parametrize("diameter_px", [1.0, 2.5, 4.0])
def test_a_point_becomes_a_disc_of_its_light_and_variance(diameter_px):
    """A disc's variance along x is a sixteenth of its squared diameter."""
    image = np.zeros((21, 21, 1), np.float32)
    image[10, 10] = 3.0
    circles = np.full((21, 21), diameter_px)
    blurred = defocused(image, circles)[..., 0]
    x = np.arange(21) - 10.0
    assert blurred.sum() == pytest.approx(3.0, rel=1e-5)
    searched = 0.01  # how well a disc's variance is found
    assert (blurred.sum(axis=0) @ x**2) / blurred.sum() == pytest.approx(diameter_px**2 / 16, rel=searched)
    np.testing.assert_allclose(blurred, blurred.T, atol=1e-6)


def test_what_is_sharp_stays():
    image = np.random.default_rng(0).uniform(0, 1, (9, 11, 3)).astype(np.float32)
    np.testing.assert_array_equal(defocused(image, np.zeros((9, 11))), image)
