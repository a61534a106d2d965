"""Sensors in a MuJoCo scene: laws of statics and dynamics, agreement with the finite elements, and what is refused."""

import pickle
from dataclasses import replace
from xml.etree import ElementTree

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from peg_expert import Expert

from hardware.rig.geometry import PlacedObject
from scenes import PlacementSpec, load_experiment, load_object, load_sensor
from scenes.write import sensor_files
from training.mujoco import TactileScene
from training.mujoco.carried import CARRIED, open_world
from training.mujoco.model import FILLET_MM, attach_sensor, load_scene, sensor_part, solid_of, write_urdf
from training.mujoco.task import BONUS, CRUSH, FRICTION, MASS_KG, WANTED
from training.surrogate.model import SurrogateError, mechanics_of, surrogate_of
from training.surrogate.solids import Drum, Ellipsoid, SweptBox, distances_to
from twin.errors import ContactError, OptionError
from twin.geometry.pins import rest_pins
from twin.mechanics.path import ContactPose
from twin.rig.kinematics import Mounting
from twin.simulator import Simulator
from twin.types import Form

SENSOR = "mg400-331"
WEIGHT = 9.81


def scene_of(bodies, *, geom="", dt=0.002, sensor=SENSOR, **options):
    """A scene of the tip at the origin, its apex up, and a body above it."""
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><option timestep='{dt}'/><worldbody><body name='tip'>{geom}<site name='tip'/></body>{bodies}</worldbody></mujoco>"
    )
    return TactileScene(model, {"tip": sensor}, **options)


def above(shape, height_mm, *, mass=0.1, joint="<joint type='slide' axis='0 0 1'/>"):
    """A body with one geom at a height, that moves up and down."""
    return f"<body name='thing' pos='0 0 {height_mm / 1e3}'>{joint}<geom name='thing' {shape} mass='{mass}' friction='.5'/></body>"


BOX, BALL = "type='box' size='.03 .03 .01'", "type='sphere' size='.02'"


@pytest.mark.parametrize("shape", [BOX, BALL])
@pytest.mark.parametrize("mass", [0.02, 0.1])
def test_a_body_at_rest_on_the_sensor_weighs_its_weight(shape, mass):
    scene = scene_of(above(shape, 29.0 if shape == BOX else 39.0, mass=mass))
    scene.step(2000)
    force = scene.read("tip").force_n
    assert np.allclose(force, [0, 0, mass * WEIGHT], atol=0.01 * mass * WEIGHT + 0.01)
    assert abs(force[2] / (mass * WEIGHT) - 1) < 0.01


def test_action_equals_reaction_in_force_and_moment_wherever_the_centres_of_mass_are():
    held = (
        "<joint type='slide' axis='0 0 1'/><geom type='box' size='.01 .01 .01' pos='.03 .02 -.05' mass='.3' contype='0' conaffinity='0'/>"
    )
    scene = scene_of(above(BOX, 26.0, joint="<freejoint/>"), geom=held)
    scene.step(5)
    applied, at = scene.data.xfrc_applied, scene.data.xipos
    assert np.abs(applied[:, :3]).sum() > 0.1
    assert np.allclose(applied[:, :3].sum(axis=0), 0, atol=1e-12)
    assert np.allclose((applied[:, 3:] + np.cross(at, applied[:, :3])).sum(axis=0), 0, atol=1e-12)


def test_a_light_ball_never_bounces_higher_than_it_fell_with_and_without_loss():
    for loss in (0.0, 1.0):
        scene, heights = scene_of(above(BALL, 44.0, mass=0.02), loss_s_per_m=loss), []
        for _ in range(1500):
            scene.step()
            heights.append(scene.data.qpos[0])
        tops = [h for before, h, after in zip(heights, heights[1:], heights[2:], strict=False) if before <= h > after]
        assert len(tops) >= 5 and tops[0] <= 0 and np.all(np.diff(tops) < 1e-5)


def test_forces_of_others_on_the_bodies_stay():
    scene = scene_of(above(BOX, 29.0))
    scene.data.xfrc_applied[2, 0] = 0.125
    scene.step(50)
    scene.reset()
    scene.data.xfrc_applied[:] = 0.0
    scene.data.xfrc_applied[2, 0] = 0.125
    scene.data.qpos[:] = 0.1  # far away: no skin pushes
    scene.step(3)
    assert np.allclose(scene.data.xfrc_applied[2], [0.125, 0, 0, 0, 0, 0])


@pytest.mark.parametrize("name, shape, height_mm", [("plane", BOX, 10.0), ("sphere", "type='sphere' size='.01'", 10.0)])
def test_a_press_is_that_of_the_simulator_within_the_surrogates_error(name, shape, height_mm):
    sensor, depth = load_sensor(SENSOR), 2.5
    state = Simulator(sensor).press(load_object(name), ContactPose(indent_mm=depth), friction=0.5)
    scene = scene_of(above(shape, 20.0 + height_mm, joint=""))
    scene.model.body_pos[2, 2] += 1e-3
    for _ in range(int(1000 * (1 + depth) / 100)):
        scene.model.body_pos[2, 2] -= 1e-4
        scene.step()
    seen = scene.read("tip")
    assert abs(seen.depth_mm - depth) < 0.05 and seen.geom == "thing"
    assert np.linalg.norm(seen.force_n - state.force_n) < 0.06 * np.linalg.norm(state.force_n) + 0.02
    moved = np.linalg.norm(state.caps_mm - seen.caps_mm, axis=1)
    assert moved.mean() < 0.08


@pytest.mark.parametrize("share, slips", [(0.95, False), (1.05, True)])
def test_a_held_block_slips_when_and_only_when_friction_says_so(share, slips):
    """``share`` is the grip that friction needs, relative to the grip there is."""
    spec, sensors = load_scene("gripper", load_sensor(SENSOR))
    spec.geom("table").pos[2] = -1.0
    model = spec.compile()
    block, geom, grip_n = model.body("block").id, model.geom("block").id, 1.0
    model.geom_friction[geom, 0] = model.body_mass[block] * WEIGHT / (2 * grip_n * share)
    scene = TactileScene(model, sensors, touchable=["block"])
    scene.data.ctrl[:] = 0.0, 0.0215
    model.opt.gravity[2] = 0.0
    scene.step(500)
    forces = [scene.read(site).force_n[2] for site in sensors]
    assert np.mean(forces) == pytest.approx(grip_n, rel=0.02)
    low = scene.data.xpos[block, 2]
    for part in range(50):  # the weight grows slowly, so that it is not felt twice
        model.opt.gravity[2] = -WEIGHT * (part + 1) / 50
        scene.step(20)
    scene.step(400)
    assert bool(low - scene.data.xpos[block, 2] > 20e-3) is slips  # the skin gives way by 5 mm


def test_a_contact_that_ends_a_jump_and_a_deep_object_are_defined():
    scene = scene_of(above(BOX, 28.0, joint=""))
    scene.step(5)
    assert scene.read("tip").depth_mm == pytest.approx(2.0) and scene.read("tip").geom == "thing"
    first = scene.read("tip").force_n.copy()
    scene.model.body_pos[2] = [0, 0, 0.2]
    scene.step()
    seen = scene.read("tip")
    assert seen.geom == "" and not seen.force_n.any() and not seen.slip and not scene.data.xfrc_applied.any()
    scene.model.body_pos[2] = [0, 0, 0.028]  # a jump: the contact begins anew, pressed straight
    scene.step()
    assert np.allclose(scene.read("tip").force_n, first, atol=0.05)
    scene.model.body_pos[2] = [0, 0, 0.0225]
    scene.step(2)
    seen = scene.read("tip")
    assert "at most 5.5" in seen.lost and seen.force_n[2] > 2 * first[2] and np.isfinite(scene.data.qpos).all()


def test_one_object_at_a_time_is_felt_and_a_second_one_is_named():
    two = above(BOX, 28.0, joint="") + "<body pos='.02 0 .017'><geom name='other' type='sphere' size='.01'/></body>"
    scene = scene_of(two)
    scene.step()
    assert {scene.read("tip").geom, *scene.read("tip").beside} == {"thing", "other"}


def test_distances_of_closed_solids_are_true_distances():
    rng = np.random.default_rng(0)
    for thing in (SweptBox(5.0, 3.0, 8.0, 0.5), SweptBox(0, 0, 10.0, 6.0), Drum(7.0, 4.0, 0.5), Ellipsoid(12.0, 8.0, 6.0)):
        points = rng.uniform(-20, 20, (400, 3))
        gap, normal = distances_to(points, thing.kind, np.array(thing.sizes))
        assert np.allclose(np.linalg.norm(normal, axis=1), 1)
        foot = points - gap[:, None] * normal
        assert np.abs(distances_to(foot, thing.kind, np.array(thing.sizes))[0]).max() < 1e-6
        ahead, _ = distances_to(points + 1e-5 * normal, thing.kind, np.array(thing.sizes))
        assert np.allclose((ahead - gap) / 1e-5, 1, atol=1e-3)


def test_geoms_that_no_skin_can_touch_are_refused_by_name():
    small = above("type='sphere' size='.003'", 40.0)
    with pytest.raises(OptionError, match=r"geom thing: a radius of curvature of 3 mm"):
        scene_of(small)
    star = "<asset><mesh name='m' vertex='0 0 0 .05 0 0 0 .05 0 0 0 .05'/></asset>"
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{star}<worldbody><site name='tip'/><geom name='pyramid' type='mesh' mesh='m'/></worldbody></mujoco>"
    )
    with pytest.raises(OptionError, match=r"geom pyramid: its mesh is .* mm off the nearest box"):
        TactileScene(model, {"tip": SENSOR})
    with pytest.raises(OptionError, match="no site 'nose'"):
        TactileScene(model, {"nose": SENSOR}, touchable=[])
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    with pytest.raises(OptionError, match="RK4"):
        TactileScene(model, {"tip": SENSOR}, touchable=[])


def test_a_sensor_of_ones_own_takes_its_own_surrogate(tmp_path):
    own = load_sensor(SENSOR)
    own = own.model_copy(update={"name": "own", "skin": own.skin.model_copy(update={"thickness_mm": 1.5 * own.skin.thickness_mm})})
    for name, text in sensor_files(own, "own").items():
        (tmp_path / name).write_text(text)
    own = load_sensor(str(tmp_path / "own.toml"))
    with pytest.raises(SurrogateError, match="no surrogate of own goes with the package.*surrogates="):
        scene_of(above(BALL, 39.0), sensor=own)
    file, made = tmp_path / "own.safetensors", surrogate_of(load_sensor(SENSOR))
    replace(made, about=made.about | {"mechanics": mechanics_of(own)}).save(file)
    scene_of(above(BALL, 39.0), sensor=own, surrogates={"own": file}).step()
    grasp = gymnasium.make("tactip/GraspLift-v0", sensor=str(tmp_path / "own.toml"), surrogate=str(file))
    assert np.isfinite(grasp.reset(seed=0)[0]["tactile"]).all()


def test_a_mesh_of_a_box_is_that_box():
    corners = " ".join(f"{x} {y} {z}" for x in (-0.02, 0.02) for y in (-0.03, 0.03) for z in (-0.01, 0.01))
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><asset><mesh name='m' vertex='{corners}'/></asset><worldbody><geom name='b' type='mesh' mesh='m'/></worldbody></mujoco>"
    )
    thing, _ = solid_of(model, 0)
    assert isinstance(thing, SweptBox) and sorted(np.array(thing.sizes[:3]) + FILLET_MM) == pytest.approx([10, 20, 30])


def test_a_sensor_is_a_part_of_any_model(tmp_path):
    sensor = load_sensor(SENSOR)
    part = sensor_part(sensor).compile()
    soft = part.geom("skin")
    assert not soft.contype and not soft.conaffinity and part.body("tactip").mass == pytest.approx(0.12)
    robot = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body name='hand'><site name='flange' euler='0 90 0'/></body></worldbody></mujoco>"
    )
    with pytest.raises(OptionError, match="no site 'wrist'; its sites are flange"):
        attach_sensor(robot, "wrist", sensor, prefix="a_")
    site = attach_sensor(robot, "flange", sensor, prefix="a_")
    model = robot.compile()
    scene = TactileScene(model, {site: sensor})
    mujoco.mj_forward(model, scene.data)
    assert np.allclose(scene.data.site_xmat[model.site(site).id].reshape(3, 3)[:, 2], [1, 0, 0])
    file = write_urdf(sensor, tmp_path)
    assert mujoco.MjModel.from_xml_path(str(file)).ngeom == 1  # it collides with its housing alone
    mass, mesh = (ElementTree.parse(file).find(f".//{tag}") for tag in ("mass", "mesh"))
    assert float(mass.get("value")) == 0.12 and (tmp_path / mesh.get("filename")).is_file()


def test_frames_of_the_scene_go_through_the_pipeline():
    scene = scene_of(above(BOX, 28.0, joint=""))
    scene.step(3)
    seen = scene.observe("tip")
    assert scene.form("tip") is Form.PROCESSED and seen.valid
    moved = seen.pins_px - scene.pipeline("tip").reference.pins_px
    assert np.nanmax(np.linalg.norm(moved, axis=1)) > 2
    assert np.nanmean(np.linalg.norm(seen.pins_px - scene.read("tip").pins_px, axis=1)) < 1.0


def play(seed, grip_n):
    """Play an episode of GraspLift with a grip that may depend on what the object needs; rewards, and what the last step says."""
    env = gymnasium.make("tactip/GraspLift-v0", observation="none").unwrapped
    env.reset(seed=seed)
    rewards, over = [], False
    while not over:
        _, reward, over, _, info = env.step(np.clip([(grip_n(env) - env.grip_n()) / 0.15], -1, 1))
        rewards.append(reward)
        assert reward == pytest.approx(sum(info["terms"].values()))
    assert min(rewards) >= 0 and max(rewards[:-1]) <= 1
    return rewards, info


def test_a_lift_needs_the_right_grip_for_each_object():
    for seed in range(1):
        rewards, info = play(seed, lambda env: WANTED * env.least_n)
        assert info["is_success"] and rewards[-1] > BONUS
        for share, why in ((0.8, "dropped"), (1.1 * CRUSH, "crushed")):
            rewards, info = play(seed, lambda env, share=share: share * env.least_n)
            assert info[why] and not info["is_success"] and rewards[-1] == 0


def test_most_objects_of_a_lift_break_or_fall_with_any_constant_grip():
    env = gymnasium.make("tactip/GraspLift-v0", observation="none").unwrapped
    least, seen = [], []
    for seed in range(150):
        _, drawn = env.reset(seed=seed)
        least.append(env.least_n)
        seen.append((drawn["mass_kg"], drawn["friction"]))
    (lightest, slippery), (heaviest, rough) = np.min(seen, axis=0), np.max(seen, axis=0)
    assert (
        MASS_KG[0] <= lightest < 0.06 and 0.25 < heaviest <= MASS_KG[1] and FRICTION[0] <= slippery < 0.35 and 0.75 < rough <= FRICTION[1]
    )
    grips, least = np.arange(0.3, 4.5, 0.05)[:, None], np.array(least)
    assert ((least <= grips) & (CRUSH * least >= grips)).mean(axis=1).max() <= 0.5


def test_the_load_that_both_sensors_feel_is_the_weight_while_the_hand_moves_evenly():
    env = gymnasium.make("tactip/GraspLift-v0", observation="wrench").unwrapped
    env.reset(seed=1, options={"mass_kg": 0.15, "friction": 0.6})
    loads = []
    for _ in range(50):
        seen, *_ = env.step(np.clip([(WANTED * env.least_n - env.grip_n()) / 0.15], -1, 1))
        left, right = seen["tactile"][0, :, 0]
        loads.append(right - left)
    assert np.mean(loads[25:]) == pytest.approx(0.15 * 9.81, rel=0.03)


def test_a_lift_is_repeated_exactly_by_its_seed_and_is_an_environment_for_gymnasium():
    env = gymnasium.make("tactip/GraspLift-v0").unwrapped
    seen = []
    for _ in range(2):
        env.reset(seed=5)
        seen.append([env.step(np.array([0.5]))[0]["tactile"] for _ in range(12)][-1])
    assert np.array_equal(*seen) and seen[0].any() and seen[0].shape == (2, 2, 331, 2)
    check_env(env, skip_render_check=True)


@pytest.mark.parametrize(("task", "size"), [("GraspLift", 1), ("PegInsert", 4)])
def test_actions_that_are_no_numbers_are_refused_and_move_nothing(task, size):
    env = gymnasium.make(f"tactip/{task}-v0", observation="none", disable_env_checker=True)
    env.reset(seed=0)
    before = env.unwrapped.scene.data.qpos.copy()
    for action in (np.full(size, np.nan), np.zeros(size + 1)):
        with pytest.raises(OptionError, match="finite numbers"):
            env.step(action)
    assert np.array_equal(env.unwrapped.scene.data.qpos, before)


@pytest.mark.parametrize(
    ("task", "wrong"),
    [("GraspLift", wrong) for wrong in ({"mass_kg": -1.0}, {"friction": np.nan}, {"friction": "high"}, {"mass": 0.1})]
    + [("PegInsert", wrong) for wrong in ({"off_mm": 1.0}, {"tilt_deg": np.inf}, {"tilt": 1.0})],
)
def test_wrong_options_of_an_episode_are_refused_by_name(task, wrong):
    env = gymnasium.make(f"tactip/{task}-v0", observation="none").unwrapped
    with pytest.raises(OptionError, match=r"call reset\(\) first"):
        env.step(env.action_space.sample())
    with pytest.raises(OptionError, match=f"reset\\(options=...\\).*{next(iter(wrong))}"):
        env.reset(seed=0, options=wrong)


def test_a_scripted_controller_inserts_pegs_by_what_the_sensors_feel():
    env = gymnasium.make("tactip/PegInsert-v0", observation="none").unwrapped
    for seed in (0,):
        _, start = env.reset(seed=seed)
        assert np.linalg.norm(start["off_mm"]) <= 5 and abs(start["tilt_deg"]) <= 5
        expert, over, rewards = Expert(env), False, []
        while not over:
            _, reward, failed, late, info = env.step(expert.act())
            rewards.append(reward)
            over = failed or late
            assert failed or info["is_success"] or reward == pytest.approx(sum(info["terms"].values()))
        assert min(rewards[:-1]) >= 0 and max(rewards[:-1]) <= 1
        assert info["is_success"]


def test_a_peg_that_is_pushed_down_without_feeling_often_misses():
    env = gymnasium.make("tactip/PegInsert-v0", observation="none").unwrapped
    env.reset(seed=0, options={"off_mm": (5.0, 0.0), "tilt_deg": 5.0})
    for _ in range(80):
        *_, failed, _, info = env.step(np.array([0, 0, -0.5, 0]))
        if failed:
            break
    assert not info["is_success"] and info["depth_mm"] < 5


@pytest.mark.parametrize("observation", ["pins", "wrench", "none"])
def test_a_peg_task_is_an_environment_for_gymnasium_that_repeats_and_can_be_stored(observation):
    env = gymnasium.make("tactip/PegInsert-v0", observation=observation).unwrapped
    check_env(env, skip_render_check=True)
    env.reset(seed=5)
    again = pickle.loads(pickle.dumps(env))
    seen = []
    for each in (env, again, env):
        each.reset(seed=5)
        seen.append([each.step(np.array([0.2, 0.0, -1.0, 0.1]))[0] for _ in range(4)][-1])
    assert all(np.array_equal(seen[0][name], other[name]) for other in seen[1:] for name in seen[0])


def test_an_arm_carries_a_sensor_through_a_scene_as_through_the_twin():
    """The scene 'following' is the can before which the servo places the sensor: the depths are those of the twin."""
    sensor = load_sensor(SENSOR)
    placed = PlacedObject(load_object("can"), PlacementSpec(), Mounting.of(sensor, load_experiment("surface-2d")))
    world = open_world("following", sensor, placed.mounting.T_tool_sensor)
    for k, indent_mm in enumerate(np.linspace(-1.0, 2.5, 8)):
        pins = world.move(placed.start_pose(indent_mm), 0.1 * k)
        assert world.scene.read(CARRIED).depth_mm == pytest.approx(max(indent_mm, 0), abs=0.02)
    rest = rest_pins(sensor.geometry)
    assert 0.5 < np.linalg.norm(pins.caps_mm - rest.caps_mm, axis=1).max() < 3
    with pytest.raises(ContactError, match=r"at most 5\.5"):
        world.move(placed.start_pose(6.5), 1.0)
    with pytest.raises(OptionError, match="no such scene; give a file of MJCF, or following, gripper"):
        open_world("elsewhere", sensor, np.eye(4))
