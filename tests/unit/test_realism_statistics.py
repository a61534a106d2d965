"""Laws of the measures of whole frames: noise, spectrum, spots, bins, pixel figures."""

import cv2
import numpy as np
import pytest

from scenes import load_sensor
from twin.camera.projection import lens_disc, round_disc
from twin.errors import FrameError
from twin.evaluation.pictures.compare import compare_images
from twin.evaluation.pictures.statistics import (
    bin_of,
    equal_count_edges,
    find_spots,
    log_distance_db,
    noise_sd,
    pair_spots,
    radial_rows,
    radial_spectrum,
    steady_spots,
)

SIZE = (320, 240)


@pytest.fixture
def rng():
    """A new generator for each test, so that its numbers do not depend on which tests ran before."""
    return np.random.default_rng(3)


@pytest.fixture(scope="module")
def disc():
    return round_disc(SIZE, np.array([160.0, 120.0]), 110.0)


def test_noise_is_found_on_a_smooth_ground_with_edges(disc, rng):
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    ground = 80 + 0.1 * x - 0.05 * y + 0.0004 * x * y
    for sd in (0.8, 2.0):
        image = ground + rng.normal(0, sd, ground.shape)
        cv2.circle(image, (160, 120), 20, 150.0, 2)
        assert noise_sd(np.clip(np.rint(image), 0, 255).astype(np.uint8), disc.inside) == pytest.approx(np.hypot(sd, 12**-0.5), rel=0.0222)


def test_a_white_image_has_its_variance_at_every_frequency(disc, rng):
    _, power = radial_spectrum(128 + rng.normal(0, 5.0, SIZE[::-1]), disc.center_px, disc.radius_px)
    few_samples = 0.297  # the innermost rings hold few frequencies; measured: 0.270
    assert power.mean() == pytest.approx(25.0, rel=0.04)
    np.testing.assert_allclose(power[5:], 25.0, rtol=few_samples)


def test_the_slope_of_a_power_law_is_found(disc, rng):
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(SIZE[0]), np.fft.fftfreq(SIZE[1])))
    shaped = np.fft.ifft2(np.fft.fft2(rng.normal(size=SIZE[::-1])) / np.maximum(f, 1e-3)).real
    frequency, power = radial_spectrum(shaped, disc.center_px, disc.radius_px)
    slope = np.polyfit(np.log(frequency[4:]), np.log(power[4:]), 1)[0]
    assert slope == pytest.approx(-2.0, abs=0.0503)


def test_spectra_ten_times_apart_are_ten_decibels_apart():
    assert log_distance_db(np.ones(5), 10 * np.ones(5)) == pytest.approx(10.0)
    assert log_distance_db(np.ones(5), np.ones(5)) == 0.0


def test_steady_spots_are_found_and_paired(disc):
    pins = np.array([[160.0, 120.0], [180.0, 120.0]])
    glints, shifted = [(100, 60), (200, 180), (90, 150)], []
    for shift in (0, 2):
        frames = []
        for extra in range(4):
            image = np.full(SIZE[::-1], 30, np.uint8)
            for x, y in [*glints, (60 + 20 * extra, 120)]:  # the last one moves from frame to frame
                image[y - 2 : y + 3, x + shift - 2 : x + shift + 3] = 220
            cv2.circle(image, (160, 120), 6, 200, -1)
            frames.append(find_spots(image, disc, pins, 20.0))
        shifted.append(steady_spots(frames))
    assert sorted(map(tuple, shifted[0].px.round().astype(int).tolist())) == sorted(glints)
    np.testing.assert_allclose(pair_spots(*shifted), 2.0, atol=1e-6)


def test_bins_have_equal_counts_and_outer_bins_take_values_beyond_the_edges(rng):
    distance = rng.uniform(0, 100, 800) ** 0.5
    edges = equal_count_edges(distance)
    assert np.bincount(bin_of(distance, edges)).tolist() == [100] * 8
    assert bin_of(np.array([-1.0, 99.0, np.nan]), edges).tolist() == [0, 7, -1]


def test_a_difference_shows_in_its_bin_alone():
    distance = np.arange(80.0)
    values = np.full(80, 10.0)
    changed = np.where(distance < 10, 11.0, values)
    changed[79] = np.nan
    rows = radial_rows("level", (distance, values), (distance, changed), equal_count_edges(distance))
    assert [round(row.difference, 6) for row in rows] == [0.1, *[0.0] * 7]


def test_pixel_figures_depend_on_pixels_in_the_disc_only(disc, rng):
    real = rng.integers(20, 200, (*SIZE[::-1], 3)).astype(np.uint8)
    other = np.where(disc.inside[..., None], real, 255).astype(np.uint8)
    same = compare_images(real, other, disc.inside)
    assert (same.psnr_db, same.ssim, same.ssim_gray, same.flip) == (np.inf, 1.0, 1.0, 0.0)
    brighter = compare_images(real, real + np.uint8(10), disc.inside)
    assert brighter.psnr_db == pytest.approx(20 * np.log10(255 / 10))
    assert 0 < brighter.flip < 0.18 and brighter.ssim < 1


def test_frames_that_differ_in_shape_are_refused(disc):
    with pytest.raises(FrameError, match="can't compare"):
        compare_images(np.zeros((4, 5), np.uint8), np.zeros((5, 4), np.uint8), disc.inside)


def test_the_lens_disc_holds_all_pins():
    spec = load_sensor("ur5-331")
    disc = lens_disc(spec.view, spec.housing)
    assert disc.radius_px > spec.pipeline.raw.mask_radius_px
    assert disc.inside.sum() == pytest.approx(np.pi * disc.radius_px**2, rel=1e-5)
