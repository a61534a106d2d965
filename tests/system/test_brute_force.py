"""The renderer's window, against Mitsuba's own path tracer through real interfaces.

Both are unbiased estimates of the same light: over independent batches their differences must be noise. And the test must
be able to fail: the same comparison refuses a renderer with one thing wrong.
"""

import numpy as np
import pytest
from brute_force import BLOCK_PX, blocks, changed, laboratory, reference, z_scores
from scipy import stats

from twin.camera.projection import window_tangent
from twin.geometry.pins import rest_pins
from twin.optics.glass import Window
from twin.optics.render import Renderer
from twin.optics.static_layer import ACROSS
from twin.optics.variant import use_variant

BOUNCES = 6  # of the bright laboratory: what a seventh brings is below the noise
CHANCE = 1e-3  # of refusing a right renderer, by blocks or in total
OURS = {"batches": 8, "spp": 64}
SMALL = {"size_px": 24, "batches": 12, "spp": 144}  # 7 s; total known to 0.4 %
LARGE = {"size_px": 48, "batches": 12, "spp": 400}  # two minutes; total known to 0.15 %
MIRRORED = {"size_px": 48, "batches": 12, "spp": 256}
EDGES = 0.01  # relative, of the mirror images' total
ABSORPTION = 0.03  # 1/mm


def renderer(spec) -> Renderer:
    """One of a vectorised variant: the scalar one does without the window."""
    made = Renderer(spec, spp=OURS["spp"], bounces=BOUNCES)
    if made.choice.backend == "scalar":
        pytest.skip("the scalar variant only approximates the window")
    return made


def our_batches(spec) -> np.ndarray:
    """Independent images (batches, size, size)."""
    made = renderer(spec)
    return np.stack([made.render(seed=k) for k in range(OURS["batches"])])


def their_batches(spec, batches: int, spp: int) -> np.ndarray:
    """The same by Mitsuba's path tracer."""
    made = renderer(spec)
    mi, surfaces = use_variant(made.choice), made.surfaces(made._rest)
    return np.stack([reference(mi, spec, surfaces, spec.camera.width_px, spp, seed=k) for k in range(batches)])


def chances(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, float]:
    """How probable differences at least as large would be for equal light: by blocks (chi-square), and in total (Welch's t)."""
    z = z_scores(blocks(ours), blocks(theirs))
    total = z_scores(ours.mean(axis=(1, 2)), theirs.mean(axis=(1, 2)))
    return float(stats.chi2.sf(np.sum(z**2), z.size)), float(2 * stats.norm.sf(abs(total)))


@pytest.fixture(scope="module", params=[SMALL, LARGE], ids=["small", "large"])
def compared(request):
    """The laboratory, and Mitsuba's images of it."""
    size, batches, spp = request.param.values()
    spec = laboratory(size)
    return spec, their_batches(spec, batches, spp)


@pytest.mark.slow
def test_the_light_is_that_of_plain_path_tracing(compared):
    spec, theirs = compared
    ours = our_batches(spec)
    print(f"{spec.camera.width_px} px: total {ours.mean() / theirs.mean() - 1:+.3%}, chances {chances(ours, theirs)}")
    assert min(chances(ours, theirs)) > CHANCE


def all_passes(spec, patch):
    """A window without Fresnel's losses."""
    patch.setattr(Window, "transmittance", lambda self, dr, *cosines: cosines[0] * 0 + 1)
    return spec


def nothing_comes_back(spec, patch):
    """A window that does not reflect what comes from the gel."""
    patch.setattr(Window, "mirror", lambda self, dr, mi, place, way, choice: (place, mi.Vector3f(way.x, way.y, -way.z), mi.Float(0)))
    return spec


def another_index(spec, patch):
    """A gel of another index."""
    return changed(spec, gel={"refractive_index": spec.gel.refractive_index + 0.05})


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [all_passes, nothing_comes_back, another_index])
def test_the_comparison_sees_what_is_wrong(compared, wrong, monkeypatch):
    spec, theirs = compared
    ours = our_batches(wrong(spec, monkeypatch))
    print(f"{wrong.__name__}: total {ours.mean() / theirs.mean() - 1:+.3%}, chances {chances(ours, theirs)}")
    assert min(chances(ours, theirs)) < CHANCE


@pytest.mark.slow
def test_the_mirror_images_alone_are_those_of_plain_path_tracing():
    """Nothing but black in the gel: what is seen are the LEDs in both faces of the window.

    The static layer finds their edges to the fourth of a pixel, once: a block may differ by what a strip of that width along
    the image's sides is worth, and by noise.
    """
    size, batches, spp = MIRRORED.values()
    black = (0.0, 0.0, 0.0)
    spec = changed(
        laboratory(size),
        leds={"radius_mm": 7.0, "size_mm": 4.0, "azimuth_deg": (12.0, 130.0, 250.0)},
        appearance={"skin_albedo": black, "pin_albedo": black, "cap_albedo": black, "skin_gloss": 0.0},
    )
    ours, theirs = blocks(renderer(spec).render()), blocks(their_batches(spec, batches, spp))
    strip = ours.max() / ACROSS / BLOCK_PX * 0.5
    noise = theirs.std(axis=0, ddof=1) / np.sqrt(batches)
    print(f"mirror images: total {ours.mean() / theirs.mean() - 1:+.3%}, worst {np.abs(ours - theirs.mean(axis=0)).max() / ours.max():.3%}")
    assert (np.abs(ours - theirs.mean(axis=0)) < strip + 4 * noise).all()
    assert ours.mean() == pytest.approx(theirs.mean(), rel=EDGES)
    assert np.count_nonzero(ours > 0.5 * ours.max()) >= 3, "the images are not on the film"


def test_gel_absorbs_as_beer_and_lambert_say():
    """Light of one scattering at the tip: its way from the window and back is known, whatever else happens to it."""
    black = (0.0, 0.0, 0.0)
    clear = changed(laboratory(24), leds={"size_mm": 0.5}, appearance={"skin_albedo": black, "pin_albedo": black, "skin_gloss": 0.0})
    murky = changed(clear, gel={"absorption_per_mm": (ABSORPTION,) * 3})
    light = []
    for spec in (clear, murky):
        made = Renderer(spec, spp=256, bounces=0)
        if made.choice.backend == "scalar":
            pytest.skip("the scalar variant has no absorption")
        light.append(made.render()[11:13, 11:13].mean())
    top = rest_pins(clear.geometry).caps_mm[0, 2] - 0.5 * clear.pins.cap_height_mm
    u = window_tangent(clear.view, np.array(clear.leds.radius_mm), np.array(top), behind_mm=clear.leds.z_mm)
    cos_gel = np.sqrt(1 - u**2 / (1 + u**2) / clear.gel.refractive_index**2)
    height = top - clear.lens.z_mm
    across_the_pixels = 2e-3  # relative: ways differ over the tip's four pixels
    assert light[1] / light[0] == pytest.approx(np.exp(-ABSORPTION * height * (1 + 1 / cos_gel)), rel=across_the_pixels)
