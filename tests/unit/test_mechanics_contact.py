"""Contact states obey the laws of statics, of friction and of symmetry."""

from itertools import pairwise

import numpy as np
import pytest
from block import Watched, last, rotation, soft_sensor, usual_sensor
from finer_mesh import shaped

from scenes.load import load_object
from twin.camera.projection import project
from twin.errors import ContactError
from twin.geometry.solid import Resolution
from twin.mechanics import ContactLaw, ContactPath, ContactPose, Friction, SkinSolver
from twin.mechanics.balance import in_object
from twin.mechanics.contact import STICK_CREEP_MM, contact_forces, contact_points, spread_forces
from twin.mechanics.newton import GAP_BOUND_MM, RESIDUAL_TOLERANCE
from twin.mechanics.path import plan_path
from twin.objects import build_field
from twin.objects.analytic import Sphere

SOLVER_MM = 1e-4  # what the residual's tolerance leaves open in a position
BETWEEN_MM = 0.02  # deepest place of the skin inside the object (measured 0.015; on a fillet of 0.1 mm 0.021)
BALANCE = 1e-6  # relative to the force: rounding
AREA_SHARE = 0.05  # relative: contact area against a finer mesh (measured 0.0003; edges of other fillets up to 0.058)
TURNED = 1e-3  # relative: a turned scene; the grid turns with it, and the penalty may be raised at another time


@pytest.fixture(scope="module")
def sensor():
    return usual_sensor()


@pytest.fixture(scope="module")
def solver(sensor):
    return Watched(sensor, resolution=Resolution(10))


@pytest.fixture(scope="module")
def sheared(solver):
    return solver.press(load_object("plane"), ContactPose(2.5, shear_mm=(1.5, 0.0)))


@pytest.fixture(scope="module", params=["sphere", "edge", "can", "compliant plane"])
def tilted(request, sensor):
    """A solver after a contact with everything at once, its object and the state."""
    solver = Watched(sensor, resolution=Resolution(12))
    spec = load_object(request.param.split()[-1])
    compliance = 0.3 if "compliant" in request.param else 0.0
    pose = ContactPose(2.0, tilt_deg=(8.0, -5.0), shear_mm=(0.8, -0.5), twist_deg=10.0)
    return solver, spec, solver.press(spec, pose, compliance_mm_per_n=compliance)


# --- the law at the contact points


@pytest.mark.parametrize("name", ["plane", "sphere", "cylinder"])
@pytest.mark.parametrize("friction", [0.0, 0.6])
@pytest.mark.parametrize("soften, bound_n", [(1.0, np.inf), (0.1, np.inf), (1.0, 0.02)])
def test_contact_stiffness_is_minus_the_derivative_of_its_forces(name, friction, soften, bound_n):
    field, generator, count = build_field(load_object(name)), np.random.default_rng(5), 400
    at = np.column_stack([generator.normal(scale=2, size=(count, 2)), np.zeros(count)])
    for _ in range(3):
        distance, normal, _ = field.probe(at)
        at = at - distance[:, None] * normal
    at -= generator.uniform(-0.005, 0.03, (count, 1)) * field.probe(at)[1]
    anchor = at + generator.normal(scale=0.8 * STICK_CREEP_MM / soften, size=at.shape)
    stiff, mu = generator.uniform(1, 5, count), np.full(count, friction)

    def forces(places):
        return contact_forces(field, places, stiff, anchor, mu, np.full(count, bound_n), soften)

    now, step = forces(at), 1e-7
    pressing = now.penetration_mm > 0
    assert np.count_nonzero(pressing) > 200 and np.count_nonzero(~pressing) > 20
    if friction:
        assert np.count_nonzero(now.slipping) > 30 and np.count_nonzero(pressing & ~now.slipping) > 30
    for axis, unit in enumerate(np.eye(3)):
        change = (forces(at + step * unit).force_n - forces(at - step * unit).force_n) / (2 * step)
        assert np.abs(change + now.stiffness[:, :, axis]).max() < 1e-5 * np.abs(now.stiffness).max()


def test_point_forces_are_normal_plus_friction_in_the_cone_and_slip_is_on_it():
    field, generator = build_field(load_object("sphere")), np.random.default_rng(5)
    at = np.column_stack([generator.normal(scale=1, size=(300, 2)), np.full(300, 0.2)])
    anchor, mu = at + generator.normal(scale=0.01, size=at.shape), generator.uniform(0, 1, 300)
    found = contact_forces(field, at, np.full(300, 2.0), anchor, mu, np.full(300, np.inf))
    bounded = contact_forces(field, at, np.full(300, 2.0), anchor, mu, np.full(300, 0.1))
    tangential = found.force_n - found.normal_n[:, None] * found.normal
    size = np.linalg.norm(tangential, axis=1)
    assert np.abs(np.einsum("pi,pi->p", tangential, found.normal)).max() < 1e-12
    assert (size <= mu * found.normal_n * (1 + 1e-9)).all()
    assert np.allclose(size[found.slipping], (mu * found.normal_n)[found.slipping])
    assert (np.einsum("pi,pi->p", tangential, at - anchor) <= 1e-12).all()  # against the travel
    less = np.linalg.norm(bounded.force_n - bounded.normal_n[:, None] * bounded.normal, axis=1)
    held = np.divide(size, mu * found.normal_n, where=mu * found.normal_n > 0, out=np.zeros(300))
    assert np.allclose(less, held * np.minimum(mu * found.normal_n, 0.1)) and np.count_nonzero(mu * found.normal_n > 0.1) > 50
    left = at - found.anchor_mm
    along = left - np.einsum("pi,pi->p", left, found.normal)[:, None] * found.normal
    assert np.allclose(np.linalg.norm(along[found.slipping], axis=1), STICK_CREEP_MM, rtol=1e-6)
    sticking = ~found.slipping & (found.penetration_mm > 0)
    assert sticking.any() and np.array_equal(found.anchor_mm[sticking], anchor[sticking])


# --- statics


def test_no_contact_moves_nothing(solver):
    rest = solver.rest()
    for indent in (0.0, -2.0):
        state = solver.press(load_object("sphere"), ContactPose(indent))
        assert np.array_equal(state.nodes_mm, rest.nodes_mm)
        assert np.array_equal(state.caps_mm, rest.caps_mm)
        assert not state.force_n.any() and state.area_mm2 == 0
    away = np.eye(4)
    away[2, 3] = 25.0
    nearer = away.copy()
    nearer[2, 3] = 20.5
    for _, state in solver.path(load_object("plane"), ContactPath(np.stack([away, nearer]))):
        assert np.abs(state.nodes_mm - rest.nodes_mm).max() < 1e-9
        assert not state.force_n.any() and len(state.contact_mm) == 0


def test_pressing_pushes_the_object_back_and_shearing_against_its_motion(sheared):
    assert sheared.force_n[2] > 0
    assert sheared.force_n[0] < 0
    assert abs(sheared.force_n[1]) < 1e-3 * sheared.force_n[2]
    assert sheared.area_mm2 > 0


def test_tractions_sum_to_force_torque_and_area(tilted):
    _, _, state = tilted
    assert state.residual <= RESIDUAL_TOLERANCE
    traction = state.tangential_n - state.normal_n[:, None] * state.normal
    assert np.abs(traction.sum(axis=0) - state.force_n).max() < BALANCE * np.linalg.norm(state.force_n)
    torque = np.cross(state.contact_mm, traction).sum(axis=0)
    assert np.abs(torque - state.torque_nmm).max() < BALANCE * np.linalg.norm(state.torque_nmm)
    pressed = state.pressure_mpa[:, None] * state.normal - state.traction_mpa
    assert np.allclose(-pressed.T @ state.point_area_mm2, state.force_n)
    assert 0 < state.point_area_mm2.sum() <= state.area_mm2
    assert np.allclose(np.linalg.norm(state.normal, axis=1), 1)


def test_the_clamps_carry_the_force_and_its_torque(tilted):
    """Third law. The torque differs by that of the lift between the splines' surface and the sphere, which moves with the skin as it is."""
    solver, _, state = tilted
    inner, points = solver.elastic_forces(), solver.setting.body.points
    traction = state.tangential_n - state.normal_n[:, None] * state.normal
    at = points.positions(solver.state.control_mm)
    where = np.array([np.linalg.norm(at - place, axis=1).argmin() for place in state.contact_mm])
    spread_forces(points.controls[where], points.weights[where], traction, inner)
    free = solver.setting.body.free
    size = np.linalg.norm(state.force_n)
    assert np.linalg.norm(inner[free]) < 2 * RESIDUAL_TOLERANCE * np.abs(traction).sum()
    assert np.abs(inner[~free].sum(axis=0) - state.force_n).max() < 10 * RESIDUAL_TOLERANCE * size
    torque = np.cross(solver.state.control_mm[~free], inner[~free]).sum(axis=0)
    lifted = np.cross(points.lift_mm[where], traction).sum(axis=0)
    assert np.abs(torque + lifted - state.torque_nmm).max() < 10 * RESIDUAL_TOLERANCE * size * 20
    assert np.linalg.norm(lifted) < 0.02 * np.linalg.norm(state.torque_nmm)


def test_nothing_lies_deeper_in_the_object_than_the_bound(tilted):
    solver, spec, state = tilted
    T, field = state.T_sensor_object, build_field(spec)
    at = solver.setting.body.points.positions(solver.state.control_mm)
    gap = field.distance((at - T[:3, 3]) @ T[:3, :3])
    assert gap.min() >= -GAP_BOUND_MM * 1.0001
    assert np.count_nonzero(gap < 0) == len(state.contact_mm)


def test_friction_stays_in_its_cone_at_every_point(tilted):
    _, spec, state = tilted
    size = np.linalg.norm(state.tangential_n, axis=1)
    assert (size <= spec.friction * state.normal_n * (1 + 1e-9)).all()
    assert (state.normal_n > 0).all()
    assert np.abs(np.einsum("ci,ci->c", state.tangential_n, state.normal)).max() < 1e-9 * state.normal_n.max()
    assert size.max() > 0


def test_friction_vanishes_without_friction_and_slides_at_its_coefficient(solver):
    pose = ContactPose(2.0, shear_mm=(3.0, 1.0))
    for mu in (0.0, 0.2):
        state = solver.press(load_object("plane"), pose, friction=mu)
        tangential = np.linalg.norm(state.tangential_n, axis=1)
        assert (tangential <= mu * state.normal_n * (1 + 1e-9)).all()
        assert np.hypot(*state.force_n[:2]) == pytest.approx(mu * state.force_n[2], rel=0.02, abs=1e-9)
    assert state.slipping.mean() > 0.9


def test_more_friction_drags_the_pins_further_along_the_shear(solver, sensor):
    rest = project(sensor.view, solver.rest().caps_mm)
    moved = []
    for mu in (0.0, 0.2, 1.0):
        state = solver.press(load_object("plane"), ContactPose(2.0, shear_mm=(1.2, 0.0)), friction=mu)
        moved.append((project(sensor.view, state.caps_mm) - rest).mean(axis=0)[0])
    assert abs(moved[0]) < 0.1 < moved[1] < moved[2]


def test_tilt_presses_the_side_that_comes_first(solver):
    """Turned right-handed about +y, a plane's +x side comes down: it meets the dome at polar angle 20 deg on +x."""
    state = solver.press(load_object("plane"), ContactPose(2.0, tilt_deg=(0.0, 20.0)))
    centre = state.normal_n @ state.contact_mm / state.normal_n.sum()
    assert centre[0] == pytest.approx(20 * np.sin(np.radians(20)), abs=1.0)
    assert abs(centre[1]) < 0.1


def test_area_force_energy_and_mean_spread_grow_with_depth(solver, sensor):
    rest = project(sensor.view, solver.rest().caps_mm)
    centre, path = rest[0], []
    for _, state in solver.path(load_object("plane"), ContactPose(4.5)):
        radial = np.linalg.norm(project(sensor.view, state.caps_mm) - centre, axis=1) - np.linalg.norm(rest - centre, axis=1)
        path.append((state.force_n[2], radial.mean(), state.area_mm2, state.elastic_nmm))
    force, spread, area, energy = np.array(path).T
    assert (np.diff(force) > 0).all() and (np.diff(energy) > 0).all()
    assert area[2] > area[0] > 0  # later the dome dimples, and the contact becomes a ring
    assert (np.diff(spread) > 0).all() and spread[0] > 0


def test_the_contact_area_grows_with_the_press_and_hardly_depends_on_the_mesh(sensor):
    usual, finer = (
        [state.area_mm2 for _, state in SkinSolver(sensor, resolution=Resolution(across)).path(load_object("edge"), ContactPose(1.5))]
        for across in (18, 28)
    )
    assert (np.diff(usual) > 0).all()
    assert usual[-1] == pytest.approx(finer[-1], rel=AREA_SHARE)


@pytest.mark.parametrize("name, shape", [("edge", {"fillet_mm": 0.5}), ("edge", {"fillet_mm": 0.2}), ("sphere", {"radius_mm": 2.0})])
def test_between_the_contact_points_the_skin_is_hardly_deeper(sensor, monkeypatch, name, shape):
    solver, field = SkinSolver(sensor), build_field(shaped(name, **shape))
    plan = plan_path(sensor.geometry, field, ContactPose(1.5))
    going = solver.begin(field, ContactLaw(), plan.at(0.0), focus=solver.focus(field, plan))
    for start, stop in pairwise(np.linspace(0, 1, 5)):
        for _ in going.advance(plan.at, start, stop, plan.time_s, "pressed"):
            pass
    monkeypatch.setattr("twin.mechanics.contact.POINTS_PER_ELEMENT", 16)
    between = contact_points(going.setting.solid, solver.shape).positions(going.load.control_mm)
    gap_mm = field.distance(in_object(between, going.load.T, going.load.border))
    assert -gap_mm.min() < BETWEEN_MM


def test_the_rim_of_a_patch_slides_first_and_in_the_end_all_of_it(solver, sheared):
    started = solver.press(load_object("plane"), ContactPose(2.5, shear_mm=(0.5, 0.0)))
    assert 0 < started.slip_share < sheared.slip_share == 1
    limit = load_object("plane").friction * started.pressure_mpa
    used = np.linalg.norm(started.traction_mpa, axis=1) / limit
    assert np.allclose(used[started.slipping], 1) and (used[~started.slipping] < 1).all()


def test_work_without_friction_is_stored(solver):
    """The force is the derivative of the stored energy by the way (Castigliano); trapezoids leave some per mille."""
    states = [state for _, state in solver.path(load_object("plane"), ContactPose(2.0), friction=0.0, step_mm=0.1)]
    force = np.array([0.0] + [state.force_n[2] for state in states])
    height = np.array([20.0] + [state.T_sensor_object[2, 3] for state in states])
    work = (-(force[1:] + force[:-1]) / 2 * np.diff(height)).sum()
    assert work == pytest.approx(states[-1].elastic_nmm, rel=0.01)
    assert all(state.dissipated_nmm == 0 for state in states)


# --- symmetry


def turned(plan, angle_rad):
    """A path and all that's in it turned about the sensor's axis."""
    turn = np.eye(4)
    turn[:3, :3] = rotation([0, 0, 1], angle_rad)
    return ContactPath(turn @ plan.poses, plan.times_s), turn[:3, :3]


@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("angle_deg", [37, *(pytest.param(more, marks=pytest.mark.slow) for more in (15, 90, -105))])
@pytest.mark.parametrize("name", ["cylinder", "edge"])
def test_a_turned_scene_gives_the_turned_answer(solver, name, friction, angle_deg):
    """The grid turns with the object and the contact."""
    field = build_field(load_object(name))
    plan = plan_path(solver.spec.geometry, field, ContactPose(2.0, tilt_deg=(0.0, 12.0), shear_mm=(0.8, 0.3), offset_mm=(2.0, 0.0)))
    state = solver.press(field, plan, friction=friction)
    caps, at = state.caps_mm, state.T_sensor_object
    plan, turn = turned(plan, np.radians(angle_deg))
    other = solver.press(field, plan, friction=friction)
    assert np.abs(other.T_sensor_object[:3, :3] - turn @ at[:3, :3]).max() < 1e-9
    size = np.linalg.norm(state.force_n)
    assert np.abs(turn @ state.force_n - other.force_n).max() < TURNED * size
    assert np.abs(turn @ state.torque_nmm - other.torque_nmm).max() < TURNED * size * 20
    assert other.elastic_nmm == pytest.approx(state.elastic_nmm, rel=TURNED)
    assert len(caps) == len(other.caps_mm)


# --- compliance, sealing


def test_a_compliant_object_yields_by_compliance_times_force(solver):
    """Without friction, whose history depends on the load steps."""
    pose, compliance, plane = ContactPose(2.0), 0.4, load_object("plane").model_copy(update={"friction": 0.0})
    hard = solver.press(plane, pose, compliance_mm_per_n=0.0)
    soft = solver.press(plane, pose, compliance_mm_per_n=compliance)
    assert soft.force_n[2] < hard.force_n[2]
    yielded = soft.T_sensor_object[2, 3] - hard.T_sensor_object[2, 3]
    assert yielded == pytest.approx(compliance * soft.force_n[2], rel=1e-5)
    same = solver.press(plane, ContactPose(2.0 - yielded), compliance_mm_per_n=0.0)
    assert same.force_n[2] == pytest.approx(soft.force_n[2], rel=1e-4)


@pytest.mark.parametrize("pose", [ContactPose(2.0), ContactPose(2.0, tilt_deg=(10.0, 0.0), shear_mm=(0.8, 0.3))])
def test_a_sealed_gel_keeps_its_volume_and_is_stiffer(sensor, solver, pose):
    sealed = Watched(soft_sensor(sensor, gel={"sealed": True, "poisson_ratio": 0.45}), resolution=Resolution(10))
    open_one = Watched(soft_sensor(sensor, gel={"poisson_ratio": 0.45}), resolution=Resolution(10))
    forces, growth = [], []
    for one in (open_one, sealed):
        state = one.press(load_object("plane"), pose)
        forces.append(state.force_n[2])
        gel, out = one.setting.body.kinds[1:], np.zeros_like(one.state.control_mm)
        volume = sum(kind.cells.weights_mm3.sum() for kind in gel)
        growth.append(sum(kind.add_volume(one.state.control_mm, out) for kind in gel) / volume)
    assert growth[0] < -1e-4  # the open gel gives way
    assert abs(growth[1]) < 1e-6
    assert forces[1] > 1.01 * forces[0]
    assert one.state.border[1] < 0  # the gel is under pressure
    inner = sealed.elastic_forces()
    traction = state.tangential_n - state.normal_n[:, None] * state.normal
    assert np.abs(inner.sum(axis=0)).max() < 1e-9  # sealing is no outer force
    assert traction.sum(axis=0) == pytest.approx(state.force_n)


@pytest.mark.parametrize("law", ["mooney-rivlin", "yeoh"])
def test_other_laws_press_alike_at_little_indentation_and_yeoh_stiffer_at_more(sensor, law):
    own = {"mooney-rivlin": {"second_invariant_share": 0.3}, "yeoh": {"c20_c10": 100.0}}[law]
    plain = Watched(sensor, resolution=Resolution(10))
    other = Watched(soft_sensor(sensor, skin={"law": law, **own}), resolution=Resolution(10))
    few, more = ([one.press(load_object("sphere"), ContactPose(mm)).force_n[2] for one in (plain, other)] for mm in (0.2, 3.0))
    assert few[1] == pytest.approx(few[0], rel=0.02)
    if law == "yeoh":
        assert more[1] > 1.005 * more[0]
    else:
        assert more[1] != more[0]


# --- friction with a kinetic coefficient


def drags(solver, friction, shear_mm=3.0, step_mm=0.1):
    plan = plan_path(solver.spec.geometry, build_field(load_object("plane")), ContactPose(1.5, shear_mm=(shear_mm, 0.0)))
    states = [(at, state) for at, state in solver.path(load_object("plane"), plan, friction=friction, step_mm=step_mm) if at > 0.5]
    return np.array([-state.force_n[0] / state.force_n[2] for _, state in states]), states


def test_force_drops_after_breakaway_where_kinetic_friction_is_less(solver):
    ratio, states = drags(solver, Friction(0.6, 0.3, 0.1))
    assert ratio.max() > 0.4
    assert ratio[-1] == pytest.approx(0.3, rel=0.05)
    assert ratio[-1] < 0.8 * ratio.max()
    assert states[-1][1].slipping.mean() > 0.9


def test_equal_coefficients_are_plain_coulomb_friction(solver):
    pose = ContactPose(1.5, shear_mm=(1.5, 0.0))
    plain = solver.press(load_object("plane"), pose, friction=0.4)
    equal = solver.press(load_object("plane"), pose, friction=Friction(0.4, 0.4, 0.05))
    assert np.array_equal(plain.nodes_mm, equal.nodes_mm)
    assert np.array_equal(plain.force_n, equal.force_n)
    object_ = load_object("plane").model_copy(update={"friction": 0.6, "kinetic_friction": 0.4, "slip_weakening_mm": 0.05})
    from_spec = solver.press(object_, pose)
    assert np.array_equal(from_spec.force_n, solver.press(object_, pose, friction=Friction(0.6, 0.4, 0.05)).force_n)
    assert not np.array_equal(from_spec.force_n, plain.force_n)


def test_drag_without_weakening_rises_to_the_coefficient_and_stays(solver):
    ratio, _ = drags(solver, 0.3, step_mm=0.3)
    assert (np.diff(ratio) > -2e-3).all()
    assert ratio[-1] == pytest.approx(0.3, rel=0.02)
    assert last(solver.path(load_object("plane"), ContactPose(1.5), friction=0.3)).dissipated_nmm >= 0


def test_shear_stress_never_exceeds_its_bound(solver):
    """Where the bound is low it alone holds the object: force = strength times area, however hard the press."""
    strength = 0.002
    bounded = load_object("plane").model_copy(update={"shear_strength_mpa": strength})
    state = solver.press(bounded, ContactPose(2.0, shear_mm=(3.0, 0.0)))
    stress = np.linalg.norm(state.tangential_n, axis=1) / state.point_area_mm2
    assert (stress <= strength * (1 + 1e-9)).all()
    assert (np.linalg.norm(state.tangential_n, axis=1) <= bounded.friction * state.normal_n * (1 + 1e-9)).all()
    assert np.hypot(*state.force_n[:2]) <= strength * state.point_area_mm2.sum() * (1 + 1e-9)
    free = solver.press(load_object("plane"), ContactPose(2.0, shear_mm=(3.0, 0.0)))
    assert np.hypot(*state.force_n[:2]) < 0.8 * np.hypot(*free.force_n[:2])
    high = bounded.model_copy(update={"shear_strength_mpa": 1e3})
    assert np.array_equal(solver.press(high, ContactPose(2.0, shear_mm=(3.0, 0.0))).force_n, free.force_n)


def test_an_object_between_the_points_of_the_mesh_is_no_contact_without_force(solver):
    """The skin would let it through, and the answer would be 0 N."""
    with pytest.raises(ContactError, match=r"2\.0 mm inside the skin, and no point of the skin's mesh has met it.*larger object"):
        solver.press(Sphere(0.3), ContactPose(2.0))
    assert solver.press(Sphere(3.0), ContactPose(2.0)).force_n[2] > 0.1
