"""Odd camera servers over real sockets: each is read, or refused in one line that names the remedy; a secret is never printed."""

import logging
import re
import time

import numpy as np
import pytest
from odd_cameras import CATALOGUE, odd_camera
from rtsp_camera import rtsp_camera

from hardware.cameras import reader
from hardware.cameras.mjpeg import without_secrets
from hardware.cameras.source import open_camera
from hardware.errors import DeviceError

SECRETS = re.compile(r"s3cret|hunter2|admin")
WAIT_S = 6.0


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch):
    monkeypatch.setattr(reader, "FAILED_PAUSE_S", 0.01)


@pytest.mark.parametrize("name", [name for name, case in CATALOGUE.items() if not case.refused])
def test_it_is_read(name, caplog):
    case = CATALOGUE[name]
    with caplog.at_level(logging.DEBUG), odd_camera(case) as url, open_camera(url) as camera:
        frames = [camera.read(timeout_s=WAIT_S) for _ in range(6)]
        notes = "\n".join(camera.notes())
        assert all(frame.image.shape[:2] == (48, 64) and frame.image.std() > 20 for frame in frames)
        assert (np.diff([frame.sequence for frame in frames]) > 0).all()
        assert all(time.monotonic() - frame.time_s < 60 for frame in frames)
        assert re.search(case.notes, notes)
        assert not SECRETS.search(f"{camera.name}{notes}{caplog.text}")


@pytest.mark.parametrize("name", [name for name, case in CATALOGUE.items() if case.refused])
def test_it_is_refused_in_one_line_with_the_remedy(name, caplog, capfd):
    case = CATALOGUE[name]
    with caplog.at_level(logging.DEBUG), odd_camera(case) as url:
        camera = open_camera(url)
        with pytest.raises((DeviceError, TimeoutError)) as refused, camera:
            camera.read(timeout_s=4.0 if name == "silent" else WAIT_S)
    line = str(refused.value)
    assert re.search(case.refused, line), line
    assert "\n" not in line and len(line) < 400
    printed = capfd.readouterr()
    assert not SECRETS.search(f"{line}{caplog.text}{printed.out}{printed.err}")


def test_a_part_is_there_before_the_next_one_begins():
    """Without a length the end of a picture must not be the beginning of the next one, which comes a period later."""
    with odd_camera(CATALOGUE["slow parts"]) as url, open_camera(url) as camera:
        camera.read(timeout_s=WAIT_S)
        ages_s = []
        for _ in range(4):
            frame = camera.read(timeout_s=WAIT_S)
            ages_s.append(time.monotonic() - frame.time_s)
    assert max(ages_s) < 0.1


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("http://admin:s3cret@host:80/a?x=1&y=hunter2#z", "http://host:80/a?x=...&y=..."),
        ("rtsp://admin:s3@cret@host/a", "rtsp://host/a"),
        ("admin:s3cret@host/video", "host/video"),
        ("ffmpeg:http://admin:s3cret@host/v", "ffmpeg:http://host/v"),
        ("/dev/video0", "/dev/video0"),
        ("recordings/a@b", "b"),
    ],
)
def test_addresses_lose_their_secrets(address, shown):
    assert without_secrets(address) == shown


@pytest.mark.parametrize("text", ["admin:s3cret@127.0.0.1/video", "http://admin:s3cret@127.0.0.1:x/", "http://admin:s3/cret@127.0.0.1/"])
def test_an_address_that_is_none_is_refused_without_its_secret(text):
    with pytest.raises(DeviceError) as refused:
        open_camera(text).connect()
    assert not SECRETS.search(str(refused.value)) and "cret" not in str(refused.value)


def test_rtsp(capfd):
    with rtsp_camera() as url, open_camera(url) as camera:
        frames = [camera.read(timeout_s=WAIT_S) for _ in range(5)]
        assert all(frame.image.shape == (48, 64, 3) and frame.image.std() > 15 for frame in frames)
        assert camera.read_after(time.monotonic(), timeout_s=WAIT_S).image.size
    assert not SECRETS.search(camera.name + "".join(capfd.readouterr()))
