"""Contact states obey the laws of statics, of friction and of symmetry."""

import numpy as np
import pytest

from scenes.load import load_object, load_sensor
from twin.errors import ContactError
from twin.geometry.mesh import Resolution
from twin.mechanics import ContactPose, SkinSolver
from twin.mechanics.contact import Anchors, contact_forces, no_anchors
from twin.mechanics.elements import elastic_forces
from twin.mechanics.newton import GAP_BOUND_MM, RESIDUAL_TOLERANCE
from twin.mechanics.path import plan_path
from twin.projection import project
from twin.stimulus import build_stimulus

SOLVER_MM = 1e-4  # what the residual's tolerance leaves open in a position
HISTORY_MM = 5e-3  # what first-order guesses of where a point touched leave open under friction


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("mg400-331")


@pytest.fixture(scope="module")
def solver(sensor):
    return SkinSolver(sensor, resolution=Resolution(across=11, gel_layers=3))


@pytest.fixture(scope="module")
def sheared(solver):
    return solver.press(load_object("plane"), ContactPose(2.5, shear_mm=(1.5, 0.0)))


@pytest.fixture(scope="module", params=["sphere", "edge", "can"])
def tilted(request, solver):
    name = request.param
    return load_object(name), solver.press(load_object(name), ContactPose(2.0, tilt_deg=(8.0, -5.0), shear_mm=(0.8, -0.5), twist_deg=10.0))


def points_in_object(solver, state):
    T = state.T_sensor_object
    return (solver.body.points.positions(state.nodes_mm) - T[:3, 3]) @ T[:3, :3]


@pytest.mark.parametrize("friction", [0.0, 0.6])
@pytest.mark.parametrize("frozen", [False, True])
def test_contact_stiffness_is_minus_the_derivative_of_its_forces(solver, friction, frozen):
    field, points = build_stimulus(load_object("sphere")), solver.body.points
    generator = np.random.default_rng(5)
    count = len(points.area_mm2)
    at = generator.normal(size=(count, 3))
    at = at / np.linalg.norm(at, axis=1, keepdims=True) * generator.uniform(9.9, 10.05, (count, 1)) + [0, 0, 10]
    anchors = Anchors(at + generator.normal(scale=0.03, size=at.shape), generator.random(count) < 0.8)
    limit = friction * generator.uniform(0, 0.05, count) if frozen else None
    options = {"friction": friction, "penalty_mpa_mm": 20.0, "frozen_limit_mm": limit}
    k = contact_forces(points, at, field, anchors, with_stiffness=True, **options).stiffness
    step = 1e-6
    for axis, unit in enumerate(np.eye(3)):
        change = (
            contact_forces(points, at + step * unit, field, anchors, **options).force_n
            - contact_forces(points, at - step * unit, field, anchors, **options).force_n
        ) / (2 * step)
        error = np.linalg.norm(change + k[:, :, axis], axis=1) / (20.0 * points.area_mm2)
        # the normal's turn under a friction force is left out of the tangent: some per cent at most, only the rate suffers
        assert np.quantile(error, 0.98) < (0.02 if friction else 1e-4)
    if frozen or friction == 0:
        way = generator.normal(size=at.shape)
        now = contact_forces(points, at, field, anchors, **options)
        energies = [contact_forces(points, at + s * step * way, field, anchors, **options).energy_nmm for s in (1, -1)]
        assert (energies[0] - energies[1]) / (2 * step) == pytest.approx(-(now.force_n * way).sum(), rel=0.01 if friction else 1e-5)


def test_no_contact_moves_nothing(solver):
    rest = solver.rest()
    for indent in (0.0, -2.0):
        state = solver.press(load_object("sphere"), ContactPose(indent))
        assert np.array_equal(state.nodes_mm, rest.nodes_mm)
        assert np.array_equal(state.caps_mm, rest.caps_mm)
        assert not state.force_n.any() and state.area_mm2 == 0


@pytest.mark.parametrize("name, offset", [("plane", (0, 0)), ("sphere", (3, -4)), ("edge", (-2, 0)), ("mesh-can", (1, 1))])
def test_path_starts_at_first_touch(sensor, name, offset):
    field = build_stimulus(load_object(name))
    T = plan_path(sensor, field, ContactPose(1.0, tilt_deg=(10.0, 5.0), offset_mm=offset)).at(0.0)
    angle = np.linspace(0, 2 * np.pi, 721)
    polar, azimuth = np.meshgrid(angle[:181], angle)
    dome = 20.0 * np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1).reshape(-1, 3)
    nearest_mm = field.distance((dome - T[:3, 3]) @ T[:3, :3]).min()
    assert -0.002 < nearest_mm < 0.02  # mm: what either sampling of the dome can miss


def test_pressing_pushes_the_object_back_and_shearing_against_its_motion(sheared):
    assert sheared.force_n[2] > 0
    assert sheared.force_n[0] < 0
    assert abs(sheared.force_n[1]) < 1e-3 * sheared.force_n[2]
    assert sheared.area_mm2 > 0


def test_forces_balance(solver, tilted):
    """Third law: the tractions sum to the force and its torque, and both are the clamps' reaction."""
    _, state = tilted
    assert state.residual <= RESIDUAL_TOLERANCE
    assert np.allclose(state.traction_n.sum(axis=0), state.force_n, rtol=1e-6, atol=1e-9)
    inner = elastic_forces(solver.body.elements, state.nodes_mm)
    inner[state.contact_nodes] += state.traction_n  # what is left is carried by the clamps
    assert np.linalg.norm(inner[solver.body.free]) < 1e-6 * np.linalg.norm(state.force_n)
    clamped = inner[~solver.body.free]
    assert np.abs(clamped.sum(axis=0) - state.force_n).max() < 1e-6 * np.linalg.norm(state.force_n)
    torque = np.cross(state.nodes_mm[~solver.body.free], clamped).sum(axis=0)
    assert np.abs(torque - state.torque_nmm).max() < 1e-5 * np.linalg.norm(state.torque_nmm)


def test_nothing_lies_deeper_in_the_object_than_the_bound(solver, tilted):
    spec, state = tilted
    field = build_stimulus(spec)
    assert field.distance(points_in_object(solver, state)).min() >= -GAP_BOUND_MM * 1.0001
    T, outer = state.T_sensor_object, np.unique(solver.mesh.outer_quads)
    assert field.distance((state.nodes_mm[outer] - T[:3, 3]) @ T[:3, :3]).min() >= -GAP_BOUND_MM * 1.0001


def test_friction_stays_in_its_cone_and_vanishes_without_friction(solver):
    pose = ContactPose(2.0, shear_mm=(1.2, 0.4))
    for mu in (0.0, 0.3):
        state = solver.press(load_object("plane"), pose, friction=mu)
        tangential = np.linalg.norm(state.traction_n[:, :2], axis=1)
        assert (tangential <= mu * state.traction_n[:, 2] * (1 + 1e-6) + 1e-9).all()
        assert (state.traction_n[:, 2] > 0).all()
        assert np.hypot(*state.force_n[:2]) == pytest.approx(mu * state.force_n[2], rel=0.05, abs=1e-6)


def test_more_friction_drags_the_pins_further_along_the_shear(solver, sensor):
    rest = project(sensor.camera, solver.rest().caps_mm)
    moved = []
    for mu in (0.0, 0.2, 1.0):
        state = solver.press(load_object("plane"), ContactPose(2.0, shear_mm=(1.2, 0.0)), friction=mu)
        moved.append((project(sensor.camera, state.caps_mm) - rest).mean(axis=0)[0])
    assert abs(moved[0]) < 0.1 < moved[1] < moved[2]


def test_tilt_presses_the_side_that_comes_first(solver):
    """Turned right-handed about +y, a plane's +x side comes down: it meets the dome at polar angle 20 deg on +x."""
    state = solver.press(load_object("plane"), ContactPose(2.0, tilt_deg=(0.0, 20.0)))
    centre = np.einsum("ci,c->i", state.nodes_mm[state.contact_nodes], state.traction_n[:, 2]) / state.force_n[2]
    assert centre[0] == pytest.approx(20 * np.sin(np.radians(20)), abs=1.0)
    assert abs(centre[1]) < 0.1


def test_area_force_and_mean_spread_grow_with_depth(solver, sensor):
    rest = project(sensor.camera, solver.rest().caps_mm)
    centre, path = rest[0], []
    for _, state in solver.path(load_object("plane"), ContactPose(4.5)):
        radial = np.linalg.norm(project(sensor.camera, state.caps_mm) - centre, axis=1) - np.linalg.norm(rest - centre, axis=1)
        path.append((state.force_n[2], radial.mean()))
    force, spread = np.array(path).T
    assert (np.diff(force) > 0).all()
    assert (np.diff(spread) > 0).all() and spread[0] > 0


@pytest.mark.parametrize("friction, tolerance_mm", [(0.0, SOLVER_MM), (0.5, HISTORY_MM)])
def test_a_scene_turned_by_a_quarter_gives_the_turned_answer(solver, friction, tolerance_mm):
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], float)
    state = solver.press(load_object("plane"), ContactPose(2.0, tilt_deg=(10.0, 0.0), shear_mm=(0.8, 0.3)), friction=friction)
    turned = solver.press(load_object("plane"), ContactPose(2.0, tilt_deg=(0.0, 10.0), shear_mm=(-0.3, 0.8)), friction=friction)
    side, layers = solver.mesh.grid[1], solver.mesh.grid[0]
    grid = (state.nodes_mm @ quarter.T).reshape(layers, side, side, 3)
    # the node that a quarter turn takes to row v, column u
    assert np.abs(grid[:, ::-1, :].transpose(0, 2, 1, 3).reshape(-1, 3) - turned.nodes_mm).max() < tolerance_mm
    assert np.allclose(quarter @ state.force_n, turned.force_n, rtol=tolerance_mm, atol=tolerance_mm)
    assert np.allclose(quarter @ state.torque_nmm, turned.torque_nmm, rtol=tolerance_mm, atol=10 * tolerance_mm)


def test_press_and_release_returns_to_rest(solver):
    last = list(solver.path(load_object("sphere"), ContactPose(2.0), release=True))[-1]
    assert last[0] == pytest.approx(1.0)
    assert np.abs(last[1].nodes_mm - solver.mesh.nodes_mm).max() < SOLVER_MM
    assert np.linalg.norm(last[1].force_n) < 1e-4


def test_finer_load_steps_change_little(solver, monkeypatch):
    pose = ContactPose(2.0, shear_mm=(1.2, 0.0))
    coarse = solver.press(load_object("cylinder"), pose)
    monkeypatch.setattr("twin.mechanics.solver._STEP_MM", 0.2)
    fine = solver.press(load_object("cylinder"), pose)
    assert np.linalg.norm(coarse.caps_mm - fine.caps_mm, axis=1).max() < 0.03  # mm: first-order friction history


def test_a_compliant_object_yields_by_compliance_times_force(solver):
    pose, compliance = ContactPose(2.0), 0.4
    hard = solver.press(load_object("plane"), pose, compliance_mm_per_n=0.0)
    soft = solver.press(load_object("plane"), pose, compliance_mm_per_n=compliance)
    assert soft.force_n[2] < hard.force_n[2]
    yielded = soft.T_sensor_object[2, 3] - hard.T_sensor_object[2, 3]
    assert yielded == pytest.approx(compliance * soft.force_n[2], rel=1e-6)
    same = solver.press(load_object("plane"), ContactPose(2.0 - yielded), compliance_mm_per_n=0.0)
    assert same.force_n[2] == pytest.approx(soft.force_n[2], rel=1e-3)


def test_every_state_on_the_path_is_converged_and_progress_is_told(solver):
    seen = []
    end = solver.press(load_object("plane"), ContactPose(1.5, twist_deg=15.0), progress=lambda at, state: seen.append((at, state)))
    assert [at for at, _ in seen] == sorted(at for at, _ in seen)
    assert seen[-1][0] == pytest.approx(1.0)
    assert seen[-1][1] is end
    assert max(state.residual for _, state in seen) <= RESIDUAL_TOLERANCE
    assert end.torque_nmm[2] < 0  # the skin resists the twist


@pytest.mark.parametrize(
    "pose, wanted",
    [
        (ContactPose(15.0), "indent_mm"),
        (ContactPose(float("nan")), "finite"),
        (ContactPose(1.0, tilt_deg=(80.0, 0.0)), "tilt_deg"),
        (ContactPose(1.0, shear_mm=(30.0, 0.0)), "shear_mm"),
        (ContactPose(1.0, twist_deg=200.0), "twist_deg"),
        (ContactPose(1.0, offset_mm=(60.0, 0.0)), "misses"),
    ],
)
def test_a_nonsense_pose_is_refused(solver, pose, wanted):
    with pytest.raises(ContactError, match=wanted):
        solver.press(load_object("sphere"), pose)


def test_a_step_that_does_not_converge_is_named_and_nothing_is_returned(solver, monkeypatch):
    monkeypatch.setattr("twin.mechanics.newton._MINIMISER_ITERATIONS", 0)
    monkeypatch.setattr("twin.mechanics.newton._NEWTON_ITERATIONS", 0)
    with pytest.raises(ContactError, match=r"load step 1 of 2 .*relative residual .*try less indentation"):
        solver.press(load_object("plane"), ContactPose(1.5))


def test_nothing_touched_has_no_anchor(solver):
    assert not no_anchors(solver.body.points).held.any()
