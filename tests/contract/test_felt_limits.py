"""A servo on the emulated MG400 lets go at too large a force, and holds still at a smaller one or where the contact slides."""

from contextlib import ExitStack, contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from arms import mg400_of
from noisy_camera import NoisyCamera
from true_estimator import TrueEstimator

from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError
from hardware.rig.geometry import PlacedObject
from hardware.safety.decide import DecisionCode, load_limits
from hardware.safety.safe_arm import RefusedMoveError, SafeArm
from hardware.servo.loop import LoopSettings, ServoLoop
from hardware.workcell.build import Rig
from scenes import load_experiment, load_object, load_sensor, load_servo
from twin.rig.kinematics import Mounting

SPEED = 20.0  # of the emulated arm, times real
STEPS = 6
ODD = 3  # estimate from which on the contact is not as it should be


class Feeling:
    """A true estimator that also tells force and slip; from estimate ``ODD`` on, before ``until``, those of ``odd``."""

    def __init__(self, inner, odd, until):
        self.inner, self.odd, self.until = inner, odd, until

    def __call__(self, frame):
        told = {"force_x": 0.0, "force_y": 0.0, "force_z": 3.0, "torque_z": 0.0, "slip_share": 0.1, "slip_begins": 0.05}
        told |= self.odd if ODD <= self.inner.calls < self.until else {}
        pose, more = self.inner(frame), np.array(list(told.values()))
        ends = {key: np.concatenate([getattr(pose, key), more]) for key in ("value", "low", "high")}
        return replace(pose, names=(*pose.names, *told), **ends)


@contextmanager
def feeling(odd, until=10**6, **limited):
    servo = load_servo("surface")
    mounting = Mounting.of(load_sensor("mg400-331"), load_experiment(servo.experiment))
    placed = PlacedObject(load_object("can"), servo.placement, mounting)
    limits = load_limits("mg400").model_copy(update=limited)
    with ExitStack() as stack:
        emulator = stack.enter_context(Mg400Emulator(port_offset=None, time_scale=SPEED))
        source = stack.enter_context(NoisyCamera(fps=200))
        safe = stack.enter_context(SafeArm(mg400_of(emulator), limits))
        truth = TrueEstimator(SimpleNamespace(track=SimpleNamespace(pose=emulator.pose)), placed)
        loop = ServoLoop(Rig(source, safe, placed, True), servo, Feeling(truth, odd, until), LoopSettings(STEPS, give_up_s=0.3))
        yield loop, placed, emulator, placed.start_pose(servo.indent_mm)


@pytest.mark.parametrize(("odd", "code"), [({"force_z": 40.0}, DecisionCode.TOO_STRONG), ({"torque_z": -900.0}, DecisionCode.TOO_TWISTED)])
def test_too_large_a_force_or_torque_ends_the_contact(odd, code):
    with feeling(odd) as (loop, placed, emulator, start):
        with pytest.raises(RefusedMoveError) as refused:
            loop.run(start)
        assert refused.value.decision.code is code
        assert len(loop.records) == ODD
        assert placed.touch(emulator.pose()).indent_mm < 0  # retreated


def test_a_contact_that_slides_is_held_still_where_slip_is_limited():
    with feeling({"slip_share": 0.8}) as (loop, _, _, start):
        assert loop.run(start).steps == STEPS  # a servo slides along the surface on purpose: no limit by default
    with feeling({"slip_share": 0.8}, slip_share=0.5) as (loop, _, _, start):
        with pytest.raises(DeviceError, match="holds still.*80% of the contact slides"):
            loop.run(start)
        assert len(loop.records) == ODD


@pytest.mark.parametrize(
    ("odd", "limited", "said"),
    [
        ({"force_z": 8.0}, {"hold_force_n": 5.0}, "is 8.0 N .*holds still above 5 N"),
        ({"torque_z": -90.0}, {"hold_torque_nmm": 60.0}, "is 90 N mm .*holds still above 60 N mm"),
        ({"slip_begins": 0.9}, {"slip_begins": 0.5}, "begins to slide .probability 90%"),
    ],
)
def test_the_arm_holds_still_at_a_force_a_torque_or_the_beginning_of_slip_and_goes_on_when_it_is_over(odd, limited, said):
    with feeling(odd, **limited) as (loop, placed, emulator, start):
        with pytest.raises(DeviceError, match=f"holds still.*{said}"):
            loop.run(start)
        assert len(loop.records) == ODD
    with feeling(odd, **limited, until=ODD + 4) as (loop, placed, emulator, start):
        assert loop.run(start).steps == STEPS
        assert any("held still before step 3" in note for note in loop.notes)
        poses = [record.pose for record in loop.records]
        assert np.linalg.norm(poses[ODD][:3] - loop.records[ODD - 1].sent[:3]) < 1.0  # it stood where it was held
