"""The elements of skin and gel obey the laws of elasticity."""

import numpy as np
import pytest
from block import LAWS, assembled, build_block, forces, loaded, material, rotation, stiffness_blocks
from scipy.sparse.linalg import spsolve

from scenes.load import load_sensor
from twin.geometry.shapes import Focus
from twin.geometry.solid import Resolution, build_solid
from twin.mechanics.body.elements import Elements, KeptStiffness
from twin.mechanics.body.material import distortion_stress, law_coefficients

UNEVEN = [0.0, 0.2, 0.5, 0.6, 1.0]
STRETCH = np.array([[1.2, 0.1, 0.0], [-0.05, 0.9, 0.2], [0.1, 0.0, 1.05]])
QUADRATURE_N = 2e-3  # of the sum of all forces: what 2x2x2 points leave on an inner control of a curved dome in a homogeneous stretch
DIFFERENCES = 1e-6  # relative: truncation and rounding of central differences
PLATE = 0.03  # relative: a strip 20 thicknesses long against plate theory


@pytest.fixture(scope="module")
def solid():
    return build_solid(load_sensor("mg400-331").geometry, resolution=Resolution(8), focus=Focus(0.3, 0.5))


@pytest.fixture(scope="module", params=["skin", "gel", "dome skin", "dome gel top", "dome gel"])
def body(request, solid):
    """Rest controls, cells and whether they are linear through the depth."""
    if request.param in ("skin", "gel"):
        block = build_block(request.param, breaks=UNEVEN, depths=[0, 0.3, 1], size_mm=(3, 2, 1))
        return block.control_mm, block.cells, request.param == "skin"
    cells = {"dome skin": solid.skin, "dome gel top": solid.gel_top, "dome gel": solid.gel_deep}[request.param]
    return solid.control_mm, cells, request.param == "dome skin"


@pytest.fixture(params=list(LAWS))
def law(request):
    return request.param


def elements_of(body, spec):
    return Elements(body[1], law_coefficients(spec, layer=body[2]))


def bent(rest, size=0.03):
    """A smooth, large bend and some noise."""
    x, y, z = (rest / np.ptp(rest, axis=0).max()).T
    smooth = np.column_stack([np.sin(2 * z) + y * x, np.cos(3 * x), x * z - y * y])
    scale = np.ptp(rest, axis=0).max()
    return rest + size * scale * smooth + 0.002 * np.random.default_rng(0).normal(size=rest.shape)


def given_stress(cells, size=0.05):
    stress = np.random.default_rng(1).normal(scale=size, size=(*cells.weights_mm3.shape, 3, 3))
    return stress + stress.swapaxes(2, 3)


# --- laws at a point


def density(spec, f):
    """The law as its docstring writes it."""
    c10, c01, c20, c30, kappa, _ = law_coefficients(spec, layer=False)
    j, c = np.linalg.det(f), f.T @ f
    i1 = j ** (-2 / 3) * np.trace(c)
    i2 = j ** (-4 / 3) * (np.trace(c) ** 2 - np.trace(c @ c)) / 2
    return c10 * (i1 - 3) + c01 * (i2 - 3) + c20 * (i1 - 3) ** 2 + c30 * (i1 - 3) ** 3 + kappa / 2 * (j - 1) ** 2


CUBE = build_block("gel")
"""A cube of volume 1, in which a homogeneous state is exact."""


def without_bulk(spec):
    """The cube's elements with the distortion part of the law alone."""
    return Elements(CUBE.cells, law_coefficients(spec, layer=False) * [1, 1, 1, 1, 0, 0])


def point(spec, f):
    """Energy and stress of the distortion part."""
    energy, force = forces(without_bulk(spec), CUBE.control_mm @ f.T)
    return energy, force.T @ CUBE.control_mm


def test_distortion_has_the_written_energy_its_gradient_and_its_curvature(law):
    spec = material(law)
    kappa = law_coefficients(spec, layer=False)[4]
    energy, stress = point(spec, STRETCH)
    assert energy == pytest.approx(density(spec, STRETCH) - kappa / 2 * (np.linalg.det(STRETCH) - 1) ** 2, rel=1e-12)
    at, step = CUBE.control_mm, 1e-6
    matrix = assembled([CUBE.cells.controls], [stiffness_blocks(without_bulk(spec), at @ STRETCH.T)], len(at))
    assert np.abs(STRETCH @ distortion_stress(law_coefficients(spec, layer=False), STRETCH) - stress).max() < 1e-12 * np.abs(stress).max()
    for i in range(3):
        for j in range(3):
            way = np.zeros((3, 3))
            way[i, j] = step
            (more, ahead), (less, behind) = point(spec, STRETCH + way), point(spec, STRETCH - way)
            assert stress[i, j] == pytest.approx((more - less) / (2 * step), abs=1e-8)
            curve = (matrix @ (at @ (way / step).T).ravel()).reshape(-1, 3).T @ at
            assert np.abs(curve - (ahead - behind) / (2 * step)).max() < 1e-8


def test_distortion_doesn_t_feel_a_change_of_volume(law):
    spec = material(law)
    energy, stress = point(spec, STRETCH)
    for scale in (0.8, 1.3):
        scaled, scaled_stress = point(spec, scale * STRETCH)
        assert scaled == pytest.approx(energy, rel=1e-12)
        assert np.allclose(scale * scaled_stress, stress, rtol=1e-12)
    assert abs((stress * STRETCH).sum()) < 1e-12  # no pressure


def test_distortion_is_blind_to_rotation_and_direction(law):
    spec, turn = material(law), rotation([1, -2, 0.5], 1.0)
    energy, stress = point(spec, STRETCH)
    turned, turned_stress = point(spec, turn @ STRETCH)
    assert turned == pytest.approx(energy, rel=1e-12)
    assert np.allclose(turned_stress, turn @ stress)
    assert point(spec, STRETCH @ turn)[0] == pytest.approx(energy, rel=1e-12)


def test_laws_without_their_own_parameters_are_neo_hookean():
    plain = law_coefficients(material(), layer=False)
    for own in ({"law": "mooney-rivlin", "second_invariant_share": 0.0}, {"law": "yeoh", "c20_c10": 0.0, "c30_c10": 0.0}):
        assert np.array_equal(law_coefficients(material(**own), layer=False), plain)
    assert not np.array_equal(law_coefficients(material("mooney-rivlin"), layer=False), plain)


# --- energy, forces, stiffness


@pytest.mark.parametrize("loaded", [False, True])
def test_forces_are_the_gradient_of_the_energy(body, law, loaded):
    elements, at = elements_of(body, material(law)), bent(body[0])
    extra = {"given": given_stress(body[1]), "pressure_mpa": 0.3} if loaded else {}
    energy, force = forces(elements, at, **extra)
    assert np.isfinite(energy)
    generator, step = np.random.default_rng(2), 1e-5
    for _ in range(3):
        way = generator.normal(size=at.shape)
        slope = (forces(elements, at + step * way, **extra)[0] - forces(elements, at - step * way, **extra)[0]) / (2 * step)
        assert slope == pytest.approx((force * way).sum(), abs=DIFFERENCES * np.linalg.norm(force) * np.linalg.norm(way))


@pytest.mark.parametrize("loaded", [False, True])
def test_stiffness_is_the_derivative_of_the_forces_and_symmetric(body, law, loaded):
    elements, at = elements_of(body, material(law)), bent(body[0])
    extra = {"given": given_stress(body[1]), "pressure_mpa": 0.3} if loaded else {}
    matrix = assembled([body[1].controls], [stiffness_blocks(elements, at, **extra)], len(at))
    largest = np.abs(matrix).max()
    assert np.abs(matrix - matrix.T).max() < 1e-12 * largest
    way, step = np.random.default_rng(3).normal(size=at.shape), 1e-6
    change = (forces(elements, at + step * way, **extra)[1] - forces(elements, at - step * way, **extra)[1]) / (2 * step)
    product = (matrix @ way.ravel()).reshape(-1, 3)
    assert np.abs(product - change).max() < DIFFERENCES * np.abs(product).max()


def test_forces_add_to_what_is_there_and_balance(body, law):
    elements, at = elements_of(body, material(law)), bent(body[0])
    _, force = forces(elements, at, given=given_stress(body[1]), pressure_mpa=0.2)
    twice = force.copy()
    loaded(elements, given_stress(body[1])).add_forces(at, twice, 0.2)
    size = np.abs(force).sum()
    assert np.abs(twice - 2 * force).max() < 1e-12 * size
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * size
    assert np.abs(np.cross(at, force).sum(axis=0)).max() < 1e-12 * size * np.abs(at).max()


def test_rigid_motion_costs_nothing_and_turns_the_forces(body, law):
    elements, turn, shift = elements_of(body, material(law)), rotation([1, 2, -1], 2.0), [3.0, -1.0, 2.0]
    scale = np.abs(forces(elements, bent(body[0]))[1]).max()
    energy, force = forces(elements, body[0] @ turn.T + shift)
    assert abs(energy) < 1e-12 * scale
    assert np.abs(force).max() < 1e-12 * scale
    at, given = bent(body[0]), given_stress(body[1])
    energy, force = forces(elements, at, given=given, pressure_mpa=0.2)
    turned_energy, turned = forces(elements, at @ turn.T + shift, given=given, pressure_mpa=0.2)
    assert turned_energy == pytest.approx(energy, rel=1e-10)
    assert np.abs(turned - force @ turn.T).max() < 1e-10 * scale


def test_the_given_stress_that_is_the_law_s_own_gives_the_law_s_own_forces(body, law):
    """Distortion's stress S = F^-1 P, given as S : C / 2 to elements without a law, acts as P."""
    spec, at = material(law), bent(body[0])
    elements = elements_of(body, spec)
    weights = elements.law * [1, 1, 1, 1, 0, 0]
    own = forces(Elements(body[1], weights), at)[1]
    given, _ = elements.relaxing_stress(at)
    assert np.abs(given - given.swapaxes(2, 3)).max() < 1e-12
    assert np.abs(forces(Elements(body[1], 0 * weights), at, given=given)[1] - own).max() < 1e-12 * np.abs(own).sum()


def test_volume_has_its_gradient_and_a_stretch_s_value(body):
    elements, at, step = elements_of(body, material()), bent(body[0]), 1e-5
    grown, way = np.zeros_like(at), np.random.default_rng(0).normal(size=at.shape)
    elements.add_volume(at, grown)
    slope = (elements.add_volume(at + step * way, np.zeros_like(at)) - elements.add_volume(at - step * way, np.zeros_like(at))) / (2 * step)
    assert slope == pytest.approx((grown * way).sum(), rel=1e-6)
    volume = body[1].weights_mm3.sum()
    assert elements.add_volume(body[0] @ STRETCH.T, np.zeros_like(at)) == pytest.approx((np.linalg.det(STRETCH) - 1) * volume, rel=1e-10)


def test_an_element_inside_out_is_noticed(body):
    elements = elements_of(body, material())
    crushed = body[0].copy()
    crushed[body[1].controls[0]] = -crushed[body[1].controls[0]]
    mirrored = body[0] * [1, 1, -1]
    for wrong in (crushed, mirrored):
        assert forces(elements, wrong)[0] == np.inf


def test_a_body_inside_out_at_rest_is_refused():
    with pytest.raises(ValueError, match="inside out"):
        build_block("gel", place=lambda at: at * [1, 1, -1])


# --- homogeneous states


@pytest.mark.parametrize("kind", ["skin", "gel"])
@pytest.mark.parametrize("sheared", [False, True])
def test_patch_a_homogeneous_stretch_is_in_equilibrium_and_has_the_exact_energy(kind, law, sheared):
    spec = material(law)
    rest = np.array([[1, 0.3, 0.2], [-0.1, 0.8, 0], [0.1, 0.2, 1.3]]) if sheared else np.eye(3)
    block = build_block(kind, breaks=UNEVEN, depths=[0, 0.2, 0.7, 1], size_mm=(3, 2, 1), place=lambda at: at @ rest.T)
    energy, force = forces(block.elements(spec), block.control_mm @ STRETCH.T + [1, 2, 3])
    assert energy == pytest.approx(6 * np.linalg.det(rest) * density(spec, STRETCH), rel=1e-12)
    assert block.inner.any()
    assert np.abs(force[block.inner]).max() < 1e-12 * np.abs(force).sum()


def test_patch_the_dome_s_stretch_has_the_exact_energy_and_nearly_balances(solid, law):
    spec = material(law)
    total, energy = np.zeros_like(solid.control_mm), 0.0
    for cells, layer in ((solid.skin, True), (solid.gel_top, False), (solid.gel_deep, False)):
        stored, force = forces(Elements(cells, law_coefficients(spec, layer=layer)), solid.control_mm @ STRETCH.T)
        total += force
        energy += stored
        assert stored == pytest.approx(cells.weights_mm3.sum() * density(spec, STRETCH), rel=1e-10)
    inner = ~solid.fixed
    inner[: solid.inner.start] = False  # the outside is loaded
    assert np.abs(total[inner]).max() < QUADRATURE_N * np.abs(total).sum()


@pytest.mark.parametrize("kind", ["skin", "gel"])
def test_small_stretch_has_the_young_modulus_and_poisson_ratio(kind, law):
    block = build_block(kind, breaks=UNEVEN, size_mm=(3, 2, 1))
    strain, spec = 1e-6, material(law)
    moved = block.control_mm * [1 + strain, 1 - 0.47 * strain, 1 - 0.47 * strain]
    force = forces(block.elements(spec), moved)[1]
    pull = force[block.control_mm[:, 0] > 3 - 1e-9, 0].sum()
    assert pull == pytest.approx(0.7 * strain * 2, rel=1e-4)
    assert np.abs(force[:, 1:]).max() < 1e-4 * pull


@pytest.mark.parametrize("kind", ["skin", "gel"])
def test_nothing_but_rigid_motion_is_without_stiffness(kind):
    """Not so in a lone element, which has fewer points than motions: what joins the elements stiffens them."""
    block = build_block(kind, breaks=UNEVEN)
    matrix = assembled([block.cells.controls], [stiffness_blocks(block.elements(material()), block.control_mm)], len(block.control_mm))
    values = np.linalg.eigvalsh(matrix.toarray())
    assert np.abs(values[:6]).max() < 1e-12 * values[-1]
    assert values[6] > 1e-6 * values[-1]


# --- bending


def end_deflection(block, elements, pull):
    """Mean motion along ``pull`` (3,) of the end x = length under 1 N spread over it, the other end clamped, no motion along y."""
    matrix = assembled([elements.cells.controls], [stiffness_blocks(elements, block.control_mm)], len(block.control_mm))
    free = np.ones((*block.index.shape, 3), bool)
    free[:, :, 0] = False
    free[..., 1] = False
    at, weights = block.basis.gauss(2)
    share = np.einsum("qc,q->c", block.basis.values(at.ravel()), weights.ravel())
    at, weights = block.through.gauss(2)
    deep = np.einsum("qc,q->c", block.through.values(at.ravel()), weights.ravel())
    load = np.zeros((*block.index.shape, 3))
    load[:, :, -1] = np.multiply.outer(np.outer(deep / deep.sum(), share / share.sum()), pull)
    keep = np.flatnonzero(free)
    moved = spsolve(matrix[keep][:, keep].tocsc(), load.ravel()[keep])
    return float(moved @ load.ravel()[keep])


DEPTHS = {"skin": (0, 1), "gel": (0, 0.5, 1)}
"""Ends of the elements through a layer that is bent: one layer of the skin's kind, two of the gel's, of which one alone is up to 10 % too
soft (``material._LARGEST_DIFFERENCE``)."""


def plate_stiffness(spec, thickness_mm):
    """E t^3 / 12 (1 - nu^2), N mm per unit of width."""
    return spec.young_modulus_mpa * thickness_mm**3 / (12 * (1 - spec.poisson_ratio**2))


@pytest.mark.parametrize("kind", ["skin", "gel"])
@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.47, 0.4999])
def test_a_thin_layer_bends_like_a_plate(kind, poisson):
    """No shear, membrane or volumetric locking, and no thickness locking in linear layers."""
    length, width, thickness = 20.0, 4.0, 1.0
    block = build_block(kind, breaks=np.linspace(0, 1, 13), depths=DEPTHS[kind], size_mm=(length, width, thickness))
    spec = material(poisson=poisson)
    shear_mpa = spec.young_modulus_mpa / (2 * (1 + poisson))
    bend = length**3 / (3 * plate_stiffness(spec, thickness) * width)
    slide = length / (5 / 6 * shear_mpa * thickness * width)
    assert end_deflection(block, block.elements(spec), [0, 0, 1]) == pytest.approx(bend + slide, rel=PLATE)


@pytest.mark.parametrize("kind", ["skin", "gel"])
@pytest.mark.parametrize("poisson", [0.3, 0.4999])
def test_a_quarter_of_a_ring_bends_like_a_curved_beam(kind, poisson):
    """Castigliano: a radial force P at the free end moves it by pi P R^3 / 4 D b."""
    radius, width, thickness = 20.0, 4.0, 1.0

    def ring(at):
        angle, r = np.pi / 2 * at[:, 0], radius + thickness / 2 + at[:, 2]
        return np.column_stack([r * np.sin(angle), at[:, 1], r * np.cos(angle)])

    block = build_block(kind, breaks=np.linspace(0, 1, 13), depths=DEPTHS[kind], size_mm=(1, width, thickness), place=ring)
    spec = material(poisson=poisson)
    wanted = np.pi * radius**3 / (4 * plate_stiffness(spec, thickness) * width)
    assert end_deflection(block, block.elements(spec), [1, 0, 0]) == pytest.approx(wanted, rel=PLATE)


@pytest.mark.parametrize("kind", ["skin", "gel"])
def test_no_volumetric_locking_in_bending(kind):
    """At equal shear modulus a plate bends 1 / (1 - nu) times as hard; an element that locks, hundreds of times."""
    block = build_block(kind, breaks=np.linspace(0, 1, 9), depths=DEPTHS[kind], size_mm=(10, 4, 1))
    moved = [end_deflection(block, block.elements(material(young_mpa=2 * (1 + nu), poisson=nu)), [0, 0, 1]) for nu in (0.3, 0.4999)]
    assert moved[0] / moved[1] == pytest.approx((1 - 0.3) / (1 - 0.4999), rel=0.03)


# --- blocks that are kept


def test_kept_stiffness_is_made_anew_where_the_body_has_changed_and_nowhere_else(body):
    elements, rest = elements_of(body, material()), body[0]
    kept = KeptStiffness(elements, 0.01)
    kept.update(elements, rest, 0.0, fresh=False)
    first = kept.blocks.copy()
    near = {"rtol": 1e-5, "atol": 1e-6 * np.abs(first).max()}
    assert np.allclose(first, stiffness_blocks(elements, rest), **near)
    one = len(first) // 2 + 2  # amid the skin
    corner = elements.cells.controls[one, 0]
    moved = rest.copy()
    moved[corner] += 0.2 * np.ptp(rest[elements.cells.controls[one]], axis=0).min()
    touched = (elements.cells.controls == corner).any(axis=1)
    kept.update(elements, moved, 0.0, fresh=False)
    exact = stiffness_blocks(elements, moved)
    assert np.array_equal(kept.blocks[~touched], first[~touched])
    assert np.allclose(kept.blocks[one], exact[one], **near) and not np.allclose(kept.blocks[one], first[one], **near)
    slightly = rest + 1e-3 * (moved - rest)
    kept.update(elements, rest, 0.0, fresh=True)
    kept.update(elements, slightly, 0.0, fresh=False)
    assert np.array_equal(kept.blocks, first)
    kept.update(elements, slightly, 0.0, fresh=True)
    assert not np.array_equal(kept.blocks[one], first[one])


def test_kept_stiffness_follows_a_changed_pressure_law_or_stress(body):
    elements, rest = elements_of(body, material()), body[0]
    other = elements_of(body, material(young_mpa=1.4))
    kept, given = KeptStiffness(elements, 0.01), loaded(other, given_stress(elements.cells))
    for kind, pressure in ((elements, 0.0), (elements, 0.2), (other, 0.2), (given, 0.2)):
        kept.update(kind, rest, pressure, fresh=False)
        exact = stiffness_blocks(kind, rest, pressure_mpa=pressure)
        assert np.allclose(kept.blocks, exact, rtol=1e-5, atol=1e-6 * np.abs(exact).max())
