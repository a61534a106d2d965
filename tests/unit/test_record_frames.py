"""Frames of a new sensor from a live camera: each contact once, never in motion, and what is wrong with the picture is said."""

from functools import cache
from urllib.request import urlopen

import cv2
import numpy as np
import pytest

import hardware.collect.record as module
from hardware.cameras.mjpeg import LINE, PicturePage
from hardware.cameras.source import open_camera
from hardware.collect.record import GIVE_UP_S, PATIENCE_S, describe_picture, record_frames
from hardware.errors import DeviceError
from twin.frames import open_recording
from twin.types import Form, Frame

SIZE, CAP_PX, NOISE, FPS = (120, 160), 4, 2.0, 30.0
GRID = np.stack(np.meshgrid(np.arange(15, 150, 14), np.arange(15, 110, 14)), axis=-1).reshape(-1, 2).astype(float)


@cache
def picture(place_px=(0.0, 0.0), depth_px=0.0, seed=0, caps=200, skin=30):
    """Caps (H, W) that a contact at ``place_px`` pushes outwards, with noise."""
    away = GRID - (80.0, 60.0) - place_px
    pins = GRID + depth_px * away / 20 * np.exp(-(away**2).sum(axis=1) / 1200)[:, None]
    image = np.full(SIZE, skin, np.uint8)
    for x, y in pins:
        cv2.circle(image, (round(8 * x), round(8 * y)), 8 * CAP_PX, int(caps), -1, cv2.LINE_AA, 3)
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    return np.clip(image + np.random.default_rng(seed).normal(0, NOISE, SIZE), 0, 255).astype(np.uint8)


class Pictures:
    """A live camera that gives a list of pictures at a steady rate, and then none."""

    name, form, is_live, streams, first_frame_s = "a camera", Form.RAW, True, True, 5.0

    def __init__(self, pictures):
        self.pictures, self.given, self.connected = pictures, 0, False

    def __enter__(self):
        self.connected = True
        return self

    def __exit__(self, *_):
        self.connected = False

    def read(self, *, timeout_s=1.0):
        if self.given == len(self.pictures):
            raise TimeoutError("a camera: no frame")
        self.given += 1
        return Frame(self.pictures[self.given - 1], self.form, time_s=self.given / FPS, sequence=self.given)

    def notes(self):
        return []


def session(contacts, still=6, **light):
    """At rest, and then contacts: each comes in three steps, stays for ``still`` frames, and goes in three steps."""
    depths = [0.0] * 15
    places = [(0.0, 0.0)] * 15
    for place, depth in contacts:
        depths += [depth * share for share in (0.3, 0.6, 0.8)] + [depth] * still + [0.7 * depth, 0.3 * depth, 0.0, 0.0, 0.0]
        places += [place] * (3 + still + 5)
    return Pictures([picture(place, depth, seed % 50, **light) for seed, (place, depth) in enumerate(zip(places, depths, strict=True))])


CONTACTS = [((25.0 * np.cos(a), 25.0 * np.sin(a)), 6.0 + k) for k, a in enumerate(np.linspace(0, 5, 5))]


def record(source, folder, count, **options):
    return record_frames(source, folder, count=count, say=lambda line: None, **options)


def test_each_contact_is_kept_once_and_none_in_motion(tmp_path):
    source = session(CONTACTS)
    told = []
    made = record(source, tmp_path / "mine", len(CONTACTS), progress=lambda stage, done, total, note="": told.append((done, note)))
    recording = open_recording(made.folder)
    assert made.count == len(recording) == len(CONTACTS) and recording.reference.name == "init_0.png" and not source.connected
    for frame, (place, depth) in zip(recording, CONTACTS, strict=True):
        assert np.abs(frame.image.astype(float) - picture(place, depth)).mean() < 2 * NOISE
    assert np.abs(recording.reference.image.astype(float) - picture()).mean() < 2 * NOISE
    assert [done for done, note in told if note == "kept"] == list(range(len(CONTACTS) + 1))
    assert {note for _, note in told} >= {"keep the sensor free of contact", "hold still"}


def test_where_nothing_new_comes_the_command_ends_and_keeps_what_it_has(tmp_path, monkeypatch):
    rest = [picture(seed=k % 50) for k in range(int(FPS * (GIVE_UP_S + 2)))]
    with pytest.raises(DeviceError, match="2 of 9 contacts after 60 s without a new one; press"):
        record(Pictures(session(CONTACTS[:2]).pictures + rest), tmp_path / "mine", 9)
    assert len(open_recording(tmp_path / "mine")) == 2
    monkeypatch.setattr(module, "ENOUGH", 2)
    told = []
    made = record_frames(Pictures(session(CONTACTS[:2]).pictures + rest), tmp_path / "enough", count=9, say=told.append)
    assert made.count == 2 and any(
        note.startswith("ended at 2 of 9 contacts, after 60 s without a new one (press at") for note in made.notes
    )
    assert [line for line in told if "of 9 contacts" in line] == [
        "2 of 9 contacts; press at another place, lightly or firmly, and hold still. Without a new one it ends in 45 s"
    ], "once, and in terms of what to do"
    with pytest.raises(DeviceError, match="has frames already; give a new folder"):
        record(session(CONTACTS), tmp_path / "mine", 2)
    with pytest.raises(DeviceError, match="no frame; check the camera"):
        record(Pictures([]), tmp_path / "none", 2)
    assert not (tmp_path / "none").exists()
    with pytest.raises(DeviceError, match="recorded already; give it to 'twin new'"):
        record(open_camera(str(tmp_path / "mine")), tmp_path / "other", 2)


@pytest.mark.parametrize(
    ("light", "blur_px", "said"),
    [({"caps": 35, "skin": 5}, 0, "too dark"), ({"skin": 255}, 0, "too bright"), ({}, 5, "blurred"), ({}, 0, "")],
)
def test_light_and_focus_are_judged_and_do_not_stop_a_patient_user(tmp_path, light, blur_px, said):
    def seen(pictures):
        different = {id(one): one for one in pictures}  # most come many times
        blurred = {key: cv2.GaussianBlur(one, (0, 0), blur_px) if blur_px else one for key, one in different.items()}
        return [blurred[id(one)] for one in pictures]

    assert describe_picture(seen([picture(**light)])[0]).startswith(said) and bool(said) == bool(
        describe_picture(seen([picture(**light)])[0])
    )
    if said:
        source = Pictures(seen(session([CONTACTS[0]], still=int(FPS * (PATIENCE_S + 1)), **light).pictures))
        source.pictures = seen([picture(seed=k % 50, **light) for k in range(int(FPS * (PATIENCE_S + 1)))]) + source.pictures
        made = record(source, tmp_path / "mine", 1)
        assert len(made.notes) == 1 and made.notes[0].startswith(said)


def test_thresholded_pictures_are_not_judged():
    assert describe_picture(np.where(picture() > 100, 255, 0).astype(np.uint8)) == ""


def test_the_page_shows_the_newest_picture_and_a_line_of_text():
    with PicturePage() as page:
        page.show(picture(), "3/40  hold still")
        assert b'<img src="/stream.mjpg"' in urlopen(page.url, timeout=5).read()
        assert urlopen(page.url.rstrip("/") + LINE, timeout=5).read() == b"3/40  hold still"
        with open_camera(page.url + "stream.mjpg") as camera:
            assert camera.read(timeout_s=5.0).image.shape[:2] == SIZE
            page.show(np.zeros((*SIZE, 3), np.uint8) + np.uint8([200, 0, 0]), "")
            newest = camera.read(timeout_s=5.0).image
            assert abs(int(newest[30, 50, 0]) - 200) < 8 and newest[30, 50, 1] < 20
