"""What the camera sees besides the gel is found again from frames drawn with it."""

import cv2
import numpy as np
import pytest
from plain_sensor import plain

from twin.calibration.light.leds import fit_reflections
from twin.calibration.light.still import median_still
from twin.calibration.optics import fit_surroundings
from twin.camera.capture import expose
from twin.camera.projection import project
from twin.evaluation.pictures.aligned import SATURATED, with_changes
from twin.geometry.pins import rest_pins
from twin.optics.static_layer import static_layer

SIZE = 0.6  # of the shipped camera's frames: fast, and still sharp enough
FRAMES = 20
MOVE_PX = 11.0 * SIZE  # of the pins between frames: every place is clear of them in some
CAP_PX, CAP_LIGHT, SKIN_LIGHT = 5.0 * SIZE, 0.25, 0.004
PLACE_MM = 0.03  # a quarter of a pixel
AZIMUTH_DEG = 0.2  # half a pixel at the rim
LED_MM = 0.06
SIZE_MM = 0.13  # a pixel
RING_LEVELS = 1.5  # rms: gray levels are rounded, the edge of the lip falls between pixels
SPECK_MM = 0.03
SPECK_SHARE = 0.25  # of radius and light, of a spot of 3 to 5 px
OPACITY = 0.2
DIM_LEVELS = 40  # at single pixels of a spot's edge

HOUSING = {
    "center_mm": (0.3, -0.2),
    "aperture_radius_mm": 16.2,
    "albedo": (0.9, 0.85, 0.7),
    "ambient": 0.5,
    "ambient_falloff_mm": 25.0,
    "glow": 4.0,
    "glow_radius_mm": 18.5,
    "glow_height_mm": 2.0,
    "glow_exponent": 1.7,
    "lip_width_mm": 1.5,
    "wall_fraction": 0.6,
}
LEDS = {
    "azimuth_deg": (20.0, 78.0, 142.0, 199.0, 262.0, 318.0),
    "radius_mm": 16.3,
    "z_mm": -6.0,
    "size_mm": 1.2,
    "core_share": 0.97,
    "core_mm": 0.06,
}
SPECKS = (
    {"x_mm": 12.5, "y_mm": 8.0, "radius_mm": 0.25, "opacity": 0.5, "light": 0.6},
    {"x_mm": -14.5, "y_mm": 2.0, "radius_mm": 0.3, "opacity": 0.5, "light": 0.1},
    {"x_mm": 3.0, "y_mm": -5.0, "radius_mm": 0.35, "opacity": 0.7, "light": 0.3},
)


@pytest.fixture(scope="module")
def known():
    """The specification that is looked for, frames drawn with it and their pins."""
    shipped = plain()
    camera = {name: SIZE * getattr(shipped.camera, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    camera |= {name: round(SIZE * getattr(shipped.camera, name)) for name in ("width_px", "height_px")}
    haze = {"haze": 0.02, "haze_sigma_px": 40.0 * SIZE}
    start = with_changes(shipped, camera=camera, leds={"power": 0.7}, gel=haze, appearance={"specks": ()})
    spec = with_changes(start, housing=HOUSING, leds=LEDS, appearance={"specks": SPECKS})
    light, cover = static_layer(spec, (0, 0, spec.camera.width_px, spec.camera.height_px))
    rng = np.random.default_rng(5)
    at_rest = project(spec.view, rest_pins(spec.geometry).caps_mm)
    images, pins = [], []
    for _ in range(FRAMES):
        pins_px = at_rest + rng.uniform(-MOVE_PX, MOVE_PX, 2)
        gel = np.full(light.shape, SKIN_LIGHT, np.float32)
        for x, y in np.rint(16 * pins_px).astype(int).tolist():
            cv2.circle(gel, (x, y), round(16 * CAP_PX), (CAP_LIGHT,) * 3, -1, cv2.LINE_8, 4)
        images.append(expose(light + (1 - cover[..., None]) * gel, spec.capture, rng))
        pins.append(pins_px)
    return start, spec, np.array(images), np.array(pins)


@pytest.fixture(scope="module")
def found(known):
    start, _, images, pins_px = known
    done = []
    spec = fit_surroundings(start, images, pins_px, lambda *step: done.append(step))
    assert done[-1] == (len(done), len(done))
    return spec


def test_the_discs_edge(known, found):
    assert np.allclose(found.housing.center_mm, known[1].housing.center_mm, atol=PLACE_MM)
    assert found.housing.aperture_radius_mm == pytest.approx(known[1].housing.aperture_radius_mm, abs=PLACE_MM)


def test_leds_are_found_by_their_reflections(known, found):
    """The LEDs' height is not seen: the radius is compared at the place of the reflection, by the law of the mirror."""
    ours, real, back = found.leds, known[1].leds, known[1].lens.back_mm
    assert np.allclose(ours.azimuth_deg, real.azimuth_deg, atol=AZIMUTH_DEG)
    distance = known[1].camera.distance_mm
    reach = [2 * back - leds.z_mm + distance for leds in (ours, real)]
    assert ours.z_mm < back
    assert ours.radius_mm / reach[0] * reach[1] == pytest.approx(real.radius_mm, abs=LED_MM)
    assert ours.size_mm == pytest.approx(real.size_mm, abs=SIZE_MM)
    assert 1 - ours.core_share == pytest.approx(1 - real.core_share, rel=0.3)


@pytest.mark.slow
def test_reflections_that_the_housing_dims_are_met(known):
    """Spots of the whole LEDs' light, over which a camera sharpens, would be white with black rings around them."""
    _, spec, images, _ = known
    dim = with_changes(spec, leds={"mirror_share": 0.01, "core_share": 0.5, "core_mm": 0.2, "size_mm": 1.0}, appearance={"specks": ()})
    real, start = drawn(dim, images), with_changes(dim, leds={"mirror_share": 1.0, "core_share": 0.0})
    miss = drawn(fit_reflections(start, median_still(start, real[None])), images).astype(float) - real
    assert np.abs(miss).max() < DIM_LEVELS


def drawn(spec, images):
    """The frame without skin and pins that a sensor gives in the size of some images."""
    return expose(static_layer(spec, (0, 0, images.shape[2], images.shape[1]))[0], spec.capture)


def test_the_rings_light(known, found):
    _, spec, images, _ = known
    y, x = np.mgrid[: images.shape[1], : images.shape[2]]
    light, cover = static_layer(found, (0, 0, images.shape[2], images.shape[1]))
    real, shown = np.median(images, axis=0), expose(light, found.capture).astype(float)
    outside = cv2.erode((cover == 1).astype(np.uint8), np.ones((9, 9))) > 0
    miss = (shown - real)[outside & (real < SATURATED).all(axis=2)]
    assert np.sqrt(np.mean(miss**2)) < RING_LEVELS
    colours = [
        np.array(part.housing.albedo) / part.housing.albedo[1] for part in (found, spec)
    ]  # how bright it is trades with ambient and glow
    np.testing.assert_allclose(*colours, atol=0.01)
    assert found.housing.lip_width_mm == pytest.approx(spec.housing.lip_width_mm, abs=0.1)
    assert found.housing.wall_fraction == pytest.approx(spec.housing.wall_fraction, abs=0.03)


def test_specks(known, found):
    ours = np.array([[s.x_mm, s.y_mm, s.radius_mm, s.light, s.opacity] for s in found.appearance.specks])
    assert len(ours) == len(SPECKS)
    for speck in SPECKS:
        x, y, radius, light, opacity = ours[np.argmin(np.linalg.norm(ours[:, :2] - [speck["x_mm"], speck["y_mm"]], axis=1))]
        assert np.hypot(x - speck["x_mm"], y - speck["y_mm"]) < SPECK_MM
        assert radius == pytest.approx(speck["radius_mm"], rel=SPECK_SHARE)
        assert light == pytest.approx(speck["light"], rel=SPECK_SHARE)
    assert opacity == pytest.approx(speck["opacity"], abs=OPACITY)  # pins pass behind the last one


def test_parameters_of_other_fits_do_not_change(known, found):
    start = known[0]
    for section in ("gel", "lens", "camera", "response", "pins", "skin"):
        assert getattr(found, section) == getattr(start, section)
    assert (found.leds.power, found.leds.balance) == (start.leds.power, start.leds.balance)
