"""``twin calibrate optics``: what it refuses, that it resumes, and (slow) that it finds a known sensor again."""

import cv2
import numpy as np
import pytest
from command import run_twin

from scenes import load_object, load_sensor
from twin.calibration import optics as calibration
from twin.calibration.optics import fit_optics
from twin.calibration.sensor_file import write_sensor
from twin.evaluation.pictures.aligned import with_changes
from twin.mechanics import ContactPose
from twin.simulator import Simulator

SENSOR = "ur5-331"


def test_what_cannot_be_calibrated_is_refused_in_one_line(tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    out = tmp_path / "mine.toml"
    cases = [((frames, out), "empty"), ((tmp_path / "missing", out), "no such"), ((frames, tmp_path / "mine.txt"), ".toml")]
    dark = tmp_path / "dark"
    dark.mkdir()
    cv2.imwrite(str(dark / "a.png"), np.zeros((480, 640, 3), np.uint8))
    cases.append(((dark, out), "black"))
    for (folder, target), word in cases:
        done = run_twin("calibrate", "optics", "--sensor", SENSOR, "--frames", folder, "--out", target)
        assert done.returncode == (2 if word == ".toml" else 1) and word in done.stderr, done.stderr
        assert len([line for line in done.stderr.splitlines() if line.startswith("twin: error")]) == 1
        assert not out.exists()


def test_an_interrupted_run_goes_on_where_it_was(tmp_path):
    """A stage that has been done is read, not run: its result is the file's."""
    spec = load_sensor(SENSOR)
    log = calibration._Log(tmp_path, spec, [("a.png", np.zeros((2, 2), np.uint8), None)])
    done = log.stage("00-one", lambda s: with_changes(s, gel={"haze": 0.125}), spec)
    again = calibration._Log(tmp_path, spec, [("a.png", np.zeros((2, 2), np.uint8), None)])
    assert again.stage("00-one", lambda s: pytest.fail("run again"), spec) == done
    other = calibration._Log(tmp_path, spec, [("a.png", np.ones((2, 2), np.uint8), None)])
    assert other.stage("00-one", lambda s: s, spec) == spec, "other frames must not find this result"


@pytest.mark.slow
def test_a_known_sensor_is_found_again(tmp_path):
    """Frames of a sensor with its own print, lights and sharpness; the shipped specification is the start."""
    start = load_sensor(SENSOR)
    rng = np.random.default_rng(2)
    truth = with_changes(
        start,
        leds={"power": 1.3 * start.leds.power, "balance": (1.15, 0.9, 1.0, 1.1, 0.85, 1.0)},
        appearance={"cap_levels": tuple((1 + 0.1 * rng.standard_normal(331)).tolist()), "cap_shapes": (), "specks": ()},
        response={"blur_sigma_px": 0.9, "jpeg_quality": 0},
    )
    simulator = Simulator(truth)
    frames = tmp_path / "frames"
    frames.mkdir()
    for k, tilt in enumerate([(0.0, 0.0), (8.0, -5.0), (-6.0, 7.0), (3.0, 9.0)]):
        state = simulator.press(load_object("plane"), ContactPose(indent_mm=2.0 + 0.5 * k, tilt_deg=tilt))
        cv2.imwrite(str(frames / f"{k}.png"), simulator.render(state, seed=k).frame.image[..., ::-1])
    found = fit_optics(frames, start, tmp_path / "work", limit=4)
    print(found.before, found.after)
    assert found.after["psnr_db"] > max(33.0, found.before["psnr_db"] + 3)
    shining = [s.leds.power * max(s.appearance.cap_albedo) * np.array(s.appearance.cap_levels).mean() for s in (found.spec, truth)]
    assert shining[0] == pytest.approx(shining[1], rel=0.1)
    np.testing.assert_allclose(found.spec.leds.balance, truth.leds.balance, rtol=0.1)
    levels = [np.array(s.appearance.cap_levels) for s in (found.spec, truth)]
    assert np.corrcoef(*levels)[0, 1] > 0.9
    write_sensor(tmp_path / "found.toml", found.spec)
    assert load_sensor(tmp_path / "found.toml").pins.count == 331
