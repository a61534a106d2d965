"""Laws of surface following: it converges, its integral is bounded, and it does not depend on how the scene is turned."""

import numpy as np
import pytest

from hardware.rig.geometry import PlacedObject, shift_in_tool
from hardware.servo.loop import Memory, Reading, reading_at, servo_step, tangent_of
from hardware.servo.trajectory import distance_along, jerk, local_smoothness, lost_contacts, smoothness
from scenes import PlacementSpec, load_experiment, load_object, load_sensor, load_servo
from twin.rig.arm_pose import matrix_of, pose_of
from twin.rig.kinematics import Mounting

EXACT_MM = 1e-9
SERVO = load_servo("surface")


@pytest.fixture(params=["mg400-331", "mg400-127"])
def mounting(request):
    return Mounting.of(load_sensor(request.param), load_experiment("surface-2d"))


def placed(mounting, name, **placement):
    return PlacedObject(load_object(name), PlacementSpec(**placement), mounting)


def follow(scene, pose, steps, servo=SERVO, noise=None):
    """Poses (steps + 1, 6) and touches of a perfect estimator (or a noisy one) and a perfect arm."""
    memory, poses, touches = Memory(), [pose], []
    for k in range(steps):
        touch = scene.touch(pose)
        touches.append(touch)
        extra = np.zeros(2) if noise is None else noise[k]
        reading = Reading(touch.depth_mm + extra[0], touch.angle_deg + extra[1])
        step = servo_step(servo, scene.mounting, tangent_of(scene.mounting, pose, reading), pose, memory)
        pose, memory = step.pose, step.memory
        poses.append(pose)
    return np.array(poses), touches


def test_it_converges_on_a_plane_from_too_shallow_and_askew(mounting):
    scene = placed(mounting, "plane", turn_deg=20.0)
    start = scene.start_pose(1.0)
    start[5] += 12.0
    _, touches = follow(scene, start, 60)
    assert abs(touches[-1].depth_mm - SERVO.indent_mm) < 1e-3
    assert abs(touches[-1].angle_deg) < 0.05
    late = [abs(touch.depth_mm - SERVO.indent_mm) for touch in touches]
    assert max(late[40:]) < 0.01 < late[0]


def test_without_its_integral_a_curved_surface_leaves_an_angle(mounting):
    scene = placed(mounting, "can")
    start = scene.start_pose(SERVO.indent_mm)
    alone = SERVO.model_copy(update={"ki_angle": 0.0, "ki_depth": 0.0})
    _, with_integral = follow(scene, start, 80)
    _, without = follow(scene, start, 80, alone)
    assert abs(with_integral[-1].angle_deg) < 0.1 * abs(without[-1].angle_deg)


def test_a_turned_scene_turns_the_trajectory(mounting):
    turn_deg = 73.0
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turn = np.array([[c, -s], [s, c]])
    noise = np.random.default_rng(0).normal(0, [0.05, 1.0], (60, 2))
    one = placed(mounting, "square", position_mm=(100.0, 0.0, 0.0))
    other = placed(mounting, "square", position_mm=(100 * c, 100 * s, 0.0), turn_deg=turn_deg)
    straight, _ = follow(one, one.start_pose(2.0), 60, noise=noise)
    turned, _ = follow(other, other.start_pose(2.0), 60, noise=noise)
    np.testing.assert_allclose(turned[:, :2], straight[:, :2] @ turn.T, atol=1e-6)
    np.testing.assert_allclose(turned[:, 5] - straight[:, 5], turn_deg, atol=1e-6)


@pytest.mark.parametrize(
    "name", ["can", "square", *(pytest.param(more, marks=pytest.mark.slow) for more in ("mesh-can", "prism", "tin-box"))]
)
def test_a_perfect_estimator_goes_round_each_object(mounting, name):
    scene = placed(mounting, name)
    outline = scene.outline()
    round_mm = np.linalg.norm(np.diff(outline, axis=0), axis=1).sum()
    poses, touches = follow(scene, scene.start_pose(SERVO.indent_mm), int(1.4 * round_mm + 120))
    indents = np.array([touch.indent_mm for touch in touches])
    assert indents.min() > 0.5 and indents.max() < 6.0
    assert lost_contacts(indents) == 0
    assert abs(poses[:, 5]).max() > 360


def test_the_integral_and_the_step_are_bounded(mounting):
    scene = placed(mounting, "plane")
    pose = shift_in_tool(scene.start_pose(0.0), -40 * mounting.axis)  # far from the surface: the error never goes away
    pose[5] += 80.0
    memory = Memory()
    for _ in range(200):
        step = servo_step(SERVO, mounting, tangent_of(mounting, pose, Reading(-40.0, 80.0)), pose, memory)
        memory = step.memory
        assert abs(memory.depth_mm) <= SERVO.integral_mm and abs(memory.angle_deg) <= SERVO.integral_deg
        assert np.linalg.norm(step.pose[:3] - pose[:3]) <= SERVO.largest_move_mm + EXACT_MM
        assert abs(step.pose[5] - pose[5]) <= SERVO.largest_turn_deg + 1e-9


def test_an_old_frame_serves_as_well_as_a_new_one_on_a_plane(mounting):
    """What counts is where the arm was at the exposure: against the same plane the step is the same."""
    scene = placed(mounting, "plane", turn_deg=-35.0)
    then = scene.start_pose(2.0)
    then[5] += 5.0
    now = shift_in_tool(then, [3.0, 0.7, 0.0])
    now[5] -= 2.0
    steps = []
    for seen_at in (then, now):
        touch = scene.touch(seen_at)
        tangent = tangent_of(mounting, seen_at, Reading(touch.depth_mm, touch.angle_deg))
        steps.append(servo_step(SERVO, mounting, tangent, now, Memory()))
    np.testing.assert_allclose(steps[0].pose, steps[1].pose, atol=1e-6)


def test_an_old_frame_adds_nothing_to_the_sums(mounting):
    pose = np.zeros(6)
    memory = Memory(0.5, -2.0)
    step = servo_step(SERVO, mounting, tangent_of(mounting, pose, Reading(1.0, 3.0)), pose, memory, fresh=False)
    assert step.memory == memory


def test_tangent_and_reading_are_inverse(mounting):
    pose = np.array([210.0, -40.0, 12.0, 0.0, 0.0, 33.0])
    reading = Reading(2.3, -7.0)
    got = reading_at(mounting, tangent_of(mounting, pose, reading), pose)
    assert (got.depth_mm, got.angle_deg) == (pytest.approx(2.3), pytest.approx(-7.0))


def test_labels_and_readings_are_inverse(mounting):
    depth, angle = mounting.labels(2.0, 5.0)
    assert (mounting.depth_mm(depth), mounting.angle_deg(angle)) == (pytest.approx(2.0), pytest.approx(5.0))


def test_a_pose_survives_the_way_there_and_back():
    pose = np.array([1.0, 2.0, 3.0, 10.0, -20.0, 200.0])
    np.testing.assert_allclose(pose_of(matrix_of(pose), near=pose), pose, atol=1e-9)


def test_the_papers_smoothness_depends_on_the_axes_and_the_local_one_does_not():
    x = np.arange(40.0)
    points = np.column_stack([x, 0.1 * np.sin(x)])
    c, s = np.cos(1.0), np.sin(1.0)
    turned = points @ np.array([[c, -s], [s, c]]).T
    assert smoothness(np.column_stack([x, 0.5 * x])) == pytest.approx(0.5)
    assert smoothness(turned) > 5 * smoothness(points)
    assert local_smoothness(turned) == pytest.approx(local_smoothness(points))
    assert jerk(turned) == pytest.approx(jerk(points))
    assert jerk(np.column_stack([x, x**2])) == pytest.approx(0, abs=1e-9)


def test_lost_contacts_are_counted_once_each():
    assert lost_contacts(np.array([1, 1, -1, -2, 1, 0, 3.0])) == 2


def test_the_way_goes_on_over_the_start():
    turn = np.linspace(0, 2 * np.pi, 201)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    angles = np.linspace(0, 3 * np.pi, 50)
    way = distance_along(circle, np.column_stack([np.cos(angles), np.sin(angles)]))
    np.testing.assert_allclose(way, angles, atol=0.05)
