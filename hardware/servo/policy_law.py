"""A policy as the law of a loop: it converts the policy's action to the arm's next pose."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.rig.geometry import matrix_of, pose_of
from twin.estimate import Estimate
from twin.policy import KnownContacts, Policy, PolicyError, PolicyModel, load_policy
from twin.rig.mounting import Mounting

AROUND = ("SurfaceFollow", "ContourFollow")
"""Tasks whose policies follow an object's outline, as a loop with an arm needs it."""


def policy_law(policy: Policy, mounting: Mounting) -> Callable[[np.ndarray, Estimate], np.ndarray]:
    """Function from the arm's pose (6,) and the policy's answer to a frame to the next pose (6,)."""
    T_tool_work = np.eye(4)
    T_tool_work[:3, :3] = mounting.work_axes

    def law(pose: np.ndarray, answer: Estimate) -> np.ndarray:
        step = policy.step(np.asarray(answer.value, float))
        move = np.eye(4)
        move[:3, :3] = Rotation.from_rotvec(step[3:], degrees=True).as_matrix()
        move[:3, 3] = step[:3]
        return pose_of(matrix_of(pose) @ T_tool_work @ move @ T_tool_work.T, pose)

    return law


def load_for_outlines(path: Path, contacts_of: Callable[[Policy], KnownContacts | None] = lambda _: None) -> PolicyModel:
    """Load a policy that follows an object's outline, ready for frames. ``contacts_of`` gives the contacts that it knows.

    Raises
    ------
    PolicyError
        The file holds no policy, or one of another task.
    """
    policy = load_policy(path)
    if policy.about["task"] not in AROUND:
        raise PolicyError(f"{path}: a policy of {policy.about['task']}; to follow an outline give a policy of {' or '.join(AROUND)}")
    return PolicyModel(policy, contacts=contacts_of(policy))
