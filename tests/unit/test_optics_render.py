"""Laws of the renderer, on small films: projection, symmetry, light, noise, updates."""

from dataclasses import replace

import numpy as np
import pytest
from plain_sensor import changed, plain

from scenes.sensor import SensorSpec
from twin.camera.projection import project
from twin.errors import RenderError
from twin.geometry.pins import PinRest, rest_pins
from twin.optics.render import Renderer
from twin.optics.sampling import PixelSamples, near_pins
from twin.optics.variant import choose_variant, use_variant

BRIGHT = {"pin_albedo": (0.9, 0.9, 0.9), "skin_albedo": (0.8, 0.8, 0.8)}  # many paths go on


@pytest.fixture(scope="module")
def small() -> SensorSpec:
    """19 wide flat caps on a 120 x 100 px film, a strongly distorting tilted mono camera."""
    return changed(
        plain(),
        pins={"rings": 2, "cap_diameter_mm": 4.0, "cap_height_mm": 0.02, "max_polar_deg": 40.0},
        camera={
            "channels": "mono", "width_px": 120, "height_px": 100, "fx_px": 115.0, "fy_px": 122.0, "cx_px": 61.3, "cy_px": 47.8,
            "tilt_x_deg": 2.0, "tilt_y_deg": -3.0, "k1": 0.5, "k2": 0.2, "p1": 0.02, "p2": -0.015,
        },
        appearance={
            "skin_gloss": 0.0, "skin_albedo": (0.0, 0.0, 0.0), "pin_albedo": (0.0, 0.0, 0.0), "cap_variation": 0.0,
        },
    )  # fmt: skip


@pytest.fixture(scope="module")
def straight(small) -> SensorSpec:
    """The same with an ideal camera on the axis, where the scene's six-fold symmetry is the image's."""
    leds = {"azimuth_deg": tuple(60.0 * k for k in range(6))}
    lens = {"tilt_x_deg": 0.0, "tilt_y_deg": 0.0, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "fx_px": 122.0}
    return changed(small, camera=lens, leds=leds, pins={"phase_deg": 0.0}, housing={"center_mm": (0.0, 0.0)})


def centroids(image: np.ndarray, near_px: np.ndarray) -> np.ndarray:
    """Light-weighted centroids (N, 2) of the spots within 6 px of the given places."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    weights = [np.where(np.hypot(x - u, y - v) < 6.0, image, 0.0) for u, v in near_px]
    return np.array([[(w * x).sum() / w.sum(), (w * y).sum() / w.sum()] for w in weights])


def cap_light(image: np.ndarray, spec: SensorSpec, rest: PinRest) -> np.ndarray:
    """Mean light of each cap (N,), over 5 x 5 px at its projection."""
    places = np.rint(project(spec.view, rest.caps_mm)).astype(int)
    return np.array([image[v - 2 : v + 3, u - 2 : u + 3].mean() for u, v in places])


def projected_caps(spec: SensorSpec) -> np.ndarray:
    """Centroids (N, 2) of the outlines of the projected cap discs (polygon area formula)."""
    rest, turn = rest_pins(spec.geometry), np.linspace(0, 2 * np.pi, 73)[:, None]
    found = []
    for centre, axis in zip(rest.caps_mm, rest.axis, strict=True):
        u = np.cross(axis, [0.3, 0.9, 0.1])
        u /= np.linalg.norm(u)
        rim = centre + 0.5 * spec.pins.cap_diameter_mm * (np.cos(turn) * u + np.sin(turn) * np.cross(axis, u))
        p = project(spec.view, rim)
        twice = p[:-1, 0] * p[1:, 1] - p[1:, 0] * p[:-1, 1]
        found.append(((p[:-1] + p[1:]) * twice[:, None]).sum(axis=0) / (3 * twice.sum()))
    return np.array(found)


@pytest.mark.parametrize(("variant", "tolerance_px"), [(None, 0.03), ("scalar", 0.06)])
def test_a_rendered_cap_is_where_the_projection_says(small, variant, tolerance_px):
    """Rms over flat caps in even light; the scalar variant's ideal image is resampled, hence its wider tolerance."""
    even = changed(small, leds={"radius_mm": 10.0, "z_mm": -60.0, "size_mm": 8.0, "power": 30.0})
    black = changed(even, appearance={"cap_albedo": (0.0, 0.0, 0.0)})  # what is left: the LEDs mirrored in the window
    expected = projected_caps(even)
    found = centroids(Renderer(even, variant, spp=64).render() - Renderer(black, variant, spp=64).render(), expected)
    assert np.sqrt(((found - expected) ** 2).sum(axis=1).mean()) < tolerance_px
    assert np.abs((found - expected).mean(axis=0)).max() < tolerance_px / 2, "a systematic shift"
    shape_px = 0.2  # perspective and distortion move the centroid of a disc this little off its projected centre
    assert np.abs(expected - project(even.view, rest_pins(even.geometry).caps_mm)).max() < shape_px


def test_a_window_is_a_part_of_the_whole_frame(small):
    whole = Renderer(small, spp=64).render()
    part = Renderer(small, spp=64, window_px=(30, 20, 91, 77)).render()
    assert part.shape == (57, 61)
    noise_mean = 0.01
    assert np.abs(part - whole[20:77, 30:91]).mean() < noise_mean * whole.max()


def test_a_dead_led_darkens_its_side_and_turns_with_the_sensor(straight):
    """Switching off LED k + 1 instead of LED k turns the picture by 60 deg: outer cap j takes the place of cap j - 2."""
    rest = rest_pins(straight.geometry)
    lit = cap_light(Renderer(straight, spp=64).render(), straight, rest)[7:]
    dark = []
    for led in (0, 1):
        spec = changed(straight, leds={"off": (led,)})
        dark.append(cap_light(Renderer(spec, spp=64).render(), spec, rest)[7:] / lit)
    assert (dark[0] < 1).all()
    assert dark[0][0] != pytest.approx(dark[0][6], rel=0.02), "the side of the dead LED looks like the far side"
    noise_relative = 0.02
    np.testing.assert_allclose(np.roll(dark[0], 2), dark[1], rtol=noise_relative)


def test_the_picture_of_a_symmetric_sensor_is_symmetric(straight):
    light = cap_light(Renderer(straight, spp=64).render(), straight, rest_pins(straight.geometry))
    noise_relative = 0.02
    np.testing.assert_allclose(light[7:].reshape(6, 2), np.tile(light[7:].reshape(6, 2).mean(axis=0), (6, 1)), rtol=noise_relative)


def test_caps_vary_as_specified_in_a_pattern_of_their_own(straight):
    even, rest = Renderer(straight, spp=64).render(), rest_pins(straight.geometry)
    patterns = []
    for pattern in (0, 0, 1):
        spec = changed(straight, appearance={"cap_variation": 0.1, "cap_pattern": pattern})
        patterns.append(cap_light(Renderer(spec, spp=64).render(), straight, rest) / cap_light(even, straight, rest))
    few_caps = 0.5  # relative: the sd of 19 draws is uncertain by 17 %
    assert patterns[0].std() == pytest.approx(0.1, rel=few_caps)
    np.testing.assert_allclose(patterns[0], patterns[1], rtol=1e-3)
    assert np.abs(patterns[2] - patterns[0]).max() > 0.05


def test_light_is_proportional_to_the_leds(small):
    one = Renderer(small, spp=16).render(seed=3)
    two = Renderer(changed(small, leds={"power": 2 * small.leds.power}), spp=16).render(seed=3)
    rounding = 1e-4
    np.testing.assert_allclose(two, 2 * one, rtol=rounding, atol=rounding * one.max())


def test_the_same_seed_gives_the_same_image_to_the_last_bit(small):
    """Also where threads add up normals and samples: they may do so in any order."""
    renderer = Renderer(changed(small, appearance=BRIGHT), spp=4)
    images = [renderer.render(seed=1) for _ in range(8)]
    assert all(np.array_equal(image, images[0]) for image in images)
    assert np.abs(renderer.render(seed=2) - images[0]).max() > 1e-3


def test_variance_falls_at_least_as_one_over_samples(small):
    def variance(spp):
        renderer = Renderer(small, spp=spp)
        return np.var([renderer.render(seed=k) for k in range(8)], axis=0, ddof=1).mean()

    sampling = 0.7  # eight images estimate a mean variance over 12000 px well; stratified samples do better than 1/spp
    assert variance(16) * 4 * sampling < variance(4)


def test_moving_the_vertices_equals_building_anew(small):
    rest = rest_pins(small.geometry)
    shift = np.array([0.4, -0.3, -0.8]) * (rest.base_mm[:, 2:] / 19.0) ** 4
    pressed = PinRest(rest.base_mm + shift, rest.axis, rest.caps_mm + shift)
    moved = Renderer(small, spp=4)
    at_rest = moved.render(seed=4)
    after, built, back = moved.render(pressed, seed=4), Renderer(small, spp=4).render(pressed, seed=4), moved.render(seed=4)
    accumulation = 1e-4
    edge_samples = 1e-3  # of pixels: samples that hit a triangle's edge may fall to either side
    assert (np.abs(after - built) > accumulation).mean() < edge_samples
    assert (np.abs(back - at_rest) > accumulation).mean() < edge_samples
    assert np.abs(after - at_rest).max() > 0.1


def test_all_states_are_rendered_by_the_same_kernels(small):
    """Nothing of a state, not even its number of samples, is part of a kernel: only the first picture waits for the compiler."""
    import drjit as dr

    bright = changed(small, appearance=BRIGHT)
    renderer, rest = Renderer(bright, variant="llvm", spp=4), rest_pins(bright.geometry)
    moved = [replace(rest, caps_mm=rest.caps_mm + [0.3 * k, 0.2 * k, 0.0]) for k in range(4)]
    used = []
    for k, state in enumerate(moved):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            renderer.render(state, seed=k)
            used.append({each["hash"] for each in dr.kernel_history() if each["type"] == dr.KernelType.JIT})
    samples = {near_pins(bright.view, bright.pins, bright.appearance, state, renderer.window_px).sum() for state in moved}
    assert len(samples) == len(moved) and len(used[1]) > 10
    assert used[1] == used[2] == used[3]


def test_a_color_camera_sees_three_channels_and_a_mono_one_their_luminance(small):
    color = Renderer(changed(small, camera={"channels": "color"}), spp=64).render()
    mono = Renderer(small, spp=64).render()
    assert color.shape == (100, 120, 3) and mono.shape == (100, 120) and color.dtype == mono.dtype == np.float32
    rest = rest_pins(small.geometry)
    luminance = cap_light(color @ np.float32([0.212671, 0.715160, 0.072169]), small, rest)
    interreflection = 0.02  # relative: products of spectra are not products of luminances
    np.testing.assert_allclose(cap_light(mono, small, rest).mean(), luminance.mean(), rtol=interreflection)


@pytest.mark.parametrize("aperture_mm", [0.0, 4.0])
def test_a_drawn_picture_is_the_traced_one(small, aperture_mm):
    """Edges in and out of focus, walls and bevels, the skin: of a state in which the shading was not fitted."""
    look = {"skin_albedo": (0.02, 0.02, 0.02), "pin_albedo": (0.1, 0.1, 0.1)}
    spec = changed(small, pins={"cap_height_mm": 0.6}, camera={"aperture_mm": aperture_mm, "focus_mm": 45.0}, appearance=look)
    rest = rest_pins(spec.geometry)
    moved = rest.base_mm * [0.02, 0.03, 0.0] - [0.0, 0.0, 0.5]
    state = PinRest(rest.base_mm + moved, rest.axis, rest.caps_mm + moved)
    traced, drawn = Renderer(spec, spp=128).render(state), Renderer(spec, quality="rasterised").render(state)
    places = project(spec.view, state.caps_mm)
    apart_px = np.linalg.norm(centroids(drawn, places) - centroids(traced, places), axis=1)
    light, within_px = 0.015, 0.06  # of the caps' light; measured: 0.0123, 0.052
    assert np.sqrt(np.mean((drawn - traced) ** 2)) < light * np.median(cap_light(traced, spec, state))
    assert np.sqrt(np.mean(apart_px**2)) < within_px


def test_what_cannot_be_rendered_is_refused(small):
    with pytest.raises(RenderError, match="spp=4"):
        Renderer(small, quality="rasterised", spp=4)
    with pytest.raises(RenderError, match="quality"):
        Renderer(small, quality="best")
    with pytest.raises(RenderError, match="window_px"):
        Renderer(small, window_px=(0, 0, 121, 100))
    rest = rest_pins(small.geometry)
    with pytest.raises(RenderError, match="19"):
        Renderer(small, spp=1).render(PinRest(rest.base_mm[:5], rest.axis[:5], rest.caps_mm[:5]))


def test_pixels_that_show_a_pin_count_as_near_one():
    """Pixels onto which rims and feet of pins are projected count as near a pin; most pixels of bare skin do not."""
    spec, window = plain(), (200, 150, 400, 350)
    rest = rest_pins(spec.geometry)
    near = near_pins(spec.view, spec.pins, spec.appearance, rest, window)
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    across = np.cross(rest.axis, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    way = np.cos(turn)[:, None, None] * across + np.sin(turn)[:, None, None] * np.cross(rest.axis, across)
    rims = project(spec.view, rest.caps_mm + 0.5 * spec.pins.cap_diameter_mm * way).reshape(-1, 2)
    at = np.rint(np.concatenate([rims, project(spec.view, rest.base_mm)])).astype(int) - window[:2]
    at = at[((at >= 0) & (at < 200)).all(axis=1)]
    assert len(at) > 1000 and near[at[:, 1], at[:, 0]].all()
    assert near.mean() < 0.8


def test_passes_are_refined_to_the_mean_of_all(small):
    """One pass is the picture itself; each further one takes noise away."""
    renderer = Renderer(small, spp=4)
    passes = list(renderer.refine(seed=3, samples=(4, 4, 8)))
    np.testing.assert_array_equal(passes[0], renderer.render(seed=3))
    calm = Renderer(small, spp=64).render(seed=9)
    noise = [np.sqrt(np.mean((each - calm) ** 2)) for each in passes]
    assert noise[2] < 0.8 * noise[0]


@pytest.mark.parametrize("wide", [0, 1, 3, 6])
def test_samples_of_a_pixel_have_one_in_each_box_of_a_grid(wide):
    """64 samples are a (0, 6)-net: in 2^wide columns and 2^(6 - wide) rows there is one in each box, in every pixel and dimension."""
    mi = use_variant(choose_variant("mono"))
    import drjit as dr

    count, pixels = 64, 5
    number = dr.arange(mi.UInt32, count * pixels)
    random = PixelSamples(mi, dr, number // count, number % count, count, 7)
    for _ in range(3):
        x, y = np.array(random.next_2d()).reshape(2, pixels, count)
        assert (x >= 0).all() and (x < 1).all() and (y >= 0).all() and (y < 1).all()
        boxes = np.floor(x * 2**wide) * count + np.floor(y * 2 ** (6 - wide))
        assert all(len(np.unique(row)) == count for row in boxes), wide
