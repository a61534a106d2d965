"""The way to an object leads around it."""

import numpy as np
import pytest

from hardware.errors import DeviceError
from hardware.rig.geometry import PlacedObject, path_around, shift_in_tool
from scenes import load_experiment, load_object, load_sensor, load_servo
from twin.rig.arm_pose import matrix_of
from twin.rig.kinematics import Mounting

SAMPLES = 200  # along each straight piece


def before(name):
    sensor, servo = load_sensor("mg400-331"), load_servo("surface")
    return PlacedObject(load_object(name), servo.placement, Mounting.of(sensor, load_experiment("surface-2d")))


@pytest.fixture
def placed():
    return before("square")


def clear_of(placed):
    return shift_in_tool(placed.start_pose(3.0), -50.0 * placed.mounting.axis)


def gaps_mm(placed, way):
    """Of the dome from the object, along straight pieces with the turn in proportion."""
    poses = [a + t * (b - a) for a, b in zip(way[:-1], way[1:], strict=True) for t in np.linspace(0, 1, SAMPLES)]
    return np.array([-placed.touch(pose).indent_mm for pose in poses])


@pytest.mark.parametrize("side_deg", range(0, 360, 45))
def test_from_any_side_the_dome_stays_clear_of_the_object(placed, side_deg):
    clear = clear_of(placed)
    middle = placed.T_base_object[:3, 3] + 40.0 * placed.T_base_object[:3, 2]  # of the square
    away = np.array([np.cos(np.radians(side_deg)), np.sin(np.radians(side_deg)), 0.0])
    start = clear.copy()
    start[:3] = middle + 150.0 * away - matrix_of(clear)[:3, :3] @ placed.mounting.centre_mm
    way = [start, *path_around(placed, start, clear)]
    assert np.allclose(way[-1], clear)
    assert gaps_mm(placed, way).min() > 5.0


def test_in_the_open_it_is_straight(placed):
    clear = clear_of(placed)
    (only,) = path_around(placed, shift_in_tool(clear, -100.0 * placed.mounting.axis), clear)
    assert only is clear


def test_from_behind_and_near_it_first_goes_outward(placed):
    clear = clear_of(placed)
    middle, inward = placed.T_base_object[:3, 3] + 40.0 * placed.T_base_object[:3, 2], placed.T_base_object[:3, 2]
    start = clear.copy()
    start[:3] = middle + 65.0 * inward - matrix_of(clear)[:3, :3] @ placed.mounting.centre_mm  # 5 mm behind the square
    way = [start, *path_around(placed, start, clear)]
    assert np.allclose((way[1] - start)[:3] / np.linalg.norm((way[1] - start)[:3]), inward)
    gaps = gaps_mm(placed, way)
    assert gaps.min() == pytest.approx(5.0, abs=0.1) and gaps[SAMPLES:].min() > 5.0


@pytest.mark.parametrize("name", ["plane", "edge"])
def test_to_an_object_without_an_end_it_is_straight_from_the_front_and_from_contact(name):
    placed = before(name)
    clear = clear_of(placed)
    for start in (shift_in_tool(clear, 60.0 * placed.mounting.across), placed.start_pose(4.0)):
        (only,) = path_around(placed, start, clear)
        assert only is clear


@pytest.mark.parametrize("name", ["plane", "edge"])
def test_through_an_object_without_an_end_there_is_no_way(name):
    placed = before(name)
    behind = placed.start_pose(70.0)
    behind[:3] += 30.0 * placed.T_base_object[:3, 0]  # of the edge, too
    with pytest.raises(DeviceError, match=f"the {name} leads .* behind its surface.*jog the arm"):
        path_around(placed, behind, clear_of(placed))
