"""The environments' own laws: geometry of tasks, options, spaces, seeds. Contacts are solved on few poses, by the finite elements."""

import pickle
import re
import subprocess
import sys
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.spatial.transform import Rotation
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_for_baselines
from stable_baselines3.common.env_util import make_vec_env
from studio_client import StudioClient

from scenes import load_experiment, load_object, load_sensor
from training.environments import ids
from training.environments.baselines import BaselinesVecEnv
from training.environments.batch import Batch, Options
from training.environments.environment import TactileEnv, TactileVectorEnv, _in_units
from training.environments.observe import Eye
from training.environments.tasks import TASKS, ObjectPush, ObjectRoll, SurfaceFollow
from training.environments.world import AXES, Surfaces, Tool, inverse, motions, standing_on, turn_about, work_frame
from training.estimate.estimator import PoseEstimator
from training.runs.run_files import shipped_names
from training.surrogate.reading import ContactReading, FiniteElements
from twin.errors import ContactError, OptionError

PLACE_TOLERANCE_MM = 1e-6  # of geometry computed in double precision
FAST = {"backend": "fem", "sensor": "mg400-127", "observation": "oracle"}


def tool_of(sensor="mg400-331", experiment="surface-2d"):
    return Tool.of(load_sensor(sensor), load_experiment(experiment))


def test_a_motion_is_the_rotation_of_its_turn_vector():
    rng = np.random.default_rng(0)
    steps = np.concatenate([rng.uniform(-2, 2, (20, 3)), rng.uniform(-90, 90, (20, 3))], axis=1)
    steps[0, 3:] = 0.0
    T = motions(steps)
    assert np.allclose(T[:, :3, :3], Rotation.from_rotvec(steps[:, 3:], degrees=True).as_matrix())
    assert np.allclose(T[:, :3, 3], steps[:, :3])
    assert np.allclose(inverse(T) @ T, np.eye(4))


@pytest.mark.parametrize("thing", ["plane", "can", "ball-40", "square", "mesh-can"])
@pytest.mark.parametrize("sensor", ["mg400-331", "ur5-331"])
def test_a_tool_stands_as_deep_and_as_turned_as_it_is_put(thing, sensor):
    tool, surface = tool_of(sensor), Surfaces()[load_object(thing)]
    T = standing_on(tool, surface, 4.0, 2.3, 7.0)
    touch = surface.depth_and_angle(tool.mounting, tool.object_poses(T[None], np.eye(4)[None]))
    assert touch.indent_mm[0] == pytest.approx(2.3, abs=PLACE_TOLERANCE_MM)
    assert abs(touch.angle_deg[0]) == pytest.approx(7.0, abs=PLACE_TOLERANCE_MM)


def test_objects_of_one_name_have_each_their_own_surface(tmp_path):
    told = []
    for folder, radius_mm in (("a", 8), ("b", 40)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "ball.toml").write_text(f'description = "ball"\nshape = {{ kind = "sphere", radius_mm = {radius_mm} }}\n')
        told.append(load_object(str(tmp_path / folder / "ball.toml")))
    surfaces = Surfaces()
    beside = np.array([[20.0, 0.0, 8.0]])
    assert surfaces[told[0]].field.distance(beside)[0] > 0 > surfaces[told[1]].field.distance(beside)[0]


def test_z_goes_towards_the_object_and_ry_turns_the_tool():
    tool, surface = tool_of(), Surfaces()[load_object("plane")]
    T = standing_on(tool, surface, 0.0, 2.0, 0.0)[None]

    def touched(step):
        return surface.depth_and_angle(tool.mounting, tool.object_poses(T @ motions(np.array([step])), np.eye(4)[None]))

    assert touched([0, 0, 0.5, 0, 0, 0]).indent_mm[0] == pytest.approx(2.5)
    assert touched([1.0, 0, 0, 0, 0, 0]).indent_mm[0] == pytest.approx(2.0)
    assert abs(touched([0, 0, 0, 0, 5.0, 0]).angle_deg[0]) == pytest.approx(5.0)


def test_the_work_frame_is_right_handed():
    for experiment in ("surface-2d", "edge-2d"):
        turn = work_frame(tool_of(experiment=experiment).mounting)[:3, :3]
        assert np.linalg.det(turn) == pytest.approx(1.0)


def test_a_ball_rolls_without_sliding():
    """Its middle moves half as far as the sensor, and the place that it touches of the table does not move."""
    task, tool = ObjectRoll(), tool_of(experiment="edge-2d")
    task.prepare(1)
    start = task.begin(0, tool, load_object("sphere"), Surfaces(), np.random.default_rng(1))
    before, T_object = start.T_work[None], start.T_object[None]
    moved = before @ motions(np.array([[0.2, -0.1, 0, 0, 0, 0]]))
    felt = ContactReading.at_rest(1, np.zeros((331, 3)))
    assert np.array_equal(task.carry_object(felt, moved, before, T_object), T_object)  # nothing holds it
    felt.force_n[0, 2] = 0.5
    after = task.carry_object(felt, moved, before, T_object)
    middle = [T[0, :3, 3] + task.kept[0, 0] * T[0, :3, 2] for T in (T_object, after)]
    assert middle[1] - middle[0] == pytest.approx([0.1, -0.05, 0.0])
    bottom = np.append(middle[0] + [0, 0, task.kept[0, 0]], 1.0)  # of the ball, on the table
    carried = after[0] @ np.linalg.inv(T_object[0]) @ bottom
    assert np.linalg.norm(carried[:3] - bottom[:3]) < 2e-3  # mm; second order in the step


def test_a_block_rests_while_the_push_is_within_its_friction_and_slides_beyond():
    task, tool = ObjectPush(), tool_of()
    task.prepare(1)
    start = task.begin(0, tool, load_object("square"), Surfaces(), np.random.default_rng(0))
    felt = ContactReading.at_rest(1, np.zeros((331, 3)))
    T_work, T_object = start.T_work[None], start.T_object[None]
    forward = (T_work @ tool.T_work_sensor)[0, :3, :3].T @ [0.0, 0.0, 1.0]
    felt.force_n[0] = 0.9 * task.kept[0, 0] * forward * 0.5
    assert task.push_object(felt, T_work, T_object, tool) is None
    felt.force_n[0] = 3.0 * task.kept[0, 0] * forward
    pushed = task.push_object(felt, T_work, T_object, tool)
    assert pushed is not None and pushed[0, 2, 3] > 0.1


def test_a_push_pays_what_it_gains_and_waiting_and_going_back_pay_nothing():
    """With a push straight towards the goal the rewards sum to how much nearer than ever the block has come."""
    batch = Batch("ObjectPush", 1, Options(**FAST))
    batch.begin(0, np.random.default_rng(0))
    task, start, told = batch.task, batch.T_work[0, :3, 3].copy(), []
    batch.goal[0] = [0.0, 50.0]
    batch.T_work[0, :3, :3] = np.eye(3)
    task.kept[0, 1] = nearest = 50.0 - task.lever_mm
    for middle in (10.0, 20.0, 20.0, 15.0, 19.0):
        batch.T_object[0, 2, 3] = middle
        batch.T_work[0, :3, 3] = start + [0.0, 0.0, middle]
        judged = task.evaluate(batch._observe_world())
        told.append((judged.reward[0], judged.terms["gain_mm"][0], judged.terms["off_mm"][0]))
        assert judged.terms["miss_mm"][0] == pytest.approx(0.0)
    reward, gain, off = np.array(told).T
    assert np.allclose(reward, gain) and np.allclose(reward[2:], 0.0)
    assert reward.sum() == pytest.approx(nearest - off.min())


def test_a_way_back_and_forth_covers_nothing():
    batch = Batch("ContourFollow", 1, Options(objects=("square",), **FAST))
    batch.begin(0, np.random.default_rng(0))
    surface, task = Surfaces()[load_object("square")], batch.task
    rewards = []
    for along in (0.0, 0.5, 1.0, 0.5, 1.0, 1.5):
        batch.T_work[0] = standing_on(batch.tool, surface, along, 3.0, 0.0)
        if not rewards:
            pose = batch.tool.object_poses(batch.T_work, batch.T_object)
            task.kept[0, 2:4] = surface.depth_and_angle(batch.tool.mounting, pose).place_mm[0, [0, 2]]
        rewards.append(task.evaluate(batch._observe_world()).reward[0])
    assert rewards == pytest.approx([0.0, 1.0, 1.0, 0.0, 0.0, 1.0]) and task.kept[0, 0] == pytest.approx(1.5)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_failing_is_never_cheaper_than_going_on(name):
    """In no state that a random motion reaches is the reward of going on less than that of failing, which no step follows."""
    batch, rng = Batch(name, 4, Options(observation="oracle")), np.random.default_rng(0)
    failed = gone_on = 0
    for _ in range(3):
        for row in range(4):
            batch.begin(row, rng)
        batch.settle(np.arange(4))
        drift, rows = rng.uniform(-1, 1, (4, len(batch.axes))), np.arange(4)
        for _step in range(25):
            done = batch.step(drift + rng.uniform(-0.3, 0.3, drift.shape), rows)
            lost = done.terminated[rows] & ~done.info["is_success"][rows]
            assert (done.reward[rows][lost] == batch.task.failed_reward).all()
            assert (done.reward[rows][~lost] >= batch.task.failed_reward).all()
            assert np.isfinite([done.info[key] for key in ("indent_mm", *batch.task.evaluate(batch._observe_world()).terms)]).all()
            failed, gone_on = failed + lost.sum(), gone_on + (~lost).sum()
            rows = rows[~done.terminated[rows]]
            if not len(rows):
                break
    assert failed and gone_on


def test_the_goal_of_a_push_is_told_as_the_tool_sees_it():
    """A robot knows where its tool is: a goal 20 mm ahead of a tool that is turned by 90 deg lies beside it."""
    goal = np.array([[3.0, 40.0], [3.0, 40.0]])
    T = np.stack([np.eye(4), turn_about((0, 1, 0), 90.0)])
    T[:, :3, 3] = [3.0, 0.0, 20.0]
    assert np.allclose(ObjectPush().goals_for_agents(goal, T), [[0.0, 2.0], [-2.0, 0.0]])


def test_a_sensor_that_knows_its_angle_gets_around_the_sharpest_corner():
    """With the task's feed and the largest action a proportional law keeps depth and angle on a hexagon with corners of 2 mm."""
    task, tool, surface = TASKS["ContourFollow"](), tool_of(), Surfaces()[load_object("prism")]
    T, way = standing_on(tool, surface, 20.0, 3.0, 0.0)[None], []
    for _ in range(200):
        touch = surface.depth_and_angle(tool.mounting, tool.object_poses(T, np.eye(4)[None]))
        way.append((touch.angle_deg[0], touch.indent_mm[0]))
        step = [*task.feed_mm, 0.0, np.clip(touch.angle_deg[0], -5, 5), 0.0]
        step[2] += np.clip(3.0 - touch.indent_mm[0], -1, 1)
        T = T @ motions(np.array([step]))
    angle, indent = np.array(way).T
    assert 5.0 < np.abs(angle).max() < 20.0 and indent.min() > 2.0  # deg, mm; of 40 deg and contact at all


def test_a_way_around_an_object_begins_anywhere_and_counts_from_there():
    task, tool, surfaces, thing = TASKS["ContourFollow"](), tool_of(), Surfaces(), load_object("square")
    task.prepare(1)
    begun = []
    for seed in range(20):
        task.begin(0, tool, thing, surfaces, np.random.default_rng(seed))
        begun.append(task.kept[0, 2:4].copy())
        assert task.kept[0, 0] == 0.0
        assert np.linalg.norm(surfaces[thing].outline - begun[-1], axis=1).min() < 0.5  # mm, the outline's step
    assert np.abs(np.array(begun)[:, 0]).max() > 37.0 and np.ptp(np.array(begun)[:, 0]) > 40.0  # mm, the corner too


def test_reward_is_largest_where_the_task_wants_the_sensor():
    batch = Batch("SurfaceFollow", 1, Options(**FAST))
    batch.begin(0, np.random.default_rng(0), {"object": "plane"})
    surface = Surfaces()[load_object("plane")]
    rewards = []
    for off_mm in (0.0, 0.5, 1.0):
        batch.T_work[0] = standing_on(batch.tool, surface, 0.0, batch.goal[0, 0] + off_mm, 0.0)
        judged = batch.task.evaluate(batch._observe_world())
        rewards.append(float(judged.reward[0]))
        assert judged.terms["off_mm"][0] == pytest.approx(off_mm)
    assert rewards[0] == pytest.approx(1.0) and rewards == sorted(rewards, reverse=True)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_an_action_of_1_is_the_tasks_largest_motion(name):
    batch = Batch(name, 1, Options(observation="oracle"))
    batch.begin(0, np.random.default_rng(0))
    batch.settle(np.zeros(1, int))
    before = batch.T_work[0].copy()
    batch.step(np.eye(len(batch.axes))[:1], np.zeros(1, int))
    step = np.append(batch.task.feed_mm, np.zeros(3))
    step[AXES.index(batch.axes[0])] += batch.task.largest_mm  # the first axis of all tasks is a shift
    assert np.allclose(batch.T_work[0], before @ motions(step[None])[0])


def test_a_sensor_that_stays_where_it_is_never_presses_gently():
    """Nor does one that follows its object without touching it."""
    env = TactileVectorEnv("GentlePress", 20, autoreset_mode="SameStep", observation="oracle")
    env.reset(seed=5)
    for still in (True, False):
        for _ in range(env.batch.steps):
            action = np.zeros((20, 2)) if still else env.batch.expert() * [1.0, 0.0]
            *_, info = env.step(action)
            assert not np.any(info.get("final_info", {}).get("is_success", False))
        env.reset(seed=5)


def test_every_force_of_a_gentle_press_can_be_reached():
    """The stiffest demand on the softest contact: the expert presses the smallest ball with the largest force, without drift."""
    batch = Batch("GentlePress", 1, Options(objects=("sphere",), observation="oracle"))
    batch.begin(0, np.random.default_rng(0))
    batch.settle(np.zeros(1, int))
    batch.goal[:], batch.task.kept[:] = batch.task.forces_n[1], 0.0
    while not (done := batch.step(batch.expert(), np.zeros(1, int))).truncated[0]:
        assert not done.terminated[0]
    assert done.info["is_success"][0]


@pytest.mark.parametrize("task", ["EdgeFollow", "ObjectRoll"])
@pytest.mark.parametrize(
    ("indent_mm", "fails", "good"), [(2.0, False, True), (-0.5, False, False), (-1.5, True, False), (5.8, True, False)]
)
def test_a_state_without_touch_is_not_good_and_a_lost_object_ends_the_episode(task, indent_mm, fails, good):
    """The sensor where the task wants it but for its height: over the edge, and over the ball."""
    batch = Batch(task, 1, Options(**FAST))
    batch.begin(0, np.random.default_rng(0))
    batch.T_work[0], batch.T_object[0], batch.goal[0] = np.eye(4), np.eye(4), 0.0
    batch.T_work[0, :3, 3] = -batch.tool.T_work_sensor[:3, 3] + [0.0, 0.0, indent_mm - batch.tool.mounting.skin_apex_mm]
    judged = batch.task.evaluate(batch._observe_world())
    assert judged.failed[0] == fails and (judged.good & ~judged.failed)[0] == good


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"observaton": "pins"}, "did you mean 'observation'"),
        ({"observation": "touch"}, "observation='touch'"),
        ({"stack": 0}, "stack=0"),
        ({"axes": ("x", "w")}, "axes="),
        ({"axes": ("x", "x")}, "each axis once"),
        ({"axes": ()}, "expected a name or several"),
        ({"backend": "cuda"}, "backend='cuda'"),
        ({"steps": -1}, "steps=-1"),
        ({"pictures": "photo"}, "pictures='photo'"),
        ({"backend": "fem", "friction_history": False}, "friction_history"),
        ({"friction_history": "no"}, "friction_history='no'"),
        ({"objects": 5}, "objects=5: expected a name or several"),
        ({"objects": ("can", 5)}, "objects="),
        ({"axes": 1.0}, "axes=1.0"),
        ({"sensor": None}, "sensor=None"),
        ({"surrogate": 3}, "surrogate=3"),
        ({"randomise": True}, "randomise=True"),
        ({"stack": True}, "stack=True"),
    ],
)
def test_an_option_that_cannot_be_meant_is_named(given, named):
    with pytest.raises(OptionError, match=named.replace("(", r"\(")):
        Options.from_keywords(given)


def test_no_node_of_a_graph_is_at_the_limit_of_the_observation():
    env = gymnasium.make("tactip/SurfaceFollow-v0", sensor="mg400-331", observation="graph")
    seen, _ = env.reset(seed=0)
    assert np.abs(seen["tactile"]).max() < 0.9 * env.observation_space["tactile"].high.max()


@pytest.mark.parametrize(("task", "thing"), [("ObjectRoll", "can"), ("EdgeFollow", "plane")])
def test_an_object_that_the_task_cannot_use_is_refused(task, thing):
    with pytest.raises(OptionError, match=thing):
        Batch(task, 1, Options(objects=(thing,), **FAST))


def test_wrong_calls_are_named():
    env = gymnasium.make("tactip/SurfaceFollow-v0", disable_env_checker=True, **FAST).unwrapped
    with pytest.raises(OptionError, match="reset"):
        env.step(np.zeros(2))
    with pytest.raises(OptionError, match="'colour'"):
        env.reset(options={"colour": "red"})
    with pytest.raises(OptionError, match="object=3"):
        env.reset(options={"object": 3})
    with pytest.raises(OptionError, match="expected a dict, such as"):
        env.reset(options=["can"])
    with pytest.raises(OptionError, match="did you mean 'SurfaceFollow'"):
        TactileEnv("surfacefollow")
    env.reset(seed=0)
    with pytest.raises(OptionError, match="NaN"):
        env.step(np.array([np.nan, 0.0]))
    with pytest.raises(OptionError, match=r"an action of shape \(2,\) is expected .*, got \(3,\)"):
        env.step(np.zeros(3))
    with pytest.raises(OptionError, match="autoreset_mode='foo' is not supported; give 'NextStep' or 'SameStep'"):
        TactileVectorEnv("SurfaceFollow", 2, autoreset_mode="foo")
    for given in ("up", [[1.0], [1.0, 2.0]], {"x": 1}):
        with pytest.raises(OptionError, match=r"an action of shape \(2,\) is expected .*, got "):
            env.step(given)
    one = TactileVectorEnv("SurfaceFollow", 1, **FAST)
    one.reset(seed=0)
    with pytest.raises(OptionError, match=r"an action of shape \(1, 2\) is expected .*, got \(2,\)"):
        one.step(np.zeros(2))
    one.close()
    env.close()
    env.close()  # gymnasium: a second close has no effect
    with pytest.raises(OptionError, match="closed"):
        env.step(np.zeros(2))
    with pytest.raises(OptionError, match="render_mode"):
        gymnasium.make("tactip/SurfaceFollow-v0", render_mode="ansi", disable_env_checker=True, **FAST)


def test_an_episode_is_shown_on_a_page_step_by_step(capsys):
    """A browser gets the newest step, with its picture, pins and object, and loses the page when the environment is closed."""
    env = gymnasium.make("tactip/SurfaceFollow-v0", render_mode="human", disable_env_checker=True, sensor="mg400-127").unwrapped
    assert env.render() is None and not capsys.readouterr().err, "no page before the first episode"
    env.reset(seed=0, options={"object": "plane"})
    url = re.search(r"http://\S+", capsys.readouterr().err)[0]
    with StudioClient(url) as client:
        client.wait(lambda u: u.number == 0)
        assert ">plane<" in client.html()
        for number in (1, 2):
            _, reward, *_ = env.step(env.action_space.sample())
            shown = client.wait(lambda u, number=number: u.number == number)
            assert f"{reward:+.3f}" in shown.html and shown.pictures == 2
            assert {"/sensor/pins", "/sensor/skin", "/object"} <= shown.nodes
    env.close()
    with pytest.raises(OSError, match="refused"):
        StudioClient(url).__enter__()
    with pytest.raises(OptionError, match="one environment"):
        gymnasium.make_vec("tactip/SurfaceFollow-v0", num_envs=2, render_mode="human")


def test_goals_are_shown_in_plain_units():
    told = [_in_units(*given) for given in (("angle / 10 deg", 0.3), ("force_n", 1.0), ("goal x_mm / 10", -1.2), ("indent_mm", 2.5))]
    assert told == ["angle 3.0 deg", "force 1.0 N", "goal x -12.0 mm", "indent 2.5 mm"]


def test_every_task_is_registered():
    assert {name.split("/")[1].split("-")[0] for name in ids()} == set(TASKS)
    for name in ids():
        assert gymnasium.spec(name).vector_entry_point is not None


@pytest.mark.parametrize(
    ("first", "asked"),
    [
        ("import gymnasium", "gymnasium.make('twin:tactip/EdgeFollow-v0', observation='oracle').spec"),
        ("import twin, gymnasium", "gymnasium.spec('tactip/EdgeFollow-v0')"),
        ("import twin; twin.register_environments(); import gymnasium", "gymnasium.spec('tactip/EdgeFollow-v0')"),
    ],
)
def test_an_id_with_the_packages_name_is_known_whatever_is_imported_first(first, asked):
    """And without torch, which only estimates of a pose need: it takes two seconds. Of what was registered, one way makes the task."""
    code = f"{first}; print({asked}.id, 'torch' in sys.modules)"
    told = subprocess.run([sys.executable, "-W", "ignore", "-c", f"import sys; {code}"], capture_output=True, text=True, check=True)
    assert told.stdout.split()[-2:] == ["tactip/EdgeFollow-v0", "False"]


def test_an_environment_is_pickled_and_goes_on_alike():
    for options in ({}, {"observation": "image"}, FAST):
        env = TactileEnv("SurfaceFollow", **options)
        env.reset(seed=0)
        twins = env, pickle.loads(pickle.dumps(env))
        one, other = ([own.step(np.array([0.2, -0.1], np.float32)) for _ in range(2)] for own in twins)
        assert all(np.array_equal(a[0]["tactile"], b[0]["tactile"]) and a[1:] == b[1:] for a, b in zip(one, other, strict=True))


def test_every_way_of_making_many_gives_the_same_episodes():
    """Gymnasium's two vectors, ours, and stable-baselines3's, each from the same seeds."""
    name, actions = "twin:tactip/SurfaceFollow-v0", np.random.default_rng(0).uniform(-0.5, 0.5, (4, 2, 2)).astype(np.float32)
    ways = [
        gymnasium.make_vec(name, num_envs=2, vectorization_mode="sync"),
        gymnasium.make_vec(name, num_envs=2, vectorization_mode="async"),
        gymnasium.make_vec(name, num_envs=2),
    ]
    told = [[way.reset(seed=3)[0]["tactile"], *(way.step(action)[0]["tactile"] for action in actions)] for way in ways]
    for theirs in (make_vec_env(name, 2, seed=3), BaselinesVecEnv(gymnasium.make_vec(name, num_envs=2))):
        theirs.seed(3)
        told.append([theirs.reset()["tactile"], *(theirs.step(action)[0]["tactile"] for action in actions)])
    for way in ways:
        way.close()
    assert all(np.array_equal(told[0], other) for other in told[1:])


def test_a_specification_in_place_of_its_name_gives_a_short_error():
    for option, given in (("sensor", load_sensor("mg400-127")), ("objects", (load_object("can"),))):
        with pytest.raises(OptionError, match=f"{option}=.*expected a name or a file") as refused:
            gymnasium.make("tactip/SurfaceFollow-v0", **{option: given})
        assert len(str(refused.value)) < 200


def test_a_learner_of_stable_baselines_gets_ends_as_it_expects_them():
    env = BaselinesVecEnv(gymnasium.make_vec("tactip/SurfaceFollow-v0", num_envs=2, steps=3, observation="oracle"))
    PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, n_epochs=1, seed=0, device="cpu").learn(8)
    env.seed(0)
    env.reset()
    for step in range(1, 4):
        seen, reward, done, infos = env.step(np.zeros((2, 2), np.float32))
        assert done.all() == (step == 3) and all({"is_success", "off_mm"} <= info.keys() for info in infos)
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert all(not np.array_equal(info["terminal_observation"]["tactile"], seen["tactile"][row]) for row, info in enumerate(infos))


def test_a_learner_of_stable_baselines_takes_only_a_vector_of_this_program_without_wrappers():
    vector = gymnasium.make_vec("tactip/SurfaceFollow-v0", num_envs=2, observation="oracle")
    with pytest.raises(OptionError, match="TransformReward.* would be lost"):
        BaselinesVecEnv(gymnasium.wrappers.vector.TransformReward(vector, lambda reward: -reward))
    for other in (gymnasium.make_vec("CartPole-v1", num_envs=2), gymnasium.make("tactip/SurfaceFollow-v0"), [vector]):
        with pytest.raises(OptionError, match="is not a vector"):
            BaselinesVecEnv(other)


def test_the_same_seed_gives_the_same_episode_on_finite_elements():
    def episode():
        env = gymnasium.make("tactip/SurfaceFollow-v0", disable_env_checker=True, randomise="moves", **{**FAST, "observation": "pins"})
        seen, _ = env.reset(seed=7)
        told = [seen["tactile"]]
        for action in ([0.3, -0.2], [-0.1, 0.5]):
            told.append(env.step(np.array(action, np.float32))[0]["tactile"])
        return np.array(told)

    first = episode()
    assert np.array_equal(first, episode())
    assert np.abs(first).max() > 0.1  # the sensor feels something


@pytest.mark.slow
def test_gymnasium_accepts_an_environment_on_finite_elements():
    check_env(gymnasium.make("tactip/SurfaceFollow-v0", steps=2, **FAST).unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("name", "observation"),
    [
        pytest.param(name, observation, marks=[pytest.mark.slow] * (number > 0 and observation != "pins"))
        for number, name in enumerate(ids())
        for observation in ("pins", "oracle", "graph", "image", "pose")
    ],
)
def test_gymnasium_and_stable_baselines_accept_every_environment(name, observation):
    env = gymnasium.make(name, observation=observation, steps=3, disable_env_checker=True).unwrapped
    check_env(env, skip_render_check=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # hints for images that are no pictures for a CNN
        check_for_baselines(env)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_vector_tells_what_gymnasium_tells_of_single_environments(mode):
    """Row i with seed s is the single environment with seed s + i, over the ends of episodes too: observations, rewards and infos."""
    options = {"steps": 5, "randomise": "moves", "stack": 2, "objects": ("plane", "can")}
    vector = TactileVectorEnv("SurfaceFollow", 2, autoreset_mode=mode, **options)
    singles = SyncVectorEnv([partial(TactileEnv, "SurfaceFollow", **options)] * 2, autoreset_mode=mode)
    assert told_alike(vector.reset(seed=5), singles.reset(seed=5))
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 2, 2)).astype(np.float32)
    actions[:, 0, 0] = 1.0  # presses row 0 out of the surrogate's domain
    outside = False
    for action in actions:
        told = vector.step(action)
        assert told_alike(told, singles.step(action))
        outside |= "outside" in str(told[4].keys()) + str(told[4].get("final_info", {}).keys())
    assert outside


def told_alike(one, other):
    """Whether nested dictionaries, tuples and arrays hold the same."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(told_alike(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return all(map(told_alike, one, other))
    one, other = np.asarray(one), np.asarray(other)
    if one.dtype == object:
        return all(told_alike(a, b) if isinstance(a, dict) else a == b for a, b in zip(one, other, strict=True))
    return one.dtype == other.dtype and np.array_equal(one, other)


def test_a_row_that_only_begins_has_gone_no_way():
    batch = Batch("ContourFollow", 2, Options(objects=("can",), observation="oracle"))
    for row in range(2):
        batch.begin(row, np.random.default_rng(row))
    batch.settle(np.arange(2))
    batch.step(np.zeros((2, 2)), np.zeros(1, int))
    assert batch.task.kept[0, 0] > 0.25 and batch.task.kept[1, 0] == 0.0


def test_the_same_seed_gives_the_same_episode_on_the_surrogate():
    def episode(seed):
        env = gymnasium.make("tactip/GentlePress-v0", disable_env_checker=True, randomise="moves").unwrapped
        env.reset(seed=seed)
        return np.array([env.step(np.array([0.1, 0.8], np.float32))[0]["tactile"] for _ in range(4)])

    assert np.array_equal(episode(3), episode(3))
    assert not np.array_equal(episode(3), episode(4))


def test_a_randomised_skin_needs_finite_elements():
    with pytest.raises(OptionError, match="skin|gel|pins"):
        Batch("SurfaceFollow", 1, Options(randomise="contact"))


def test_what_only_the_optics_need_can_be_drawn_with_a_surrogate(tmp_path):
    (tmp_path / "haze.toml").write_text('description = "haze"\n[sensor]\n"gel.haze" = {value = [0.0, 0.05]}\n')
    batch = Batch("SurfaceFollow", 1, Options(objects=("plane",), randomise=str(tmp_path / "haze.toml")))
    batch.begin(0, np.random.default_rng(0))
    assert batch.contacts[0].sensor.gel.haze > 0


def test_of_the_papers_objects_the_surrogate_leaves_out_the_wire_mesh():
    assert set(Batch("ContourFollow", 1, Options()).objects) == set(TASKS["ContourFollow"].objects) - {"mesh-can"}
    with pytest.raises(ContactError, match="mesh-can.*domain|domain.*mesh-can"):
        Batch("ContourFollow", 1, Options(objects=("can", "mesh-can")))


def test_what_will_be_drawn_beyond_the_surrogates_domain_is_refused_at_once(tmp_path):
    (tmp_path / "rough.toml").write_text('description = "rough"\n[friction]\nlow = 0.5\nhigh = 1.0\nstick_share = 0.1\nstick = 5.0\n')
    with pytest.raises(ContactError, match="friction of 5"):
        Batch("SurfaceFollow", 1, Options(objects=("plane",), randomise=str(tmp_path / "rough.toml")))
    with pytest.raises(ContactError, match="friction of 5"):
        Batch("SurfaceFollow", 1, Options(randomise=str(tmp_path / "rough.toml")))


def test_too_deep_an_episode_ends_and_says_why():
    env = gymnasium.make("tactip/SurfaceFollow-v0", disable_env_checker=True).unwrapped
    env.reset(seed=0, options={"object": "plane"})
    for _ in range(8):
        _, reward, terminated, _, info = env.step(np.array([1.0, 0.0], np.float32))
        if terminated:
            break
    assert terminated and reward == 0.0 and "domain" in info["outside"] and not info["is_success"]


def test_a_picture_of_the_sensor_is_rendered():
    env = gymnasium.make("tactip/SurfaceFollow-v0", render_mode="rgb_array", disable_env_checker=True).unwrapped
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.shape == (360, 360, 3) and picture.std() > 10


CAMERAS = """description = "two cameras and lights"
[sensor]
"camera.cx_px" = {add = [-4.0, 4.0]}
"leds.power" = {scale = [0.3, 0.9]}
"""


def test_pictures_show_the_light_that_was_drawn(tmp_path):
    (tmp_path / "cameras.toml").write_text(CAMERAS)
    batch = Batch("SurfaceFollow", 1, Options(observation="oracle", objects=("plane",), randomise=str(tmp_path / "cameras.toml")))
    shown = []
    for seed in (0, 1):  # the second episode after the first was shown
        batch.begin(0, np.random.default_rng(seed))
        batch.settle(np.zeros(1, int))
        shown.append((batch.contacts[0].sensor.leds.power, batch.picture(0).mean()))
    (dark, first), (bright, second) = shown
    assert dark < 0.8 * bright and first < second - 0.2  # gray levels; most of a picture is black


def test_pins_found_in_pictures_of_a_drawn_camera_are_counted_from_its_own_rest(tmp_path):
    (tmp_path / "cameras.toml").write_text(CAMERAS)
    told = []
    for pictures in ("none", "preview"):
        batch = Batch("SurfaceFollow", 1, Options(pictures=pictures, objects=("plane",), randomise=str(tmp_path / "cameras.toml")))
        batch.begin(0, np.random.default_rng(3))
        batch.settle(np.zeros(1, int))
        told.append(batch.observation()["tactile"])
    assert abs(batch.contacts[0].sensor.camera.cx_px - batch.sensor.camera.cx_px) > 2.0
    assert np.abs(told[0]).max() > 0.3 and np.abs(told[0] - told[1]).mean() < 0.05  # spacings


def test_pins_found_in_drawn_frames_are_near_the_projected_ones():
    told = []
    for pictures in ("none", "preview"):
        env = gymnasium.make("tactip/SurfaceFollow-v0", pictures=pictures, disable_env_checker=True).unwrapped
        told.append(env.reset(seed=2)[0]["tactile"])
    assert np.abs(told[0]).max() > 0.3 and np.abs(told[0] - told[1]).mean() < 0.05  # spacings


@pytest.mark.parametrize("name", shipped_names())
def test_every_shipped_estimator_can_be_observed(name):
    """All that it tells has a scale; where it learnt from the light on the caps as well, it needs pictures."""
    sensor, pictures = load_sensor(name), "none"
    if PoseEstimator.load(name).part.sees_light:
        with pytest.raises(OptionError, match="pictures='preview'"):
            Eye(sensor, 1, "pose", pictures="none", pin_noise_px=0.0)
        pictures = "preview"
    eye = Eye(sensor, 1, "pose", pictures=pictures, pin_noise_px=0.0)
    seen, valid = eye.look(FiniteElements(sensor, 1), np.zeros(1, int), [np.random.default_rng(0)])
    assert seen.shape == (1, *eye.shape) and np.isfinite(seen).all() and valid.all()


def test_goals_of_a_follower_lie_in_its_range():
    task, tool = SurfaceFollow(), tool_of()
    task.prepare(1)
    rng = np.random.default_rng(0)
    goals = [task.begin(0, tool, load_object("plane"), Surfaces(), rng).goal[0] for _ in range(50)]
    low, high = task.indents_mm
    assert low <= min(goals) and max(goals) <= high and max(goals) - min(goals) > 0.5 * (high - low)
