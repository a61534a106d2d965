"""Laws of the preview: light through the window, places, coverage, symmetry, calibration."""

import numpy as np
import pytest
from plain_sensor import changed, plain

from scenes.sensor import SensorSpec
from twin.camera.projection import pixel_rays, project
from twin.errors import RenderError
from twin.geometry.pins import PinRest, rest_pins
from twin.optics.direct_light import DirectLight
from twin.optics.preview import Preview, Shading

NOTHING = (0.0, 0.0)  # no light from elsewhere, nothing covered


class EvenLight(DirectLight):
    """Light that is the same everywhere."""

    def __call__(self, points_mm, normals, bump=0.0):
        return np.ones(normals.shape)


@pytest.fixture
def evenly(monkeypatch):
    monkeypatch.setattr("twin.optics.preview.DirectLight", EvenLight)


@pytest.fixture(scope="module")
def small() -> SensorSpec:
    """19 wide flat caps alone on a 120 x 100 px film, a strongly distorting tilted mono camera."""
    return changed(
        plain(),
        pins={"rings": 2, "cap_diameter_mm": 4.0, "cap_height_mm": 0.02, "max_polar_deg": 40.0},
        camera={
            "channels": "mono", "width_px": 120, "height_px": 100, "fx_px": 125.0, "fy_px": 130.0, "cx_px": 61.3, "cy_px": 47.8,
            "tilt_x_deg": 2.0, "tilt_y_deg": -3.0, "k1": 0.7, "k2": 0.3, "p1": 0.02, "p2": -0.015,
        },
        appearance={
            "skin_albedo": (0.0, 0.0, 0.0), "pin_albedo": (0.0, 0.0, 0.0), "cap_albedo": (0.8, 0.8, 0.8),
            "cap_variation": 0.0, "cap_levels": (), "cap_shapes": (),
        },
    )  # fmt: skip


@pytest.fixture(scope="module")
def straight(small) -> SensorSpec:
    """The same with an ideal camera on the axis, where the scene's six-fold symmetry is the image's."""
    camera = {key: 0.0 for key in ("tilt_x_deg", "tilt_y_deg", "k1", "k2", "p1", "p2")}
    camera |= {"fx_px": 130.0, "width_px": 101, "height_px": 101, "cx_px": 50.0, "cy_px": 50.0}
    return changed(small, camera=camera, leds={"azimuth_deg": tuple(60.0 * k for k in range(6))}, pins={"phase_deg": 0.0})


def direct_light(spec: SensorSpec) -> DirectLight:
    return DirectLight(spec)


def area_and_centroid(polygon: np.ndarray) -> tuple[float, np.ndarray]:
    """Of a closed polygon (K, 2)."""
    after = np.roll(polygon, -1, axis=0)
    twice = polygon[:, 0] * after[:, 1] - after[:, 0] * polygon[:, 1]
    return abs(twice.sum()) / 2, ((polygon + after) * twice[:, None]).sum(axis=0) / (3 * twice.sum())


def projected_discs(spec: SensorSpec) -> list[np.ndarray]:
    """Outlines (72, 2) of the caps' discs at rest."""
    rest, turn, found = rest_pins(spec.geometry), np.linspace(0, 2 * np.pi, 73)[:-1, None], []
    for centre, axis in zip(rest.caps_mm, rest.axis, strict=True):
        u = np.cross(axis, [0.3, 0.9, 0.1])
        u /= np.linalg.norm(u)
        found.append(project(spec.view, centre + 0.5 * spec.pins.cap_diameter_mm * (np.cos(turn) * u + np.sin(turn) * np.cross(axis, u))))
    return found


def moved(rest: PinRest, pin: int, shift) -> PinRest:
    """The pins with one of them elsewhere."""
    by = np.zeros_like(rest.base_mm)
    by[pin] = shift
    return PinRest(rest.base_mm + by, rest.axis, rest.caps_mm + by)


@pytest.mark.parametrize("depth_mm", [2.0, 15.0])
def test_all_light_that_enters_the_gel_crosses_each_plane_in_it(depth_mm):
    """The irradiance times n^2 over a plane sums to ``L A integral T cos(theta) d omega`` of one LED, with T = 1 for equal indices."""
    spec = plain()
    spec = changed(
        spec, lens={"refractive_index": 1.0}, gel={"refractive_index": 1.4}, leds={"off": (1, 2, 3, 4, 5)}, housing={"fill": 0.0}
    )
    angle = (np.arange(4000) + 0.5) / 4000 * np.pi / 2  # in air; half of the light is lost at most beyond the outermost radius
    out = np.array([np.cos(np.radians(spec.leds.azimuth_deg[0])), np.sin(np.radians(spec.leds.azimuth_deg[0]))]) * spec.leds.radius_mm
    bent = np.arcsin(np.sin(angle) / 1.4)
    rho = (spec.lens.z_mm - spec.leds.z_mm) * np.tan(angle) + depth_mm * np.tan(bent)
    s, p = ((np.cos(a) - 1.4 * np.cos(b)) / (np.cos(a) + 1.4 * np.cos(b)) for a, b in ((angle, bent), (bent, angle)))
    passed = 1 - 0.5 * (s**2 + p**2)
    cone = angle < 1.2  # where the plane's rings stay narrow
    expected = np.sum((passed * np.cos(angle) * 2 * np.pi * np.sin(angle))[cone]) * (angle[1] - angle[0])
    points = np.stack([out[0] + rho, np.full_like(rho, out[1]), np.full_like(rho, spec.lens.z_mm + depth_mm)], axis=1)
    light = direct_light(spec)(points, np.tile([0.0, 0.0, -1.0], (len(points), 1)))[:, 1]
    strength = direct_light(changed(spec, gel={"refractive_index": 1.0}))(np.array([[*out, 1e4]]), np.array([[0.0, 0.0, -1.0]]))[0, 1]
    flux = strength * (1e4 - spec.leds.z_mm) ** 2  # radiance times area: all indices 1, seen from far away
    ring = np.gradient(rho) * 2 * np.pi * rho
    quadrature = 2.5e-7
    assert (light * ring)[cone].sum() * 1.4**2 == pytest.approx(flux * expected, rel=quadrature)


def test_a_way_to_the_camera_is_the_ray_of_the_pixel(small):
    rest = rest_pins(small.geometry)
    toward, length, _ = direct_light(small).refracted_rays(rest.caps_mm, np.array([0.0, 0.0, -small.camera.distance_mm]))
    entry, inward = pixel_rays(small.view, project(small.view, rest.caps_mm))
    rounding = 1e-12
    np.testing.assert_allclose(toward, -inward, atol=rounding)
    np.testing.assert_allclose(rest.caps_mm + length[:, None] * toward, entry, atol=rounding)


def test_the_centroid_of_a_cap_is_that_of_its_projected_disc(small, evenly):
    image, errors = Preview(small, static=NOTHING).render(), []
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    for disc in projected_discs(small):
        _, centroid = area_and_centroid(disc)
        weight = np.where(np.hypot(x - centroid[0], y - centroid[1]) < 7.5, image, 0.0)
        errors.append([(weight * x).sum() / weight.sum() - centroid[0], (weight * y).sum() / weight.sum() - centroid[1]])
    tolerance_px = 0.0047  # measured: 0.0043; an outline is a polygon, and caps overlap
    assert np.sqrt(np.square(errors).sum(axis=1).mean()) < tolerance_px


def test_caps_cover_their_projected_area(small, evenly):
    clear = changed(small, lens={"refractive_index": 1.0}, gel={"refractive_index": 1.0})  # the window takes no light
    covered = Preview(clear, static=NOTHING).render().sum() / (0.8 / np.pi)
    share = 0.009  # measured: 0.0081, because caps overlap
    assert covered == pytest.approx(sum(area_and_centroid(disc)[0] for disc in projected_discs(clear)), rel=share)


def test_caps_with_measured_outlines_have_their_shape(small, evenly):
    """``1 + a cos 2t`` has (1 + a^2 / 2) of the circle's area and is longest along x."""
    clear = changed(small, lens={"refractive_index": 1.0}, gel={"refractive_index": 1.0})
    round_, oval = (Preview(changed(clear, appearance={"cap_shapes": s}), static=NOTHING).render() for s in ((), ((0.0, 0.2, 0.0),) * 19))
    assert oval.sum() / round_.sum() == pytest.approx(1 + 0.2**2 / 2, rel=0.0062)
    u, v = np.rint(project(clear.view, rest_pins(clear.geometry).caps_mm[0])).astype(int)
    wider, lower = (oval - round_)[v, u - 9 : u + 10].sum(), (oval - round_)[v - 9 : v + 10, u].sum()
    assert wider > 0.69 and lower < -0.36


def test_moving_one_cap_changes_its_neighbourhood_only(small):
    preview, rest = Preview(small, static=NOTHING), rest_pins(small.geometry)
    after, before = preview.render(moved(rest, 4, (0.3, 0.2, -0.4))), preview.render()
    y, x = np.nonzero(after != before)
    away = np.hypot(x - project(small.view, rest.caps_mm[4])[0], y - project(small.view, rest.caps_mm[4])[1])
    reach_px = 8.7  # of a stem and cap of 4 mm; measured: 7.9
    assert len(away) > 103 and away.max() < reach_px
    assert (preview.render() == before).all()


def test_a_turned_scene_is_a_turned_picture(straight):
    """Pin j of ring r takes the place of pin j - r when the sensor is turned by 60 deg: here all pins of ring 2 by one dead LED."""
    pictures = [Preview(changed(straight, leds={"off": (k,)}), static=NOTHING).render() for k in (0, 3)]
    rounding = 1e-6  # of single precision
    np.testing.assert_allclose(pictures[0], pictures[1][::-1, ::-1], atol=rounding * pictures[0].max())
    places = np.rint(project(straight.view, rest_pins(straight.geometry).caps_mm[7:])).astype(int)
    near, next_ = (np.array([p[v - 2 : v + 3, u - 2 : u + 3].mean() for u, v in places])
                   for p in (Preview(changed(straight, leds={"off": (k,)}), static=NOTHING).render() for k in (0, 1)))  # fmt: skip
    np.testing.assert_allclose(np.roll(near, 2), next_, rtol=5 * rounding)


def test_a_dead_led_darkens_its_side(straight):
    lit, dark = (Preview(changed(straight, leds={"off": off}), static=NOTHING).render() for off in ((), (0,)))
    rounding = 1e-6 * lit.max()
    assert (dark <= lit + rounding).all()
    left, right = np.s_[:, :40], np.s_[:, 61:]  # LED 0 is to the right; light from there falls on caps to the left
    ratios = [dark[side].sum() / lit[side].sum() for side in (left, right)]
    assert abs(ratios[0] - ratios[1]) > 0.24 and max(ratios) < 1


def test_light_is_proportional_to_the_leds(small):
    one, two = (Preview(changed(small, leds={"power": power}), static=NOTHING).render() for power in (0.4, 0.8))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-6)


def test_levels_scale_their_caps(small):
    levels = tuple(0.5 + 0.02 * k for k in range(19))
    even, own = (Preview(changed(small, appearance={"cap_levels": each}), static=NOTHING).render() for each in ((), levels))
    places = np.rint(project(small.view, rest_pins(small.geometry).caps_mm)).astype(int)
    np.testing.assert_allclose([own[v, u] / even[v, u] for u, v in places], levels, rtol=1e-6)


def test_an_absorbing_gel_takes_most_of_its_own_colour(small):
    color = changed(small, camera={"channels": "color"})
    clear, blue = (
        Preview(changed(color, gel={"absorption_per_mm": a}), static=NOTHING).render() for a in ((0.0, 0.0, 0.0), (0.02, 0.01, 0.0))
    )
    u, v = np.rint(project(small.view, rest_pins(small.geometry).caps_mm[0])).astype(int)
    kept = blue[v, u] / clear[v, u]
    way_mm = 2 * 20.0  # in and out of the gel, at least
    assert kept[2] == pytest.approx(1) and kept[1] < np.exp(-0.01 * 0.9 * way_mm)
    np.testing.assert_allclose(kept[0], kept[1] ** 2, rtol=1e-6)


def test_a_window_is_a_part_of_the_whole_frame(small):
    preview = Preview(small, window_px=(30, 20, 91, 77), static=NOTHING)
    np.testing.assert_allclose(preview.render(), Preview(small, static=NOTHING).render()[20:77, 30:91], atol=1e-6)


def test_the_static_layer_covers_the_gel(small):
    rng = np.random.default_rng(0)
    shine, cover = rng.uniform(0, 1, (100, 120, 3)), rng.uniform(0, 1, (100, 120))
    grayish = shine @ [0.212671, 0.715160, 0.072169]
    expected = grayish + (1 - cover) * Preview(small, static=NOTHING).render()
    np.testing.assert_allclose(Preview(small, static=(shine, cover)).render(), expected, atol=1e-6)


@pytest.mark.parametrize(("towards_mm", "seen"), [(-3.0, 0.5), (3.0, 1.0)])
def test_a_nearer_cap_hides_a_farther_one(small, evenly, towards_mm, seen):
    """Pin 1 (level 0.5) is put before, then behind pin 0 (level 1)."""
    levels = (1.0, 0.5, *[1.0] * 17)
    rest = rest_pins(small.geometry)
    state = moved(rest, 1, rest.caps_mm[0] - rest.caps_mm[1] + [0.0, 0.0, towards_mm])
    image = Preview(changed(small, appearance={"cap_levels": levels}), static=NOTHING).render(state)
    u, v = np.rint(project(small.view, rest.caps_mm[0])).astype(int)
    window_takes = 0.043
    assert image[v, u] == pytest.approx(seen * 0.8 / np.pi, rel=window_takes)


@pytest.mark.parametrize("channels", [pytest.param("mono", marks=pytest.mark.slow), "color"])
def test_calibration_finds_the_shading_of_a_frame(channels):
    """A frame drawn with a known shading gives that shading back."""
    spec = changed(plain(), pins={"rings": 4}, camera={"channels": channels}, appearance={"cap_levels": (), "cap_shapes": ()})
    rng, window, size = np.random.default_rng(2), (90, 40, 530, 460), 1 if channels == "mono" else 3
    known = Shading(rng.uniform(0.7, 1.3, (4, size)), rng.uniform(0.0, 0.2, (4, size)))
    preview = Preview(spec, window_px=window, static=NOTHING)
    found = preview.calibrate(Preview(spec, window_px=window, shading=known, static=NOTHING))
    gain, offset, skin = 0.0068, 0.0089, 0.00035  # errors by single precision; measured: 0.0062, 0.0081, 0.00031
    np.testing.assert_allclose(found.gain, known.gain, atol=gain)
    np.testing.assert_allclose(found.offset, known.offset, atol=offset)
    np.testing.assert_allclose(found.skin, 1, atol=skin)
    with pytest.raises(RenderError, match="window_px"):
        preview.calibrate(Preview(spec, static=NOTHING))


def test_calibration_is_not_biased_by_noise():
    """A frame whose light is right in the mean, and wrong by half in each pixel, gives gains that are right."""
    spec = changed(plain(), pins={"rings": 4}, camera={"channels": "mono"}, appearance={"cap_levels": (), "cap_shapes": ()})
    preview = Preview(spec, window_px=(90, 40, 530, 460), static=NOTHING)

    class Noisy:
        window_px = preview.window_px

        def render(self):
            light = Preview(spec, window_px=self.window_px, static=NOTHING).render()
            return light * np.random.default_rng(1).uniform(0, 2, light.shape).astype(np.float32)

    found = preview.calibrate(Noisy())
    ambient = found.offset.T  # of the caps' light
    tolerance = 0.04  # measured: 0.018; 0.67 with weights by the noisy light
    np.testing.assert_allclose((found.gain.T + ambient)[0, -2:], 1, atol=tolerance)


def test_calibration_finds_where_the_skin_is_shaded():
    spec = changed(plain(), pins={"rings": 4}, appearance={"cap_levels": (), "cap_shapes": ()})
    preview, feet = Preview(spec, static=NOTHING), rest_pins(spec.geometry).base_mm
    shade = np.ones_like(preview.calibrate(preview).skin)
    shade[: len(feet), 0] = 1 - 0.3 * np.exp(-np.sum((feet[:, :2] - [6.0, 2.0]) ** 2, axis=1) / (2 * 6.0**2))
    shaded = Preview(spec, static=NOTHING, shading=Shading(skin=shade))
    before = np.abs(preview.render() - shaded.render()).sum()
    preview.calibrate(shaded)
    left_over = 0.091  # a corner's gain is a mean over its surroundings; measured: 0.083
    assert np.abs(preview.render() - shaded.render()).sum() < left_over * before


def test_a_state_of_another_sensor_is_refused(small):
    rest = rest_pins(small.geometry)
    with pytest.raises(RenderError, match="19"):
        Preview(small, static=NOTHING).render(PinRest(rest.base_mm[:5], rest.axis[:5], rest.caps_mm[:5]))
