"""The furnace test through the whole renderer: in a white, closed enclosure under an even sky every pixel has the sky's radiance.

Skin, stems and caps reflect everything, and every way out of the gel leads through the window to a sky of radiance 1. Then light is in
equilibrium: it is n^2 in the gel and 1 in the air in every direction (Kirchhoff), whatever the window reflects at its faces. So the test
knows the answer of camera rays, refraction, Fresnel's losses, total reflection, scattering, shadows and mirror images together.
"""

import numpy as np
import pytest
from brute_force import BLOCK_PX, changed, laboratory
from scipy import stats

from scenes.sensor import SensorSpec
from twin.camera.capture import expose
from twin.optics import static_layer, tracer
from twin.optics.direct_light import Patch
from twin.optics.glass import Window
from twin.optics.render import Renderer

WHITE = (1.0, 1.0, 1.0)
SIZE_PX, SPP = 24, 196
BOUNCES = 30  # a quarter of the light leaves at each scattering: 0.75^30 = 2e-4 of it is left
SKY_MM = 100.0  # below the window
SKY_TANGENTS = (0.0, 0.5, 1.3, 4.0, 50.0)  # of the edges of its rings; beyond the last one 4e-4 of the sky is missing
THIN_MM = 1e-3  # window: light mirrored at its back comes back this far aside, so none leaves over the skin's rim
PINS_MM = 0.1  # thin: the smooth normals of their eight-sided stems point out of the facets and lose light (1.5 % of it with pins of 2 mm)
CHANCE = 1e-3  # of refusing a right renderer by its blocks
SYSTEMATIC = 2e-3  # relative: bounces and sky left out, and the skin's facets, whose smooth normals are not their own
SURE = 4.0  # standard errors
LEVELS = 0.5  # gray levels: rounding


def sky(spec: SensorSpec) -> list[Patch]:
    """Rings of radiance 1 below the window: each is sampled alone, so that near and far directions are equally well known."""
    center = np.array([0.0, 0.0, spec.lens.back_mm - SKY_MM])
    edges = SKY_MM * np.array(SKY_TANGENTS)
    return [Patch(center, np.zeros((2, 2)), np.array(radii), np.ones(3)) for radii in zip(edges[:-1], edges[1:], strict=True)]


@pytest.fixture(scope="module")
def furnace() -> SensorSpec:
    """A white sensor that is closed: the window begins at the skin's rim, caps are as wide as their stems."""
    return changed(
        laboratory(SIZE_PX),
        lens={"z_mm": 0.0, "radius_mm": 1000.0, "thickness_mm": THIN_MM},
        pins={"cap_diameter_mm": PINS_MM, "diameter_mm": PINS_MM},
        appearance={"skin_albedo": WHITE, "pin_albedo": WHITE, "cap_albedo": WHITE, "skin_gloss": 0.0},
    )


def image_of(spec: SensorSpec) -> np.ndarray:
    """Light (size, size); all pixels are independent estimates of one radiance."""
    made = Renderer(spec, spp=SPP, bounces=BOUNCES)
    if made.choice.backend == "scalar":
        pytest.skip("the scalar variant does without the window")
    with pytest.MonkeyPatch.context() as patch:
        for module in (tracer, static_layer):
            patch.setattr(module, "lights", lambda *_: sky(spec))
        return made.render(seed=0).astype(float)


@pytest.fixture(scope="module")
def image(furnace) -> np.ndarray:
    """Light of the furnace."""
    return image_of(furnace)


def off_by(image: np.ndarray) -> tuple[float, float]:
    """How far the mean is from the sky's radiance 1, and its standard error."""
    return float(image.mean() - 1), float(stats.sem(image, axis=None))


def test_in_a_furnace_every_pixel_has_the_skys_radiance(image):
    off, error = off_by(image)
    parts = image.reshape(SIZE_PX // BLOCK_PX, BLOCK_PX, -1, BLOCK_PX).swapaxes(1, 2).reshape(-1, BLOCK_PX**2)
    even = float(stats.f_oneway(*parts).pvalue)  # no place is brighter than another
    worst = np.abs(parts.mean(axis=1) - 1).max()
    print(f"furnace: {off:+.3%} +- {error:.3%} in total, {worst:.1%} at most by {BLOCK_PX} px, chance {even:.3f}")
    assert abs(off) < SYSTEMATIC + SURE * error
    assert even > CHANCE


def all_passes(self, dr, *cosines):
    """A window without Fresnel's losses on the camera's and the light's way, which still mirrors."""
    return cosines[0] * 0 + 1


def nothing_comes_back(self, dr, mi, place, direction, choice):
    """A window that does not reflect what comes from the gel."""
    return place, mi.Vector3f(direction.x, direction.y, -direction.z), mi.Float(0)


@pytest.mark.parametrize(
    ("method", "wrong"), [("mirror", nothing_comes_back), pytest.param("transmittance", all_passes, marks=pytest.mark.slow)]
)
def test_the_furnace_sees_what_is_wrong(furnace, monkeypatch, method, wrong):
    monkeypatch.setattr(Window, method, wrong)
    off, error = off_by(image_of(furnace))
    print(f"{wrong.__name__}: {off:+.2%} +- {error:.2%}")
    assert abs(off) > 5 * (SYSTEMATIC + SURE * error)


def test_the_furnaces_gray_level_is_the_linear_cameras(furnace, image):
    """With a linear response, haze, blur and sharpening an even picture stays even: gray is 255 times exposure times light."""
    camera = {"exposure": 0.5, "gamma": 1.0, "black_level": 0.0, "blur_sigma_px": 0.8, "sharpening": 0.5, "jpeg_quality": 0}
    spec = changed(furnace, response=camera, gel={"haze": 0.2, "haze_sigma_px": 5.0})
    even = expose(np.ones((SIZE_PX, SIZE_PX), np.float32), spec.capture)
    assert np.ptp(even) == 0 and abs(int(even[0, 0]) - 0.5 * 255) <= LEVELS
    _, error = off_by(image)
    gray = expose(image, spec.capture).astype(float)
    assert abs(gray.mean() - 0.5 * 255) < 0.5 * 255 * (SYSTEMATIC + SURE * error) + LEVELS / SIZE_PX
