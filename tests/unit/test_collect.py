"""Collecting: the frame is exposed after the arm has confirmed where it stands, however slow the arm and late the camera."""

import csv
import json
import time

import numpy as np
import pytest
from faulty_arm import ArmFault, FaultyArm

from hardware.arms.arm import SimulatedArm
from hardware.cameras.reader import DevicePicture, LiveSource
from hardware.collect.collect import COLUMNS, META, Collection, WorkFrame, collect, draw_contact
from hardware.errors import DeviceError
from hardware.rig.geometry import PlacedObject
from hardware.workcell.build import Rig
from scenes import PlacementSpec, load_experiment, load_object, load_sensor
from training.data.design import nearest_to_even
from twin.frames import open_recording, read_image
from twin.rig.arm_pose import matrix_of
from twin.rig.kinematics import Mounting
from twin.types import Form, Frame

LATE_S = 0.15  # of the late camera: a frame arrives so long after its exposure
SCALE = 1e-2  # mm a gray level in the pictures of ``PoseCamera``
FAST = 20.0  # times the arm's speed
SAMPLES = 40  # along a move


class PoseCamera(LiveSource):
    """Writes the arm's pose at the exposure into the picture, and delivers it late."""

    def __init__(self, arm, *, late_s: float = 0.0) -> None:
        super().__init__("pose camera", Form.RAW)
        self._arm, self._late_s, self._number = arm, late_s, 0

    def _open(self):
        pass

    def _close(self):
        pass

    def _grab(self):
        exposed_s = time.monotonic()
        time.sleep(0.005 + self._late_s)
        self._number += 1
        levels = np.round((self._arm.track.pose(exposed_s)[:3] + 500) / SCALE).astype(np.uint32)
        image = np.zeros((16, 16), np.uint8)
        image[0, :3], image[1, :3], image[2, :3] = levels >> 16, (levels >> 8) & 255, levels & 255
        image[3:] = 100 + self._number % 100
        return DevicePicture(image, exposed_s)


def seen_mm(image: np.ndarray) -> np.ndarray:
    """The pose's place that a picture shows."""
    high, middle, low = (image[k, :3].astype(int) for k in range(3))
    return ((high << 16) + (middle << 8) + low) * SCALE - 500


@pytest.fixture
def rig():
    sensor, experiment = load_sensor("mg400-331"), load_experiment("surface-2d")
    placed = PlacedObject(load_object("plane"), PlacementSpec(), Mounting.of(sensor, experiment))
    arm = FaultyArm(axes=6, time_scale=FAST)
    return experiment, placed, arm


def run(rig, folder, count, *, late_s=0.0, about=None):
    experiment, placed, arm = rig
    camera = PoseCamera(arm, late_s=late_s)
    with arm, camera:
        collection = Collection(folder, about or {"seed": 1}, Form.RAW)
        return collect(Rig(camera, arm, placed, False), experiment, collection, count, seed=1, speed=(100.0, 100.0))


def rows(folder):
    with (folder / "targets.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_frame_shows_the_confirmed_pose_with_a_slow_arm_and_a_late_camera(rig, tmp_path):
    experiment, placed, arm = rig
    arm.faults.add(ArmFault.SLOW)
    assert run(rig, tmp_path, 3, late_s=LATE_S) == 3
    frame_of = WorkFrame(experiment, placed)
    for row in rows(tmp_path):
        shown = seen_mm(read_image(tmp_path / "images" / row["image_name"])[0])
        label = np.array([float(row[f"pose_{k}"]) for k in range(1, 7)])
        stands = frame_of.base_pose(label + experiment.clear + experiment.tap, np.zeros(6))
        np.testing.assert_allclose(shown, stands[:3], atol=SCALE)
    for line in (tmp_path / "contacts.jsonl").read_text().splitlines():
        log = json.loads(line)
        assert log["frame_s"] > log["confirmed_s"]
        assert log["moved_meanwhile_mm"] == 0.0


def test_the_labels_are_those_that_were_drawn_and_the_twin_indents_as_they_say(rig, tmp_path):
    experiment, placed, _ = rig
    run(rig, tmp_path, 3)
    for index, row in enumerate(rows(tmp_path)):
        asked = draw_contact(experiment, 1, index)
        got = np.array([float(row[name]) for name in COLUMNS[4:]])
        np.testing.assert_allclose(got, [*asked.pose, *asked.move], atol=1e-6)
        low, high = np.array(list(experiment.ranges().values())).T
        assert (got >= low - 1e-6).all() and (got <= high + 1e-6).all()
        stands = WorkFrame(experiment, placed).base_pose(got[:6] + experiment.clear + experiment.tap, np.zeros(6))
        touch = placed.touch(stands)
        assert placed.mounting.labels(touch.depth_mm, touch.angle_deg)[1] == pytest.approx(asked.pose[5])
        # the frame's axes lean with the plate by half a degree, the way along it is up to 5 mm
        assert placed.mounting.labels(touch.depth_mm, touch.angle_deg)[0] == pytest.approx(asked.pose[1], abs=0.06)


def test_a_collection_is_gone_on_with(rig, tmp_path):
    run(rig, tmp_path, 2)
    first = rows(tmp_path)
    with (tmp_path / "targets.csv").open("a") as file:
        file.write("frame_2_0.png,frame_2,1")  # killed while the row was written
    experiment, placed, _ = rig
    again = (experiment, placed, SimulatedArm(axes=6, time_scale=FAST))
    assert run(again, tmp_path, 4) == 4
    assert rows(tmp_path)[:2] == first
    assert [row["data_name"] for row in rows(tmp_path)] == [f"frame_{k}" for k in range(4)]


def test_another_collection_is_not_mixed_in(rig, tmp_path):
    run(rig, tmp_path, 1)
    with pytest.raises(DeviceError, match="seed"):
        Collection(tmp_path, {"seed": 2}, Form.RAW)


def test_a_start_that_failed_before_the_first_frame_keeps_no_folder_for_itself(tmp_path):
    """For example a wrong camera: the same command with the right one must not need another folder."""
    Collection(tmp_path, {"seed": 1, "camera": "none"}, Form.RAW)
    assert Collection(tmp_path, {"seed": 1, "camera": "another"}, Form.RAW).count == 0
    assert json.loads((tmp_path / META).read_text())["camera"] == "another"
    Collection(tmp_path, {"seed": 1, "camera": "another"}, Form.RAW).keep_rest(Frame(np.zeros((4, 4), np.uint8), Form.RAW))
    with pytest.raises(DeviceError, match="with other settings \\(camera\\)"):
        Collection(tmp_path, {"seed": 1, "camera": "none"}, Form.RAW)


def test_the_folder_is_a_recording(rig, tmp_path):
    run(rig, tmp_path, 3)
    recording = open_recording(tmp_path)
    assert recording.names == [f"frame_{k}_0.png" for k in range(3)]
    assert recording.reference is not None
    assert set(COLUMNS[4:]) <= set(recording.labels)


def test_an_arm_that_did_not_move_is_not_believed(rig, tmp_path):
    rig[2].faults.add(ArmFault.IGNORE)
    with pytest.raises(DeviceError, match="not executed"):
        run(rig, tmp_path, 1)
    assert rows(tmp_path) == []


def test_the_approach_is_free_of_contact(rig, tmp_path):
    """Nothing touches before the tap: along every way but tap, move and lift the dome stays clear of the plate."""
    experiment, placed, arm = rig
    run(rig, tmp_path, 2)
    lifts = [piece for piece in arm.track._pieces if piece.linear]
    starts = np.array([placed.touch(piece.pose(piece.start_s)).indent_mm for piece in lifts])
    ends = np.array([placed.touch(piece.pose(piece.end_s)).indent_mm for piece in lifts])
    across = np.array([np.linalg.norm((matrix_of(p.pose(p.end_s)) - matrix_of(p.pose(p.start_s)))[[0, 2], 3]) for p in lifts])
    free = (starts < 0) & (across > 1.0)
    assert free.any() and (ends[free] < 0.5).all()


def test_what_was_being_written_when_it_was_killed_spoils_nothing(rig, tmp_path):
    run(rig, tmp_path, 1)
    with (tmp_path / "contacts.jsonl").open("a") as file:
        file.write('{"image_name": "frame_1_0.png", "ask')
    experiment, placed, _ = rig
    assert run((experiment, placed, SimulatedArm(axes=6, time_scale=FAST)), tmp_path, 2) == 2
    assert [json.loads(line)["image_name"] for line in (tmp_path / "contacts.jsonl").open()] == ["frame_0_0.png", "frame_1_0.png"]


def test_killed_before_the_first_row_it_begins_anew(rig, tmp_path):
    for torn in ("image_na", ""):
        (tmp_path / "targets.csv").write_text(torn)
        (tmp_path / "meta.json").write_text('{"seed": 1}')
        assert Collection(tmp_path, {"seed": 1}, Form.RAW).count == 0
    (tmp_path / "meta.json").write_text('{"se')
    with pytest.raises(DeviceError, match="meta.json"):
        Collection(tmp_path, {"seed": 1}, Form.RAW)


@pytest.mark.parametrize(("share", "reached"), [(0.5, True), (0.0, False)])
def test_a_contact_that_the_arm_stops_short_of_is_not_the_one_that_was_asked_for(rig, tmp_path, share, reached, monkeypatch):
    experiment, placed, arm = rig
    monkeypatch.setattr("hardware.workcell.build.MOST_PIECES", 20)
    move = arm.move_linear
    arm.move_linear = lambda pose, **options: move(share * pose + (1 - share) * arm.state().pose, **options)
    if reached:
        assert run(rig, tmp_path, 1) == 1
        asked = draw_contact(experiment, 1, 0).pose
        assert abs(float(rows(tmp_path)[0]["pose_2"]) - asked[1]) < 1.0  # mm: less than two moves may be off
    else:
        with pytest.raises(DeviceError, match="`safety`"):
            run(rig, tmp_path, 1)
        assert rows(tmp_path) == []


@pytest.mark.parametrize("name", ["square", "can"])
def test_it_goes_around_an_object_to_its_contacts(rig, tmp_path, name):
    """From behind the object to the first contact, and from lift to lift, the dome touches nothing."""
    experiment, plane, _ = rig
    placed = PlacedObject(load_object(name), PlacementSpec(), plane.mounting)
    behind = placed.start_pose(0.0)
    behind[:3] += 180.0 * placed.T_base_object[:3, 2]
    arm = SimulatedArm(axes=6, pose=behind, time_scale=FAST)
    run((experiment, placed, arm), tmp_path, 2)
    pieces = [piece for piece in arm.track._pieces if piece.linear]
    indents = [[placed.touch(p.pose(s)).indent_mm for s in np.linspace(p.start_s, p.end_s, SAMPLES)] for p in pieces]
    first = next(k for k, each in enumerate(indents) if max(each) > 0)
    assert first > 3  # around, and then the tap
    assert np.max(indents[: first - 2]) < -8.0  # on the way; then off the lift, to the tap's start
    lifted = [each for each in indents if max(each[0], each[-1]) < -8.0]
    assert len(lifted) > first and np.max(lifted) < -8.0


def test_stopped_on_the_way_it_does_not_cross_the_object(rig, tmp_path):
    experiment, plane, _ = rig
    placed = PlacedObject(load_object("can"), PlacementSpec(), plane.mounting)
    behind = placed.start_pose(0.0)
    behind[:3] += 180.0 * placed.T_base_object[:3, 2]
    arm = SimulatedArm(axes=6, pose=behind, time_scale=FAST)
    calls = []

    move = arm.move_linear

    def interrupted(target, **options):
        calls.append(target)
        if len(calls) > 2:
            raise KeyboardInterrupt
        return move(target, **options)

    arm.move_linear = interrupted

    with arm, PoseCamera(arm) as camera, pytest.raises(KeyboardInterrupt):
        rig = Rig(camera, arm, placed, False)
        collect(rig, experiment, Collection(tmp_path, {"seed": 1}, Form.RAW), 1, seed=1, speed=(100.0, 100.0))
    assert len(calls) == 3 and not arm._enabled  # no fourth move, which would lead straight to the front


def test_a_frame_at_rest_that_is_refused_is_kept_to_go_on_with(rig, tmp_path):
    experiment, placed, arm = rig

    def refuse(frame):
        raise DeviceError("pressed")

    collection = Collection(tmp_path, {"seed": 1}, Form.RAW)
    options = {"seed": 1, "speed": (100.0, 100.0), "on_rest": refuse}
    with arm, PoseCamera(arm) as camera, pytest.raises(DeviceError, match="pressed"):
        collect(Rig(camera, arm, placed, False), experiment, collection, 1, **options)
    assert collection.rest.is_file() and rows(tmp_path) == []
    again = SimulatedArm(axes=6, time_scale=FAST)
    with again, PoseCamera(again) as camera:
        assert collect(Rig(camera, again, placed, False), experiment, collection, 1, **options) == 1


@pytest.mark.parametrize("count", [10, 20, 40])
def test_even_contacts_fill_the_ranges_whatever_their_number(count):
    """In each coordinate the places of n even contacts are nearer to (k + 1/2) / n than those of random ones: a fifth of the distance."""
    experiment = load_experiment("surface-3d")
    low, high = np.array(list(experiment.ranges().values())).T
    varied = high > low

    def unevenness(design, seed):
        contacts = [draw_contact(experiment, seed, k, design) for k in range(count)]
        drawn = np.stack([np.concatenate([contact.pose, contact.move]) for contact in contacts])
        assert (drawn >= low).all() and (drawn <= high).all()
        shares = np.sort((drawn - low)[:, varied] / (high - low)[varied], axis=0)
        return np.abs(shares - (np.arange(count)[:, None] + 0.5) / count).mean()

    even, random = (np.mean([unevenness(design, seed) for seed in range(6)]) for design in ("even", "random"))
    assert even < 0.4 * random


def test_an_even_contact_depends_on_its_number_and_the_seed_alone():
    experiment = load_experiment("surface-3d")
    one, again, other = (draw_contact(experiment, seed, 7, "even").pose for seed in (1, 1, 2))
    assert np.array_equal(one, again) and not np.array_equal(one, other)


def test_frames_are_chosen_as_evenly_as_a_design_makes_them():
    """None twice, the first ones as well, and each eighth of the circle as often as the others."""
    rng = np.random.default_rng(0)
    labels = np.column_stack([np.full(800, 2.0), rng.uniform(0, 1, 800) ** 3, rng.uniform(-180, 180, 800)])
    rows = nearest_to_even(labels, ("mm", "mm", "deg"), 32, seed=1)
    assert len(set(rows.tolist())) == 32 and np.array_equal(rows, nearest_to_even(labels, ("mm", "mm", "deg"), 32, seed=1))
    for count in (8, 32):
        assert (np.histogram(labels[rows[:count], 2], np.linspace(-180, 180, 9))[0] == count // 8).sum() >= 6
        assert abs(np.median(labels[rows[:count], 1]) - 0.5) < 0.15 < abs(np.median(labels[:, 1]) - 0.5)
