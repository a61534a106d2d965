"""The view in Rerun: what it is told to show must be there; without the package there is an error with a remedy."""

import re
import socket
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_frames import drawn_frame

from hardware.errors import DeviceError
from hardware.live.live import RerunView
from scenes import load_sensor
from training.estimate.estimator import PoseEstimate
from twin.errors import ExtraError, OptionError
from twin.pins import Pipeline
from twin.studio.page import LiveFrame
from twin.types import Form


def test_without_the_package_the_remedy_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ExtraError, match="pip install"):
        RerunView("title", "viewer")


def test_a_target_that_is_none_is_an_error():
    with pytest.raises(OptionError, match="expected 'viewer'"):
        RerunView("title", "somewhere")


def test_a_file_that_is_there_is_not_written_over(tmp_path):
    (tmp_path / "live.rrd").write_bytes(b"kept")
    with pytest.raises(DeviceError, match="give a new file"):
        RerunView("title", str(tmp_path / "live.rrd"))


class Stream:
    """Of a viewer that takes connections and is then gone."""

    def __init__(self, title):
        self.flushed, self.closed = 0, False

    def connect_grpc(self, address):
        pass

    def flush(self, *, timeout_sec):
        self.flushed += 1
        if self.flushed > 1:
            raise RuntimeError("connection lost")

    def disconnect(self):
        self.closed = True


@pytest.mark.parametrize("target", ["rerun+http://127.0.0.1:1/proxy", "rerun+http:///proxy"])
def test_an_address_at_which_no_viewer_answers_is_an_error_when_it_is_opened(monkeypatch, target):
    monkeypatch.setitem(sys.modules, "rerun", SimpleNamespace(RecordingStream=Stream))
    with pytest.raises(DeviceError, match=f"`rerun` {re.escape(target)}: can't be opened .*start a viewer"), RerunView("title", target):
        pytest.fail("it was opened")


def test_a_viewer_that_goes_is_an_error_at_the_end(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", SimpleNamespace(RecordingStream=Stream))
    with socket.create_server(("127.0.0.1", 0)) as server:
        view = RerunView("title", f"rerun+http://127.0.0.1:{server.getsockname()[1]}/proxy")
        with pytest.raises(DeviceError, match="closed before the end .connection lost."), view:
            pass
    assert view._stream.closed


def test_frame_pins_and_pose_are_in_the_file(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is optional")
    sensor = load_sensor("mg400-331")
    pipeline = Pipeline(sensor, Form.PROCESSED)
    frame = replace(drawn_frame(sensor, Form.PROCESSED, pipeline.reference.pins_px), time_s=1.0, sequence=7)
    seen = pipeline(frame)
    assert seen.valid
    value = np.array([1.0, 2.0])
    estimate = PoseEstimate(("pose_2", "pose_6"), ("mm", "deg"), value, value - 1, value + 1, np.nan, True, "", 1.0)
    file = tmp_path / "live.rrd"
    with RerunView("twin", str(file)) as view:
        view.show(LiveFrame(frame, estimate, ("pose",)), seen)
    content = file.read_bytes()
    for entity in (b"camera/pins", b"camera/edges", b"pose/pose_2", b"pose/pose_6", b"figures"):
        assert entity in content
