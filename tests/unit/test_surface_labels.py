"""A label means the same on every object: the flat plate that has it would be touched alike."""

import numpy as np
import pytest

from scenes import load_experiment, load_object, load_sensor
from twin.rig.kinematics import Mounting, object_pose, rig_of
from twin.rig.touch import SmoothSurface, surface_labels

SAME_MM, SAME_DEG = 3e-3, 1e-4  # what a plate that leans by a degree, or an arm whose other axes are off a little, leaves out
SURFACE = load_experiment("surface-2d")


def poses_of(sensor, count=40):
    """Poses of the arm (M, 6) about an object, and the object's as the sensor sees it (M, 4, 4)."""
    low, high = np.array([[-4, -4, 0, 0, 0, -20], [4, 0, 0, 0, 0, 20]])
    poses = np.random.default_rng(0).uniform(low, high, (count, 6))
    return poses, np.stack([object_pose(rig_of(sensor), SURFACE, pose, sensor.skin.outer_radius_mm) for pose in poses])


@pytest.mark.parametrize("name", ["mg400-331", "mg400-127", "ur5-331"])
def test_on_the_flat_plate_labels_are_the_arms_own(name):
    sensor = load_sensor(name)
    level = {"turn_offset_deg": (0.0, 0.0, rig_of(sensor).turn_offset_deg[2])}  # not out of the angle's plane
    sensor = sensor.model_copy(update={"rig": rig_of(sensor).model_copy(update=level)})
    poses, T = poses_of(sensor)
    found = surface_labels(SURFACE, Mounting.of(sensor, SURFACE), SmoothSurface(load_object("plane")), T)
    slope = np.tan(np.radians(rig_of(sensor).plate_tilt_deg))
    assert np.abs(found["pose_6"] - poses[:, 5]).max() < SAME_DEG
    assert np.abs(found["pose_2"] - (poses[:, 1] - slope * poses[:, 0])).max() < SAME_MM


@pytest.mark.parametrize("name", ["sphere", "cylinder", "edge", "square"])
def test_a_flat_plate_with_an_objects_labels_is_touched_at_the_same_distance_and_angle(name):
    sensor = load_sensor("mg400-331")
    rig, surface = rig_of(sensor), SmoothSurface(load_object(name))
    _, T = poses_of(sensor)
    found = surface_labels(SURFACE, Mounting.of(sensor, SURFACE), surface, T)
    for seen, depth, angle in zip(T, found["pose_2"], found["pose_6"], strict=True):
        plate = object_pose(rig, SURFACE, np.array([0, depth, 0, 0, 0, angle]), sensor.skin.outer_radius_mm)
        centre = -seen[:3, :3].T @ seen[:3, 3]
        distance, outward, _ = surface.field.probe(centre[None])
        assert plate[:3, 2] @ plate[:3, 3] == pytest.approx(distance[0], abs=SAME_MM)
        normal, flat = -seen[:3, :3] @ outward[0], plate[:3, 2]
        assert np.degrees(np.arccos(min(normal @ flat, 1.0))) < 1e-4


def test_beside_a_balls_pole_depth_and_angle_are_those_of_the_line_between_the_centres():
    sensor, radius_mm = load_sensor("mg400-331"), load_object("sphere").shape.radius_mm
    _, T = poses_of(sensor)
    touch = SmoothSurface(load_object("sphere")).depth_and_angle(Mounting.of(sensor, SURFACE), T)
    to_ball = T[:, :3, 3] + radius_mm * T[:, :3, 2]
    assert np.allclose(touch.indent_mm, sensor.skin.outer_radius_mm + radius_mm - np.linalg.norm(to_ball, axis=1))
    assert np.allclose(np.cos(np.radians(touch.angle_deg)), to_ball[:, 2] / np.linalg.norm(to_ball, axis=1), atol=1e-4)
    assert np.allclose(np.linalg.norm(touch.place_mm - [0, 0, radius_mm], axis=1), radius_mm)


def test_a_texture_lifts_the_surface_by_its_height():
    sensor, can = load_sensor("mg400-331"), load_object("mesh-can")
    _, T = poses_of(sensor)
    mounting, bare = Mounting.of(sensor, SURFACE), can.model_copy(update={"texture": None})
    lifted = SmoothSurface(can).depth_and_angle(mounting, T).indent_mm - SmoothSurface(bare).depth_and_angle(mounting, T).indent_mm
    assert np.allclose(lifted, can.texture.wire_diameter_mm)


def test_turns_about_several_axes_give_no_angle_label():
    sensor, tilted = load_sensor("ur5-331"), load_experiment("surface-3d")
    _, T = poses_of(sensor, 2)
    assert surface_labels(tilted, Mounting.of(sensor, tilted), SmoothSurface(load_object("sphere")), T) == {}
