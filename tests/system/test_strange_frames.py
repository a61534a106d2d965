"""A strange frame in the middle of following an object: the arm holds, and goes on with the next good one."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from coarse_skin import use_coarse_skin

from hardware.servo.loop import LoopSettings, ServoLoop
from hardware.workcell.build import RigPlan, build_rig
from scenes import load_experiment, load_object, load_servo
from training.estimate.estimator import PoseEstimator

STEPS, STRANGE = 6, 4


def torn(image):
    middle = len(image) // 2
    return np.concatenate([image[:middle], np.roll(image[middle:], 9, 1)])


@pytest.mark.parametrize(
    "change", [lambda image: np.roll(image, 9, 1), torn, lambda image: image[:, ::-1].copy()], ids=["rolled", "torn", "mirrored"]
)
def test_a_strange_frame_holds_the_arm_and_the_next_good_one_goes_on(change, monkeypatch):
    use_coarse_skin(monkeypatch)
    model, servo = PoseEstimator.load("mg400-331"), load_servo("surface")
    plan = RigPlan(load_object("can"), servo, camera="twin", arm="simulated", plain_light=True)
    rig = build_rig(plan, model.sensor, load_experiment(servo.experiment), form=model.form, at_once=True)
    answers, poses = [], []

    def estimate(frame):
        if len(answers) == STRANGE:
            frame = replace(frame, image=change(frame.image))
        answers.append(model(frame))
        poses.append(rig.arm.state().pose)
        return answers[-1]

    with rig:
        loop = ServoLoop(rig, servo, estimate, LoopSettings(STEPS, frame_timeout_s=rig.frame_timeout_s))
        loop.run(rig.placed.start_pose(servo.indent_mm))
    assert [answer.valid for answer in answers[STRANGE - 1 : STRANGE + 2]] == [True, False, True]
    assert answers[STRANGE].reason.startswith(("displaced camera", "torn frame", "not a contact", "ambiguous pins", "inconsistent pins"))
    np.testing.assert_allclose(poses[STRANGE + 1], poses[STRANGE], atol=1e-6)  # it stood until the next frame
    assert len(loop.records) == STEPS
    steps_mm = [np.linalg.norm(after.pose[:3] - before.pose[:3]) for before, after in pairwise(loop.records)]
    assert max(steps_mm) < 1.5 * servo.feed_mm
