"""Places of the pins at rest that contacts alone tell, by what contacts can do to the pins."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame

from scenes.pins import PinsSpec
from training.data.dataset import load_dataset
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.estimate.rest import (
    FEWEST_CONTACTS,
    FEWEST_FRAMES,
    RestPlaces,
    RestSeeker,
    learn_displacements,
    other_rest,
    read_displacements,
    rest_from_contacts,
    write_displacements,
)
from training.studies.evaluation import at_own_rest
from twin.errors import FrameError
from twin.geometry.pins import pin_lattice
from twin.pins import make_reference, nominal_reference

PINS = PinsSpec(rings=4)
START = make_reference(150 * pin_lattice(PINS).places + 200, PINS)
PITCH = float(np.median(START.spacing_px))


def contacts(count, seed, *, depth=(0.0, 1.0)):
    """Displacements (count, N, 2) by a depth, a place and a shear, as a dome's pins move: curved in all of them."""
    rng = np.random.default_rng(seed)
    r = (START.pins_px - START.pins_px.mean(axis=0)) / np.abs(START.pins_px - START.pins_px.mean(axis=0)).max()
    moved = []
    for _ in range(count):
        z, place, shear = rng.uniform(*depth), rng.uniform(-0.4, 0.4, 2), rng.uniform(-0.5, 0.5, 2)
        near = np.exp(-((r - place) ** 2).sum(axis=1) / (0.2 + 0.5 * z))[:, None]
        moved.append(PITCH * near * (z * (r - place) + np.sqrt(z + 0.1) * shear))
    return np.array(moved)


@pytest.fixture(scope="module")
def known():
    return learn_displacements(contacts(FEWEST_FRAMES, 0))


@pytest.fixture(scope="module")
def other_unit():
    """Rest places of another unit: its camera sits otherwise, and its pins are not where they were drawn."""
    off = 0.02 * (START.pins_px - START.pins_px.mean(axis=0)) + [0.1 * PITCH, -0.05 * PITCH]
    return START.pins_px + off + np.random.default_rng(1).normal(0, 0.02 * PITCH, START.pins_px.shape)


@pytest.mark.parametrize("depth", [(0.0, 1.0), (0.6, 1.0)], ids=["as learnt", "deep ones alone"])
def test_contacts_without_labels_tell_where_another_units_pins_are_at_rest(known, other_unit, depth):
    """A mean of the frames would be wrong by the mean displacement."""
    moved = contacts(FEWEST_CONTACTS, 2, depth=depth)
    found = rest_from_contacts(known, START, other_unit + moved)
    off, before, mean = (np.sqrt(np.mean((px - other_unit) ** 2)) for px in (found, START.pins_px, other_unit + moved.mean(axis=0)))
    assert off < 0.25 * before and off < 0.5 * mean, (off, before, mean)


def test_the_same_unit_keeps_its_places_and_few_contacts_tell_nothing(known, other_unit):
    moved = contacts(FEWEST_CONTACTS, 3)
    assert other_rest(known, START, START.pins_px + moved) is None
    assert other_rest(known, START, other_unit + moved[1:]) is None
    assert other_rest(None, START, other_unit + moved) is None
    told = other_rest(known, START, other_unit + moved)
    assert told is not None and told.shape == START.pins_px.shape


def test_displacements_survive_their_file_and_another_sensors_are_refused(known, tmp_path):
    path = tmp_path / "displacements.safetensors"
    write_displacements(path, known)
    again = read_displacements(path, PINS.count)
    at = np.random.default_rng(4).normal(size=(5, len(known.scale)))
    assert np.abs(again.at(at) - known.at(at)).max() < 2e-3 * np.abs(known.at(at)).max()
    with pytest.raises(TrainingError, match=r"displacements\.safetensors.*train again"):
        read_displacements(path, 331)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(TrainingError, match=r"displacements\.safetensors"):
        read_displacements(path, PINS.count)


def test_few_frames_teach_no_displacements():
    assert learn_displacements(contacts(FEWEST_FRAMES - 1, 0)) is None


def test_the_shipped_weights_find_another_units_rest_places():
    estimator = PoseEstimator.load("mg400-127")
    start = nominal_reference(estimator.sensor, estimator.form)
    off = np.random.default_rng(5).normal(0, 0.03 * float(np.median(start.spacing_px)), start.pins_px.shape)
    moved = estimator.displacements.at(np.random.default_rng(6).normal(size=(FEWEST_CONTACTS, 6))).reshape(FEWEST_CONTACTS, -1, 2)
    found = estimator.rest.other(start, start.pins_px + off + moved)
    assert np.sqrt(np.mean((found.pins_px - start.pins_px - off) ** 2)) < 0.2 * np.sqrt(np.mean(off**2))


def test_a_recording_without_a_no_contact_frame_is_counted_from_where_its_contacts_tell(tmp_path, monkeypatch):
    estimator = PoseEstimator.load("mg400-127")
    rest = nominal_reference(estimator.sensor, estimator.form)
    cv2.imwrite(str(tmp_path / "f_0.png"), drawn_frame(estimator.sensor, estimator.form, rest.pins_px).image)
    (tmp_path / "targets.csv").write_text("image_name,pose_2,pose_6\nf_0.png,-1,2\n")
    data = load_dataset(tmp_path, estimator.sensor, estimator.names, form=estimator.form)
    assert at_own_rest(estimator, data) is data, "one contact tells nothing"
    monkeypatch.setattr(
        RestPlaces, "other", lambda rest, start, nodes_px: make_reference(start.pins_px + [1.0, 0.0], estimator.sensor.pins)
    )
    told = at_own_rest(estimator, data)
    assert "found from the contacts" in told.problems[-1]
    estimates = [estimator.predict_rows(each, np.arange(1)).mean for each in (data, told)]
    assert np.abs(estimates[0] - estimates[1]).max() > 0.01
    cv2.imwrite(str(tmp_path / "init_0.png"), drawn_frame(estimator.sensor, estimator.form, rest.pins_px).image)
    assert at_own_rest(estimator, data) is data, "a frame without contact is more exact"


class PinsSeen:
    """A model whose frames are pins; it tells how far they are, on average, from the rest places that it counts from."""

    def __init__(self, known, reference=START, turned=False):
        self.turned = turned
        self.known, self.pipeline, self.sensor, self.form = known, SimpleNamespace(reference=reference), None, None

    def at_known_rest(self):
        return PinsSeen(self.known)

    def rest_from_contacts(self, nodes_px, name):
        if self.turned:
            raise FrameError(f"{name}: the camera's picture is turned")
        other = other_rest(self.known, START, nodes_px)
        return (self.at_known_rest(), False) if other is None else (PinsSeen(self.known, make_reference(other, PINS)), True)

    def estimate_without_pose(self, seen, started):
        return SimpleNamespace(valid=False, reason=seen.reason, seen=seen.seen)

    def __call__(self, pins_px):
        seen = SimpleNamespace(graph=SimpleNamespace(nodes_px=pins_px))
        return SimpleNamespace(seen=seen, value=(pins_px - self.pipeline.reference.pins_px).mean())


def test_a_stream_tells_the_rest_places_once_enough_contacts_differ(known, other_unit, caplog):
    """A contact that is held tells nothing new; those that differ tell what they tell as a recording."""
    frames = other_unit + contacts(2 * FEWEST_CONTACTS, 2)
    seeker, gathered = RestSeeker(PinsSeen(known)), []
    for frame in frames:
        for noise in np.random.default_rng(8).normal(0, 0.007 * PITCH, (3, *frame.shape)):
            if not seeker.other:
                made = seeker(frame + noise)
        gathered.append(frame)
        if seeker.other:
            break
        assert np.array_equal(seeker.pipeline.reference.pins_px, START.pins_px)
    assert FEWEST_CONTACTS <= len(gathered) < 1.3 * FEWEST_CONTACTS
    as_recording = other_rest(known, START, np.array(gathered))
    assert np.sqrt(np.mean((seeker.pipeline.reference.pins_px - as_recording) ** 2)) < 0.02 * PITCH
    assert made.value == pytest.approx((frames[len(gathered) - 1] - as_recording).mean(), abs=0.02 * PITCH), (
        "the frame that tells it counts"
    )
    assert "they are not where they were measured" in caplog.text


def test_a_stream_of_the_known_unit_keeps_its_model(known):
    seeker = RestSeeker(PinsSeen(known))
    model = seeker._model
    for frame in START.pins_px + contacts(2 * FEWEST_CONTACTS, 3):
        seeker(frame)
    assert not seeker.other and seeker._model is model


def test_a_stream_of_a_turned_camera_gets_no_estimate_any_more(known):
    seeker = RestSeeker(PinsSeen(known, turned=True))
    answers = [seeker(frame) for frame in START.pins_px + contacts(2 * FEWEST_CONTACTS, 3)]
    refused = [getattr(answer, "reason", "") for answer in answers]
    assert not any(refused[: FEWEST_CONTACTS - 1]) and all("picture is turned" in reason for reason in refused[-5:])
