"""A policy of ``GraspLift`` observes and commands on a real gripper what it observes and commands in its environment."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="mujoco (the extra) is not installed")
import training.environments  # noqa: F401
from training.environments.grasp import SETTLE_STEPS, TOUCHING_MM, GraspPolicy, load_grasp_policy
from twin.policy import PolicyError

OBJECT_MM = 40.0
WIDEST_MM = OBJECT_MM - 2 + 2 * TOUCHING_MM  # of the scene's gripper


def step_with(index, pins_px):
    """A step of the live loop, in which these pins are found."""
    graphs = [SimpleNamespace(nodes_px=pins) for pins in pins_px]
    return SimpleNamespace(index=index, pins={name: SimpleNamespace(graph=graph) for name, graph in zip("lr", graphs, strict=True)})


def test_a_live_policy_observes_and_commands_what_the_environment_has():
    env = gymnasium.make("tactip/GraspLift-v0", disable_env_checker=True)
    seen, _ = env.reset(seed=3)
    grasp, rng, observed = env.unwrapped, np.random.default_rng(0), []
    policy = GraspPolicy(lambda each: observed.append(each) or actions[len(observed) - 1], OBJECT_MM)
    actions = rng.uniform(-0.5, 1.5, (40, 1))
    for index in range(2 * SETTLE_STEPS):
        motion, width_mm = policy(step_with(index, grasp.rest_px))
        assert not motion.any() and width_mm == (OBJECT_MM + 4 if index < SETTLE_STEPS else OBJECT_MM - 2)
    hand_mm = 0.0
    for index, action in enumerate(actions):
        motion, width_mm = policy(step_with(2 * SETTLE_STEPS + index, [each.pins_px for each in grasp.felt]))
        assert {name: observed[-1][name].tolist() for name in seen} == {name: seen[name].tolist() for name in seen}
        seen, *_ = env.step(np.clip(action, -1, 1))
        hand_mm += motion[2]
        hand, grip = grasp.scene.data.ctrl * 1e3
        assert (hand_mm, width_mm) == pytest.approx((hand, WIDEST_MM - 2 * grip)) and not motion[[0, 1, 3, 4, 5]].any()
    assert np.abs(observed[-1]["tactile"][1]).max() > 0.01 < np.abs(observed[-1]["tactile"][0]).max()


@pytest.fixture(scope="module")
def learners(tmp_path_factory):
    """Untrained policies in ZIP files by their observations."""
    sb3 = pytest.importorskip("stable_baselines3", reason="stable_baselines3 (the extra rl) is not installed")
    found = {}
    for observation in ("pins", "none"):
        env = gymnasium.make("tactip/GraspLift-v0", disable_env_checker=True, observation=observation)
        learner = sb3.PPO("MultiInputPolicy", env, seed=0, device="cpu", n_steps=4, batch_size=4)
        path = tmp_path_factory.mktemp("policy") / f"{observation}.zip"
        learner.save(path)
        found[observation] = learner, path
    return found


def test_a_zip_file_of_stable_baselines3_gives_the_mean_action(learners):
    learner, path = learners["pins"]
    act, space = load_grasp_policy(str(path)), learner.observation_space
    space.seed(1)
    for _ in range(3):
        seen = space.sample()
        np.testing.assert_array_equal(act(seen), learner.predict(seen, deterministic=True)[0])
    assert len({float(act(space.sample())[0]) for _ in range(3)}) == 3


def test_other_files_and_other_observations_are_refused(learners, tmp_path):
    with pytest.raises(PolicyError, match="give a policy of tactip/GraspLift-v0 with the observation 'pins'"):
        load_grasp_policy(str(learners["none"][1]))
    with pytest.raises(PolicyError, match="nowhere.zip: no such file; give a ZIP file of stable-baselines3"):
        load_grasp_policy("nowhere.zip")
    (tmp_path / "text.zip").write_text("no policy")
    with pytest.raises(PolicyError, match="text.zip: holds no PPO policy"):
        load_grasp_policy(str(tmp_path / "text.zip"))
