"""What is refused as a real frame, and how that is said."""

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame

from scenes import load_sensor
from twin.camera.projection import lens_disc
from twin.errors import FrameError
from twin.evaluation.pictures.aligned import FEW_LOST, read_real
from twin.pins import nominal_reference
from twin.types import Form


@pytest.fixture(scope="module")
def spec():
    return load_sensor("ur5-331")


@pytest.fixture(scope="module")
def good(spec):
    return drawn_frame(spec, Form.RAW, nominal_reference(spec, Form.RAW).pins_px).image


def read(folder, spec, images, **options):
    for name, image in images.items():
        cv2.imwrite(str(folder / name), image)
    return read_real(folder, spec, lens_disc(spec.view, spec.housing), **options)


def test_bad_frames_are_refused_by_name_and_good_ones_kept(tmp_path, spec, good):
    gap = good.copy()
    gap[200:260, 250:310] = 15
    images = {
        "a_good.png": good, "b_black.png": good // 16, "c_white.png": np.full_like(good, 255),
        "d_gap.png": gap, "e_small.png": good[:240, :320], "f_good.png": good,
    }  # fmt: skip
    found, refused = read(tmp_path, spec, images)
    assert [real.frame.name for real in found] == ["a_good.png", "f_good.png"]
    assert np.isfinite(found[0].pins_px).all()
    reasons = {each["image_name"]: each["reason"] for each in refused}
    for name, said in {"b_black": "black", "c_white": "saturated", "d_gap": "of 331 pins", "e_small": "expected 640x480"}.items():
        assert said in reasons[f"{name}.png"]


def test_few_lost_pins_are_left_out_where_the_others_are_fitted_and_many_are_not(tmp_path, spec, good):
    glint, gap = good.copy(), good.copy()
    glint[225:245, 270:290] = 15  # a cap or two
    gap[180:300, 230:350] = 15
    found, refused = read(tmp_path, spec, {"a_glint.png": glint, "b_gap.png": gap}, lost=FEW_LOST)
    assert [real.frame.name for real in found] == ["a_glint.png"]
    assert 0 < np.isnan(found[0].pins_px[:, 0]).sum() <= FEW_LOST * 331
    assert "of 331 pins" in refused[0]["reason"]
    with pytest.raises(FrameError, match="a_glint.png: .*pins"):
        read(tmp_path, spec, {})


def test_a_folder_without_a_usable_frame_names_the_first(tmp_path, spec, good):
    with pytest.raises(FrameError, match="dark.png: black"):
        read(tmp_path, spec, {"dark.png": good // 16})


def test_an_empty_folder_is_said_to_be_empty(tmp_path, spec):
    with pytest.raises(FrameError, match="empty"):
        read(tmp_path, spec, {})


def test_thresholded_recordings_are_refused(tmp_path):
    spec = load_sensor("mg400-331")
    image = drawn_frame(spec, Form.PROCESSED, nominal_reference(spec, Form.PROCESSED).pins_px).image
    with pytest.raises(FrameError, match="raw camera frames"):
        read(tmp_path, spec, {"frame.png": image})


def test_a_limit_spreads_over_the_folder(tmp_path, spec, good):
    found, _ = read(tmp_path, spec, {f"frame_{k}.png": good for k in range(5)}, limit=3)
    assert [real.frame.name for real in found] == ["frame_0.png", "frame_2.png", "frame_4.png"]
