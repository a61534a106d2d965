"""The elements obey the laws of elasticity, and the direct solver solves."""

import numpy as np
import pytest

from scenes.load import load_sensor
from twin.geometry.mesh import Resolution, build_mesh
from twin.mechanics.elements import elastic_energy, elastic_forces, elastic_stiffness, element_table, lame_constants
from twin.mechanics.linear import FrontalSolver, NotPositiveDefinite

CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)


@pytest.fixture(scope="module")
def mesh():
    return build_mesh(load_sensor("mg400-331"), resolution=Resolution(across=7, gel_layers=2))


@pytest.fixture(scope="module")
def table(mesh):
    stiff = np.where(mesh.material == 0, 1.0, 0.1)
    return element_table(mesh.nodes_mm, mesh.hexes, 0.3 * stiff, 4.0 * stiff)


@pytest.fixture
def bent(mesh):
    x, y, z = mesh.nodes_mm.T
    return mesh.nodes_mm + 0.02 * np.column_stack([z * np.sin(x / 9), x * y / 20, y * np.cos(z / 8)])


def patch():
    """A 2x2x2 block of distorted elements, its inner node off centre."""
    index = np.arange(27).reshape(3, 3, 3)
    nodes = np.stack(np.meshgrid(*[np.linspace(0, 2, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = [index[a : 2 + a, b : 2 + b, c : 2 + c].ravel() for a, b, c in CUBE.astype(int)]
    nodes[13] += [0.2, -0.15, 0.1]
    return nodes, np.stack(corners, axis=1)


def test_patch_a_homogeneous_stretch_is_in_equilibrium_and_has_the_exact_energy():
    nodes, hexes = patch()
    mu, lame = lame_constants(0.7, 0.47)
    table = element_table(nodes, hexes, np.full(8, mu), np.full(8, lame))
    f = np.array([[1.2, 0.1, 0.0], [-0.05, 0.9, 0.2], [0.1, 0.0, 1.05]])
    moved = nodes @ f.T
    j = np.linalg.det(f)
    density = mu / 2 * ((f * f).sum() - 3) - mu * np.log(j) + lame / 2 * (j - 1) ** 2
    assert elastic_energy(table, moved) == pytest.approx(8 * density, rel=1e-12)
    assert np.abs(elastic_forces(table, moved)[13]).max() < 1e-12


def test_small_stretch_has_the_young_modulus_and_poisson_ratio():
    mu, lame = lame_constants(0.7, 0.47)
    table = element_table(CUBE, np.arange(8)[None], np.array([mu]), np.array([lame]))
    strain = 1e-6
    moved = CUBE * [1 + strain, 1 - 0.47 * strain, 1 - 0.47 * strain]
    force = elastic_forces(table, moved)
    assert force[[1, 2, 5, 6], 0].sum() == pytest.approx(0.7 * strain, rel=1e-4)
    assert np.abs(force[:, 1:]).max() < 1e-4 * 0.7 * strain


def test_no_volumetric_locking_in_bending():
    """A nearly incompressible element resists an in-plane bending mode that keeps its volume with shear stiffness only."""
    bending = np.zeros((8, 3))
    bending[:, 0] = (CUBE[:, 0] - 0.5) * (CUBE[:, 1] - 0.5) * 1e-3
    energies = []
    for poisson in (0.3, 0.4999):
        mu, lame = lame_constants(2 * (1 + poisson), poisson)  # the same shear modulus, 1
        table = element_table(CUBE, np.arange(8)[None], np.array([mu]), np.array([lame]))
        energies.append(elastic_energy(table, CUBE + bending))
    assert energies[1] == pytest.approx(energies[0], rel=1e-3)


def test_rigid_motion_costs_nothing(mesh, table):
    turn = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], float)
    moved = mesh.nodes_mm @ turn.T + [3.0, -1.0, 2.0]
    assert abs(elastic_energy(table, moved)) < 1e-9
    assert np.abs(elastic_forces(table, moved)).max() < 1e-10


def test_forces_are_the_gradient_of_the_energy_and_balance(mesh, table, bent):
    force = elastic_forces(table, bent)
    assert np.abs(force.sum(axis=0)).max() < 1e-10
    assert np.abs(np.cross(bent, force).sum(axis=0)).max() < 1e-9
    generator = np.random.default_rng(0)
    for _ in range(5):
        way, step = generator.normal(size=bent.shape), 1e-5
        slope = (elastic_energy(table, bent + step * way) - elastic_energy(table, bent - step * way)) / (2 * step)
        assert slope == pytest.approx((force * way).sum(), rel=1e-6)


def test_stiffness_is_the_derivative_of_the_forces_and_symmetric(mesh, table, bent):
    blocks = np.zeros((len(mesh.hexes), 24, 24))
    elastic_stiffness(table, bent, blocks)
    assert np.array_equal(blocks, blocks.transpose(0, 2, 1))
    way, step = np.random.default_rng(1).normal(size=bent.shape), 1e-6
    product = np.zeros_like(bent)
    np.add.at(product, mesh.hexes, np.einsum("mij,mj->mi", blocks, way[mesh.hexes].reshape(-1, 24)).reshape(-1, 8, 3))
    change = (elastic_forces(table, bent + step * way) - elastic_forces(table, bent - step * way)) / (2 * step)
    assert np.abs(product - change).max() < 1e-6 * np.abs(product).max()


def test_an_element_inside_out_is_noticed(mesh, table):
    crushed = mesh.nodes_mm.copy()
    crushed[mesh.hexes[100, 4:]] = 2 * crushed[mesh.hexes[100, :4]] - crushed[mesh.hexes[100, 4:]]
    assert elastic_energy(table, crushed) == np.inf
    assert elastic_forces(table, crushed) is None
    with pytest.raises(ValueError, match="inside out"):
        element_table(CUBE[[4, 5, 6, 7, 0, 1, 2, 3]], np.arange(8)[None], np.ones(1), np.ones(1))


@pytest.mark.parametrize("symmetric", [True, False])
def test_frontal_solver_solves_the_assembled_equations(mesh, table, bent, symmetric):
    blocks = np.zeros((len(mesh.hexes), 24, 24))
    elastic_stiffness(table, mesh.nodes_mm if symmetric else bent, blocks)
    if not symmetric:
        blocks += 0.01 * np.random.default_rng(2).normal(size=blocks.shape)
    solver = FrontalSolver(mesh.hexes, mesh.fixed, mesh.grid)
    dense = np.zeros((3 * len(mesh.nodes_mm),) * 2)
    rows = (3 * mesh.hexes[:, :, None] + np.arange(3)).reshape(-1, 24)
    for block, row in zip(blocks, rows, strict=True):
        dense[np.ix_(row, row)] += block
    free = np.repeat(~mesh.fixed, 3)
    right = np.random.default_rng(3).normal(size=(solver.size, 2))
    wanted = np.linalg.solve(dense[np.ix_(free, free)] + 0.1 * np.eye(solver.size), right)
    factors = solver.factor(blocks, symmetric=symmetric, shift=0.1)
    assert np.abs(factors.solve(right) - wanted).max() < 1e-8 * np.abs(wanted).max()
    assert np.allclose(factors.solve(right[:, 0]), wanted[:, 0])


def test_frontal_solver_notices_negative_stiffness(mesh, table):
    blocks = np.zeros((len(mesh.hexes), 24, 24))
    elastic_stiffness(table, mesh.nodes_mm, blocks)
    blocks[20] *= -3
    with pytest.raises(NotPositiveDefinite):
        FrontalSolver(mesh.hexes, mesh.fixed, mesh.grid).factor(blocks, symmetric=True)
