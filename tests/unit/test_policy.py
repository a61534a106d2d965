"""A policy: its file, what it does with a frame, and the motion of an arm that it asks for; learning one, in small."""

from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from changed_views import altered, mirrored, moved, rolled, torn
from typer.testing import CliRunner

from hardware.rig.geometry import PlacedObject
from hardware.servo.following import load_for_outlines, policy_law
from scenes import load_experiment, load_object, load_sensor, load_servo
from training.environments import learn, policy_domain
from training.environments.batch import Batch, Options
from training.environments.learn import LearnPlan, Learnt, evaluate_policy, learn_policy
from training.environments.policy_domain import contacts_of
from training.environments.world import Surfaces, standing_on
from twin.cli import command_line
from twin.errors import FrameError, OptionError
from twin.geometry.pins import rest_pins
from twin.policy import Policy, PolicyError, PolicyModel, flatten, load_policy
from twin.rig.kinematics import Mounting
from twin.types import Form, Frame

SHIPPED = Path(__file__).parents[2] / "training" / "policies" / "SurfaceFollow-mg400-331.safetensors"
SMALL = Options(sensor="mg400-127", steps=4)


@pytest.fixture(scope="module")
def policy():
    return load_policy(SHIPPED)


def answer(policy, action):
    class Answer:
        names, value, valid, reason = policy.axes, np.array(action), True, ""

    return Answer()


def test_a_file_gives_back_what_was_saved(policy, tmp_path):
    path = tmp_path / "mine.safetensors"
    assert policy.save(path) < 200_000
    again = load_policy(path)
    assert again.about == policy.about
    seen, goal = np.random.default_rng(0).normal(size=(3, 1, 331, 2)), np.array([[3.0, 0.0]] * 3)
    assert np.allclose(again.act(seen, goal), policy.act(seen, goal), atol=1e-6)


def test_policies_that_a_rig_cannot_run_are_refused(policy, tmp_path):
    with pytest.raises(PolicyError, match="'oracle'"):
        PolicyModel(replace(policy, about={**policy.about, "observation": "oracle"}))
    path = tmp_path / "roll.safetensors"
    replace(policy, about={**policy.about, "task": "ObjectRoll"}).save(path)
    with pytest.raises(PolicyError, match="ObjectRoll"):
        load_for_outlines(path)
    with pytest.raises(FrameError, match="ur5-331"):
        PolicyModel(policy).check(load_sensor("ur5-331"), Form.PROCESSED)


def test_an_arm_is_moved_as_the_environment_moves_its_tool(policy):
    """z presses by so many mm, Ry turns by so many deg, and the feed goes along the surface."""
    mounting = Mounting.of(load_sensor("mg400-331"), load_experiment("surface-2d"))
    placed = PlacedObject(load_object("plane"), load_servo("surface").placement, mounting)
    law, start = policy_law(policy, mounting), placed.start_pose(3.0)
    mm, deg = policy.about["scale"]
    fed, pressed, turned = (placed.touch(law(start, answer(policy, action))) for action in ([0, 0], [0.5, 0], [0, 1.0]))
    assert fed.indent_mm == pytest.approx(3.0) and abs(fed.place_mm[0]) == pytest.approx(policy.about["feed_mm"][0])
    assert pressed.indent_mm == pytest.approx(3.0 + 0.5 * mm)
    assert abs(turned.angle_deg) == pytest.approx(deg)


def test_a_frame_gives_the_action_that_its_observation_gives(policy):
    """The live pipeline and the environment see the same: they count pins from frames of the same sensor at rest."""
    env = gymnasium.make("tactip/SurfaceFollow-v0", pictures="preview", disable_env_checker=True).unwrapped
    seen, _ = env.reset(seed=4)
    eye = env.batch.eye
    rest = eye.frame(0, rest_pins(eye.sensor.geometry), np.random.default_rng(0))
    model = PolicyModel(replace(policy, about={**policy.about, "goal": seen["goal"].tolist()})).at_rest(rest)
    frame = eye.frame(0, env.batch.backend.attitude(0), np.random.default_rng(1))
    told = model(frame)
    assert told.valid and told.names == policy.axes
    assert np.allclose(told.value, policy.act(seen["tactile"][None], seen["goal"][None])[0], atol=0.15)


def test_a_frame_without_pins_gives_no_action(policy):
    model = PolicyModel(policy)
    told = model(Frame(np.zeros((360, 360), np.uint8), Form.PROCESSED))
    assert not told.valid and told.reason and np.isnan(told.value).all()


@pytest.fixture(scope="module")
def known_contacts(policy):
    """A frame at rest and one of a contact, and the policy that knows the sensor's contacts, counted from the first."""
    env = gymnasium.make("tactip/SurfaceFollow-v0", pictures="preview", disable_env_checker=True).unwrapped
    env.reset(seed=4)
    eye = env.batch.eye
    rest = eye.frame(0, rest_pins(eye.sensor.geometry), np.random.default_rng(0))
    model = PolicyModel(policy, contacts=contacts_of(policy))
    return rest, eye.frame(0, env.batch.backend.attitude(0), np.random.default_rng(1)), model


@pytest.mark.parametrize("change", [rolled(9), torn(15), mirrored, moved(turn_deg=5), moved(zoom=1.1)])
def test_a_policy_does_not_act_on_a_strange_frame(known_contacts, change):
    rest, frame, model = known_contacts
    model = model.at_rest(rest)
    assert model(frame).valid
    strange = model(altered(frame, change))
    assert not strange.valid and strange.reason and np.isnan(strange.value).all()


@pytest.mark.parametrize("change", [moved(turn_deg=37), moved(stretch=1.08), moved(zoom=1.1)])
def test_a_policy_refuses_a_view_that_is_not_its_cameras(known_contacts, change):
    rest, _, model = known_contacts
    with pytest.raises(FrameError, match="picture is (turned|stretched|zoomed)"):
        model.at_rest(altered(rest, change))


def test_a_policy_acts_as_before_through_a_camera_that_is_turned_a_little(known_contacts):
    rest, frame, model = known_contacts
    turn = moved(turn_deg=3)
    straight, turned = model.at_rest(rest)(frame), model.at_rest(altered(rest, turn))(altered(frame, turn))
    assert turned.valid and np.allclose(straight.value, turned.value, atol=0.15)


def test_a_policy_of_an_own_sensor_knows_the_contacts_of_its_training(tmp_path, few_looks, monkeypatch):
    """Its file holds them: it knows the motions that it learnt from, and no torn frame."""
    monkeypatch.setattr(policy_domain, "_shipped_estimator", lambda sensor: None)
    monkeypatch.setattr(policy_domain, "ACTING_STEPS", 150)
    made = learn_policy(LearnPlan("SurfaceFollow", SMALL, minutes=0.002, environments=4, episodes=1), tmp_path)
    again = load_policy(tmp_path / "policy.safetensors")
    known = contacts_of(again)
    displacements = known.seen_from(known.reference, "rest")
    vector = learn.TactileVectorEnv("SurfaceFollow", 4, sensor="mg400-127", autoreset_mode="SameStep")
    seen, _ = vector.reset(seed=1)
    spacing, none = known.reference.spacing_px.mean(), np.zeros(127, bool)
    right = torn_apart = 0
    for _ in range(20):
        for pins in seen["tactile"][:, -1].astype(float):
            nodes = known.reference.pins_px + spacing * pins
            right += not displacements(nodes, none)[1]
            nodes[nodes[:, 1] > nodes[:, 1].mean(), 0] += 0.5 * spacing
            torn_apart += bool(displacements(nodes, none)[1])
        seen, *_ = vector.step(made.policy.act(seen["tactile"], seen["goal"]))
    assert right >= 76 and torn_apart >= 78  # of 80
    with pytest.raises(PolicyError, match="domain is damaged"):
        contacts_of(replace(again, about={**again.about, "domain": {}}))


def test_the_shipped_policy_presses_where_it_is_too_shallow_and_lifts_where_it_is_too_deep(policy):
    pressed = {}
    for depth in (1.8, 4.2):
        env = gymnasium.make("tactip/SurfaceFollow-v0", objects=("plane",), disable_env_checker=True).unwrapped
        env.reset(seed=0)
        batch = env.batch
        batch.T_work[0] = start_on(batch, depth)
        batch.backend.begin(0, batch.contacts[0])
        batch.goal[0] = [3.0, 0.0]
        batch.settle(np.zeros(1, int))
        seen = batch.observation()
        pressed[depth] = policy.act(seen["tactile"], seen["goal"])[0, policy.axes.index("z")]
    assert pressed[1.8] > 0 > pressed[4.2]


def start_on(batch, depth_mm):
    return standing_on(batch.tool, Surfaces()[load_object("plane")], 0.0, depth_mm, 0.0)


def test_a_policy_without_sight_sees_fewer_directions_alone(few_looks):
    vector = learn.TactileVectorEnv("SurfaceFollow", 2, sensor="mg400-127", objects=("plane",))
    with_sight, without = (learn._untrained_inputs(LearnPlan("SurfaceFollow", SMALL, sight=sight), vector) for sight in (True, False))
    assert len(with_sight.basis) == 2 * len(without.basis) and with_sight.sight and not without.sight


@pytest.fixture
def few_looks(monkeypatch):
    """Little random motion: what a test learns need not be seen well."""
    monkeypatch.setattr(learn, "RANDOM_STEPS", 10)


def test_a_policy_is_learnt_in_small(tmp_path, few_looks):
    plan = LearnPlan("SurfaceFollow", SMALL, minutes=0.002, environments=2, episodes=2)
    made = learn_policy(plan, tmp_path)
    assert {path.name for path in made.written} == {"policy.safetensors", "learning.csv", "learning.png", "result.json"}
    assert all(path.is_file() for path in made.written)
    again = load_policy(tmp_path / "policy.safetensors")
    assert again.about["sensor"]["name"] == "mg400-127" and again.axes == ("z", "Ry")
    assert set(made.success) == {"surrogate"} and "solved" in made.lines()[0]
    seen, goal = np.random.default_rng(0).normal(size=(3, 1, 127, 2)), np.array([[3.0, 0.0]] * 3)
    assert np.allclose(again.act(seen, goal), made.policy.act(seen, goal), atol=1e-4) and len(again.sight) == 3


def test_a_policy_is_learnt_from_pictures_in_small(tmp_path, few_looks):
    options = replace(SMALL, observation="image", objects=("plane",))
    made = learn_policy(LearnPlan("SurfaceFollow", options, minutes=0.001, environments=2, episodes=1), tmp_path)
    assert load_policy(made.written[0]).mean.shape == (1024,)  # of 32 x 32 means of 4 x 4 px


def test_pictures_are_seen_as_means_of_squares():
    picture = np.zeros((1, 128, 128, 2), np.uint8)
    picture[0, 4:8, 8:10, 1] = 255
    seen = flatten(picture).reshape(32, 32, 2)
    assert seen[1, 2, 1] == pytest.approx(0.5) and seen.sum() == pytest.approx(0.5)


def test_a_plan_names_what_is_missing_or_of_a_wrong_kind():
    with pytest.raises(OptionError, match="`task` is missing"):
        LearnPlan()
    with pytest.raises(OptionError, match="options="):
        LearnPlan("SurfaceFollow", options={"stack": 2})


def test_a_policy_that_learnt_without_friction_history_is_also_judged_with_it(tmp_path, few_looks, monkeypatch):
    asked = []
    monkeypatch.setattr(
        learn, "evaluate_policy", lambda policy, task, options, episodes, seed: asked.append(options.friction_history) or 0.5
    )
    made = learn_policy(LearnPlan("SurfaceFollow", replace(SMALL, friction_history=False), minutes=0.001, environments=2), tmp_path)
    assert asked == [False, True] and len(made.success) == 2


def test_a_policys_sight_tells_what_the_pins_do_not_say_at_once():
    """The network learns the product of two numbers, which no linear one could tell."""
    given = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    truth = np.column_stack([given[:, 0] * given[:, 1], np.zeros(4000)])
    layers = learn._train_state_estimator((given[:, :2], given[:, 2:]), truth, 0)
    told = Policy({}, np.zeros(2), np.eye(2), (), layers).reduce_inputs(given[:, :2], given[:, 2:])[:, 3:]
    assert np.abs(told[:, 0] - truth[:, 0] / truth[:, 0].std()).mean() < 0.1 and np.abs(told[:, 1]).max() < 0.1  # of a deviation


def test_judging_counts_long_episodes_as_well_as_short_ones(policy, monkeypatch):
    """Every second row fails in its first step, the others are solved in ten: half of the episodes are solved."""

    class Rows:
        def __init__(self, task, count, **options):
            self.lasts = np.where(np.arange(count) % 2, 10, 1)
            self.steps = 0

        def seen(self):
            return {"tactile": np.zeros((len(self.lasts), 1, 331, 2)), "goal": np.zeros((len(self.lasts), 2))}

        def reset(self, seed):
            return self.seen(), {}

        def step(self, actions):
            self.steps += 1
            ended = self.steps % self.lasts == 0
            return self.seen(), 0.0, ended, np.zeros_like(ended), {"final_info": {"is_success": ended & (self.lasts > 1)}}

    monkeypatch.setattr(learn, "TactileVectorEnv", Rows)
    assert [evaluate_policy(policy, "SurfaceFollow", SMALL, episodes) for episodes in (2, 8, 24)] == [0.5] * 3


def test_a_policy_is_kept_where_judging_it_is_interrupted(tmp_path, few_looks, monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(learn, "evaluate_policy", interrupted)
    with pytest.raises(KeyboardInterrupt):
        learn_policy(LearnPlan("SurfaceFollow", SMALL, minutes=0.001, environments=2, episodes=2), tmp_path)
    assert load_policy(tmp_path / "policy.safetensors").axes == ("z", "Ry") and (tmp_path / "learning.csv").is_file()


def test_finite_elements_judge_with_the_objects_that_were_learnt_from():
    batch = Batch("ContourFollow", 1, Options())
    true = learn.on_finite_elements(batch.options, tuple(batch.objects))
    assert true.objects == tuple(batch.objects) and "mesh-can" not in true.objects
    assert (true.backend, true.pictures, true.surrogate) == ("fem", "preview", None)


def test_the_command_takes_a_surrogate_and_objects_of_ones_own(tmp_path, monkeypatch):
    """As the refusal of a sensor without a surrogate advises."""
    asked = []

    def learnt(plan, out, **options):
        asked.append(plan.options)
        return Learnt(None, [], {"surrogate": 1.0}, [])

    monkeypatch.setattr(learn, "learn_policy", learnt)
    given = ["learn", "--task", "SurfaceFollow", "--sensor", "mg400-127", "--surrogate", "mine.safetensors", "--objects", "can,plane"]
    ended = CliRunner().invoke(command_line(), [*given, "--out", str(tmp_path / "out")])
    assert ended.exit_code == 0, ended.output
    assert asked[0].surrogate == "mine.safetensors" and asked[0].objects == ("can", "plane")


WRONG = [
    ("EdgeFollow", {"minutes": float("nan")}, "minutes=nan"),
    ("EdgeFollow", {"fem_episodes": -1}, "fem_episodes=-1"),
    ("EdgeFollow", {"seed": 0.5}, "seed=0.5"),
]


@pytest.mark.parametrize(
    ("task", "more", "says"),
    [("Juggle", {}, "Juggle"), ("EdgeFollow", {"minutes": 0}, "minutes"), ("EdgeFollow", {"environments": 1}, "environments=1"), *WRONG],
)
def test_a_plan_that_cannot_be_meant_is_refused(task, more, says):
    with pytest.raises(OptionError, match=says):
        LearnPlan(task, SMALL, **more)
