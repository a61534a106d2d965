"""Laws of what the camera sees besides the gel: mirrored LEDs, the ring's disc, specks."""

import numpy as np
import pytest
from plain_sensor import changed, plain

from scenes.sensor import RimSpec, SensorSpec, SpeckSpec
from twin.camera.projection import project
from twin.optics.direct_light import led_patches
from twin.optics.glass import ray_table
from twin.optics.static_layer import ACROSS, static_layer

WINDOW = (50, 20, 255, 225)
HALF = {"width_px": 320, "height_px": 240, "fx_px": 245.0, "fy_px": 245.0, "cx_px": 152.0, "cy_px": 124.0}
SPOT_PX = 0.05  # centroid of a glint of many pixels, each sampled ACROSS times each way


@pytest.fixture(scope="module")
def bare() -> SensorSpec:
    """LEDs and window alone, seen by a tilted, distorting camera: the housing is out of sight."""
    return changed(
        plain(),
        camera=HALF | {"tilt_x_deg": 3.0, "tilt_y_deg": -2.0, "k1": 0.4, "p1": 0.01},
        leds={"radius_mm": 12.0, "z_mm": -10.0, "size_mm": 2.0, "core_share": 0.0, "balance": (), "off": ()},
        housing={"aperture_radius_mm": 1000.0, "outer_radius_mm": 2000.0},
        appearance={"specks": ()},
    )


def seen_straight(spec: SensorSpec, points_mm: np.ndarray) -> np.ndarray:
    """Pixels of points that are seen through air alone."""
    return project(changed(spec, lens={"refractive_index": 1.0}, gel={"refractive_index": 1.0}).view, points_mm)


def outline_of(patch, plane_mm: float) -> np.ndarray:
    """Corners (4, 3) of a square light, mirrored in a plane."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ patch.half_mm
    return np.column_stack([patch.center_mm[:2] + square, np.full(4, 2 * plane_mm - patch.center_mm[2])])


def area_and_centroid(polygon: np.ndarray) -> tuple[float, np.ndarray]:
    """Of a closed polygon (K, 2)."""
    after = np.roll(polygon, -1, axis=0)
    twice = polygon[:, 0] * after[:, 1] - after[:, 0] * polygon[:, 1]
    return abs(twice.sum()) / 2, ((polygon + after) * twice[:, None]).sum(axis=0) / (3 * twice.sum())


def centroid(image: np.ndarray) -> np.ndarray:
    """Light-weighted, px of the raw frame."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(image * x).sum(), (image * y).sum()]) / image.sum() + WINDOW[:2]


def test_a_layer_is_computed_once_for_all_that_does_not_change_it(bare, monkeypatch):
    computed = []
    monkeypatch.setattr("twin.optics.static_layer.ray_table", lambda *given: computed.append(given) or ray_table(*given))
    window = (51, 20, 255, 225)  # one that no other test has asked for
    light, cover = static_layer(bare, window)
    hazy = changed(bare, gel={"haze": 0.3}, camera={"vignetting": 0.4}, appearance={"pin_albedo": (0.1, 0.1, 0.1)})
    for each in (bare, hazy):
        again, same = static_layer(each, window)
        assert np.array_equal(again, light) and np.array_equal(same, cover)
    assert len(computed) == 1
    again[:] = 0.0
    assert np.array_equal(static_layer(bare, window)[0], light), "who writes to a layer must not change it for others"
    with pytest.raises(ValueError, match="read-only"):
        cover[0, 0] = 0.5
    brighter, _ = static_layer(changed(bare, leds={"power": 2 * bare.leds.power}), window)
    assert len(computed) == 2 and light.max() > 0
    np.testing.assert_allclose(brighter, 2 * light, rtol=1e-5)


@pytest.mark.parametrize("face", ["back", "front"])
def test_a_glint_sits_where_the_mirrored_led_projects(bare, face):
    """One face alone reflects where the other parts equal indices; before the front then lies nothing but air."""
    index = bare.gel.refractive_index
    one = changed(bare, leds={"azimuth_deg": (40.0,)}, lens={"refractive_index": index if face == "back" else 1.0})
    light, _ = static_layer(one, WINDOW)
    plane_mm = one.lens.back_mm if face == "back" else one.lens.z_mm
    patch = led_patches(one.leds)[0]
    area_px, middle_px = area_and_centroid(seen_straight(one, outline_of(patch, plane_mm)))
    assert centroid(light[..., 0]) == pytest.approx(middle_px, abs=SPOT_PX)
    # Fresnel at the angle under which the mirrored LED is seen
    across, height = np.hypot(*patch.center_mm[:2]), 2 * plane_mm - patch.center_mm[2] + one.camera.distance_mm
    outside = np.arctan2(across, height)
    inside = np.arcsin(np.sin(outside) / index)
    s, p = np.sin(outside - inside) / np.sin(outside + inside), np.tan(outside - inside) / np.tan(outside + inside)
    over_the_square = 0.02  # relative: reflectance and pixels' size vary over it
    assert light[..., 0].sum() == pytest.approx(patch.radiance[0] * 0.5 * (s**2 + p**2) * area_px, rel=over_the_square)


def test_the_image_in_the_front_face_lies_between_its_place_in_air_and_none(bare):
    """A window lifts what is mirrored at its far side: it seems t / n deep, from nearly ahead."""
    one = changed(bare, leds={"azimuth_deg": (40.0,), "radius_mm": 3.0}, gel={"refractive_index": 4.0})
    thick = changed(one, lens={"z_mm": 0.0, "thickness_mm": 4.0})
    only_back = changed(thick, gel={"refractive_index": thick.lens.refractive_index})
    both, back = (static_layer(spec, WINDOW)[0][..., 0] for spec in (thick, only_back))
    seems_mm = thick.lens.back_mm + thick.lens.thickness_mm / thick.lens.refractive_index
    _, expected_px = area_and_centroid(seen_straight(thick, outline_of(led_patches(thick.leds)[0], seems_mm)))
    paraxial_px = 0.2
    assert centroid(both - back) == pytest.approx(expected_px, abs=paraxial_px)


def test_a_dead_led_has_neither_glow_nor_glint():
    spec = changed(plain(), camera=HALF, housing={"ambient": 0.0})
    lit, dead = static_layer(spec, WINDOW)[0], static_layer(changed(spec, leds={"off": (2,)}), WINDOW)[0]
    without = static_layer(changed(spec, leds={"azimuth_deg": spec.leds.azimuth_deg[:2] + spec.leds.azimuth_deg[3:]}), WINDOW)[0]
    assert dead == pytest.approx(without, abs=1e-6)
    lost = (lit - dead)[..., 0]
    assert (lost > -1e-6).all() and lost.max() > 0.1
    towards = project(spec.view, np.array([[0.0, 0.0, spec.housing.z_mm]]))[0] - centroid(lost)
    assert np.degrees(np.arctan2(-towards[1], -towards[0])) % 360 == pytest.approx(spec.leds.azimuth_deg[2], abs=3)


def test_the_disc_is_the_aperture(sensor):
    """Cover is 0 within, 1 beyond and a share of the pixel on the rim only; the free area is that of the aperture's outline."""
    spec = changed(sensor, appearance={"specks": ()})
    window = (0, 0, spec.camera.width_px, spec.camera.height_px)
    _, cover = static_layer(spec, window)
    turn = np.linspace(0, 2 * np.pi, 721)[:-1]
    rim = np.array(spec.housing.center_mm) + spec.housing.aperture_radius_mm * np.column_stack([np.cos(turn), np.sin(turn)])
    outline = seen_straight(spec, np.column_stack([rim, np.full(len(rim), spec.housing.z_mm)]))
    area_px2, middle = area_and_centroid(outline)
    samples = np.sqrt(np.pi * np.sqrt(4 * area_px2 / np.pi)) / ACROSS  # errors of the rim's pixels add up at random
    assert (1 - cover).sum() == pytest.approx(area_px2, abs=4 * samples)
    y, x = np.mgrid[: cover.shape[0], : cover.shape[1]]
    away = np.hypot(x - middle[0], y - middle[1])
    radius = np.linalg.norm(outline - middle, axis=1)
    assert (cover[away < radius.min() - 1] == 0).all() and (cover[away > radius.max() + 1] == 1).all()
    assert ((cover > 0) & (cover < 1)).any()


def test_a_speck_hides_its_opacity_and_sends_its_light(bare):
    """At its middle; and in all, a soft disc that is full up to half its radius: 7/12 of a sharp one."""
    speck = SpeckSpec(x_mm=2.0, y_mm=-3.0, radius_mm=2.0, opacity=0.7, light=0.25)
    dark = changed(bare, leds={"off": tuple(range(6))}, appearance={"specks": (speck,)})
    light, cover = static_layer(dark, WINDOW)
    place = np.array([speck.x_mm, speck.y_mm, dark.lens.z_mm])
    at = np.rint(project(dark.view, place) - WINDOW[:2]).astype(int)
    assert cover[at[1], at[0]] == pytest.approx(speck.opacity, abs=1e-6)
    assert light[at[1], at[0]] == pytest.approx(speck.light, abs=1e-6)
    assert centroid(cover) == pytest.approx(project(dark.view, place), abs=SPOT_PX)
    turn = np.linspace(0, 2 * np.pi, 181)[:-1]
    rim = place + speck.radius_mm * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    area_px2, _ = area_and_centroid(project(dark.view, rim))
    over_the_disc = 0.01  # relative: distortion varies over it
    assert cover.sum() == pytest.approx(7 / 12 * speck.opacity * area_px2, rel=over_the_disc)


def test_overlapping_specks_multiply_their_transmittance(bare):
    speck = SpeckSpec(x_mm=0.0, y_mm=0.0, radius_mm=2.0, opacity=0.5)
    _, cover = static_layer(changed(bare, appearance={"specks": (speck, speck)}), WINDOW)
    assert cover.max() == pytest.approx(0.75, abs=1e-6)


def test_the_rims_light_stands_at_its_azimuth_and_radius(bare):
    """One entry of the table: its light, where its place of the housing's plane is seen, and nothing elsewhere."""
    azimuths, radii, lit = 12, 5, (2, 3)
    light = np.zeros((azimuths, radii, 3), int)
    light[lit] = 100, 200, 300
    ring = {"aperture_radius_mm": 12.0, "center_mm": (0.5, -0.3), "rim": RimSpec(inner_mm=9.0, outer_mm=11.0, light=light.tolist())}
    with_rim = changed(bare, housing=ring | {"outer_radius_mm": 2000.0}, leds={"mirror_share": 0.0})
    without = changed(with_rim, housing={"rim": None})
    more = static_layer(with_rim, WINDOW)[0] - static_layer(without, WINDOW)[0]
    angle, radius = 2 * np.pi * lit[0] / azimuths, 9.0 + 2.0 * lit[1] / (radii - 1)
    place = np.array([0.5 + radius * np.cos(angle), -0.3 + radius * np.sin(angle), bare.housing.z_mm])
    brightest = np.unravel_index(more[..., 1].argmax(), more.shape[:2])
    away_px = np.array(brightest[::-1]) + WINDOW[:2] - seen_straight(with_rim, place[None])[0]
    assert np.linalg.norm(away_px) < 1.5, "the peak is a ridge of pixels"
    assert more[brightest] == pytest.approx([0.1, 0.2, 0.3], rel=0.1)
    assert more.min() >= -1e-6 and (more[..., 1] > 1e-6).mean() < 0.05
