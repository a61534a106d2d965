"""Laws of the measures of caps, on caps drawn with known size, shape and sharpness."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from twin.pins.finding.caps import inner_distance, measure_caps

FINE = 6  # subpixels per pixel in the drawing
LOW, HIGH = 20.0, 140.0
PITCH_PX = 20
MARGIN_PX = 6


def drawn(half_axes, *, sigma_px=0.0, shift=(0.0, 0.0), turn=0.0):
    """A 3 x 3 lattice of ellipses, blurred before it is sampled; pins (9, 2) px."""
    size = 3 * PITCH_PX + 2 * MARGIN_PX
    y, x = (np.mgrid[: size * FINE, : size * FINE] + 0.5) / FINE - 0.5
    image, pins = np.full(x.shape, LOW), []
    for row in range(3):
        for column in range(3):
            u, v = MARGIN_PX + PITCH_PX * (np.array([column, row]) + 0.5) + shift
            along, across = (x - u) * np.cos(turn) + (y - v) * np.sin(turn), (y - v) * np.cos(turn) - (x - u) * np.sin(turn)
            image[(along / half_axes[0]) ** 2 + (across / half_axes[1]) ** 2 < 1] = HIGH
            pins.append((u, v))
    image = gaussian_filter(image, sigma_px * FINE, mode="nearest")
    return np.rint(image.reshape(size, FINE, size, FINE).mean(axis=(1, 3))).astype(np.uint8), np.array(pins)


@pytest.mark.parametrize(("sigma_px", "relative"), [(0.8, 0.0425), (1.2, 0.0292)])
def test_edge_width_of_a_blurred_cap(sigma_px, relative):
    """It is 2.563 sigma, where the pixel's square (variance 1/12 px^2) is part of the blur.

    Curvature of the edge and interpolation cause the ``relative`` error.
    """
    image, pins = drawn((6.0, 6.0), sigma_px=sigma_px, shift=(0.3, -0.2))
    expected = 2.563 * np.sqrt(sigma_px**2 + 1 / 12)
    np.testing.assert_allclose(measure_caps(image, pins).edge_px, expected, rtol=relative)


@pytest.mark.parametrize(("radius_px", "relative"), [(4.0, 0.0257), (5.5, 0.0129), (7.0, 0.0105)])
def test_diameter_does_not_depend_on_place_or_blur(radius_px, relative):
    """Blur moves the half-level line inwards by sigma^2 / (2 radius), which causes the ``relative`` error."""
    for sigma, shift in ((0.5, (0.0, 0.0)), (0.8, (0.4, 0.25))):
        image, pins = drawn((radius_px, radius_px), sigma_px=sigma, shift=shift)
        np.testing.assert_allclose(measure_caps(image, pins).diameter_px, 2 * radius_px, rtol=relative)


def test_eccentricity_of_an_ellipse_at_any_angle():
    for turn in (0.0, 0.5, 1.2):
        image, pins = drawn((6.5, 4.0), sigma_px=0.5, turn=turn)
        assert measure_caps(image, pins).eccentricity == pytest.approx(np.sqrt(1 - (4.0 / 6.5) ** 2), abs=0.0031)
    image, pins = drawn((5.5, 5.5), sigma_px=0.5)
    assert (measure_caps(image, pins).eccentricity < 1e-6).all(), "a circle"


def test_level_and_contrast_are_those_drawn():
    image, pins = drawn((5.5, 5.5), sigma_px=0.8)
    caps = measure_caps(image, pins)
    np.testing.assert_allclose(caps.level, HIGH, atol=0.14)
    np.testing.assert_allclose(caps.skin, LOW, atol=0.043)
    np.testing.assert_allclose(caps.contrast, HIGH - LOW, atol=0.182)


def test_lost_pins_and_pins_without_a_cap_are_nan():
    image, pins = drawn((5.5, 5.5), sigma_px=0.8)
    image[: MARGIN_PX + PITCH_PX, : MARGIN_PX + PITCH_PX] = LOW
    pins[4] = np.nan
    caps = measure_caps(image, pins)
    assert np.isnan(caps.level[4])
    assert np.isnan(caps.edge_px[0]) and np.isfinite(caps.level[[1, 2, 3, 5, 6, 7, 8]]).all()


def test_distances_within_a_cap_are_exact_wherever_the_memory_lies():
    """OpenCV's own differ in the last bit from call to call; then a pixel at half of the largest depth is in the plateau by chance."""
    generator = np.random.default_rng(5)
    for side in range(5, 45):
        mask = generator.random((side, side + 1)) < 0.9
        mask[0, 0], mask[-1, -1] = False, True
        outside, inside = np.argwhere(~mask), np.argwhere(mask)
        square = ((inside[:, None] - outside[None]) ** 2).sum(axis=2).min(axis=1)
        np.testing.assert_array_equal(inner_distance(mask)[mask], np.sqrt(square.astype(np.float32)))
