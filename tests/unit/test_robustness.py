"""Changes of an image are what their names say, and their table counts every frame."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame

from training.estimate.estimator import PoseEstimator
from training.studies.judging import CHANGES, measure_changes
from twin.report.page import write_table
from twin.types import Form, Frame


@pytest.fixture(scope="module")
def estimator(trained):
    return PoseEstimator.load(trained)


def test_each_change_moves_the_pins_as_named(data, estimator):
    rest = data.pins.reference.pins_px
    image = drawn_frame(data.pins.sensor, Form.PROCESSED, rest).image
    middle = (np.array(image.shape[::-1]) - 1) / 2
    seen = {
        name: estimator.pipeline(Frame(change(image, np.random.default_rng(1), estimator), Form.PROCESSED))
        for name, change in CHANGES.items()
    }
    z, at_rest = {}, (rest - middle) @ [1, 1j]
    for name in ("1 % scale", "2 px shift", "1 deg turn"):
        z[name] = (seen[name].pins_px - middle) @ [1, 1j]
    assert np.nanmedian(np.abs(np.abs(z["1 % scale"] / at_rest)[1:] - 1)) == pytest.approx(0.01, abs=2e-3)
    assert np.abs(np.nanmean(z["2 px shift"] - at_rest)) == pytest.approx(2, abs=0.1)
    assert np.degrees(np.nanmedian(np.abs(np.angle(z["1 deg turn"] / at_rest)[1:]))) == pytest.approx(1, abs=0.1)
    assert np.isnan(seen["5 pins erased"].pins_px[:, 0]).sum() == 5


def test_the_table_has_every_change_and_every_frame(data, estimator, tmp_path):
    folder = tmp_path / "recording"
    (folder / "frames_bw").mkdir(parents=True)
    rows = np.arange(6)
    lines = ["image_name,pose_2,pose_6"]
    for k in rows:
        image = drawn_frame(data.pins.sensor, Form.PROCESSED, data.pins.nodes_px[k]).image
        cv2.imwrite(str(folder / "frames_bw" / data.pins.image_name[k]), image if k else 0 * image)  # the first shows nothing
        lines.append(f"{data.pins.image_name[k]},0,0")
    (folder / "targets.csv").write_text("\n".join(lines) + "\n")
    found = measure_changes(estimator, replace(data, folders=(folder,)), rows)
    assert [row["change"] for row in found] == ["none", *CHANGES]
    assert all(row["frames"] == 6 and row["not_valid"] == 1 for row in found) and found[0]["pose_2_more"] == 0
    assert write_table(tmp_path / "robustness.csv", found).read_text().count("\n") == 1 + len(found)
