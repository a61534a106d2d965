"""The capture side: exposure, response, noise, and the recorder's binary images."""

import cv2
import numpy as np
import pytest

from scenes.sensor import RecordingSpec, ResponseSpec
from twin.camera import expose, record
from twin.errors import FrameError

PLAIN = ResponseSpec(exposure=1.0, gamma=2.2, black_level=4.0, blur_sigma_px=0.0, noise_sd=0.0)
RECORDING = RecordingSpec(crop_px=(20, 10, 140, 110), width_px=120, height_px=100, threshold_block_px=61, threshold_offset=-5.0)


def with_(spec, **change):
    return spec.model_copy(update=change)


def dots(gray: int = 120) -> np.ndarray:
    """A dark (120, 160) frame with bright discs of 4 px radius."""
    frame = np.full((120, 160), 15, np.uint8)
    for x in range(30, 150, 16):
        for y in range(20, 110, 16):
            cv2.circle(frame, (x, y), 4, gray, -1)
    return frame


def test_black_is_the_black_level_and_white_saturates():
    assert (expose(np.zeros((4, 5)), PLAIN) == 4).all()
    assert (expose(np.full((4, 5, 3), 7.0), PLAIN) == 255).all()


def test_more_exposure_is_never_darker():
    light = np.random.default_rng(0).uniform(0, 1.2, (40, 30, 3))
    frames = [expose(light, with_(PLAIN, exposure=e, blur_sigma_px=0.8)).astype(int) for e in (0.3, 0.6, 1.2)]
    assert (np.diff(frames, axis=0) >= 0).all() and frames[2].mean() > frames[0].mean() + 20


def test_white_balance_acts_on_its_channel():
    light = np.full((4, 4, 3), 0.2)
    assert expose(light, with_(PLAIN, white_balance=(2.0, 1.0, 1.0)))[0, 0, 0] > expose(light, PLAIN)[0, 0, 0]
    assert (expose(light, with_(PLAIN, white_balance=(2.0, 1.0, 1.0)))[..., 1:] == expose(light, PLAIN)[..., 1:]).all()


@pytest.mark.parametrize("sd", [0.9, 3.0])
def test_noise_has_the_specified_sd(sd):
    light = np.full((400, 400), 0.2)
    noisy = expose(light, with_(PLAIN, noise_sd=sd), np.random.default_rng(1)).astype(float)
    quantisation_var = 1 / 12
    sampling_tolerance = 0.02  # relative; 160 000 pixels give 0.2 %
    assert noisy.std() == pytest.approx(np.sqrt(sd**2 + quantisation_var), rel=sampling_tolerance)
    assert (expose(light, with_(PLAIN, noise_sd=sd)) == expose(light, PLAIN)).all(), "no generator, no noise"


def test_noise_is_new_in_every_frame_and_the_same_for_the_same_seed():
    light, response = np.full((50, 50), 0.2), with_(PLAIN, noise_sd=1.0)
    rng = np.random.default_rng(5)
    first, second = expose(light, response, rng), expose(light, response, rng)
    assert (first != second).any()
    assert (expose(light, response, np.random.default_rng(5)) == first).all()


def test_blur_keeps_the_light_and_widens_an_edge_by_its_sigma():
    """Linear response: the blurred step is the normal distribution function, 10-90 % over 2.563 sigma."""
    light = np.zeros((20, 200))
    light[:, 100:] = 0.8
    linear = with_(PLAIN, gamma=1.0, black_level=0.0, blur_sigma_px=4.0)
    row = expose(light, linear)[10].astype(float) / (0.8 * 255)
    width = np.interp(0.9, row, np.arange(200)) - np.interp(0.1, row, np.arange(200))
    quantisation_px = 0.2
    assert width == pytest.approx(2.563 * 4.0, abs=quantisation_px)


def test_a_recording_is_binary_and_shows_the_dots():
    raw = dots()
    image = record(raw, RECORDING)
    assert image.shape == (100, 120) and image.dtype == np.uint8 and set(np.unique(image)) == {0, 255}
    assert (image[20 - 10 : 95 : 16, 30 - 20 : 115 : 16] == 255).all(), "a dot is black"
    assert (image[28 - 10 : 95 : 16, 38 - 20 : 115 : 16] == 0).all(), "between dots it is white"


def test_a_resized_recording_has_gray_edges():
    image = record(dots(), with_(RECORDING, width_px=90, height_px=80))
    assert image.shape == (80, 90) and 0 < np.mean((image > 0) & (image < 255)) < 0.3


def test_a_part_of_the_frame_records_as_the_whole_does():
    raw = dots()
    assert (record(raw[5:115, 10:150], RECORDING, origin_px=(10, 5)) == record(raw, RECORDING)).all()
    with pytest.raises(FrameError, match="crop_px"):
        record(raw[50:], RECORDING, origin_px=(0, 50))


def test_single_bright_pixels_do_not_survive_the_recorder():
    raw = dots()
    raw[12:108:16, 38:138:16] = 255
    assert (record(raw, RECORDING) == record(dots(), RECORDING)).all()


def test_colour_frames_are_recorded_as_their_gray():
    raw = dots()
    assert (record(np.repeat(raw[..., None], 3, axis=2), RECORDING) == record(raw, RECORDING)).all()
