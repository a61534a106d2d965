"""Dark pins on a bright skin: the same layouts as of bright pins, and gaps between pins are never pins, in neither polarity."""

import cv2
import numpy as np
import pytest
from drawn_frames import draw_discs, smooth_warp
from scipy.spatial import cKDTree
from unknown_sensor import frames_of, leave_out_costs, rest_of, search_few_sizes

from scenes.pins import PinsSpec
from scenes.sensor import AppearanceSpec, BlobSpec, CameraSpec, PipelineSpec, SensorSpec
from twin.calibration.new_sensor import DARK_CAPS, new_sensor
from twin.camera.capture import expose
from twin.errors import FrameError
from twin.evaluation.degradation.conditions.body import faded, missing, pale
from twin.frames.forms import is_two_level
from twin.optics.preview import Preview
from twin.optics.surfaces import cap_albedo
from twin.pins import Pipeline, make_detector, shipped_detector
from twin.pins.check import Grade, examine
from twin.pins.detectors.tune import _at_rest, tune
from twin.pins.finding.caps import measure_caps
from twin.pins.labelling.identify import LayoutInFrame, _at_likelier_spots, identify, score_layout
from twin.pins.labelling.matching import match
from twin.pins.labelling.reference import make_reference
from twin.pins.labelling.rest import Rest
from twin.types import Form, Frame

GRID = PinsSpec(layout="grid", columns=7, rows=9)
SIZE = (240, 180)


def dots(count=2, *, pins=GRID, share=0.22, level=(200, 60), noise=3.0, light=0.5, corner=0.5, seed=0, blur_px=1.0):
    """Gray frames of contacts of a dome with dots of a share of their spacing, in uneven light that falls off towards the corners, and the
    dots' places."""
    rest = rest_of(pins, size=SIZE, radius=76.0, turn_deg=3.0)
    spacing = np.median(np.sort(np.linalg.norm(rest[:, None] - rest, axis=2), axis=1)[:, 1])
    u, v = (np.linspace(-1, 1, n) for n in SIZE)
    lit = (1 + light * (0.6 * u - 0.4 * v[:, None])) * (1 - corner * (u**2 + v[:, None] ** 2) / 2)
    images, places = [], []
    for k in range(count):
        rng = np.random.default_rng(100 * seed + k)
        px = smooth_warp(rest, 3.0, rng)
        cover = draw_discs(SIZE, px, share * spacing, level=(0, 255), blur_px=blur_px) / 255
        image = (level[0] + (level[1] - level[0]) * cover) * lit + rng.normal(0, noise, cover.shape)
        images.append(np.clip(np.round(image), 0, 255).astype(np.uint8))
        places.append(px)
    return images, places


def off_px(found, places):
    """Largest distance of a named pin from the nearest true place, over all frames."""
    named = [seen.pins_px[np.isfinite(seen.pins_px[:, 0])] for seen in found.best.seen]
    return max(cKDTree(true).query(px)[0].max() for px, true in zip(named, places, strict=True))


@pytest.mark.parametrize("look", [{}, {"share": 0.4, "noise": 6.0}, {"blur_px": 4.5, "share": 0.3}], ids=["small", "large", "blurred"])
def test_dots_are_named_in_both_polarities_and_gaps_in_none(look):
    images, places = dots(1, **look)
    dark, bright = identify(images), identify([255 - image for image in images])
    assert (dark.polarity, bright.polarity) == ("dark", "bright")
    for found in (dark, bright):
        assert (found.best.pins.layout, found.best.pins.columns, found.best.pins.rows) == ("grid", 7, 9)
        assert found.sure and off_px(found, places) < 3
    assert np.array_equal(dark.best.rest_px, bright.best.rest_px)


@pytest.mark.parametrize("columns", [6, 8])
def test_a_given_layout_that_fits_the_gaps_is_not_seen_in_them(columns):
    images, _ = dots(share=0.4)
    gaps = PinsSpec(layout="grid", columns=columns, rows=columns + 2)
    assert score_layout(gaps, images) is None
    assert score_layout(GRID, [255 - image for image in images]) is not None


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A new sensor from frames of dark dots."""
    folder = tmp_path_factory.mktemp("dark") / "mine"
    folder.mkdir()
    images, places = dots(2)
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"frame_{k}.png"), image)
    with pytest.MonkeyPatch.context() as patch:
        leave_out_costs(patch)
        search_few_sizes(patch)
        return new_sensor(folder, folder.with_name("dark.toml")), images, places


@pytest.mark.usefixtures("few_sizes")
def test_a_sensor_of_dark_pins_is_made_checked_and_tuned(made):
    """The state of its own frames is good, and a tuning of them finds the same pins in the same polarity."""
    found, images, places = made
    assert found.sensor.pipeline.raw.polarity == "dark" and found.sensor.appearance.dark_caps
    assert any("darker than the skin" in line for line in found.lines())
    frames = [Frame(image, Form.RAW, f"{k}") for k, image in enumerate(images)]
    pipeline = Pipeline(found.sensor, Form.RAW)
    for frame, true in zip(frames, places, strict=True):
        seen = pipeline(frame)
        assert seen.valid and seen.found == 63 and cKDTree(true).query(seen.pins_px)[0].max() < 1
    usual, findings = found.sensor.pipeline.usual_caps, {one.name: one for one in examine(frames, found.sensor)}
    assert usual is not None and usual.contrast == pytest.approx(135, abs=15)
    assert {findings[name].verdict for name in ("brightness", "saturation", "focus", "glare", "layout", "pins")} == {Grade.HEALTHY}
    assert "below the skin" in findings["brightness"].text
    detector = tune(frames, found.sensor).detector
    assert detector.blob.polarity == "dark" and detector.evidence is not None and detector.evidence.exact_rate == 1
    with pytest.raises(FrameError, match="other polarity"):
        tune([Frame(255 - frame.image, Form.RAW) for frame in frames], found.sensor)


@pytest.mark.usefixtures("no_other_layout", "few_sizes")
def test_white_skin_around_dark_caps_is_saturated_and_black_caps_are_not(made):
    found, _, _ = made
    images, _ = dots(1, level=(290, 0), light=0.0, corner=0.0)
    findings = {one.name: one for one in examine([Frame(image, Form.RAW) for image in images], found.sensor)}
    assert findings["saturation"].verdict is Grade.FAILED and "skin" in findings["saturation"].text
    images, _ = dots(1, level=(180, 0), light=0.0, corner=0.0)
    findings = {one.name: one for one in examine([Frame(image, Form.RAW) for image in images], found.sensor)}
    assert findings["saturation"].verdict is Grade.HEALTHY


@pytest.mark.usefixtures("no_assumption_costs", "few_sizes")
def test_thresholded_frames_of_dark_pins_are_recognised(tmp_path):
    images, _ = dots(light=0.0, corner=0.0)
    white = [np.where(image > 130, 255, 0).astype(np.uint8) for image in images]
    small = [cv2.resize(image, (180, 135), interpolation=cv2.INTER_AREA) for image in white]
    assert all(is_two_level(image) for image in [*white, *small]) and not any(is_two_level(image) for image in images)
    for k, image in enumerate(white):
        cv2.imwrite(str(tmp_path / f"frame_{k}.png"), image)
    found = new_sensor(tmp_path, tmp_path / "out" / "dark.toml")
    assert found.sensor.pipeline.processed is not None and found.sensor.pipeline.processed.polarity == "dark"
    assert found.health.all_pins == 1 and found.sensor.recording is not None and found.sensor.recording.threshold_offset > 0


def test_caps_are_measured_alike_in_both_polarities():
    (image,), (px,) = dots(1)
    dark, bright = measure_caps(image, px, polarity="dark"), measure_caps(255 - image, px)
    np.testing.assert_allclose(dark.contrast, bright.contrast, rtol=1e-3)  # pixels at the half level may be on its other side
    np.testing.assert_allclose([dark.level, dark.skin], [255 - bright.level, 255 - bright.skin], atol=0.2)
    assert np.nanmin(dark.contrast) > 0 and np.nanmedian(dark.level) < np.nanmedian(dark.skin)


def sensor_of(polarity="dark", appearance=DARK_CAPS):
    """A sensor of 7 x 9 pins."""
    camera = CameraSpec(width_px=320, height_px=240, fx_px=240.0, fy_px=240.0, cx_px=160.0, cy_px=120.0, distance_mm=44.8)
    blob = BlobSpec(polarity=polarity, threshold=-12.0, threshold_block_px=31, mask_center_px=(160.0, 120.0), mask_radius_px=95.0)
    return SensorSpec(name="dots", pins=GRID, camera=camera, appearance=appearance, pipeline=PipelineSpec(raw=blob))


def test_drawn_frames_show_dark_caps_and_the_pipeline_finds_them():
    spec = sensor_of()
    image = expose(Preview(spec).render(), spec.capture)
    seen = Pipeline(spec, Form.RAW)(Frame(image, Form.RAW))
    assert seen.valid and seen.found == 63
    caps = measure_caps(image, seen.pins_px, polarity="dark")
    assert np.nanmin(caps.contrast) > 20 and 60 < np.nanmedian(caps.skin) < 240
    assert not Pipeline(sensor_of("bright"), Form.RAW)(Frame(image, Form.RAW)).valid, "gaps are no pins"


def test_dark_pins_need_dark_caps():
    with pytest.raises(ValueError, match="darker than the skin"):
        sensor_of(appearance=AppearanceSpec())


def test_degraded_dark_caps_become_like_the_skin():
    """Caps that come off show the skin; faded ones, and a worn skin, lose contrast."""
    spec = sensor_of()
    gone = cap_albedo(missing(spec, 1.0, np.random.default_rng(0)).appearance, 63)
    np.testing.assert_allclose(gone, np.broadcast_to(spec.appearance.skin_albedo, (63, 3)))
    for change in (faded, pale):
        look = change(spec.appearance, 0.5, np.random.default_rng(0))
        assert look.dark_caps
        assert look.skin_albedo[0] - look.cap_albedo[0] < 0.7 * (spec.appearance.skin_albedo[0] - spec.appearance.cap_albedo[0])


def test_the_published_method_refuses_dark_pins():
    with pytest.raises(FrameError, match="bright pins only"):
        make_detector(sensor_of(), shipped_detector(sensor_of(), Form.RAW, "legacy"))


def test_pins_at_the_same_place_are_an_error_in_words_not_a_division_by_zero():
    rest = rest_of(GRID)
    rest[10] = rest[11]
    with pytest.raises(FrameError, match="pins 1[01] and 1[01] are at the same place"):
        match(make_reference(rest, GRID), rest_of(GRID), np.ones(63))


@pytest.mark.usefixtures("no_other_layout")
def test_a_pin_out_of_view_is_not_put_on_another_one():
    """Two frames that are labelled differently may give an unseen pin the median place at which the frame at rest shows another pin."""
    images = frames_of(rest_of(PinsSpec(rings=4)), 1, contact_px=1e-9)
    found = identify(images).best
    rest = found.rest_px.copy()
    rest[60] = np.nan
    found.rest_px[60] = rest[59]
    spec = tune([Frame(images[0], Form.RAW)], sensor_of("bright", AppearanceSpec()).model_copy(update={"pins": found.pins})).detector
    places = np.array(_at_rest(spec, found.pins, Rest(rest, "found", "frame.png"), found).pins_px)
    assert make_reference(places, found.pins).spacing_px.min() > 5


def test_a_pin_put_on_a_spot_beside_the_sensor_is_moved_to_the_spot_that_fits_the_others():
    """A layout that is one spot off at a corner, as if that spot was a dark place of the housing, in most frames."""
    rest = rest_of(GRID, size=SIZE, radius=76.0)
    wrong = rest.copy()
    wrong[0] += 0.8 * (rest[0] - rest[8])
    seen = [LayoutInFrame(wrong, wrong, 0, rest[:1] + 0.1)] * 3
    np.testing.assert_allclose(_at_likelier_spots(GRID, wrong, seen)[0], rest[0] + 0.1)
    assert np.array_equal(_at_likelier_spots(GRID, rest, [LayoutInFrame(rest, rest, 0, wrong[:1])] * 3), rest)


def test_a_layout_with_a_missing_pin_is_seen_in_a_curved_view():
    """Laid over the spots as a whole, the lattice misses most of them."""
    away = rest_of(GRID, size=SIZE, radius=76.0, bulge=-0.3) - np.array(SIZE) / 2
    rest = np.array(SIZE) / 2 + away / (1 + away[:, 1:] / 180)  # a camera that looks from the side
    pins = GRID.model_copy(update={"missing": (10,)})
    image = draw_discs(SIZE, np.delete(rest, 10, axis=0), 2.2, blur_px=0.8)
    shown = score_layout(pins, [image])
    assert shown is not None and shown.explained > 0.9 and len(shown.rest_px) == 62
