"""Measures of likeness: identity is perfect, damage lowers both."""

import numpy as np
import pytest

from twin.errors import FrameError
from twin.evaluation.pictures.compare import compare_images

ALL = np.ones((64, 80), bool)


@pytest.mark.parametrize("shape", [(64, 80), (64, 80, 3)])
def test_identity_is_perfect_and_noise_lowers_both_measures(shape):
    rng = np.random.default_rng(0)
    frame = rng.integers(40, 200, shape, dtype=np.uint8)
    same = compare_images(frame, frame, ALL)
    assert same.ssim == pytest.approx(1) and same.psnr_db == float("inf")
    noisy = [compare_images(frame, np.clip(frame + rng.normal(0, sd, shape), 0, 255).astype(np.uint8), ALL) for sd in (3, 12, 40)]
    assert noisy[0].ssim > noisy[1].ssim > noisy[2].ssim and noisy[0].psnr_db > noisy[1].psnr_db > noisy[2].psnr_db


def test_psnr_is_its_definition():
    frame = np.full((64, 80), 100, np.uint8)
    assert compare_images(frame, frame + 5, ALL).psnr_db == pytest.approx(20 * np.log10(255 / 5))


def test_frames_of_two_sizes_are_refused():
    with pytest.raises(FrameError, match="one sensor"):
        compare_images(np.zeros((64, 80), np.uint8), np.zeros((64, 81), np.uint8), ALL)
