"""The object's way as the sensor sees it, against what the arm does by definition."""

import numpy as np
import pytest

from scenes import RigSpec, load_experiment, load_object, load_sensor
from scenes.body import SkinSpec
from scenes.rig import PlacedSpec
from twin.errors import ContactError
from twin.objects import build_field
from twin.objects.analytic import Plane
from twin.rig.contact import contact_law
from twin.rig.kinematics import TURNING, Mounting, arm_path, object_pose, rig_of
from twin.rig.labels import ArmLabel

EXACT_MM = 1e-9
TOUCH_MM = 3e-3  # the dome is sampled
ARC_MM = 6e-3  # what a path's straight pieces miss of the arm's arc
RADIUS_MM, TAP_MM = 20.0, 5.0
SENSOR, SURFACE = load_sensor("mg400-331"), load_experiment("surface-2d")
PLAIN = RigSpec(tcp_to_dome_mm=0.0, image_turn_deg=90.0)
FITTED = rig_of(SENSOR)


def label(depth, angle, move_mm, move_deg, executed=True):
    return ArmLabel(np.array([0, depth, 0, 0, 0, angle]), np.array([move_mm, 0, 0, 0, 0, move_deg]), executed)


def way(rig, *numbers):
    return arm_path(rig, SURFACE, SENSOR.skin, Plane(), label(*numbers))


def carried(path, start, stop, points):
    """Where material points of the plate go (k, 3) between two poses."""
    T = path.poses[stop] @ np.linalg.inv(path.poses[start])
    return points @ T[:3, :3].T + T[:3, 3]


def indentation_mm(T):
    return RADIUS_MM - T[:3, 2] @ T[:3, 3]


def test_an_unturned_sensor_indents_by_pose_and_tap_straight_down():
    poses = way(PLAIN, -1.5, 0.0, 0.0, 0.0, False).path.poses
    assert np.allclose(poses[:, 2, 2], 1) and np.allclose(poses[:, 2, 3], [RADIUS_MM, RADIUS_MM - (TAP_MM - 1.5)], atol=TOUCH_MM)


def test_without_contact_the_way_ends_clear():
    made = way(PLAIN, -TAP_MM - 0.1, 0.0, 0.0, 0.0)
    assert not made.touches and all(indentation_mm(T) < 0 for T in made.path.poses)
    assert np.array_equal(made.labels[-1].pose, [0, -TAP_MM - 0.1, 0, 0, 0, 0])


def test_a_tap_that_begins_in_contact_is_followed_from_first_touch():
    """As in the recordings, whose deepest taps begin 0.35 mm inside the plate."""
    path = way(PLAIN, 0.3, 0.0, 0.0, 0.0).path
    assert abs(indentation_mm(path.poses[0])) < TOUCH_MM and indentation_mm(path.poses[1]) == pytest.approx(TAP_MM + 0.3)
    with pytest.raises(ContactError, match="in the sensor's way"):
        way(PLAIN, 11.0, 0.0, 0.0, 0.0)


def test_robot_x_is_where_the_image_turn_says():
    """The arm moves by +x: the plate goes the other way, seen from the sensor."""
    for turn_deg in (90.0, 30.0):
        path = way(PLAIN.model_copy(update={"image_turn_deg": turn_deg}), -1.0, 0.0, 2.0, 0.0).path
        moved = path.poses[-1, :3, 3] - path.poses[1, :3, 3]
        assert np.allclose(moved, [-2 * np.cos(np.radians(turn_deg)), -2 * np.sin(np.radians(turn_deg)), 0], atol=EXACT_MM)


def test_the_arm_turns_about_the_tcp():
    turn_rad = np.radians(FITTED.image_turn_deg)
    across = np.array([np.cos(turn_rad), np.sin(turn_rad), 0])
    tcp = (-FITTED.tcp_to_dome_mm * np.array([0, 0, 1]) - FITTED.tcp_lateral_mm * across)[None]
    path = way(FITTED, -1.0, 6.0, 0.0, 5.0).path
    assert np.allclose(carried(path, 1, len(path.poses) - 1, tcp), tcp, atol=EXACT_MM)
    turn = path.poses[-1, :3, :3] @ path.poses[1, :3, :3].T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(5.0)


def test_a_left_handed_robot_turns_the_other_way():
    left = PLAIN.model_copy(update={"turn_sign": -1})
    for pose in ([0, 0, 0, 0, 0, 7.0], [0, 0, 0, 0, 0, -7.0]):
        assert np.allclose(object_pose(PLAIN, SURFACE, pose, RADIUS_MM), object_pose(left, SURFACE, np.negative(pose), RADIUS_MM))


def test_the_tap_goes_along_robot_y_and_starts_at_first_touch():
    path = way(FITTED, -1.0, 15.0, 3.0, -2.0).path
    assert abs(indentation_mm(path.poses[0])) < TOUCH_MM and indentation_mm(path.poses[1]) > 1
    move = path.poses[1, :3, 3] - path.poses[0, :3, 3]
    off_normal = np.degrees(np.arccos(-move @ path.poses[0, :3, 2] / np.linalg.norm(move)))
    assert off_normal == pytest.approx(abs(FITTED.plate_tilt_deg), abs=1e-6)


def test_a_move_that_was_not_executed_leaves_the_state_before_it():
    done, undone = (way(FITTED, -1.0, 10.0, 3.0, -4.0, executed).path for executed in (True, False))
    assert len(done.poses) > 2 and np.array_equal(done.poses[:2], undone.poses)
    same = way(FITTED, -1.0, 14.0, 3.0, 0.0, False).path
    assert np.allclose(same.poses, undone.poses)


def test_labels_on_the_way_are_those_of_the_poses():
    made = way(FITTED, -1.0, 10.0, 3.0, -4.0)
    for fraction in (0.0, 0.13, 0.5, 0.77, 1.0):
        at = made.path.at(fraction * (len(made.path.poses) - 1))
        exact = object_pose(FITTED, SURFACE, made.label(fraction).pose, RADIUS_MM)
        assert np.abs(at - exact).max() < ARC_MM
    assert np.allclose(made.label(1.0).pose, [0, -1, 0, 0, 0, 10]) and np.allclose(made.label(1.0).move, [3, 0, 0, 0, 0, -4])
    assert not made.label(0.1).move.any()


def test_the_plate_is_one_plane_in_the_world():
    """Indentation differs along the plate by its tilt, and by nothing else."""
    straight = -FITTED.turn_offset_deg[2]
    indents = [indentation_mm(object_pose(FITTED, SURFACE, [x, -1.0, 0, 0, 0, straight], RADIUS_MM)) for x in (-5.0, 0.0, 5.0)]
    assert np.allclose(np.diff(indents) / 5, -np.sin(np.radians(FITTED.plate_tilt_deg)), atol=1e-12)
    tilted = RigSpec(tcp_to_dome_mm=0.0, plate_tilt_deg=3.0)  # sensor's x is robot +x: the plate's normal leans towards -x
    assert object_pose(tilted, SURFACE, np.zeros(6), RADIUS_MM)[0, 2] == pytest.approx(-np.sin(np.radians(3)))


@pytest.mark.parametrize("approach", ["x", "y", "z"])
def test_every_approach_is_a_rigid_motion_that_indents_alike(approach):
    experiment = SURFACE.model_copy(update={"approach": approach})
    T = object_pose(PLAIN, experiment, np.zeros(6), RADIUS_MM)
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3)) and np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert indentation_mm(T) == pytest.approx(TAP_MM)


def test_an_edge_lies_where_its_label_says():
    """Tapped from above: the object's edge, along robot y, is at minus pose_1 across and turned by minus pose_6."""
    experiment, rig = load_experiment("edge-2d"), RigSpec(tcp_to_dome_mm=-RADIUS_MM)
    T = object_pose(rig, experiment, np.array([1.5, 0, 3.0, 0, 0, 20.0]), RADIUS_MM)
    along, origin = T[:2, 1], T[:2, 3]
    assert np.degrees(np.arctan2(along[1], along[0])) == pytest.approx(90 - 20)
    assert np.hypot(*origin) == pytest.approx(1.5) and RADIUS_MM - T[2, 3] == pytest.approx(3.0)


@pytest.mark.parametrize("name", ["mg400-331", "mg400-127"])
def test_every_label_of_the_recordings_leads_somewhere(name):
    generator, sensor = np.random.default_rng(0), load_sensor(name)
    for numbers in generator.uniform([-4, -20, -5, -5], [0, 20, 5, 5], (20, 4)):
        made = arm_path(rig_of(sensor), SURFACE, sensor.skin, Plane(), label(*numbers))
        assert made.touches and 0.5 < indentation_mm(made.path.poses[1]) < 7.5


@pytest.mark.parametrize(("approach", "sign"), [("x", 1), ("y", 1), ("y", -1), ("z", -1)])
def test_an_arm_that_turns_under_a_force_is_where_a_larger_angle_would_have_sent_it(approach, sign):
    plan = load_experiment("surface-2d").model_copy(update={"approach": approach})
    rig = RigSpec(tcp_to_dome_mm=-17.0, tcp_lateral_mm=0.7, tcp_binormal_mm=0.4, turn_sign=sign, image_turn_deg=80.0, plate_tilt_deg=-1.0)
    pose, further = np.zeros(6), np.zeros(6)
    pose[TURNING[approach]] = 12.0
    further[TURNING[approach]] = 12.0 + 0.6
    sent = object_pose(rig, plan, pose, 20.0)
    mounting, plane = Mounting(rig, plan, SkinSpec()), load_object("plane")
    assert contact_law(rig, mounting, plane).given_way is None
    turning = contact_law(rig.model_copy(update={"turn_compliance_deg_per_n": 0.3}), mounting, plane).pose
    across, aside = mounting.across_in_sensor, np.cross([0.0, 0.0, 1.0], mounting.across_in_sensor)
    force_n = 2.0 * across + 5.0 * np.array([0.0, 0.0, 1.0]) + 3.0 * aside
    assert np.allclose(turning(sent, force_n), object_pose(rig, plan, further, 20.0), atol=1e-9)
    assert np.allclose(turning(sent, force_n - 2.0 * across), sent)


def test_a_tap_of_the_tool_goes_along_the_sensor_s_own_axis_and_ends_where_another_does():
    plan = load_experiment("surface-3d")
    rig = PLAIN.model_copy(update={"turn_sign": -1, "image_turn_deg": 20.0, "tcp_to_dome_mm": 5.0})
    field, pose = build_field(load_object("plane")), np.array([0, 0, 3.0, 8.0, -11.0, 0])
    own, straight = (
        arm_path(rig, each, SkinSpec(), field, ArmLabel(pose, np.zeros(6))).path.poses
        for each in (plan.model_copy(update={"tap_frame": "tool"}), plan)
    )
    assert own[-1] == pytest.approx(straight[-1])
    way, normal = own[1, :3, 3] - own[0, :3, 3], straight[1, :3, 3] - straight[0, :3, 3]
    assert way / np.linalg.norm(way) == pytest.approx([0, 0, -1], abs=1e-9)
    assert normal / np.linalg.norm(normal) == pytest.approx(-straight[0, :3, 2], abs=1e-9)


def test_an_object_is_turned_about_the_approach_and_shifted_in_the_robots_axes():
    """An edge along robot x that begins at y = 1: from y < 1 the arm taps beside it, from y > 1 on it, wherever the tool is turned to."""
    plan = load_experiment("edge-circle")
    placed = PlacedSpec(object="edge", contact_offset_mm=0.5, object_shift_mm=(0.0, 1.0), object_turn_deg=90.0)
    rig = RigSpec(tcp_to_dome_mm=-RADIUS_MM, placed=(placed,))
    before, field = rig.for_object("edge"), build_field(load_object("edge"))
    assert before.placed == () and before.contact_offset_mm == 0.5 and rig.for_object("plane") == rig.model_copy(update={"placed": ()})
    for turn in (0.0, 77.0, -150.0):
        for y, beside in ((-14.0, True), (9.0, False)):
            T = object_pose(before, plan, np.array([3.0, y, 2.0, 0, 0, turn]), RADIUS_MM)
            indent_mm = RADIUS_MM - field.distance(np.linalg.inv(T)[None, :3, 3])[0]
            assert (indent_mm < 0) if beside else (indent_mm == pytest.approx(2.5, abs=1e-6)), (turn, y, indent_mm)


def test_an_object_that_is_placed_twice_is_refused():
    with pytest.raises(ValueError, match="'edge' is given twice"):
        RigSpec(tcp_to_dome_mm=0.0, placed=(PlacedSpec(object="edge"), PlacedSpec(object="edge")))
