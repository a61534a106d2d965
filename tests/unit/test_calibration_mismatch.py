"""Frames and pins that do not fit the specification are refused by name, with what to do, before anything is fitted."""

from functools import partial

import cv2
import numpy as np
import pytest
from plain_sensor import plain

from twin.calibration.optics import _stages, fit_surroundings
from twin.camera.capture import expose
from twin.camera.projection import lens_disc, project
from twin.errors import FrameError
from twin.evaluation.pictures.aligned import Aligned, read_frames, require_cameras_own, with_changes
from twin.geometry.pins import rest_pins
from twin.mechanics.skin_fit import FittedPins
from twin.optics.preview import Preview
from twin.progress import silent, stage


def quiet(*_):
    pass


@pytest.fixture(scope="module")
def drawn():
    """A small colour sensor and its frame at rest."""
    shipped = plain()
    camera = {name: 0.6 * getattr(shipped.camera, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    camera |= {name: round(0.6 * getattr(shipped.camera, name)) for name in ("width_px", "height_px")}
    blob = shipped.pipeline.raw
    center = tuple(0.6 * x for x in blob.mask_center_px)
    raw = blob.model_copy(update={"mask_center_px": center, "mask_radius_px": 0.6 * blob.mask_radius_px})
    spec = with_changes(shipped, camera=camera, pipeline={"raw": raw})
    return spec, expose(Preview(spec).render(), spec.capture)


def aligned(spec, image):
    rest = rest_pins(spec.geometry)
    state = FittedPins(rest.base_mm, rest.axis, rest.caps_mm, np.zeros(len(rest.caps_mm)), np.zeros(3))
    return Aligned("seen.png", image, project(spec.view, rest.caps_mm), state)


def test_a_mono_specification_refuses_colour_frames_by_name(drawn, tmp_path):
    spec, image = drawn
    mono = with_changes(spec, camera={"channels": "mono"})
    cv2.imwrite(str(tmp_path / "seen.png"), image[..., ::-1])
    assert len(read_frames(tmp_path, spec, 6, quiet)[0]) == 1
    with pytest.raises(FrameError, match=r'seen.png: a colour frame.*channels = "color"'):
        read_frames(tmp_path, mono, 6, quiet)


def test_gray_frames_stored_as_colour_suit_a_mono_specification(drawn, tmp_path):
    spec, image = drawn
    mono = with_changes(spec, camera={"channels": "mono"})
    cv2.imwrite(str(tmp_path / "seen.png"), np.repeat(image[..., 1:2], 3, axis=2))
    ((_, found, _),), _ = read_frames(tmp_path, mono, 6, quiet)
    np.testing.assert_array_equal(found, image[..., 1])


def test_a_colour_specification_refuses_gray_frames_by_name(drawn, tmp_path):
    spec, image = drawn
    cv2.imwrite(str(tmp_path / "seen.png"), image[..., 1])
    with pytest.raises(FrameError, match=r'seen.png: a gray frame.*channels = "mono"'):
        read_frames(tmp_path, spec, 6, quiet)


def test_frames_of_the_cameras_own_kind_pass(drawn):
    spec, image = drawn
    require_cameras_own(image, "seen.png", spec.camera)
    require_cameras_own(image[..., 1], "seen.png", spec.camera.model_copy(update={"channels": "mono"}))
    with pytest.raises(FrameError, match="seen.png: 192 x 144 px.*384 x 288"):
        require_cameras_own(image[::2, ::2], "seen.png", spec.camera)


def test_thresholded_frames_are_refused(drawn):
    spec, image = drawn
    with pytest.raises(FrameError, match="thresholded"):
        fit_surroundings(spec, np.where(image > 100, 255, 0).astype(np.uint8)[None], np.zeros((1, spec.pins.count, 2)))


def test_frames_of_another_size_are_refused(drawn, tmp_path):
    spec, image = drawn
    cv2.imwrite(str(tmp_path / "seen.png"), image[::2, ::2])
    with pytest.raises(FrameError, match="384x288"):
        read_frames(tmp_path, spec, 6, quiet)


@pytest.fixture(scope="module")
def ringless(drawn):
    """A frame that grows brighter to its border: where the brightest place is the last one, nothing tells where a ring begins."""
    spec, image = drawn
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    disc = lens_disc(spec.view, spec.housing)
    beyond_px = np.hypot(x - disc.center_px[0], y - disc.center_px[1]) - 1.3 * disc.radius_px
    slope = np.clip(240 * np.exp(beyond_px / 20), 1, 254).astype(np.uint8)
    return np.repeat(slope[..., None], 3, axis=2)


def test_frames_that_grow_brighter_to_their_border_have_no_ring(drawn, ringless):
    spec, _ = drawn
    pins_px = project(spec.view, rest_pins(spec.geometry).caps_mm)[None]
    with pytest.raises(FrameError, match="no bright ring"):
        fit_surroundings(spec, ringless[None], pins_px)


def test_where_no_ring_is_seen_the_housing_is_held_and_the_fit_goes_on(drawn, ringless):
    spec, _ = drawn
    surroundings, *later = _stages([aligned(spec, ringless)], np.ones(ringless.shape[:2], bool), None, partial(stage, silent))
    assert surroundings(spec).housing == spec.housing and later


def test_a_cap_too_few_in_the_appearance_is_refused_where_it_enters(drawn):
    """Offsets of another layout would otherwise end the fit of the caps in a broadcasting error."""
    spec, _ = drawn
    with pytest.raises(ValueError, match=f"cap_offsets needs one pair for each of the {spec.pins.count} pins"):
        with_changes(spec, appearance={"cap_offsets": ((0.0, 0.0),) * (spec.pins.count - 1)})
