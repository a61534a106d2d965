"""Laws of measured details: tiles that stand in the caps' planes, drawn prints, the background, their switches and their fit."""

import cv2
import numpy as np
import pytest
from plain_sensor import changed, plain

from scenes.pins import PinsSpec
from scenes.sensor import BackgroundSpec, ReliefSpec, SensorSpec
from twin.calibration.details import CELLS, REACH, fit_details, undetermined_tiles
from twin.camera.capture import expose
from twin.errors import FrameError, RenderError
from twin.evaluation.pictures.aligned import Aligned
from twin.geometry.pins import rest_pins
from twin.mechanics.skin_fit import FittedPins
from twin.optics.preview import Preview
from twin.optics.relief import DETAILS, POWER, SKIN_FROM, CapLamp, Relief, cap_places, cap_planes, tiles_of, tiles_picture, without
from twin.optics.static_layer import BACKGROUND_POWER, picture_of, static_layer, values_of

WINDOW = (0, 0, 320, 240)
CODED = 0.02  # error of a value in a picture, of its span: two levels near the span's end


@pytest.fixture(scope="module")
def spec() -> SensorSpec:
    """A sensor of 19 pins with a small frame."""
    half = {"width_px": 320, "height_px": 240, "fx_px": 245.0, "fy_px": 245.0, "cx_px": 152.0, "cy_px": 124.0}
    pins = PinsSpec(layout="hexagon", rings=2, max_polar_deg=35.0, length_mm=1.1, diameter_mm=0.8, cap_diameter_mm=3.0, cap_height_mm=0.1)
    whole = plain()
    pipeline = whole.pipeline.model_copy(update={"processed": None})
    return changed(whole, camera=half).model_copy(update={"pins": pins, "recording": None, "pipeline": pipeline})


@pytest.fixture(scope="module")
def tiles(spec) -> np.ndarray:
    """Smooth random tiles (N, CELLS, CELLS, 3)."""
    rng = np.random.default_rng(3)
    rough = rng.standard_normal((spec.pins.count, CELLS, CELLS, 3)).astype(np.float32)
    return 0.15 * np.stack([cv2.GaussianBlur(tile, (0, 0), 3) * 6 for tile in rough])


def with_tiles(spec: SensorSpec, tiles: np.ndarray, **fields) -> SensorSpec:
    relief = ReliefSpec(tiles=picture_of(tiles_picture(tiles), 1.0, POWER), count=len(tiles), span=1.0, cells=CELLS, reach=REACH, **fields)
    return changed(spec, appearance={"relief": relief})


def added(spec: SensorSpec, state) -> np.ndarray:
    """Light (240, 320, 3) that the relief adds."""
    light = np.zeros((240 * 320, 3))
    pixels, more = Relief(spec, WINDOW).light(state)
    light[pixels] = more
    return light.reshape(240, 320, 3)


def test_a_picture_gives_back_signed_values():
    values = np.linspace(-1, 1, 48 * 64).reshape(48, 64, 1).repeat(3, axis=2)
    assert np.abs(values_of(picture_of(values, 1.0, 2.2), 1.0, 2.2, "x") - values).max() < 2 * CODED
    with pytest.raises(FrameError, match="x: the picture can't be decoded"):
        values_of("data:image/png;base64,QUJD", 1.0, 2.2, "x")


def test_a_pixel_lies_on_the_nearest_cap_at_its_place_in_the_caps_plane(spec):
    state = rest_pins(spec.geometry)
    middle, plane = cap_planes(spec.view, spec.pins, state)
    places = cap_places(spec.view, spec.pins, state, WINDOW, REACH)
    at = np.column_stack([places.pixels % 320, places.pixels // 320])
    np.testing.assert_allclose(middle[places.cap] + np.einsum("nij,nj->ni", plane[places.cap], places.place), at, atol=1e-9)
    away = at[:, None] - middle
    on_tile = (np.abs(np.einsum("nij,pnj->pni", np.linalg.inv(plane), away)) < REACH).all(axis=2)
    apart = np.where(on_tile, np.linalg.norm(away, axis=2), np.inf)
    np.testing.assert_allclose(apart[np.arange(len(at)), places.cap], apart.min(axis=1))


def test_an_even_tile_adds_its_share_of_the_caps_own_light(spec):
    state, even = rest_pins(spec.geometry), np.full((spec.pins.count, CELLS, CELLS, 3), 0.25)
    for shown in (state, FittedPins(state.base_mm, state.axis[::-1], state.caps_mm, np.zeros(len(even)), np.zeros(3))):
        light, lamp = added(with_tiles(spec, even), shown), CapLamp(spec)(shown)
        places = cap_places(spec.view, spec.pins, shown, WINDOW, REACH)
        np.testing.assert_allclose(light.reshape(-1, 3)[places.pixels], 0.25 * lamp[places.cap], rtol=0.05)


def test_a_drawn_picture_has_the_relief_too(spec, tiles):
    raised, smooth = (Preview(each, static=(0.2, np.zeros((240, 320)))).render() for each in (with_tiles(spec, tiles), spec))
    np.testing.assert_allclose(raised, np.maximum(smooth + added(with_tiles(spec, tiles), rest_pins(spec.geometry)), 0), atol=1e-6)


def test_a_faded_cap_has_a_faded_relief(spec, tiles):
    state, whole = rest_pins(spec.geometry), with_tiles(spec, tiles)
    levels = np.ones(19)
    levels[3] = 0.001
    faded = added(changed(whole, appearance={"cap_levels": tuple(levels)}), state).reshape(-1, 3)
    places = cap_places(spec.view, spec.pins, state, WINDOW, REACH)
    lost, before = places.pixels[places.cap == 3], added(whole, state).reshape(-1, 3)
    np.testing.assert_allclose(faded[lost], 0.001 * before[lost], rtol=1e-5, atol=1e-9)
    np.testing.assert_array_equal(np.delete(faded, lost, axis=0), np.delete(before, lost, axis=0))


def test_relief_and_grain_share_the_tile_and_are_switched_off_alone(spec, tiles):
    state, whole = rest_pins(spec.geometry), with_tiles(spec, tiles)
    relief, grain = (added(without(whole, [off]), state) for off in ("grain", "relief"))
    np.testing.assert_allclose(relief + grain, added(whole, state), atol=1e-12)
    places = cap_places(spec.view, spec.pins, state, WINDOW, REACH)
    inside = places.pixels[np.linalg.norm(places.place, axis=1) < SKIN_FROM]
    assert not grain.reshape(-1, 3)[inside].any() and relief.reshape(-1, 3)[inside].any()


def test_without_details_the_smooth_model_is_left(spec, tiles):
    background = BackgroundSpec(light=picture_of(np.full((240, 320, 3), 0.3), 2.0, BACKGROUND_POWER))
    whole = changed(with_tiles(spec, tiles), housing={"background": background})
    assert without(whole, DETAILS) == spec
    with pytest.raises(RenderError, match="'gloss' is no detail of a render: use relief, grain, background"):
        without(whole, ["gloss"])


def test_a_drawn_print_has_the_mean_and_the_spread_of_the_measured_tiles(spec, tiles):
    drawn = tiles_of(with_tiles(spec, tiles, pattern=1).appearance.relief, 400)
    again, other = (tiles_of(with_tiles(spec, tiles, pattern=k).appearance.relief, 400) for k in (1, 2))
    assert (drawn == again).all() and not np.allclose(drawn, other)
    scatter = tiles.std(axis=0).mean()
    assert np.abs(drawn.mean(axis=0) - tiles.mean(axis=0)).max() < 0.3 * scatter
    assert drawn.std(axis=0).mean() == pytest.approx(scatter, rel=0.1)


def test_a_background_is_added_where_it_was_measured_and_scaled_to_the_frame(spec):
    values = np.zeros((240, 320, 3))
    values[30:60, 40:90] = (0.5, 0.2, -0.1)
    values = cv2.GaussianBlur(values, (0, 0), 8)
    background = BackgroundSpec(light=picture_of(values, 2.0, BACKGROUND_POWER))
    with_it = changed(spec, housing={"background": background})
    window = (20, 10, 300, 200)
    (light, cover), (bare, same) = static_layer(with_it, window), static_layer(spec, window)
    np.testing.assert_allclose(light - bare, values[10:200, 20:300], atol=2 * CODED)
    assert (cover == same).all()
    half, whole = {"width_px": 160, "height_px": 120}, (0, 0, 160, 120)
    small = static_layer(changed(with_it, camera=half), whole)[0] - static_layer(changed(spec, camera=half), whole)[0]
    np.testing.assert_allclose(small, cv2.resize(values, (160, 120), interpolation=cv2.INTER_AREA), atol=2 * CODED)


def test_too_few_tiles_are_an_error(spec, tiles):
    few = with_tiles(spec, tiles[:5]).appearance.relief.model_copy(update={"count": 19})
    with pytest.raises(FrameError, match=f"the picture holds 6 tiles of {CELLS} cells, the specification says 19"):
        tiles_of(few, 19)


def moved_frames(spec: SensorSpec, true: SensorSpec, moves_mm: np.ndarray, glint: np.ndarray) -> tuple[list[Aligned], list[np.ndarray]]:
    """Frames of a sensor whose caps all move by moves (M, 2), over an even ground and a background; and the light without details."""
    rest, base = rest_pins(spec.geometry), np.full((240, 320, 3), 0.2, np.float32)
    frames = []
    for number, move in enumerate(moves_mm):
        shift = np.append(move, 0.0)
        state = FittedPins(rest.base_mm + shift, rest.axis, rest.caps_mm + shift, np.zeros(19), np.zeros(3))
        image = expose(np.maximum(base + added(true, state) + glint, 0).astype(np.float32), spec.capture)
        frames.append(Aligned(f"{number}.png", image, np.zeros((19, 2)), state))
    return frames, [base] * len(frames)


def test_the_fit_finds_the_tiles_and_the_background_of_frames_with_moving_caps(spec, tiles):
    """Most of what smooth renders lack is explained in a frame that the fit has not seen."""
    true = with_tiles(spec, tiles)
    glint = np.zeros((240, 320, 3), np.float32)
    glint[100:106, 150:158] = 0.3
    frames, smooth = moved_frames(spec, true, np.random.default_rng(0).uniform(-1.5, 1.5, (6, 2)), glint)
    found = fit_details(spec, frames[:5], smooth[:5])
    light = smooth[5] + added(found, frames[5].state) + static_layer(found, WINDOW)[0] - static_layer(spec, WINDOW)[0]
    real = frames[5].image.astype(float)
    before, after = (real - expose(np.maximum(x, 0).astype(np.float32), spec.capture) for x in (smooth[5], light))
    assert np.mean(after**2) < 0.15 * np.mean(before**2)
    lost = [Aligned(f.name, f.image, np.where(np.arange(19)[:, None] == 4, np.nan, f.pins_px), f.state) for f in frames[:5]]
    assert undetermined_tiles(spec, frames[:5]) == 0 and undetermined_tiles(spec, lost) == 1


def test_the_relief_of_caps_that_hardly_move_is_no_background(spec, tiles):
    """Their edges lack the same light in every frame, as a glint does, but it is the tiles that must hold it."""
    true, moves_mm = with_tiles(spec, tiles), np.append(np.random.default_rng(0).uniform(-0.3, 0.3, (5, 2)), [[1.5, -1.0]], axis=0)
    frames, smooth = moved_frames(spec, true, moves_mm, np.zeros((240, 320, 3), np.float32))
    found = fit_details(spec, frames[:5], smooth[:5])
    wanted, got = (added(each, frames[5].state) for each in (true, found))
    assert np.mean((got - wanted) ** 2) < 0.2 * np.mean(wanted**2)
