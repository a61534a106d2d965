"""A closed loop: a rendered frame taken for a real one is found to look like its own render."""

import json

import cv2
import numpy as np
import pytest
from command import run_twin

from scenes import load_object, load_sensor
from training.studies.realism import compare_with_renders
from twin.mechanics import ContactPose
from twin.simulator import Simulator

SENSOR = "ur5-331"
DARK = np.zeros((480, 640, 3), np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames")
    simulator = Simulator(load_sensor(SENSOR))
    state = simulator.press(load_object("plane"), ContactPose(indent_mm=2.5, tilt_deg=(6.0, -4.0)))
    cv2.imwrite(str(path / "press.png"), simulator.render(state, seed=5).frame.image[..., ::-1])
    cv2.imwrite(str(path / "dark.png"), DARK)
    return path


@pytest.mark.slow
def test_a_render_looks_like_itself(folder, tmp_path):
    """The skin fitted to the detected pins gives the same picture again, but for noise and a few hundredths of a pixel."""
    made = compare_with_renders(folder, load_sensor(SENSOR), tmp_path, test=False)
    metrics, written = made.metrics, made.written
    assert metrics["refused"] == [{"image_name": "dark.png", "reason": metrics["refused"][0]["reason"]}]
    images, found = metrics["pin_aligned"], metrics["statistics"]
    assert images["exact_fraction"] == 1.0
    least_ssim, least_psnr_db, most_flip = 0.987, 36.24, 0.0342  # measured: 0.9882, 37.07, 0.0311; errors may be 10 % larger
    assert images["ssim"]["mean"] > least_ssim and images["psnr_db"]["mean"] > least_psnr_db and images["flip"]["mean"] < most_flip
    assert all(found["target"]["met"].values()), found["worst_relative_difference"]
    assert found["spots"]["paired"] >= 0.9 * found["spots"]["real"], "noise may join two of the rim's spots, or part them"
    assert all(path.stat().st_size for path in written)
    page = (tmp_path / "index.html").read_text()
    for picture in (tmp_path / "pictures").iterdir():
        assert f"pictures/{picture.name}" in page
    assert json.loads((tmp_path / "metrics.json").read_text())["frames"] == 1


def test_the_command_refuses_in_one_line(tmp_path):
    (tmp_path / "none").mkdir()
    cv2.imwrite(str(tmp_path / "dark.png"), DARK)
    for path, word in ((tmp_path / "none", "empty"), (tmp_path / "missing", "no such"), (tmp_path / "dark.png", "black")):
        done = run_twin("realism", path, "--sensor", SENSOR, "--out", tmp_path / "out")
        assert done.returncode == 1 and "Traceback" not in done.stderr
        assert any(line.startswith("twin: error:") and word in line for line in done.stderr.splitlines()), done.stderr
