"""Real frames against real frames (make validate): what the measures of realism say where there is nothing to find."""

import cv2
import numpy as np
import pytest

from scenes import load_sensor
from training.data.two_sample import two_sample
from twin.camera.projection import lens_disc
from twin.evaluation.pictures.aligned import read_real
from twin.evaluation.pictures.statistics import TARGET, TARGET_MEASURES, FrameStatistics, Statistics

pytestmark = [pytest.mark.real, pytest.mark.slow]

CHANCE = 0.05  # from one half; a few random divisions of 30 frames
SPLITS = 4  # random divisions of the frames into halves
SLIGHT_BLUR_PX = 0.6


@pytest.fixture(scope="module")
def real(real_dir):
    spec = load_sensor("ur5-331")
    disc = lens_disc(spec.view, spec.housing)
    found, refused = read_real(real_dir / "ur5-331-raw", spec, disc)
    assert not refused
    return disc, found


def test_halves_of_the_real_frames_have_the_same_caps(real):
    disc, frames = real
    measured = [FrameStatistics(frame.gray, frame.pins_px, disc) for frame in frames]
    found = Statistics(measured[::2], measured[1::2])
    worst = {measure: found.worst(measure) for measure in TARGET_MEASURES}
    print(worst, found.spectrum_db, found.scalars)
    assert max(worst.values()) < TARGET


def test_two_halves_of_the_real_frames_are_not_distinguished(real):
    disc, frames = real
    images, rng, found = [frame.frame.image for frame in frames], np.random.default_rng(0), []
    half = len(images) // 2
    for split in range(SPLITS):
        order = rng.permutation(len(images))
        first, second = ([images[k] for k in part] for part in (order[:half], order[half : 2 * half]))
        found.append(two_sample(first, second, disc.inside, seed=split).accuracy)
    print(found)
    assert np.mean(found) == pytest.approx(0.5, abs=CHANCE)


def test_slightly_blurred_frames_are_distinguished(real):
    disc, frames = real
    images = [frame.frame.image for frame in frames]
    outcome = two_sample(images, [cv2.GaussianBlur(image, (0, 0), SLIGHT_BLUR_PX) for image in images], disc.inside)
    print(outcome.accuracy, outcome.low, outcome.high)
    assert outcome.accuracy > 0.95
