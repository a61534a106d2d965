"""Laws of the window between air and gel: Snell, Fermat, conserved flux, total reflection; and of the samples' numbers."""

import numpy as np
import pytest
from scipy.optimize import minimize

from scenes import load_sensor
from twin.optics.glass import Window
from twin.optics.sampling import PixelSamples
from twin.optics.variant import choose_variant, use_variant

SINGLE = 2e-5  # relative: single precision through a dozen operations
GRAZING_DEG = 80.0  # in air; beyond, little light passes and Newton's few steps serve no purpose
STEPS_RAD = 2e-4  # what Newton's few steps leave of a direction up to there


@pytest.fixture(scope="module")
def jit():
    """Mitsuba and Dr.Jit, in a vectorised mono variant."""
    choice = choose_variant("mono")
    if choice.backend == "scalar":
        pytest.skip("the scalar variant does without this window")
    mi = use_variant(choice)
    import drjit as dr

    return mi, dr


@pytest.fixture(scope="module")
def window() -> Window:
    return Window(load_sensor("mg400-331").view)


def gel_points(count: int = 300) -> np.ndarray:
    """Places (n, 3) in the gel."""
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-12, 12, (count, 2)), rng.uniform(0, 17, count)])


def connected(jit, window: Window, points: np.ndarray, light: np.ndarray):
    """Direction (n, 3), length (n,) and factor (n,) as numpy arrays."""
    mi, dr = jit
    toward, length, factor = window.connect(dr, mi.Point3f(points.T.astype(np.float32)), mi.Point3f(light.T.astype(np.float32)))
    return np.stack([np.array(each) for each in toward], axis=1), np.array(length), np.array(factor)


def optical_mm(window: Window, point: np.ndarray, light: np.ndarray, crossings: np.ndarray) -> float:
    """Length times index of the broken line from a point to a light; crossings (4,): x, y at the gel side and at the back."""
    front, back = np.append(crossings[:2], window.front), np.append(crossings[2:], window.back)
    legs = (point - front, window.gel_index), (front - back, window.window_index), (back - light, 1.0)
    return sum(np.linalg.norm(leg) * index for leg, index in legs)


def in_air(window: Window, cos_air: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines in air, window and gel of one ray."""
    sine2 = 1 - cos_air**2
    return cos_air, np.sqrt(1 - sine2 / window.window_index**2), np.sqrt(1 - sine2 / window.gel_index**2)


def test_the_way_to_a_light_is_the_quickest(jit, window):
    """Fermat: where the way leaves the gel is where a minimiser puts it, for LEDs near and far."""
    points = gel_points(12)
    light = np.tile([11.0, -4.0, -5.0], (len(points), 1))
    toward, length, _ = connected(jit, window, points, light)
    for point, end, way, far in zip(points, light, toward, length, strict=True):
        start = np.tile(0.5 * (point + end)[:2], 2)
        least = minimize(lambda at, p=point, e=end: optical_mm(window, p, e, at), start, method="BFGS", options={"gtol": 1e-9})
        found_mm = 2e-3  # a minimum is flat
        assert (point + way * far)[:2] == pytest.approx(least.x[:2], abs=found_mm)


def test_the_way_obeys_snell_at_both_faces(jit, window):
    """Followed on from the gel by Snell's law, it meets the light."""
    points = gel_points()
    light = np.column_stack([gel_points()[::-1, :2], np.full(len(points), -5.0)])
    toward, length, _ = connected(jit, window, points, light)
    assert np.linalg.norm(toward, axis=1) == pytest.approx(1, abs=SINGLE)
    across, place = toward[:, :2] * window.gel_index, (points + toward * length[:, None])[:, :2]
    for index, height in ((window.window_index, window.front - window.back), (1.0, window.back + 5.0)):
        sine = across / index
        place = place + sine / np.sqrt(1 - np.sum(sine**2, axis=1, keepdims=True)) * height
    missed_mm = 5e-3
    assert np.abs(place - light[:, :2]).max() < missed_mm


def test_a_ray_followed_inwards_is_found_again_outwards(jit, window):
    """`enter` and `connect` are each other's inverse, and agree on what the window lets through."""
    mi, dr = jit
    polar = np.radians(np.linspace(0, GRAZING_DEG, 40))
    direction = np.column_stack([np.sin(polar), 0 * polar, np.cos(polar)])
    origin = np.tile([1.0, 2.0, -5.0], (len(polar), 1))
    place, inward, through = window.enter(dr, mi, mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(direction.T.astype(np.float32)))
    place, inward, through = np.array(place).T, np.array(inward).T, np.array(through)
    assert np.hypot(inward[:, 0], inward[:, 1]) * window.gel_index == pytest.approx(np.sin(polar), abs=SINGLE)
    toward, length, _ = connected(jit, window, place + inward * 9.0, origin)
    assert toward == pytest.approx(-inward, abs=STEPS_RAD)
    assert through == pytest.approx(window.transmittance(*in_air(window, np.cos(polar))), rel=SINGLE)


@pytest.mark.parametrize("height_mm", [0.5, 10.0])
def test_a_bright_sky_lights_the_gel_with_what_the_window_lets_through(jit, window, height_mm):
    """A plane of radiance 1 in the air fills the hemisphere: the irradiance in the gel is the flux that passes,

    pi times the transmittance averaged over the hemisphere with the cosine. The plane's rings are those that polar angles in air reach.
    """
    nodes, weights = np.polynomial.legendre.leggauss(400)
    cos_air = np.cos(polar := np.pi / 4 * (nodes + 1))
    expected = 2 * np.pi * np.sum(weights * np.pi / 4 * np.sin(polar) * cos_air * window.transmittance(*in_air(window, cos_air)))
    sky = window.back - 5.0
    rho = np.tan(polar) * (window.front - sky + height_mm)
    ring_mm2 = 2 * np.pi * rho * weights * np.pi / 4 * (window.front - sky + height_mm) / cos_air**2
    point = np.tile([0.0, 0.0, window.front + height_mm], (len(rho), 1))
    toward, _, factor = connected(jit, window, point, np.column_stack([rho, 0 * rho, np.full_like(rho, sky)]))
    few_steps = 2e-3  # relative: Newton's last digits at grazing angles
    assert np.sum(factor * -toward[:, 2] * ring_mm2) == pytest.approx(expected, rel=few_steps)
    assert 0.85 * np.pi < expected < np.pi


def test_the_factor_is_the_solid_angle_in_the_gel(jit, window):
    """By finite differences of directions in double precision: d omega / d area, times transmittance and n^2."""
    points, step = gel_points(50), 0.05
    light = np.tile([9.0, 3.0, -5.0], (len(points), 1))
    moved = [connected(jit, window, points, light + np.array(s) * step)[0] for s in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))]
    along_x, along_y = ((moved[k] - moved[k + 1]).astype(float) / (2 * step) for k in (0, 2))
    toward, _, factor = connected(jit, window, points, light)
    solid = np.abs(np.sum(np.cross(along_x, along_y) * toward, axis=1))
    sine = np.hypot(toward[:, 0], toward[:, 1]).astype(float) * window.gel_index
    differences = 3e-3  # relative: of single-precision directions
    expected = solid * window.gel_index**2 * window.transmittance(*in_air(window, np.sqrt(1 - sine**2)))
    assert factor == pytest.approx(expected, rel=differences, abs=differences * 0.01 * float(factor.max()))


def test_what_is_not_let_through_is_reflected(jit, window):
    """Both ways: a slab has the same transmittance from either side."""
    mi, dr = jit
    cos_air, _, cos_gel = in_air(window, np.cos(np.radians(np.linspace(0, 89, 60))))
    _, _, weight = mirrored(jit, window, cos_gel, np.zeros(60))
    assert weight + window.transmittance(*in_air(window, cos_air)) == pytest.approx(1, abs=20 * SINGLE)


def mirrored(jit, window: Window, cos_gel: np.ndarray, choice: np.ndarray):
    """Rays from (0, 0) of the gel side, with x ahead, mirrored: places (n, 3), directions (n, 3), weights (n,)."""
    mi, dr = jit
    down = np.stack([np.sqrt(1 - cos_gel**2), 0 * cos_gel, -cos_gel]).astype(np.float32)
    place = mi.Point3f(np.tile([[0.0], [0.0], [window.front]], len(cos_gel)).astype(np.float32))
    place, back, weight = window.mirror(dr, mi, place, mi.Vector3f(down), mi.Float(choice.astype(np.float32)))
    return np.array(place).T, np.array(back).T, np.array(weight)


def test_beyond_the_critical_angle_all_is_reflected(jit, window):
    critical = np.arcsin(1 / window.gel_index)
    below, beyond = (np.cos(np.linspace(*ends, 30)) for ends in ((0, critical - 1e-3), (critical + 1e-3, np.pi / 2 - 1e-2)))
    assert mirrored(jit, window, beyond, np.full(30, 0.5))[2] == pytest.approx(1, abs=SINGLE)
    assert (mirrored(jit, window, below, np.full(30, 0.5))[2] < 1).all()


def test_a_ray_from_the_back_face_comes_out_displaced(jit, window):
    """Both faces reflect in proportion to their shares; the one from the back has crossed the window twice."""
    cos_gel = np.full(2000, np.cos(0.4))
    place, back, weight = mirrored(jit, window, cos_gel, (np.arange(2000) + 0.5) / 2000)
    assert back[:, 2] == pytest.approx(cos_gel, abs=SINGLE) and back[:, 0] == pytest.approx(np.sin(0.4), abs=SINGLE)
    inside = np.arcsin(np.sin(0.4) * window.gel_index / window.window_index)
    displaced = place[:, 0] > 0
    assert place[displaced, 0] == pytest.approx(2 * np.tan(inside) * (window.front - window.back), rel=SINGLE)
    s = np.sin(0.4 - inside) / np.sin(0.4 + inside), np.tan(0.4 - inside) / np.tan(0.4 + inside)  # Fresnel's own forms
    assert 1 - displaced.mean() == pytest.approx(np.mean(np.square(s)) / weight[0], abs=1 / 2000)


@pytest.mark.parametrize("spp", [4, 16, 64])
def test_a_pixels_samples_are_stratified_in_every_way(jit, spp):
    """A (0, 2)-net: each box of area 1 / spp with sides that are powers of a half holds exactly one point; 1-d likewise."""
    mi, dr = jit
    pixels = 50
    number = dr.arange(mi.UInt32, pixels * spp)
    random = PixelSamples(mi, dr, number // spp, number % spp, spp, 7)
    for _ in range(5):
        line = np.array(random.next_1d()).reshape(pixels, spp)
        assert (np.sort((line * spp).astype(int), axis=1) == np.arange(spp)).all()
        points = np.array(random.next_2d()).T.reshape(pixels, spp, 2)
        for k in range(spp.bit_length()):
            wide = 2**k
            box = (points[..., 0] * wide).astype(int) + wide * (points[..., 1] * (spp // wide)).astype(int)
            assert (np.sort(box, axis=1) == np.arange(spp)).all()


def test_seeds_pixels_and_dimensions_are_uncorrelated(jit):
    """Correlations of the numbers of one draw with another's are those of chance."""
    mi, dr = jit
    spp, pixels = 4, 4000
    number = dr.arange(mi.UInt32, pixels * spp)
    draws = {}
    for seed in (0, 1):
        random = PixelSamples(mi, dr, number // spp, number % spp, spp, seed)
        draws |= {(seed, k): np.array(random.next_1d()) for k in range(4)}
    values = np.stack(list(draws.values()))
    neighbours = np.corrcoef(values[0], np.roll(values[0], spp))[0, 1]
    between = np.corrcoef(values)[np.triu_indices(len(values), 1)]
    chance = 5 / np.sqrt(pixels)  # correlations are over whole nets
    assert np.abs(np.append(between, neighbours)).max() < chance
    again = PixelSamples(mi, dr, number // spp, number % spp, spp, 0)
    assert (np.array(again.next_1d()) == draws[0, 0]).all()
