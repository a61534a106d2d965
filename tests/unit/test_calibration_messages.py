"""A calibration says where it ended worse than it began, and what it cannot know; frames of one stem are kept apart."""

from types import SimpleNamespace

import numpy as np

from scenes import load_sensor
from twin.calibration.contact.calibrate import ContactCalibration
from twin.calibration.contact.report import warnings_of
from twin.calibration.optics import Calibration, OpticsCalibration, _Log, write_page
from twin.evaluation.pictures.aligned import Aligned
from twin.frames import distinct_stems
from twin.mechanics.skin_fit import FittedPins

GOOD = {"psnr_db": 20.0, "psnr_gray_db": 21.0, "ssim": 0.8, "ssim_gray": 0.8, "flip": 0.1, "psnr_whole_db": 19.0}


def frame(name, level):
    image = np.full((48, 64), level, np.uint8)
    return Aligned(name, image, np.zeros((3, 2)), FittedPins(*np.zeros((3, 3, 3)), np.zeros(3), np.zeros(3)))


def calibration(after):
    frames = [frame("a.png", 10), frame("a.jpg", 200)]
    images = [each.image for each in frames]
    return Calibration(load_sensor("ur5-331"), GOOD, after, [], frames, images, images)


def test_optics_that_ended_worse_say_so_everywhere(tmp_path):
    for after, worse in ((GOOD, 0), (GOOD | {"psnr_db": 14.85}, 1), (GOOD | {"psnr_db": 14.0, "ssim": np.nan}, 2)):
        found = calibration(after)
        lines = OpticsCalibration(found, []).lines()
        assert len(found.warnings) == worse == sum("worse than it began" in line for line in lines)
        page = write_page(tmp_path, found.spec, found, "taps").read_text()
        assert page.count("worse than it began") == worse


def test_pictures_of_frames_of_one_stem_are_all_written(tmp_path):
    write_page(tmp_path, load_sensor("ur5-331"), calibration(GOOD), "taps")
    assert sorted(p.name for p in (tmp_path / "pictures").glob("*-real*")) == ["a.jpg-real.png", "a.png-real.png"]


def test_stems_are_told_apart():
    assert distinct_stems(["a.png", "b.png"]) == ["a", "b"]
    assert distinct_stems(["a.png", "a.jpg", "b.png"]) == ["a.png", "a.jpg", "b"]


def test_frames_of_one_stem_do_not_share_a_fitted_skin(tmp_path, monkeypatch):
    class Fit:
        """In the place of the fit of a skin: tells what it was fitted to."""

        def __init__(self, spec):
            pass

        def __call__(self, pins_px):
            return FittedPins(*np.repeat(np.pad(pins_px, ((0, 0), (0, 1)))[None], 3, axis=0), np.zeros(3), np.zeros(3))

    spec = load_sensor("ur5-331")
    raw = [(name, np.zeros((4, 4), np.uint8), np.full((3, 2), level)) for name, level in (("a.png", 1.0), ("a.jpg", 2.0))]
    monkeypatch.setattr("twin.calibration.optics.SkinFit", Fit)
    for _ in range(2):  # fitted, then from disk
        first, second = _Log(tmp_path, spec, raw).align_frames(spec, raw, lambda *_: None)
        assert first.state.caps_mm[0, 0] == 1.0 and second.state.caps_mm[0, 0] == 2.0


def test_a_contact_says_what_it_does_not_know_and_where_it_is_worse():
    fit = SimpleNamespace(before_px=np.array([1.0, 2.0]), after_px=np.array([0.5, 0.6]))
    assert warnings_of(fit, (1.5, 0.7), 3) == []
    (unknown,) = warnings_of(fit, None, 0)
    assert "no held-out frame is left" in unknown
    (worse,) = warnings_of(fit, (1.5, 1.7), 3)
    assert "worse than it began on the 3 held-out frames: 1.50 -> 1.70 px" in worse
    (worse,) = warnings_of(replace_after(fit, 3.0), (1.5, 0.7), 3)
    assert "worse than it began on the fitted frames" in worse
    summary = {"problems": [], "parameters": [], "fitted_px": {}, "held_out_px": {}, "distrusted": [], "warnings": [unknown]}
    summary |= {"newtons": {"said": "the stiffness is assumed"}}
    lines = ContactCalibration(load_sensor("ur5-331"), summary, []).lines()
    assert unknown in lines and "the stiffness is assumed" in lines


def replace_after(fit, value):
    return SimpleNamespace(before_px=fit.before_px, after_px=np.full(2, value))
