"""A tangent that turns with the body."""

from itertools import pairwise

import numpy as np
import pytest
from block import assembled, material, rotation, stiffness_blocks

from scenes.load import load_object, load_sensor
from twin.geometry.shapes import shape_of
from twin.geometry.solid import Resolution, build_solid
from twin.mechanics import ContactPose, SkinSolver
from twin.mechanics.balance import Body
from twin.mechanics.body.elements import Elements
from twin.mechanics.body.material import law_coefficients
from twin.mechanics.contact import contact_points
from twin.mechanics.law import ContactLaw
from twin.mechanics.path import plan_path
from twin.mechanics.turns import Turns, turn_vectors, turned_back, turned_matrix
from twin.objects import build_field

EXACT = 1e-9  # rotations: the polar decomposition's own end
SINGLE = 1e-5  # relative: blocks and matrices in single precision
SAVED = 0.9  # eliminations with turned tangents over those without, at most


@pytest.fixture(scope="module")
def solid():
    return build_solid(load_sensor("mg400-331").geometry, resolution=Resolution(8))


@pytest.fixture(scope="module")
def body(solid):
    parts = (
        (solid.skin, material(), True),
        (solid.gel_top, material(young_mpa=0.02), False),
        (solid.gel_deep, material(young_mpa=0.02), False),
    )
    kinds = tuple(Elements(cells, law_coefficients(spec, layer=layer)) for cells, spec, layer in parts)
    return Body(kinds, contact_points(solid, shape_of(load_sensor("mg400-331").skin)), np.ones(len(solid.control_mm), bool), sealed=False)


def tangent(body, at):
    """(3 n, 3 n) of all controls."""
    return assembled([kind.cells.controls for kind in body.kinds], [stiffness_blocks(kind, at) for kind in body.kinds], len(at)).toarray()


def pressed(at, depth_mm):
    """A dimple at the apex, as under a ball of 4 mm."""
    out = at.copy()
    out[:, 2] -= depth_mm * np.exp(-(at[:, 0] ** 2 + at[:, 1] ** 2) / 2 / 4**2) * np.clip(at[:, 2] / at[:, 2].max(), 0, 1)
    return out


def test_a_body_that_turns_as_a_whole_turns_every_control_and_its_tangent(solid, body):
    here, turn = pressed(solid.control_mm, 1.0), rotation([1, 2, 3], 0.7)
    turns = Turns(body)
    found = turns.since(turns.strains(here), here @ turn.T)
    assert np.abs(found - turn).max() < EXACT
    wanted = tangent(body, here @ turn.T)
    assert np.abs(turned_matrix(found, tangent(body, here)) - wanted).max() < SINGLE * np.abs(wanted).max()


def test_turned_vectors_are_the_matrix_times_them(solid, body):
    rng, turns = np.random.default_rng(0), Turns(body)
    found = turns.since(turns.strains(solid.control_mm), pressed(solid.control_mm, 2.0))
    matrix, vector = rng.normal(size=(2, *[3 * len(found)] * 2)), rng.normal(size=3 * len(found))
    symmetric = matrix[0] + matrix[0].T
    assert np.allclose(turned_back(found, turn_vectors(found, vector)), vector, atol=EXACT)
    assert np.allclose(turned_matrix(found, symmetric) @ vector, turn_vectors(found, symmetric @ turned_back(found, vector)), atol=1e-6)


def effort(sensor):
    """Outer iterations and eliminations of a press."""
    solver, field = SkinSolver(sensor), build_field(load_object("sphere"))
    plan = plan_path(sensor.geometry, field, ContactPose(1.6))
    going = solver.begin(field, ContactLaw().override(friction=0.5), plan.at(0.0), focus=solver.focus(field, plan))
    for start, stop in pairwise(np.linspace(0, 1, 5)):
        for _ in going.advance(plan.at, start, stop, plan.time_s, "pressed"):
            pass
    return going.stepper.iterations, going.stepper.eliminations


def test_a_tangent_that_turns_with_the_skin_lasts_longer(monkeypatch):
    sensor = load_sensor("mg400-331")
    iterations, eliminations = effort(sensor)
    monkeypatch.setattr("twin.mechanics.newton._LEAST_TURN", np.inf)
    still_iterations, still_eliminations = effort(sensor)
    print(iterations, eliminations, still_iterations, still_eliminations)
    assert iterations <= still_iterations and eliminations < SAVED * still_eliminations
