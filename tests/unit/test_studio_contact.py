"""What the studio's page shows, without the page: where the object may go, what an answer belongs to, and the two meshes."""

import re
from dataclasses import asdict, replace

import numpy as np
import pytest

from scenes import load_experiment, load_object, load_sensor
from training.estimate.estimator import PoseEstimator
from twin.camera.capture import expose
from twin.camera.projection import project_in_form
from twin.errors import ContactError, FrameError
from twin.mechanics.path import deepest_mm
from twin.optics.preview import Preview
from twin.pins import Pipeline
from twin.rig.kinematics import object_pose, rig_of
from twin.rig.touch import SmoothSurface, tilted_labels
from twin.studio.camera import StudioCamera, dome_window
from twin.studio.contact import ContactSetup, Light, MovingContact, SolvedMesh
from twin.studio.pose import LIMITS, NAMES, ObjectPose, bend_mm
from twin.types import Form, Frame

SENSOR = load_sensor("mg400-331")
SPHERE, PLANE = load_object("sphere"), load_object("plane")
PIN_PX, FORCE_SHARE = 0.5, 0.05  # largest mean error of the pins and of the force of what is shown while the object moves


@pytest.fixture(scope="module")
def contact():
    return MovingContact(ContactSetup(SENSOR, SPHERE))


def pressed(contact, wish, most=60):
    """The answer at a wish, step by step."""
    for _ in range(most):
        answer = contact.step(wish)
        if answer.arrived:
            return answer
    raise AssertionError("did not arrive")


def test_a_pose_is_its_numbers():
    pose = ObjectPose(1.0, -2.0, 3.0, 10.0, -20.0, 30.0)
    assert np.allclose(list(asdict(ObjectPose.of(pose.matrix(20.0), 20.0)).values()), list(asdict(pose).values()))


def test_limits_are_kept_and_named():
    within, why = ObjectPose(x_mm=99.0, tilt_x_deg=-80.0).within_limits()
    assert within.x_mm == LIMITS["x_mm"][1] and within.tilt_x_deg == LIMITS["tilt_x_deg"][0]
    assert "x is limited to 20 mm" in why and "tilt x is limited to -60 deg" in why
    with pytest.raises(ContactError, match="depth_mm: nan is not a finite number"):
        ObjectPose(depth_mm=float("nan")).within_limits()


def test_the_first_touch_is_where_the_gap_closes_also_beside_the_axis_and_tilted(contact):
    for pose in (ObjectPose(), ObjectPose(x_mm=5.0), ObjectPose(x_mm=5.0, tilt_y_deg=20.0)):
        touch = replace(pose, depth_mm=contact.touch_mm(pose)).matrix(SENSOR.skin.apex_mm)
        assert abs(contact._follower.gap_mm(touch)) < 0.02
    assert contact.touch_mm(ObjectPose(x_mm=5.0)) > contact.touch_mm(ObjectPose()) + 0.2


def test_a_straight_way_has_no_bend():
    ends = [ObjectPose(depth_mm=d).matrix(20.0) for d in (0.0, 2.0)]
    assert bend_mm([ends[0], ObjectPose(depth_mm=0.7).matrix(20.0), ends[1]]) < 1e-9
    assert bend_mm([ends[0], ObjectPose(x_mm=0.5, depth_mm=1.0).matrix(20.0), ends[1]]) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("wish", "why"),
    [
        (ObjectPose(depth_mm=20.0), "half the gel's depth"),
        (ObjectPose(x_mm=20.0, depth_mm=20.0, tilt_y_deg=60.0), "beyond the rim"),
        (ObjectPose(depth_mm=20.0, tilt_x_deg=60.0), "half the gel's depth"),
    ],
    ids=["too deep", "beyond the rim", "tilted inside"],
)
def test_an_impossible_place_is_left_upwards_as_far_as_needed(contact, wish, why):
    T, reason = contact.admissible(wish)
    assert re.search(why, reason)
    assert not contact.refusal(T)
    assert T[:2, 3] == pytest.approx(wish.matrix(20.0)[:2, 3])
    lower = T.copy()
    lower[2, 3] -= 0.05
    assert contact.refusal(lower)


def test_any_wish_leads_to_a_possible_place(contact):
    rng = np.random.default_rng(0)
    for values in rng.uniform(-1, 1, (200, 6)):
        wish = ObjectPose(**{name: 1.5 * value * LIMITS[name][1] for name, value in zip(NAMES, values, strict=True)})
        T, _ = contact.admissible(wish)
        assert -contact._follower.gap_mm(T) <= deepest_mm(SENSOR.geometry) + 1e-3


def test_every_answer_belongs_to_one_pose_on_the_way(contact):
    contact.restart()
    pressed(contact, ObjectPose())
    wish, depths, numbers = ObjectPose(x_mm=1.0, depth_mm=2.5), [], []
    for _ in range(40):
        answer = contact.step(wish)
        depths.append(answer.pose.depth_mm)
        numbers.append(answer.number)
        assert np.allclose(answer.state.T_sensor_object, answer.pose.matrix(20.0), atol=1e-9)
        if answer.arrived:
            break
    assert answer.arrived and answer.pose.depth_mm == pytest.approx(2.5) and not answer.stopped
    assert np.all(np.diff(depths) > 0) and np.all(np.diff(numbers) == 1)
    assert answer.seen.found == SENSOR.pins.count and answer.state.force_n[2] > 0.2


def test_the_dome_alone_is_as_good_as_the_whole_frame(contact):
    """The part that is drawn holds everything that the pipeline looks at."""
    answer = pressed(contact, ObjectPose(depth_mm=3.0))
    whole = expose(Preview(SENSOR).render(answer.state), SENSOR.capture)
    seen = Pipeline(SENSOR, Form.RAW)(Frame(whole, Form.RAW))
    assert np.nanmax(np.linalg.norm(seen.pins_px - answer.seen.pins_px, axis=1)) < 0.1


def test_what_moves_is_near_the_fine_mesh():
    """A press with a shear, where friction remembers the way."""
    contact = MovingContact(ContactSetup(SENSOR, PLANE))
    pressed(contact, ObjectPose())
    usual = pressed(contact, ObjectPose(depth_mm=3.0))
    usual = pressed(contact, ObjectPose(x_mm=1.5, depth_mm=3.0, tilt_y_deg=4.0))
    while not contact.refined:
        fine = contact.refine()
    assert fine is not None and fine.mesh is SolvedMesh.FINE and usual.mesh is SolvedMesh.USUAL
    assert fine.pose == usual.pose
    fine_px, usual_px = (project_in_form(SENSOR, Form.RAW, answer.state.caps_mm) for answer in (fine, usual))
    assert np.linalg.norm(fine_px - usual_px, axis=1).mean() < PIN_PX
    assert np.linalg.norm(fine.state.force_n - usual.state.force_n) < FORCE_SHARE * np.linalg.norm(fine.state.force_n)


def test_an_old_picture_is_refused(contact):
    answer = pressed(contact, ObjectPose(depth_mm=1.0))
    light = np.asarray(answer.light)
    traced = contact.newest_traced(answer.solved, light, Light.TRACED, 5.0)
    assert traced is not None and traced.lit is Light.TRACED and traced.number > answer.number and traced.state is answer.state
    pressed(contact, ObjectPose(depth_mm=1.1))
    assert contact.newest_traced(answer.solved, light, Light.TRACED, 5.0) is None


def test_the_solvers_failure_leaves_the_object_where_it_is(contact, monkeypatch):
    before = pressed(contact, ObjectPose(depth_mm=2.0))

    def fail(T, time_s):
        raise ContactError("no convergence; use less indentation")

    with monkeypatch.context() as patched:
        patched.setattr(contact._follower, "move", fail)
        after = contact.step(ObjectPose(depth_mm=2.5))
    assert after.pose == before.pose and after.arrived and "the object stays here: no convergence" in after.stopped
    assert after.number > before.number
    again = pressed(contact, ObjectPose(depth_mm=2.5))
    assert again.pose.depth_mm == pytest.approx(2.5) and not again.stopped


def test_a_changed_friction_begins_the_contact_anew(contact):
    pressed(contact, ObjectPose(depth_mm=2.0))
    pressed(contact, ObjectPose(x_mm=2.0, depth_mm=2.0))
    contact.change(friction=0.0)
    answer = pressed(contact, ObjectPose(x_mm=2.0, depth_mm=2.0))
    assert np.linalg.norm(answer.state.tangential_n) < 1e-6
    contact.change(obj=PLANE)
    assert contact.setup.friction is None
    contact.change(obj=SPHERE)


def test_the_recordings_form_is_refused_where_there_is_none():
    camera = StudioCamera.__new__(StudioCamera)
    camera.spec = SENSOR.model_copy(update={"recording": None})
    with pytest.raises(FrameError, match="has no processed frames; show raw frames"):
        camera.as_recorded(Frame(np.zeros((4, 4), np.uint8), Form.RAW))


@pytest.mark.parametrize("name", ["mg400-331", "mg400-127", "ur5-331"])
def test_the_window_holds_mask_and_recording(name):
    sensor = load_sensor(name)
    x0, y0, x1, y1 = dome_window(sensor)
    mask = sensor.pipeline.raw
    assert x0 <= mask.mask_center_px[0] - mask.mask_radius_px or x0 == 0
    assert y1 >= mask.mask_center_px[1] + mask.mask_radius_px or y1 == sensor.camera.height_px
    if sensor.recording is not None:
        crop = sensor.recording.crop_px
        assert x0 <= crop[0] and y0 <= crop[1] and x1 >= crop[2] and y1 >= crop[3]


def test_depth_and_both_tilts_are_the_inverse_of_the_arms_way():
    sensor, experiment, rng = load_sensor("ur5-331"), load_experiment("surface-3d"), np.random.default_rng(0)
    radius, surface = sensor.skin.outer_radius_mm, SmoothSurface(PLANE)
    odd = rig_of(sensor).model_copy(update={"turn_offset_deg": (0.3, -0.5, 2.0), "plate_tilt_deg": 3.0, "tcp_binormal_mm": 0.4})
    for rig in (rig_of(sensor), odd):
        for _ in range(20):
            pose = np.array([0, 0, rng.uniform(0, 5), *rng.uniform(-20, 20, 2), 0])
            found = tilted_labels(rig, experiment, surface, radius, object_pose(rig, experiment, pose, radius))
            assert list(found.values()) == pytest.approx(pose[2:5], abs=1e-9)
    assert tilted_labels(odd, load_experiment("surface-2d"), surface, radius, np.eye(4)) == {}


def test_the_pins_of_a_frame_are_sought_once(monkeypatch):
    """Where the model takes the frame that is shown, what is drawn over it is what the estimate was made from."""
    model = PoseEstimator.load("mg400-127")
    contact = MovingContact(ContactSetup(model.sensor, SPHERE, form=model.form), model)
    sought = []
    monkeypatch.setattr(Pipeline, "__call__", lambda self, frame, seek=Pipeline.__call__: sought.append(frame) or seek(self, frame))
    answer = pressed(contact, ObjectPose(depth_mm=0.5))
    assert len(sought) == answer.number and answer.seen is answer.estimate.seen and answer.seen.found == 127
    contact.change(form=Form.RAW)
    answer = contact.again()
    assert len(sought) == answer.number + 1 and answer.seen is not answer.estimate.seen
