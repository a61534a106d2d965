"""A contact on the fixed grid of the skin: nothing is lost in between, and it lies where it happened."""

import numpy as np
import pytest

from scenes import load_object, load_sensor
from twin.geometry.shapes import Focus, shape_of
from twin.geometry.solid import Resolution, build_solid
from twin.mechanics.contact import contact_points
from twin.mechanics.path import ContactPose
from twin.mechanics.skin_map import SIDE, skin_grid, skin_map
from twin.mechanics.solver import SkinSolver

ROUGH_SHARE = 2e-3  # of the skin's area that quads of 0.3 mm cut off a sphere
SPLINE_MM = 0.1  # by which the splines' even places differ from the chart's on a grid of 16 elements across
NODE_MM = 2.0  # largest distance of a contact from the middle of the nodes that stand for it


@pytest.fixture(scope="module")
def pressed():
    spec = load_sensor("mg400-127")
    solver = SkinSolver(spec, resolution=Resolution(8))
    return spec, solver, solver.press(load_object("ball-40"), ContactPose(1.0, shear_mm=(0.3, 0.0), offset_mm=(2.0, -1.0)), friction=0.3)


@pytest.mark.parametrize("sensor", ["mg400-331", "mg400-127"])
def test_the_nodes_areas_tile_the_skin(sensor):
    spec = load_sensor(sensor)
    grid = skin_grid(spec.geometry)
    cap_mm2 = 2 * np.pi * spec.skin.outer_radius_mm * (spec.skin.outer_radius_mm - spec.skin.rim_z_mm)
    assert len(grid.nodes_mm) == SIDE**2 and grid.area_mm2.min() > 0
    assert grid.area_mm2.sum() == pytest.approx(cap_mm2, rel=ROUGH_SHARE)


@pytest.mark.parametrize("focus", [Focus(), Focus(0.4, 1.0, 0.7, 0.3)])
def test_contact_points_know_their_place_whatever_the_focus(focus):
    spec = load_sensor("mg400-127")
    shape = shape_of(spec.skin)
    solid = build_solid(spec.geometry, resolution=Resolution(16), focus=focus)
    points = contact_points(solid, shape)
    np.testing.assert_allclose(points.positions(solid.control_mm), shape.outside(points.place), atol=SPLINE_MM)


def test_sums_over_the_nodes_are_the_contacts_own(pressed):
    spec, _, state = pressed
    found = skin_map(spec.geometry, state)
    np.testing.assert_allclose(found.force_n.sum(axis=0), state.force_n, atol=1e-12)
    assert found.normal_n.sum() == pytest.approx(state.normal_n.sum())
    assert found.touched_mm2.sum() == pytest.approx(state.point_area_mm2.sum())
    assert found.slipping_mm2.sum() == pytest.approx(state.point_area_mm2[state.slipping].sum())
    assert 0 < found.slipping_mm2.sum() <= found.touched_mm2.sum()


def test_it_lies_where_the_object_pressed(pressed):
    spec, _, state = pressed
    found, grid = skin_map(spec.geometry, state), skin_grid(spec.geometry)
    middle = found.normal_n @ grid.nodes_mm / found.normal_n.sum()
    truth = state.normal_n @ state.contact_mm / state.normal_n.sum()
    assert np.linalg.norm((middle - truth)[:2]) < NODE_MM


def test_nothing_touched_is_an_empty_map(pressed):
    spec, solver, _ = pressed
    found = skin_map(spec.geometry, solver.rest())
    assert not any(values.any() for values in (found.force_n, found.normal_n, found.touched_mm2, found.slipping_mm2))
