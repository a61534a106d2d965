"""The view in Rerun: what it is told to show must be there; without the package there is an error with a remedy."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from drawn_frames import drawn_frame

from hardware.errors import DeviceError
from hardware.view.rerun import RerunView
from scenes import load_sensor
from training.estimator import PoseEstimate
from twin.preprocess import Pipeline
from twin.types import Form


def test_without_the_package_the_remedy_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(DeviceError, match="pip install"):
        RerunView("title", "viewer")


def test_a_target_that_is_none_is_an_error():
    with pytest.raises(DeviceError, match="expected 'viewer'"):
        RerunView("title", "somewhere")


def test_a_file_that_is_there_is_not_written_over(tmp_path):
    (tmp_path / "live.rrd").write_bytes(b"kept")
    with pytest.raises(DeviceError, match="give a new file"):
        RerunView("title", str(tmp_path / "live.rrd"))


def test_frame_pins_and_pose_are_in_the_file(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is optional")
    sensor = load_sensor("mg400-331")
    pipeline = Pipeline(sensor, Form.RECORDING)
    frame = replace(drawn_frame(sensor, Form.RECORDING, pipeline.reference.pins_px), time_s=1.0, sequence=7)
    seen = pipeline(frame)
    assert seen.valid
    value = np.array([1.0, 2.0])
    estimate = PoseEstimate(("pose_2", "pose_6"), ("mm", "deg"), value, value - 1, value + 1, np.nan, True, "", 1.0)
    file = tmp_path / "live.rrd"
    with RerunView("twin", str(file)) as view:
        view.log(frame, seen, estimate)
        assert view.show(np.zeros((10, 10, 3), np.uint8), {"0": "pose"})
    content = file.read_bytes()
    for entity in (b"camera/pins", b"camera/edges", b"pose/pose_2", b"pose/pose_6", b"figures"):
        assert entity in content
