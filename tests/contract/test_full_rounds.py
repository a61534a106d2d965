"""An MG400 follows whole rounds, again and again: its last axis turns back by itself, clear of the object."""

from types import SimpleNamespace

import numpy as np
import pytest
from arms import mg400_of
from noisy_camera import NoisyCamera
from true_estimator import TrueEstimator

from hardware.arms.motion import MG400
from hardware.emulators.mg400 import Mg400Emulator
from hardware.rig.geometry import HOLD_DEG, LastAxis, PlacedObject, turns_back_mm
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm
from hardware.servo.following import steps_round
from hardware.servo.loop import LoopSettings, ServoLoop
from hardware.workcell.build import Rig
from scenes import load_experiment, load_object, load_sensor, load_servo
from twin.rig.kinematics import Mounting

OBJECTS = ("can", "mesh-can", "square", "prism", "tin-box")
SPEED = 20.0  # of the emulated arm, times real
TURN_DEG = 180.0  # more than this in one step is a turn back
NEAR_MM = 5.0  # of the dome to the surface


def placed_object(name, servo):
    return PlacedObject(load_object(name), servo.placement, Mounting.of(load_sensor("mg400-331"), load_experiment(servo.experiment)))


def rounds(name, count, *, feed_mm, blocking=True):
    """Follow an object ``count`` times. Gives each round's loop, and where the arm was all the time."""
    servo = load_servo("surface").model_copy(
        update={"feed_mm": feed_mm, "clear_mm": 20.0, "blind_mm": 8.0, "largest_move_mm": feed_mm + 2.0}
    )
    placed = placed_object(name, servo)
    with Mg400Emulator(port_offset=None, time_scale=SPEED) as emulator:
        safe = SafeArm(mg400_of(emulator), load_limits("mg400"))
        with NoisyCamera(fps=200) as source, safe:
            truth = TrueEstimator(SimpleNamespace(track=SimpleNamespace(pose=emulator.pose)), placed)
            for _ in range(count):
                steps, way_mm = steps_round(placed, servo, 1.0)
                settings = LoopSettings(steps, blocking=blocking, period_s=0.03)
                loop = ServoLoop(Rig(source, safe, placed, True), servo, truth, settings)
                loop.run(placed.start_pose(servo.indent_mm))
                yield loop, placed, steps, way_mm


def assert_whole(loop, placed, steps):
    assert len(loop.records) == steps
    assert all("turned back" in note for note in loop.notes), loop.notes
    assert len(loop.notes) == 1, loop.notes
    turns = [abs(record.sent[5] - record.pose[5]) for record in loop.records]
    assert max(turns) < 30.0  # never a full turn at the object
    depths = [placed.touch(record.pose).indent_mm for record in loop.records[2:]]
    assert min(depths) > 0.0


def test_two_rounds_in_a_row():
    for loop, placed, steps, _ in rounds("can", 2, feed_mm=5.0):
        assert_whole(loop, placed, steps)


def test_a_whole_round_of_a_streamed_loop():
    for loop, placed, steps, _ in rounds("can", 1, feed_mm=2.0, blocking=False):
        assert_whole(loop, placed, steps)


@pytest.mark.slow
@pytest.mark.parametrize("name", OBJECTS)
def test_ten_rounds_in_a_row(name):
    for loop, placed, steps, _ in rounds(name, 10, feed_mm=1.0):
        assert_whole(loop, placed, steps)


@pytest.mark.parametrize("name", OBJECTS)
def test_the_turn_back_is_planned(name):
    servo = load_servo("surface")
    placed = placed_object(name, servo)
    (at_mm,) = turns_back_mm(placed, LastAxis(MG400, placed.mounting.centre_mm), servo.indent_mm, 1000.0)
    assert 80.0 < at_mm < 260.0
    assert turns_back_mm(placed, LastAxis(None), servo.indent_mm, 1000.0) == []
    assert turns_back_mm(placed, LastAxis(MG400), servo.indent_mm, at_mm - 1.0) == []


@pytest.mark.parametrize("beyond_deg", [-20.0, -1.0, 1.0, 4.0, 20.0])
@pytest.mark.parametrize("end", [-180.0, 180.0])
def test_a_pose_beyond_the_end_is_held_about_the_sensor_and_keeps_its_turn(end, beyond_deg):
    centre = np.array([0.0, -30.0, 0.0])
    axis = LastAxis(MG400, centre)
    pose = np.array([300.0, 60.0, 0, 0, 0, np.degrees(np.arctan2(60, 300)) + end + np.sign(end) * beyond_deg])
    held, off = axis.on_turn(pose, end)
    joints = MG400.inverse(held)
    assert -180.0 < joints[3] < 180.0 and MG400.nearest_pose(held)[5] == pytest.approx(held[5])
    assert off == pytest.approx(max(beyond_deg, 0.0), abs=6.0) and (off == 0.0) == (beyond_deg < 0)
    where = [p[:3] + _turn(p[5]) @ centre for p in (pose, held)]
    np.testing.assert_allclose(*where, atol=0.2)
    turned = axis.turned_back(held, pose)
    assert (turned is not None) == (off > HOLD_DEG) or abs(beyond_deg) < 5
    if turned is not None and off > HOLD_DEG:
        assert abs(turned[5] - held[5]) > TURN_DEG


def _turn(deg):
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
