"""Video streams: what whole numbers of luma and colour differences leave of colours, and how a frame tells that it came by one."""

import numpy as np
import pytest

from twin.camera.capture import STREAMS, decoded, encoded, luma_weights, stream_of, through_stream


def colours(count: int = 4000, seed: int = 0) -> np.ndarray:
    """Gray levels (1, n, 3) that the stream can hold without clipping: not far from gray."""
    rng = np.random.default_rng(seed)
    return np.clip(rng.uniform(40, 200, (1, count, 1)) + rng.uniform(-30, 30, (1, count, 3)), 0, 255).astype(np.float32)


@pytest.mark.parametrize("stream", STREAMS)
def test_a_colour_comes_back_to_within_the_steps_of_the_stream(stream):
    """Half a step of luma is 0.6 levels, half a step of a colour difference at most 1.06 levels of red or blue; and rounding."""
    levels = 2.2
    back = through_stream(colours(), stream).astype(float)
    assert np.abs(back - colours()).max() <= levels
    assert np.abs((back - colours()) @ luma_weights(stream)).max() < 1.5


@pytest.mark.parametrize("stream", STREAMS)
def test_gray_stays_gray_and_black_and_white_are_reached(stream):
    gray = np.arange(256.0)[None, :, None] * np.ones(3)
    back = through_stream(gray, stream).astype(int)
    assert (np.ptp(back, axis=2) == 0).all() and back[0, 0, 0] == 0 and back[0, -1, 0] == 255
    assert np.abs(back - gray).max() <= 1


def test_the_way_back_is_the_usual_integer_arithmetic():
    """BT.709: 298, 459, 55, 136, 541; BT.601: 298, 409, 100, 208, 516 (256ths), as the drivers' own conversion has them."""
    numbers = np.array([100, 140, 110])
    c, d, e = numbers - [16, 128, 128]
    by_hand = {
        "bt709": [298 * c + 459 * e, 298 * c - 55 * d - 136 * e, 298 * c + 541 * d],
        "bt601": [298 * c + 409 * e, 298 * c - 100 * d - 208 * e, 298 * c + 516 * d],
    }
    for stream, products in by_hand.items():
        assert decoded(numbers, stream).tolist() == [(p + 128) >> 8 for p in products]


@pytest.mark.parametrize("stream", STREAMS)
def test_a_frame_tells_its_stream(stream):
    frame = through_stream(colours(), stream)
    assert stream_of([frame]) == stream
    assert stream_of([np.rint(colours()).astype(np.uint8)]) == "rgb"
    assert (through_stream(frame.astype(np.float32), stream) == frame).mean() > 0.99, "a stream changes its own colours"


def test_frames_without_colours_tell_nothing():
    assert stream_of([np.zeros((4, 4), np.uint8)]) == "rgb" == stream_of([np.full((4, 4, 3), 255, np.uint8)])


def test_numbers_are_in_the_studio_range():
    ends = encoded(np.array([[0.0, 0, 0], [255, 255, 255], [0, 0, 255], [255, 0, 0]]), "bt709")
    assert ends[0].tolist() == [16, 128, 128] and ends[1].tolist() == [235, 128, 128]
    assert ends[2, 1] == 240 == ends[3, 2]
