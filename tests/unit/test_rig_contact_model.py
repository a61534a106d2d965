"""One contact model: whoever follows an object pose by pose gets the contact that a label's path gives, with the rig's numbers."""

from itertools import pairwise

import numpy as np
import pytest

from scenes import RigSpec, load_experiment, load_object, load_sensor
from scenes.body import SkinSpec
from twin.geometry.solid import Resolution
from twin.mechanics.follow import Follower
from twin.mechanics.law import Friction
from twin.mechanics.path import ContactPath
from twin.mechanics.solver import SkinSolver
from twin.rig.contact import RigContact, contact_law, friction_between
from twin.rig.kinematics import Mounting, object_pose
from twin.rig.labels import ArmLabel

COARSE = Resolution(across=8)
ANGLE_DEG = 1.0  # of the label: so near to the apex both solvers refine the same part of the skin
LIKE_MM = 0.003  # of a cap, a hundredth of a pixel: the solvers choose their load steps differently, and friction remembers the way
TOLD = 20.0  # times that: what each of the rig's numbers changes, so that none can be left out unnoticed
STOPS = [-0.5, 1.0, 2.0, 3.0]  # mm of indentation on the way down
DRAGS_MM = [0.5, 1.0, 1.5, 2.0]
RIGS = {
    "rigid": {},
    "along": {"compliance_mm_per_n": 0.2},
    "turning": {"turn_compliance_deg_per_n": 2.0},
    "both": {"compliance_mm_per_n": 0.2, "turn_compliance_deg_per_n": 2.0},
}
PLANE, SURFACE = load_object("plane"), load_experiment("surface-2d")


def rigged(sensor="mg400-331", **numbers):
    """A sensor on a rig whose friction is not the plate's, and that gives way as told."""
    spec = load_sensor(sensor)
    rig = {"friction": 0.25, "compliance_mm_per_n": 0.0, "turn_compliance_deg_per_n": 0.0} | numbers
    return spec.model_copy(update={"rig": spec.rig.model_copy(update=rig)})


def commanded(rig):
    """Poses of the plate as an arm commands them: pressed a little turned, then dragged along the plate."""
    labels = [np.array([0.0, mm - SURFACE.zero_mm - rig.contact_offset_mm, 0, 0, 0, ANGLE_DEG]) for mm in STOPS]
    labels += [labels[-1] + [mm, 0, 0, 0, 0, 0] for mm in DRAGS_MM]
    return np.stack([object_pose(rig, SURFACE, label, 20.0) for label in labels])


def followed(solver, poses, law):
    follower = Follower(solver, PLANE, law)
    for k, T in enumerate(poses):
        state = follower.move(T, float(k))
    assert follower.restarts == 0
    return state


def largest_mm(one, other):
    return np.linalg.norm(one.caps_mm - other.caps_mm, axis=1).max()


@pytest.mark.parametrize("kind", RIGS)
def test_the_follower_ends_where_the_path_does(kind):
    spec = rigged(**RIGS[kind])
    solver = SkinSolver(spec, resolution=COARSE)
    contact = RigContact(solver, SURFACE, PLANE)
    poses = commanded(contact.rig)
    law = contact_law(spec.rig, Mounting.of(spec, SURFACE), PLANE)
    *_, (_, wanted) = solver.path(PLANE, ContactPath(poses), law=contact.law)
    found = followed(solver, poses, law)
    assert largest_mm(found, wanted) < LIKE_MM
    np.testing.assert_allclose(found.force_n, wanted.force_n, atol=0.02 * np.linalg.norm(wanted.force_n))
    np.testing.assert_allclose(found.T_sensor_object, wanted.T_sensor_object, atol=LIKE_MM)


@pytest.mark.parametrize("left_out", ["friction", "compliance_mm_per_n", "turn_compliance_deg_per_n"])
def test_every_number_of_the_rig_tells(left_out):
    """A follower without one of them would end elsewhere by far more than the tolerance above."""
    spec = rigged(**RIGS["both"])
    instead = PLANE.friction if left_out == "friction" else 0.0
    other = rigged(**(RIGS["both"] | {left_out: instead}))
    solver, mounting, poses = SkinSolver(spec, resolution=COARSE), Mounting.of(spec, SURFACE), commanded(spec.rig)
    whole, part = (followed(solver, poses, contact_law(each.rig, mounting, PLANE)) for each in (spec, other))
    assert largest_mm(whole, part) > TOLD * LIKE_MM


def test_an_arm_stands_where_its_force_holds_it():
    """The pose that is taken is the commanded one, turned and pushed back by the force that is there at the end."""
    spec = rigged(**RIGS["both"])
    solver, law = SkinSolver(spec, resolution=COARSE), contact_law(spec.rig, Mounting.of(spec, SURFACE), PLANE)
    poses = commanded(spec.rig)
    state = followed(solver, poses, law)
    held = law.pose(poses[-1], state.force_n)
    held[2, 3] += law.compliance_mm_per_n * state.force_n[2]
    np.testing.assert_allclose(state.T_sensor_object, held, atol=0.005)  # mm, and the same on a radius of 1 mm for its turn
    assert np.abs(held - poses[-1]).max() > 0.05


@pytest.mark.parametrize("turn_deg", [0.0, 40.0, 90.0, 200.0])
def test_an_arm_turns_by_the_force_in_its_own_frame(turn_deg):
    """Whichever way the object lies, one force turns the arm by one angle about one point of the tool."""
    spec = rigged(**RIGS["turning"])
    law = contact_law(spec.rig, Mounting.of(spec, SURFACE), PLANE)
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    T = np.eye(4)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = [1.0, -2.0, 17.0]
    force_n = np.array([0.3, 1.2, 2.0])
    moved = law.pose(T, force_n) @ np.linalg.inv(T)
    np.testing.assert_allclose(moved, law.pose(np.eye(4), force_n), atol=1e-12)
    across = Mounting.of(spec, SURFACE).across_in_sensor
    assert np.degrees(np.arccos((np.trace(moved[:3, :3]) - 1) / 2)) == pytest.approx(2.0 * abs(across @ force_n))


def test_a_label_commands_the_pose_that_its_path_ends_at():
    spec = rigged()
    contact = RigContact(SkinSolver(spec, resolution=COARSE), SURFACE, PLANE)
    label = ArmLabel(np.array([1.0, -3.0, 0, 0, 0, 8.0]), np.array([1.0, 0, 0, 0, 0, 3.0]))
    poses = contact.commanded_path(label).path.poses
    np.testing.assert_allclose(poses[-1], object_pose(spec.rig, SURFACE, label.pose, 20.0), atol=1e-12)
    assert all(np.abs(one - other).max() > 1e-3 for one, other in pairwise(poses))


def test_the_rigs_friction_counts_and_the_objects_where_there_is_no_rig():
    rubber = PLANE.model_copy(update={"friction": 0.7, "kinetic_friction": 0.4, "shear_strength_mpa": 0.05})
    rig = RigSpec(tcp_to_dome_mm=0.0, friction=0.3)
    assert friction_between(rig, rubber) == Friction(0.3, 0.3)
    assert friction_between(None, rubber) == Friction(0.7, 0.4, rubber.slip_weakening_mm, 0.05)
    mounting = Mounting(rig, SURFACE, SkinSpec())
    assert contact_law(rig, mounting, rubber, friction=0.9).friction == Friction(0.9, 0.9)
    soft = rubber.model_copy(update={"compliance_mm_per_n": 0.1})
    assert contact_law(rig.model_copy(update={"compliance_mm_per_n": 0.2}), mounting, soft).compliance_mm_per_n == pytest.approx(0.3)
