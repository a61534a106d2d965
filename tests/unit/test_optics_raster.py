"""Laws of drawn pins and triangles: exact cover, cut-offs, nesting, linear fields."""

import numpy as np
import pytest

from twin.optics.raster import draw_pins, draw_triangles


def area_of(polygon: np.ndarray) -> float:
    """Of a closed polygon (K, 2)."""
    after = np.roll(polygon, -1, axis=0)
    return abs(np.sum(polygon[:, 0] * after[:, 1] - after[:, 0] * polygon[:, 1])) / 2


def drawn(shape, polygons, light=None, side=None) -> np.ndarray:
    """Caps with these faces on black, of light 1 by default; with ``side`` each has a bevel and a wall around a smaller face."""
    count, image = len(polygons), np.zeros(shape)
    light = np.ones((count, shape[2])) if light is None else light
    middle = polygons.mean(axis=1, keepdims=True)
    face, edge = (polygons, polygons) if side is None else (middle + share * (polygons - middle) for share in (0.6, 0.8))
    outlines = np.stack([np.repeat(middle, polygons.shape[1], axis=1), polygons, edge, face], axis=1)
    sides = np.zeros((count, 2 * polygons.shape[1], shape[2])) + (0.0 if side is None else side)
    draw_pins(image, outlines, (light, sides, light), np.ones(count, bool), np.arange(count))
    return image


def ring_of(count: int, rng) -> np.ndarray:
    """A convex polygon of random place and size within 40 x 30 px."""
    turn = np.sort(rng.uniform(0, 2 * np.pi, count))
    return rng.uniform([8, 8], [32, 22]) + rng.uniform(1, 7) * np.stack([np.cos(turn), rng.uniform(0.2, 1) * np.sin(turn)], axis=1)


def test_polygons_cover_exactly_their_area():
    rng, rounding = np.random.default_rng(0), 1e-9
    for _ in range(50):
        polygon = ring_of(7, rng)
        image = drawn((30, 40, 1), polygon[None])
        assert image.sum() == pytest.approx(area_of(polygon), abs=rounding) and image.max() <= 1 + rounding
        np.testing.assert_allclose(drawn((30, 40, 1), polygon[None, ::-1]), image, atol=rounding, err_msg="the sense of turning matters")


def test_a_pixels_cover_is_the_share_of_its_square_inside():
    """Against many points in each pixel (the slow twin)."""
    polygon, across = ring_of(6, np.random.default_rng(3)), 40
    image = drawn((30, 40, 1), polygon[None])
    y, x = (np.mgrid[: 30 * across, : 40 * across] + 0.5) / across - 0.5
    inside = np.ones(x.shape, bool)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        inside &= (bx - ax) * (y - ay) >= (by - ay) * (x - ax)
    points = 1.5 / across  # an edge through a pixel passes this share of its points closely
    np.testing.assert_allclose(image[..., 0], inside.reshape(30, across, 40, across).mean(axis=(1, 3)), atol=points)


def test_polygons_are_clipped_at_the_border():
    rng = np.random.default_rng(1)
    polygons = np.stack([ring_of(8, rng) for _ in range(20)])
    light = rng.uniform(0, 1, (20, 2))
    np.testing.assert_allclose(drawn((11, 15, 2), polygons - [13, 9], light), drawn((30, 40, 2), polygons, light)[9:20, 13:28], atol=1e-12)


def test_facets_side_by_side_leave_no_seam():
    """A cap of a wall, a bevel and a face of one light is a single polygon; of another light, the sides are what the face leaves."""
    polygon = ring_of(6, np.random.default_rng(4))[None]
    once, inside = drawn((30, 40, 1), polygon), drawn((30, 40, 1), polygon.mean(axis=1) + 0.6 * (polygon - polygon.mean(axis=1)))
    np.testing.assert_allclose(drawn((30, 40, 1), polygon, side=1.0), once, atol=1e-12)
    np.testing.assert_allclose(drawn((30, 40, 1), polygon, side=0.3), 0.3 * once + 0.7 * inside, atol=1e-12)


def test_a_cap_seen_from_behind_hides_what_is_below_it():
    """Its face and the walls' outer sides are out of sight; the inside is black."""
    polygon = ring_of(6, np.random.default_rng(5))[None]
    image, light, black = np.ones((30, 40, 1)), np.ones((1, 1)), np.zeros((1, 12, 1))
    outlines = np.stack([np.repeat(polygon.mean(axis=1, keepdims=True), 6, axis=1), polygon, polygon, polygon], axis=1)
    draw_pins(image, outlines, (light, black, light), np.zeros(1, bool), np.zeros(1, int))
    np.testing.assert_allclose(image, 1 - drawn((30, 40, 1), polygon), atol=1e-12)


def test_triangles_show_a_linear_field_without_gaps():
    corners = np.array([[-5.0, -6.0], [60.0, -4.0], [55.0, 50.0], [-7.0, 45.0], [20.3, 14.7], [20.0, 3.0]])
    faces = np.array([[0, 5, 4], [0, 1, 5], [1, 4, 5], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    light = (0.3 + corners @ [[0.01], [0.02]]).astype(np.float32)
    draw_triangles(image := np.full((30, 40, 1), np.nan, np.float32), corners, light, faces)
    y, x = np.mgrid[:30, :40]
    np.testing.assert_allclose(image[..., 0], 0.3 + 0.01 * x + 0.02 * y, atol=1e-5)
