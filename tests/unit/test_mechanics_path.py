"""Contacts along any path: history, hysteresis, load steps, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from block import Watched, last, rotation, usual_sensor

from scenes.body import MaterialSpec
from scenes.load import load_object
from scenes.object import ObjectSpec
from twin.errors import ContactError
from twin.geometry.solid import Resolution
from twin.mechanics import ContactPath, ContactPose, Friction, SkinSolver
from twin.mechanics.newton import GAP_BOUND_MM, RESIDUAL_TOLERANCE, LoadStepper, NoConvergence
from twin.mechanics.path import plan_path
from twin.objects import build_field

SOLVER_MM = 1e-4  # what the residual's tolerance leaves open in a position
SIDE_SHARE = 0.02  # of a side force before slip, whatever the load step
STEP_SHARE = 0.03  # of the largest motion: load steps half as large, with friction
WORK_SHARE = 0.05  # of the work: trapezoids over load steps of 0.15 mm, and what sticking points creep


@pytest.fixture(scope="module")
def sensor():
    return usual_sensor()


@pytest.fixture(scope="module")
def solver(sensor):
    return Watched(sensor, resolution=Resolution(10))


def pose(x=0.0, y=0.0, height=0.0, *, axis=(0, 0, 1), turn_deg=0.0):
    """The object above the apex, moved and turned about its origin."""
    T = np.eye(4)
    T[:3, :3] = rotation(axis, np.radians(turn_deg))
    T[:3, 3] = [x, y, 20 + height]
    return T


def through(*poses, times_s=None):
    return ContactPath(np.stack(poses), times_s)


def work_nmm(states, rest_height=20.0):
    """Work of the mover on the skin by trapezoids over the poses; no rotations."""
    force = np.array([np.zeros(3)] + [state.force_n for state in states])
    at = np.array([[0.0, 0.0, rest_height]] + [state.T_sensor_object[:3, 3] for state in states])
    return -((force[1:] + force[:-1]) / 2 * np.diff(at, axis=0)).sum()


# --- paths


def test_a_path_s_poses_are_met_and_between_them_it_goes_straight_and_turns_evenly():
    path = through(pose(), pose(height=-1), pose(2, 0, -1, turn_deg=40), times_s=[0.0, 1.0, 5.0])
    assert np.allclose(path.at(0), pose())
    assert np.allclose(path.at(1), pose(height=-1))
    assert np.allclose(path.at(2), pose(2, 0, -1, turn_deg=40))
    assert np.allclose(path.at(1.25), pose(0.5, 0, -1, turn_deg=10))
    assert path.time_s(1.5) == pytest.approx(3.0)
    back = path.there_and_back()
    assert len(back.poses) == 5
    for share in (0.3, 1.0, 1.7):
        assert np.allclose(back.at(4 - share), path.at(share))
    assert back.time_s(4.0) == pytest.approx(10.0)
    assert back.time_s(4.0) - back.time_s(3.0) == pytest.approx(path.time_s(1.0) - path.time_s(0.0))


@pytest.mark.parametrize(
    "poses, times_s, wanted",
    [
        ([pose()], None, "at least two"),
        ([pose(), pose() * np.nan], None, "finite"),
        ([pose(), np.diag([1.0, 1.0, 2.0, 1.0])], None, "rigid"),
        ([pose(), np.diag([1.0, 1.0, -1.0, 1.0])], None, "rigid"),
        ([pose(), pose()], [1.0, 1.0], "rise"),
        ([pose(), pose()], [1.0, 0.0], "rise"),
        ([pose(), pose()], [0.0, 1.0, 2.0], "rise"),
        ([pose(), pose()], [0.0, np.nan], "rise"),
    ],
)
def test_a_path_that_makes_no_sense_is_refused(poses, times_s, wanted):
    with pytest.raises(ContactError, match=wanted):
        ContactPath(np.array(poses), times_s)


def test_arbitrary_motions_converge_state_by_state_and_end_free(solver):
    """Approach, tap, press, shear, twist, slide, roll, hold, retract."""
    path = through(
        pose(height=2),
        pose(height=-0.8),
        pose(height=0.5),  # tap
        pose(height=-2),
        pose(1, 0, -2),  # shear
        pose(1, 0, -2, turn_deg=20),  # twist
        pose(3, 2, -1.8, turn_deg=20),  # slide
        pose(3, 2, -1.8, turn_deg=20),  # hold
        pose(3, 2, -1.8, axis=(1, 0.3, 1), turn_deg=12),  # roll
        pose(3, 2, 3),
    )
    seen = list(solver.path(load_object("plane"), path))
    done, states = zip(*seen, strict=True)
    assert list(done) == sorted(done) and done[-1] == pytest.approx(1.0)
    assert max(state.residual for state in states) <= RESIDUAL_TOLERANCE
    assert all(state.dissipated_nmm >= 0 for state in states)
    assert all(np.isfinite(state.nodes_mm).all() for state in states)
    contact = np.array([state.area_mm2 > 0 for state in states])
    assert not contact[0] and not contact[-1] and np.count_nonzero(np.diff(contact.astype(int)) == 1) == 2  # the tap and the press
    assert np.abs(states[-1].nodes_mm - solver.mesh.nodes_mm).max() < SOLVER_MM
    assert np.linalg.norm(states[-1].force_n) == 0
    for T in path.poses:
        assert min(np.abs(state.T_sensor_object - T).max() for state in states) < 1e-9 or np.allclose(T, path.poses[0])


@pytest.mark.parametrize(
    "name, pose_, across",
    [
        ("sphere", ContactPose(2.0), 8),
        ("cylinder", ContactPose(2.0, tilt_deg=(8.0, -5.0), twist_deg=10.0), 12),
        ("edge", ContactPose(2.0, tilt_deg=(8.0, -5.0), shear_mm=(0.8, -0.5), twist_deg=10.0), 16),
    ],
)
def test_skin_is_touched_wherever_the_object_meets_it(sensor, name, pose_, across):
    state = SkinSolver(sensor, resolution=Resolution(across)).press(load_object(name), pose_)
    assert state.residual <= RESIDUAL_TOLERANCE


def test_an_object_that_crosses_the_dome_between_two_free_poses_touches_it(solver):
    field = build_field(load_object("sphere"))
    aside = pose(-24, 0, -1), pose(24, 0, -1)
    states = [state for _, state in solver.path(field, through(*aside), friction=0.0)]
    force = np.array([state.force_n[2] for state in states])
    assert force[0] == force[-1] == 0
    pressed = solver.press(field, ContactPose(1.0), friction=0.0).force_n[2]
    assert force.max() == pytest.approx(pressed, rel=0.15)  # the grid is fine along the whole crossing there, at one place here


def test_twist_is_resisted(solver):
    end = solver.press(load_object("plane"), through(pose(), pose(height=-1.5), pose(height=-1.5, turn_deg=15)))
    assert end.torque_nmm[2] < 0
    other = solver.press(load_object("plane"), through(pose(), pose(height=-1.5), pose(height=-1.5, turn_deg=-15)))
    assert other.torque_nmm[2] == pytest.approx(-end.torque_nmm[2], rel=1e-3)


def test_every_state_s_progress_is_told_in_order(solver):
    seen = []
    end = solver.press(load_object("plane"), ContactPose(1.5, twist_deg=15.0), progress=lambda at, state: seen.append((at, state)))
    assert [at for at, _ in seen] == sorted({at for at, _ in seen})
    assert seen[-1][0] == pytest.approx(1.0)
    assert seen[-1][1] is end


@pytest.mark.parametrize("name, offset", [("plane", (0, 0)), ("sphere", (3, -4)), ("edge", (-2, 0)), ("mesh-can", (1, 1))])
def test_path_starts_at_first_touch(sensor, name, offset):
    field = build_field(load_object(name))
    T = plan_path(sensor.geometry, field, ContactPose(1.0, tilt_deg=(10.0, 5.0), offset_mm=offset)).at(0.0)
    angle = np.linspace(0, 2 * np.pi, 721)
    polar, azimuth = np.meshgrid(angle[:181], angle)
    dome = 20.0 * np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1).reshape(-1, 3)
    nearest_mm = field.distance((dome - T[:3, 3]) @ T[:3, :3]).min()
    assert -0.002 < nearest_mm < 0.02  # mm: what either sampling of the dome can miss


# --- history


def test_the_same_path_twice_is_the_same_to_the_bit(sensor):
    """Nothing is left over from another contact in between."""
    solver = SkinSolver(sensor, resolution=Resolution(10))
    path = through(pose(), pose(height=-1.5), pose(0.8, 0.3, -1.5, turn_deg=5))
    first = solver.press(load_object("plane"), path)
    other = solver.press(load_object("sphere"), ContactPose(2.0, tilt_deg=(5.0, 0.0)))
    assert not np.array_equal(other.nodes_mm, first.nodes_mm)
    for again in (solver, SkinSolver(sensor, resolution=Resolution(10))):
        state = again.press(load_object("plane"), path)
        for name in ("nodes_mm", "caps_mm", "force_n", "torque_nmm", "normal_n", "tangential_n", "slipping"):
            assert np.array_equal(getattr(state, name), getattr(first, name)), name


def test_press_and_release_returns_to_rest(solver):
    end = last(solver.path(load_object("sphere"), ContactPose(2.0), friction=0.0, release=True))
    assert np.abs(end.nodes_mm - solver.mesh.nodes_mm).max() < SOLVER_MM
    assert np.linalg.norm(end.force_n) < 1e-4


def test_without_friction_the_way_back_is_the_way_there(solver):
    states = [state for _, state in solver.path(load_object("plane"), ContactPose(1.5), friction=0.0, release=True)]
    there, back = states[: len(states) // 2], states[-2 : len(states) // 2 - 1 : -1]
    for one, other in zip(there[-2::-1], back[::-1], strict=False):
        assert one.T_sensor_object[2, 3] == pytest.approx(other.T_sensor_object[2, 3])
        assert other.force_n[2] == pytest.approx(one.force_n[2], rel=1e-3)
    assert abs(work_nmm(states)) < 0.02 * work_nmm(there)


def test_friction_and_shear_there_and_back_lose_what_friction_took(solver):
    """Hysteresis: the loop's area is the energy dissipated."""
    path = through(pose(), pose(height=-1.5), pose(1.5, 0, -1.5), pose(0, 0, -1.5), pose())
    states = [state for _, state in solver.path(load_object("plane"), path, friction=0.4, step_mm=0.15)]
    assert all(state.dissipated_nmm >= 0 for state in states)
    dissipated = sum(state.dissipated_nmm for state in states)
    work = work_nmm(states)
    assert work > 0
    assert dissipated == pytest.approx(work, rel=WORK_SHARE)
    assert np.abs(states[-1].nodes_mm - solver.mesh.nodes_mm).max() < SOLVER_MM  # friction lets go with the contact


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_different_ways_to_one_pose_differ_only_with_friction(solver, friction):
    straight = through(pose(), pose(height=-2), pose(1.5, 0, -2))
    detour = through(pose(), pose(height=-2), pose(0, 2, -2), pose(3, 0, -2), pose(1.5, 0, -2))
    one, other = (solver.press(load_object("plane"), path, friction=friction) for path in (straight, detour))
    off = np.abs(one.nodes_mm - other.nodes_mm).max()
    if friction:
        assert off > 0.05
        assert np.abs(one.force_n - other.force_n).max() > 0.05 * one.force_n[2]
    else:
        assert off < SOLVER_MM
        assert np.abs(one.force_n - other.force_n).max() < 1e-4 * one.force_n[2]


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_load_steps_half_as_large_change_little(solver, friction):
    pose_ = ContactPose(2.0, shear_mm=(1.2, 0.0))
    coarse, fine = (last(solver.path(load_object("cylinder"), pose_, friction=friction, step_mm=mm)) for mm in (0.6, 0.3))
    largest = np.linalg.norm(fine.nodes_mm - solver.mesh.nodes_mm, axis=1).max()
    off = np.linalg.norm(coarse.nodes_mm - fine.nodes_mm, axis=1).max()
    assert off < (STEP_SHARE * largest if friction else GAP_BOUND_MM)  # the penalty may have been raised on one way only
    assert np.abs(coarse.force_n - fine.force_n).max() < (STEP_SHARE if friction else 0.003) * fine.force_n[2]


def sheared_edge(**options):
    return ContactPose(2.0, tilt_deg=(0.0, 7.5), offset_mm=(3.0, 1.0), **options)


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_pose_a_little_further_gives_a_state_a_little_further(solver, friction):
    """The grid is a continuous function of the pose: nothing jumps."""
    edge = load_object("edge")
    for near in (dict(offset_mm=(3.0001, 1.0)), dict(tilt_deg=(0.0, 7.5001)), dict(tilt_deg=(0.0001, 7.5))):
        here = solver.press(edge, sheared_edge(), friction=friction)
        there = solver.press(edge, replace(sheared_edge(), **near), friction=friction)
        assert np.abs(here.caps_mm - there.caps_mm).max() < 1e-3
        assert np.linalg.norm(here.force_n - there.force_n) < 3e-3 * np.linalg.norm(here.force_n)


def test_without_friction_deeper_and_back_is_where_it_was_on_an_edge(solver):
    """The grid does not depend on how deep the path goes."""
    field = build_field(load_object("edge"))
    straight = plan_path(solver.spec.geometry, field, sheared_edge())
    deeper = straight.poses[1] - 0.8 * np.eye(4)[:, [2]] * np.eye(4)[3]
    here = solver.press(field, straight, friction=0.0)
    again = solver.press(field, ContactPath(np.stack([*straight.poses, deeper, straight.poses[1]])), friction=0.0)
    largest = np.linalg.norm(here.caps_mm - solver.rest().caps_mm, axis=1).max()
    assert np.abs(here.caps_mm - again.caps_mm).max() < 1e-3 * largest
    assert np.linalg.norm(here.force_n - again.force_n) < 1e-3 * np.linalg.norm(here.force_n)


def test_an_edge_s_shear_does_not_depend_on_the_load_step(solver):
    edge, pose_ = load_object("edge"), ContactPose(2.0, shear_mm=(1.5, 0.0))
    forces = np.array([last(solver.path(edge, pose_, friction=0.5, step_mm=mm)).force_n for mm in (0.2, 0.3, 0.6)])
    assert np.linalg.norm(np.ptp(forces, axis=0)) < 0.01 * np.linalg.norm(forces[0])


@pytest.mark.parametrize(("name", "tilt_deg"), [("plane", 15.0), ("edge", 7.5)])
def test_the_side_force_before_slip_hardly_depends_on_the_load_step(solver, name, tilt_deg):
    """A front of contact that passes several points in one step slips over them all the same."""
    short, usual, long = (
        last(solver.path(load_object(name), ContactPose(1.2, tilt_deg=(0.0, tilt_deg)), friction=0.5, step_mm=mm)).force_n
        for mm in (0.1, 0.4, 0.6)
    )
    assert abs(short[0]) > 0.05 * short[2]
    assert abs(usual[0] - short[0]) < SIDE_SHARE * abs(short[0]) and abs(long[0] - short[0]) < SIDE_SHARE * abs(short[0])
    assert np.linalg.norm(long - short) < 0.004 * np.linalg.norm(short)


@pytest.mark.parametrize("friction", [Friction(0.3, 0.3), Friction(0.5, 0.2)])
def test_a_cycle_of_friction_takes_the_work_that_is_done(solver, friction):
    """Also where the coefficient falls with the slip; the work is a sum of trapezoids over the load steps."""
    path = through(pose(), pose(height=-1.5), pose(1.5, 0, -1.5), pose(-1.5, 0, -1.5), pose(1.5, 0, -1.5))
    states = [state for _, state in solver.path(load_object("plane"), path, friction=friction, step_mm=0.1)]
    start, end = np.flatnonzero(np.abs([state.T_sensor_object[0, 3] - 1.5 for state in states]) < 1e-9)
    cycle = states[start : end + 1]
    moved = np.diff([state.T_sensor_object[:3, 3] for state in cycle], axis=0)
    force = np.array([state.force_n for state in cycle])
    work = -((force[1:] + force[:-1]) / 2 * moved).sum()
    taken = sum(state.dissipated_nmm for state in cycle[1:]) + cycle[-1].elastic_nmm - cycle[0].elastic_nmm
    assert taken == pytest.approx(work, rel=0.01)


def test_what_a_sliding_ball_s_friction_takes_hardly_depends_on_the_load_step(solver):
    """Also of the points that it leaves behind within a step."""
    path = through(pose(), pose(height=-1.5), pose(1.5, 0, -1.5), pose(-1.5, 0, -1.5))
    short, usual = (
        sum(state.dissipated_nmm for _, state in solver.path(load_object("sphere"), path, friction=0.5, step_mm=mm)) for mm in (0.1, 0.4)
    )
    assert usual == pytest.approx(short, rel=0.01)


# --- what is refused


@pytest.mark.parametrize(
    "pose_, wanted",
    [
        (ContactPose(15.0), "indent_mm"),
        (ContactPose(float("nan")), "finite"),
        (ContactPose(1.0, tilt_deg=(80.0, 0.0)), "tilt_deg"),
        (ContactPose(1.0, shear_mm=(30.0, 0.0)), "shear_mm"),
        (ContactPose(1.0, twist_deg=200.0), "twist_deg"),
        (ContactPose(1.0, offset_mm=(60.0, 0.0)), "misses"),
        (ContactPose(1.0, offset_mm=(2000.0, 0.0)), "offset_mm"),
    ],
)
def test_a_nonsense_pose_is_refused(solver, pose_, wanted):
    with pytest.raises(ContactError, match=wanted):
        solver.press(load_object("sphere"), pose_)


def test_a_path_that_starts_inside_the_skin_or_goes_too_deep_is_refused(solver):
    with pytest.raises(ContactError, match="starts 0.99 mm inside the skin"):
        solver.press(load_object("plane"), through(pose(height=-1), pose(height=-2)))
    with pytest.raises(ContactError, match="the path goes 1[0-4].. mm into the skin"):
        solver.press(load_object("plane"), through(pose(), pose(height=-14)))


def test_a_step_that_does_not_converge_is_named_and_nothing_is_returned(solver, monkeypatch):
    def fail(*_):
        raise NoConvergence(0.25)

    monkeypatch.setattr(LoadStepper, "step", fail)
    with pytest.raises(ContactError, match=r"load step 1 of \d .*relative residual 2.5e-01, needed 1e-05; try less indentation"):
        solver.press(load_object("plane"), ContactPose(1.5))


@pytest.mark.parametrize(
    "wrong, wanted",
    [
        ({"poisson_ratio": 0.5}, "above 0.49999"),
        ({"poisson_ratio": -0.1}, "greater than or equal to 0"),
        ({"young_modulus_mpa": -1.0}, "greater than 0"),
        ({"young_modulus_mpa": 0.0}, "greater than 0"),
        ({"law": "ogden"}, "neo-hookean"),
        ({"second_invariant_share": 0.2}, "belongs to law = 'mooney-rivlin'"),
        ({"law": "mooney-rivlin", "c20_c10": 0.2}, "belongs to law = 'yeoh'"),
        ({"law": "yeoh", "c30_c10": -0.2}, "greater than or equal to 0"),
        ({"law": "mooney-rivlin", "second_invariant_share": 1.2}, "less than or equal to 1"),
        ({"relaxation": [{"fraction": 0.6, "time_s": 1.0}, {"fraction": 0.4, "time_s": 2.0}]}, "sum to less than 1"),
        ({"relaxation": [{"fraction": 0.6, "time_s": 0.0}]}, "greater than 0"),
        ({"relaxation": [{"fraction": 0.0, "time_s": 1.0}]}, "greater than 0"),
    ],
)
def test_a_material_that_makes_no_sense_is_refused(wrong, wanted):
    with pytest.raises(ValueError, match=wanted):
        MaterialSpec(**{"young_modulus_mpa": 0.7, "poisson_ratio": 0.47, **wrong})


def test_an_object_that_grips_better_sliding_than_sticking_is_refused():
    plane = load_object("plane").model_dump()
    ObjectSpec.model_validate({**plane, "friction": 0.5, "kinetic_friction": 0.5})
    for wrong, wanted in (
        ({"kinetic_friction": 0.6}, "not be larger"),
        ({"slip_weakening_mm": 0.0}, "greater than 0"),
        ({"friction": -0.1}, "greater"),
    ):
        with pytest.raises(ValueError, match=wanted):
            ObjectSpec.model_validate({**plane, "friction": 0.5, **wrong})


@pytest.mark.parametrize("static, kinetic", [(0.3, 0.6), (-0.1, -0.1), (float("nan"), 0.1), (float("inf"), 0.1)])
def test_friction_that_makes_no_sense_is_refused(static, kinetic):
    with pytest.raises(ContactError, match="kinetic <= static"):
        Friction(static, kinetic)


def test_no_shear_stress_exceeds_its_bound(solver):
    bound_mpa = 0.004
    law = Friction(0.8, 0.8, shear_strength_mpa=bound_mpa)
    state = solver.press(load_object("plane"), ContactPose(2.0, shear_mm=(1.0, 0.0)), friction=law)
    stress = np.linalg.norm(state.tangential_n, axis=1) / state.point_area_mm2
    assert stress.max() <= bound_mpa * (1 + 1e-9)
    assert (np.linalg.norm(state.tangential_n, axis=1) <= 0.8 * state.normal_n * (1 + 1e-9)).all()
    assert np.count_nonzero(stress > 0.999 * bound_mpa) > 10
