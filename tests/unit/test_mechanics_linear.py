"""The direct solver solves the assembled equations."""

import numpy as np
import pytest
from block import assembled, material, stiffness_blocks

from scenes.load import load_sensor
from twin.geometry.solid import Resolution, build_solid
from twin.mechanics.body.elements import Elements
from twin.mechanics.body.linear import FrontalSolver, NotPositiveDefinite
from twin.mechanics.body.material import law_coefficients

SINGLE = 2e-3  # relative: single precision times the matrix's condition, 3e4 (measured 1e-5 to 1e-4)
BACKWARD = 3e-6  # residual over matrix and solution: single precision, some ten operations deep
SCHUR = 1e-4  # relative: single precision, magnified by how much softer the kept part is than the matrix (measured 2e-5)
REFINED = 1e-9  # relative: after the residual, in double precision, was solved for three times


@pytest.fixture(scope="module")
def solid():
    return build_solid(load_sensor("mg400-331").geometry, resolution=Resolution(8))


@pytest.fixture(scope="module")
def blocks(solid):
    x, y, z = solid.control_mm.T
    at = solid.control_mm + 0.2 * np.column_stack([np.sin(z / 5), np.cos(x / 6), np.sin(x / 7 + y / 9)])
    parts = (
        (solid.skin, material(), True),
        (solid.gel_top, material(young_mpa=0.02), False),
        (solid.gel_deep, material(young_mpa=0.02), False),
    )
    return [stiffness_blocks(Elements(cells, law_coefficients(spec, layer=layer)), at) for cells, spec, layer in parts]


@pytest.fixture(scope="module")
def dense(solid, blocks):
    """The free controls' matrix, assembled the obvious way."""
    free = np.repeat(~solid.fixed, 3)
    controls = [c.controls for c in (solid.skin, solid.gel_top, solid.gel_deep)]
    return assembled(controls, blocks, len(solid.fixed)).toarray()[np.ix_(free, free)]


def solver_of(solid, keep):
    controls = [c.controls for c in (solid.skin, solid.gel_top, solid.gel_deep)]
    return FrontalSolver(controls, list(solid.boxes), solid.fixed, keep & ~solid.fixed)


def kept(solid, which):
    side = solid.basis.count
    keep = np.zeros(len(solid.fixed), bool)
    if which == "outside":
        keep[: side * side] = True
    elif which == "middle":
        keep[: side * side].reshape(side, side)[3:6, 2:7] = True
    elif which == "scattered":
        keep = np.random.default_rng(1).random(len(keep)) < 0.2
    return keep


@pytest.mark.parametrize("which, shift", [("none", 0.0), ("middle", 0.0), ("middle", 0.1), ("outside", 0.0), ("scattered", 0.0)])
def test_elimination_then_the_kept_part_solves_the_assembled_equations(solid, blocks, dense, which, shift):
    solver = solver_of(solid, kept(solid, which))
    assert solver.size == len(dense)
    inner = np.setdiff1d(np.arange(solver.size), solver.kept)
    full = dense.copy()
    full[inner, inner] += shift
    right = np.random.default_rng(2).normal(size=solver.size)
    wanted = np.linalg.solve(full, right)
    for _ in range(2):  # nothing is left over from an earlier elimination
        remaining = solver.eliminate(blocks, shift=shift)
    matrix = np.tril(remaining).astype(float)
    matrix += np.tril(matrix, -1).T

    def solve(b):
        forward = solver.forward(b)
        return solver.backward(forward, np.linalg.solve(matrix, forward[solver.kept]))

    found = solve(right)
    assert np.abs(found - wanted).max() < SINGLE * np.abs(wanted).max()
    assert np.linalg.norm(full @ found - right) < BACKWARD * np.linalg.norm(full, 1) * np.linalg.norm(found)
    found = found.astype(float)
    for _ in range(3):
        found = found + solve(right - full @ found)
    assert np.abs(found - wanted).max() < REFINED * np.abs(wanted).max()


def test_what_is_kept_is_the_schur_complement_in_the_kept_order(solid, blocks, dense):
    keep = kept(solid, "middle")
    solver = solver_of(solid, keep)
    assert set(solver.kept) == set(solver.unknown[keep & ~solid.fixed].ravel())
    k, inner = solver.kept, np.setdiff1d(np.arange(solver.size), solver.kept)
    wanted = dense[np.ix_(k, k)] - dense[np.ix_(k, inner)] @ np.linalg.solve(dense[np.ix_(inner, inner)], dense[np.ix_(inner, k)])
    found = solver.eliminate(blocks)
    assert np.abs(np.tril(found) - np.tril(wanted)).max() < SCHUR * np.abs(wanted).max()


def test_clamped_controls_have_no_unknowns_and_the_others_three_each(solid):
    unknown = solver_of(solid, kept(solid, "none")).unknown
    assert (unknown[solid.fixed] == -1).all()
    assert np.array_equal(unknown[~solid.fixed].ravel(), np.arange(3 * np.count_nonzero(~solid.fixed)))


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_negative_stiffness_is_noticed_and_a_shift_heals_it(solid, blocks, kind):
    solver = solver_of(solid, kept(solid, "none"))
    wrong = [block.copy() for block in blocks]
    wrong[kind][5] *= -30
    with pytest.raises(NotPositiveDefinite):
        solver.eliminate(wrong)
    shift = 1.1 * 30 * max(np.abs(block).sum(axis=(1, 3)).max() for block in blocks)
    solver.eliminate(wrong, shift=shift)
