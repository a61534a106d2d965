"""The capture side: gel, lens, camera, and the recorder's binary images."""

import cv2
import numpy as np
import pytest
from plain_sensor import changed, plain

from scenes import load_sensor
from scenes.sensor import RecordingSpec
from twin.camera.capture import (
    WIDE_PX,
    amplified,
    blurred,
    compressed,
    curve,
    developed,
    dispersed,
    expose,
    hazed,
    noisy,
    record,
    shared,
    sharpened,
    vignetted,
)
from twin.errors import FrameError
from twin.frames import open_recording
from twin.frames.forms import gray_levels

RECORDING = RecordingSpec(crop_px=(20, 10, 140, 110), width_px=120, height_px=100, threshold_block_px=61, threshold_offset=-5.0)
WIDTH, HEIGHT = 160, 120
NEUTRAL = {
    "gel": {"haze": 0.0},
    "camera": {
        "vignetting": 0.0, "red_scale": 1.0, "blue_scale": 1.0, "width_px": WIDTH, "height_px": HEIGHT, "cx_px": 83.0, "cy_px": 56.5,
    },
    "response": {
        "exposure": 1.0, "white_balance": (1.0, 1.0, 1.0), "gamma": 1.0, "black_level": 0.0, "blur_sigma_px": 0.0,
        "brightness_drift": 0.0, "read_noise": 0.0, "shot_noise": 0.0, "sharpening": 0.0, "chroma_sigma_px": 0.0,
        "chroma_median_px": 0, "chroma_columns": 1, "noise_sigma_px": 0.0, "stream": "rgb", "jpeg_quality": 0,
        "residual": None,
    },
}  # fmt: skip
FULL = {
    "gel": {"haze": 0.1, "haze_sigma_px": 4.0},
    "camera": {"vignetting": 0.3, "red_scale": 1.01, "blue_scale": 0.99},
    "response": {
        "exposure": 0.8,
        "white_balance": (1.2, 1.0, 0.9),
        "gamma": 2.2,
        "blur_sigma_px": 0.6,
        "sharpening": 0.5,
        "chroma_sigma_px": 1.0,
        "chroma_median_px": 3,
        "chroma_columns": 2,
        "stream": "bt709",
    },
}
SECTIONS = [(section, key, value) for section, values in FULL.items() for key, value in values.items() if key != "haze_sigma_px"]


PLAIN = changed(plain(), **NEUTRAL)
CURVED = changed(PLAIN, response={"gamma": 2.2, "black_level": 4.0})


def picture(seed: int = 0) -> np.ndarray:
    """Smooth light (H, W, 3) between 0 and 1."""
    light = cv2.GaussianBlur(np.random.default_rng(seed).uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32), (0, 0), 2.0)
    return (light - light.min()) / np.ptp(light)


def spot(x: float, y: float, sigma_px: float = 2.5) -> np.ndarray:
    """A Gaussian spot of light (H, W, 3), the same in all colours."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.repeat(np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma_px**2))[..., None], 3, axis=2).astype(np.float32)


def centroid(image: np.ndarray) -> np.ndarray:
    """Light-weighted centroid (x, y)."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(image * x).sum(), (image * y).sum()], float) / image.sum(dtype=float)


def dots(gray: int = 120) -> np.ndarray:
    """A dark (120, 160) frame with bright discs of 4 px radius."""
    frame = np.full((120, 160), 15, np.uint8)
    for x in range(30, 150, 16):
        for y in range(20, 110, 16):
            cv2.circle(frame, (x, y), 4, gray, -1)
    return frame


def test_a_neutral_camera_only_rounds():
    light = picture()
    assert (expose(light, PLAIN.capture) == np.rint(255 * light)).all()
    assert (expose(light, PLAIN.capture, np.random.default_rng(0)) == expose(light, PLAIN.capture)).all(), "noise of size zero"


@pytest.mark.parametrize(("section", "key", "value"), SECTIONS)
def test_each_step_acts_in_the_chain(section, key, value):
    full = changed(PLAIN, **FULL)
    without = changed(full, **{section: {key: NEUTRAL[section][key]}})
    assert (expose(picture(), full.capture) != expose(picture(), without.capture)).any()


def test_a_neutral_step_returns_its_input():
    light, frame, rng = picture(), expose(picture(), PLAIN.capture), np.random.default_rng(0)
    optics = hazed(light, PLAIN.gel), dispersed(light, PLAIN.camera), blurred(light, 0.0), vignetted(light, PLAIN.camera)
    film = amplified(light, PLAIN.response, rng), noisy(light, PLAIN.response, rng), sharpened(light, PLAIN.response)
    assert all(handed is light for handed in (*optics, *film)) and compressed(frame, 0) is frame
    assert rng.standard_normal() == np.random.default_rng(0).standard_normal(), "a neutral step drew a number"


def test_black_is_the_black_level_and_white_saturates():
    assert (expose(np.zeros((4, 5)), CURVED.capture) == 4).all()
    assert (expose(np.full((4, 5, 3), 7.0), CURVED.capture) == 255).all()


def test_more_exposure_is_never_darker():
    frames = [
        expose(picture(), changed(CURVED, response={"exposure": e, "blur_sigma_px": 0.8}).capture).astype(int) for e in (0.3, 0.6, 1.2)
    ]
    assert (np.diff(frames, axis=0) >= 0).all() and frames[2].mean() > frames[0].mean() + 20


def test_white_balance_acts_on_its_channel_and_on_colour_only():
    warm = changed(CURVED, response={"white_balance": (2.0, 1.0, 1.0)})
    light = np.full((4, 4, 3), 0.2)
    assert expose(light, warm.capture)[0, 0, 0] > expose(light, CURVED.capture)[0, 0, 0]
    assert (expose(light, warm.capture)[..., 1:] == expose(light, CURVED.capture)[..., 1:]).all()
    assert (expose(light[..., 0], warm.capture) == expose(light[..., 0], CURVED.capture)).all()


@pytest.mark.parametrize("gray", [23.0, 125.0])
def test_noise_is_read_and_shot_noise_through_the_curve(gray):
    """sd of gray = slope of the curve at the mean light times sqrt(read^2 + shot light); here dark skin and caps of real frames."""
    noise = {"read_noise": 2e-4, "shot_noise": 6e-5}
    light = np.float32(((gray - 4) / 251) ** 2.2)
    frames = expose(np.full((600, 600), light), changed(CURVED, response=noise).capture, np.random.default_rng(1)).astype(float)
    slope = (251 / 2.2) * light ** (1 / 2.2 - 1)
    expected = np.hypot(slope * np.sqrt(noise["read_noise"] ** 2 + noise["shot_noise"] * light), np.sqrt(1 / 12))
    curvature = 0.0078  # relative: the curve is not straight over the noise; sampling adds 0.1 %; measured: 0.0071
    assert frames.std() == pytest.approx(expected, rel=curvature)
    real_sd = 1.0  # gray levels; 0.8 to 1.1 in real frames
    assert frames.std() == pytest.approx(real_sd, abs=0.32)


def test_a_frames_gain_varies_by_the_drift_and_is_one_for_all_pixels():
    spec, rng = changed(PLAIN, response={"brightness_drift": 0.05}), np.random.default_rng(3)
    frames = np.array([expose(np.full((4, 5, 3), 0.5), spec.capture, rng) for _ in range(800)], float)
    assert (np.ptp(frames, axis=(1, 2, 3)) == 0).all()
    few = 0.08  # relative: 800 draws give a sd to 2.5 %
    assert frames[:, 0, 0, 0].std() == pytest.approx(0.05 * 0.5 * 255, rel=few)


def test_noise_is_new_in_every_frame_and_the_same_for_the_same_seed():
    light = np.full((50, 50), 0.2)
    spec = changed(CURVED, response={"read_noise": 1e-2, "brightness_drift": 0.01})
    rng = np.random.default_rng(5)
    first, second = expose(light, spec.capture, rng), expose(light, spec.capture, rng)
    assert (first != second).any()
    assert (expose(light, spec.capture, np.random.default_rng(5)) == first).all()
    assert (expose(light, spec.capture) == expose(light, CURVED.capture)).all(), "no generator, no noise and no drift"


def test_blur_widens_an_edge_by_its_sigma():
    """The blurred step is the normal distribution function, 10-90 % over 2.563 sigma."""
    light = np.zeros((20, 200), np.float32)
    light[:, 100:] = 0.8
    row = blurred(light, 4.0)[10] / 0.8
    width = np.interp(0.9, row, np.arange(200)) - np.interp(0.1, row, np.arange(200))
    sampling_px = 0.052  # of kernel and step; measured: 0.047
    assert width == pytest.approx(2.563 * 4.0, abs=sampling_px)


@pytest.mark.parametrize("shape", [(90, 120), (70, 50, 3)])
def test_a_wide_blur_is_that_of_the_kernel(shape):
    """OpenCV cuts its kernel at four standard deviations, so that it is as near as that."""
    cut = 1e-4
    light, sigma_px = np.random.default_rng(0).random(shape).astype(np.float32), 1.5 * WIDE_PX
    kernel = cv2.GaussianBlur(light, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)
    np.testing.assert_allclose(blurred(light, sigma_px), kernel, atol=cut)
    assert blurred(light, sigma_px).dtype == np.float32


def test_blur_and_haze_keep_the_light():
    light, rounding = picture(), 1e-6
    gel = PLAIN.gel.model_copy(update={"haze": 0.3, "haze_sigma_px": 20.0})
    for spread in (blurred(light, 3.0), hazed(light, gel)):
        np.testing.assert_allclose(spread.mean(axis=(0, 1), dtype=float), light.mean(axis=(0, 1), dtype=float), rtol=rounding)
    even = np.full_like(light, 0.4)
    np.testing.assert_allclose(hazed(even, gel), even, rtol=rounding)


def test_haze_takes_its_share_from_a_spot():
    """What is left of a spot much smaller than the haze's reach is 1 - haze of it."""
    light, gel = spot(80, 60, 1.0), PLAIN.gel.model_copy(update={"haze": 0.2, "haze_sigma_px": 15.0})
    spread_light = 0.2 * (1.0**2 / 15.0**2)  # the peak of what is scattered
    np.testing.assert_allclose(hazed(light, gel)[60, 80], 1 - 0.2, atol=1.1 * spread_light)


@pytest.mark.parametrize("place", [(30.3, 20.2), (120.7, 90.5), (83.0, 56.5)])
def test_red_and_blue_move_by_their_scale_times_the_distance(place):
    spec = changed(PLAIN, camera={"red_scale": 1.02, "blue_scale": 0.985})
    seen = dispersed(spot(*place), spec.camera)
    middle = np.array([spec.camera.cx_px, spec.camera.cy_px])
    rounding_px = 6e-4  # measured: 5.5e-4
    for channel, scale in ((0, 1.02), (1, 1.0), (2, 0.985)):
        moved = centroid(seen[..., channel]) - centroid(spot(*place)[..., channel])
        np.testing.assert_allclose(moved, (scale - 1) * (np.array(place) - middle), atol=rounding_px)


def test_mono_light_is_not_dispersed():
    light = picture()[..., 0]
    assert dispersed(light, changed(PLAIN, camera={"red_scale": 1.02}).camera) is light


def test_vignetting_takes_its_share_at_the_corners_and_falls_with_the_square():
    loss = 1 - vignetted(np.ones((HEIGHT, WIDTH, 3)), changed(PLAIN, camera={"vignetting": 0.4}).camera)
    half_pixel = 0.0153  # relative: a corner pixel's centre is not the corner; measured: 0.0139
    np.testing.assert_allclose(loss[[0, 0, -1, -1], [0, -1, 0, -1]], 0.4, rtol=half_pixel)
    x, y = WIDTH / 4, HEIGHT / 4  # half way to a corner
    np.testing.assert_allclose(loss[int(y), int(x)], 0.4 / 4, rtol=2 * half_pixel)


def test_sharpening_leaves_even_light_and_overshoots_at_an_edge():
    sharp = changed(PLAIN, response={"sharpening": 1.0, "sharpening_sigma_px": 1.5})
    light = np.full((40, 40), 0.2)
    assert (expose(light, sharp.capture) == expose(light, PLAIN.capture)).all()
    light[:, 20:] = 0.6
    row = expose(light, sharp.capture)[20].astype(int)
    assert row[:20].min() < 51 - 33 and row[20:].max() > 153 + 33 and row[0] == 51 and row[-1] == 153


def luma(frame: np.ndarray) -> np.ndarray:
    return frame @ np.array([0.299, 0.587, 0.114])


def test_lost_chroma_leaves_the_luma_as_it_is():
    light, soft = picture(), changed(PLAIN, response={"chroma_sigma_px": 2.0, "chroma_columns": 2}).response
    lost = developed(light, light, soft, soft.chroma_columns, (0, 0))
    assert np.abs(luma(lost) - luma(255 * light)).max() < 5e-5 and np.abs(lost - 255 * light).max() > 58


def test_soft_colour_of_an_edge_stays_at_the_edge():
    """Colour differences are softened in gray levels: half of their step lies at the edge, and 16 to 84 % is two blurs wide."""
    light = np.full((40, 80, 3), 0.01, np.float32)
    light[:, 40:] = (0.2, 0.3, 0.6)
    soft = changed(CURVED, response={"chroma_sigma_px": 2.0}).response
    gray = developed(light, light, soft, 1, (0, 0))
    row = (gray[20, :, 2] - luma(gray[20]))[30:50]
    half = np.interp((row[0] + row[-1]) / 2, row, np.arange(30.0, 50.0))
    edge = 39.5
    assert half == pytest.approx(edge, abs=0.01)
    width = np.interp(row[0] + np.array([0.16, 0.84]) * (row[-1] - row[0]), row, np.arange(30.0, 50.0))
    assert np.diff(width)[0] == pytest.approx(2 * 2.0, rel=0.1)


def test_a_median_of_colour_flattens_specks_and_keeps_edges_and_luma():
    light = np.full((40, 80, 3), 0.01, np.float32)
    light[:, 40:] = (0.2, 0.3, 0.6)
    edge = developed(light, light, CURVED.response, 1, (0, 0))
    light[4::10, 4::10, 2] += 0.1  # single pixels
    medians = [changed(CURVED, response={"chroma_median_px": side}).response for side in (0, 5)]
    plain, clean = (developed(light, light, median, 1, (0, 0)) for median in medians)
    rounding = 1e-3
    np.testing.assert_allclose(luma(clean), luma(plain), atol=rounding)
    np.testing.assert_allclose(clean - luma(clean)[..., None], edge - luma(edge)[..., None], atol=rounding)


def test_neighbouring_columns_share_the_first_ones_chroma():
    gray = 255 * picture()
    chroma = gray - luma(gray)[..., None]
    pairs = shared(chroma, 2)
    assert (pairs[:, 0::2] == chroma[:, 0::2]).all() and (pairs[:, 1::2] == chroma[:, 0::2]).all()
    assert (shared(chroma[:, 3:], 2, 3)[:, 1:] == pairs[:, 4:]).all(), "a window's pairs are the full frame's"


def test_sharpening_changes_all_channels_alike():
    light = picture()
    change = sharpened(light, changed(PLAIN, response={"sharpening": 1.0}).response) - light
    assert np.abs(change - change[..., :1]).max() < 1e-6 and np.abs(change).max() > 0.079


def test_noise_is_smoothed_but_not_sharpened():
    light = np.full((200, 200), 0.2, np.float32)
    noise = {"read_noise": 0.01, "noise_sigma_px": 0.0}
    sd = {}
    for name, more in (("plain", {}), ("sharp", {"sharpening": 2.0}), ("smooth", {"noise_sigma_px": 0.6})):
        sd[name] = expose(light, changed(PLAIN, response=noise | more).capture, np.random.default_rng(0)).std()
    assert sd["sharp"] == sd["plain"] > 1.48 * sd["smooth"]


def test_a_window_of_a_frame_is_exposed_as_the_frame_is():
    """Away from the window's borders, where blur and haze know what is outside; the blocks of the stream lie alike."""
    spec = changed(CURVED, **FULL)
    spec = changed(spec, response={"jpeg_quality": 80})
    x0, y0, border = 21, 13, 16 + 16
    whole = expose(picture(), spec.capture)
    part = expose(picture()[y0:118, x0:157], spec.capture, origin_px=(x0, y0))
    gray_levels = 2  # sums of floats in another order may round to either side before the stream does
    apart = np.abs(part[border:-border, border:-border].astype(int) - whole[y0:118, x0:157][border:-border, border:-border])
    assert apart.mean() < 0.01 and apart.max() <= gray_levels
    without = expose(picture()[y0:118, x0:157], spec.capture)[border:-border, border:-border].astype(int)
    assert np.abs(without - whole[y0:118, x0:157][border:-border, border:-border]).mean() > 3.6, "the origin has no effect"


@pytest.mark.parametrize("mono", [False, True])
def test_a_stream_of_lower_quality_is_further_from_the_frame(mono):
    light = picture()[..., 1] if mono else picture()
    clean = expose(light, PLAIN.capture).astype(float)
    errors = [
        np.sqrt(((expose(light, changed(PLAIN, response={"jpeg_quality": q}).capture) - clean) ** 2).mean()) for q in (98, 80, 40, 10)
    ]
    fine_gray, coarse_gray = (0.56, 7.5) if mono else (4.7, 18.7)  # the finest stream still halves the resolution of colour
    assert errors == sorted(errors) and errors[0] < fine_gray and errors[-1] > coarse_gray


def test_a_stream_keeps_colours_in_their_channels():
    light = np.full((64, 64, 3), (0.7, 0.4, 0.1))
    gray_levels = 2  # colour is rounded in another space
    assert (
        np.abs(expose(light, changed(PLAIN, response={"jpeg_quality": 95}).capture).astype(int) - expose(light, PLAIN.capture)).max()
        <= gray_levels
    )


def test_the_curve_is_the_inverse_of_its_power_law():
    light = np.linspace(0, 1, 101, dtype=np.float32)
    rounding = 1e-6
    np.testing.assert_allclose(((curve(light, CURVED.response) - 4) / 251) ** 2.2, light, atol=rounding)


def test_a_recording_is_binary_and_shows_the_dots():
    raw = dots()
    image = record(raw, RECORDING)
    assert image.shape == (100, 120) and image.dtype == np.uint8 and set(np.unique(image)) == {0, 255}
    assert (image[20 - 10 : 95 : 16, 30 - 20 : 115 : 16] == 255).all(), "a dot is black"
    assert (image[28 - 10 : 95 : 16, 38 - 20 : 115 : 16] == 0).all(), "between dots it is white"


def test_a_resized_recording_has_gray_edges():
    image = record(dots(), RECORDING.model_copy(update={"width_px": 90, "height_px": 80}))
    assert image.shape == (80, 90) and 0 < np.mean((image > 0) & (image < 255)) < 0.108


def test_resized_before_its_threshold_a_recording_is_black_and_white():
    small = RECORDING.model_copy(update={"width_px": 90, "height_px": 80, "resized": "before", "threshold_block_px": 45})
    image = record(dots(), small)
    assert image.shape == (80, 90) and set(np.unique(image)) == {0, 255}
    assert (record(dots(), RECORDING) == record(dots(), RECORDING.model_copy(update={"resized": "before"}))).all(), "the crop's own size"


def test_without_a_median_single_bright_pixels_stay_in_the_recording():
    raw = dots()
    raw[12:108:16, 38:138:16] = 255
    bare = RECORDING.model_copy(update={"median_px": 0})
    assert (record(raw, bare)[12 - 10 : 98 : 16, 38 - 20 : 118 : 16] == 255).all()


@pytest.mark.real
def test_the_ur5s_raw_frames_recorded_are_the_makers_pictures_bit_for_bit(real_dir):
    spec = load_sensor("ur5-331")
    assert spec.recording is not None
    raws, theirs = open_recording(real_dir / "ur5-331-raw", spec), open_recording(real_dir / "ur5-331-surface-3d-tap", spec)
    assert len(raws) == 30
    for raw in raws:
        assert np.array_equal(record(raw.image, spec.recording), gray_levels(theirs.read(theirs.names.index(raw.name)).image)), raw.name


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


def test_a_colour_shift_moves_only_that_colour():
    """A spot's red moves by the shift, green stays."""
    spec = plain()
    camera = spec.camera.model_copy(update={"red_scale": 1.0, "blue_scale": 1.0, "red_shift_px": (0.4, -0.3), "blue_shift_px": (0.0, 0.0)})
    y, x = np.mgrid[:60, :80]
    spot = np.exp(-((x - 40.0) ** 2 + (y - 30.0) ** 2) / (2 * 3.0**2)).astype(np.float32)
    seen = dispersed(np.stack([spot] * 3, axis=-1), camera)
    moved = [[(c * x).sum() / c.sum() - 40, (c * y).sum() / c.sum() - 30] for c in np.moveaxis(seen, 2, 0)]
    np.testing.assert_allclose(moved, [[0.4, -0.3], [0, 0], [0, 0]], atol=1e-6)
