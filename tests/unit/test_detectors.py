"""Every detector finds the pins of an easy frame; tuning needs no knowledge but the layout, and its file says it all."""

import pickle
import re
from dataclasses import replace
from functools import cache, partial

import cv2
import numpy as np
import pytest
from drawn_frames import draw_discs, drawn_frame, smooth_warp
from unknown_sensor import leave_out_other_layouts

from scenes import load_sensor
from twin.errors import FrameError, OptionError
from twin.frames.forms import known_sizes
from twin.geometry.pins import pin_lattice
from twin.pins import METHODS, load_detector, make_detector, shipped_detector, write_detector
from twin.pins.detectors.detector_spec import own_detector, own_name, own_places
from twin.pins.detectors.tune import tune
from twin.pins.detectors.tune_files import tune_on_frames
from twin.pins.labelling.reference import nominal_reference
from twin.types import Form, Frame

# scale spaces give whole pixels; DoH, from an integral image, is off by about one
CENTROID_PX = {"twin": 0.1, "legacy": 0.6, "adaptive": 0.6, "fixed": 0.6, "simple": 0.6, "log": 1.0, "dog": 1.0, "doh": 1.8}
FOREIGN_PX = (400, 300)
QUICK = ("twin", "legacy", "adaptive")  # methods that make test tunes; the others are tuned by make validate


@pytest.fixture(scope="module")
def spec():
    return load_sensor("mg400-127")


def flat_layout(spec):
    """Pins (N, 2) laid flat, the outermost at distance 1."""
    place = pin_lattice(spec.pins).places @ [1, 1j] * np.exp(1j * np.radians(spec.pins.phase_deg))
    return np.column_stack([place.real, place.imag])


@pytest.fixture(scope="module")
def foreign(spec):
    """Frames of a sensor like ours whose camera nobody knows: of another size, displaced, turned, brighter ring around; and their pins."""
    flat = flat_layout(spec)
    turn = np.radians(8.0)
    turning = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    center, frames, truths = np.array([187.5, 159.0]), [], []
    for k in range(2):
        rest = center + 103.0 * (flat @ turning) * (1 - 0.08 * np.linalg.norm(flat, axis=1, keepdims=True))
        truth = smooth_warp(rest, 3.8, np.random.default_rng(k))
        image = draw_discs(FOREIGN_PX, truth, 3.8, level=(20, 120), blur_px=0.8, noise_sd=1.0, rng=np.random.default_rng(k))
        cv2.circle(image, (187, 159), 128, 180, 9)
        frames.append(Frame(image, Form.RAW, f"foreign-{k}"))
        truths.append(truth)
    return frames, truths


@pytest.fixture(scope="module")
def tuned_by(spec, foreign):
    """A tuning by each method."""
    with pytest.MonkeyPatch.context() as patch:
        leave_out_other_layouts(patch)
        yield cache(partial(tune, foreign[0], spec))


@pytest.fixture(scope="module")
def tuned(tuned_by):
    return tuned_by("twin")


@pytest.mark.parametrize("method", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in METHODS])
def test_every_method_tunes_itself_and_finds_the_pins(spec, foreign, tuned_by, method):
    frames, truths = foreign
    detector = tuned_by(method).detector
    find = make_detector(spec, detector)
    for frame, truth in zip(frames, truths, strict=True):
        found = find(frame)
        assert len(found.claims_px) == spec.pins.count, (method, len(found.claims_px), detector)
        nearest = np.linalg.norm(found.claims_px - truth[:, None], axis=2).min(axis=1)
        assert np.sqrt(np.mean(nearest**2)) < CENTROID_PX[method]
        assert found.valid and (method == "legacy" or found.graph.nodes_px.shape == truth.shape)
    assert detector.evidence.exact_rate == 1.0


def test_a_tuning_tells_what_it_left_out_and_frames_of_another_size(spec, tuned, tmp_path, monkeypatch):
    monkeypatch.setattr("twin.pins.detectors.tune_files.tune", lambda *_, **__: tuned)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"f_{k}.png"), np.full((240, 320), 40 * k, np.uint8))
    (tmp_path / "f_1.png").write_bytes(b"no picture")
    told = tune_on_frames(tmp_path, spec, limit=3).odd
    assert any(note.startswith("skipped f_1.png: not a readable picture") for note in told)
    assert any("f_0.png: 320x240" in note and "mg400-127" in note for note in told)
    width, height = known_sizes(spec)[Form.RAW]
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"f_{k}.png"), np.full((height, width), 40 * k, np.uint8))
    assert not tune_on_frames(tmp_path, spec, limit=3).odd


@pytest.mark.usefixtures("no_other_layout")
def test_a_tuning_says_whether_its_pins_at_rest_were_made_from_contacts(spec, foreign):
    uneven = foreign[1][0] + np.random.default_rng(0).normal(0, 0.9, foreign[1][0].shape)  # as no frame without contact is
    contact, given = (
        Frame(draw_discs(FOREIGN_PX, px, 3.8, level=(20, 120), blur_px=0.8), Form.RAW, name)
        for px, name in ((uneven, "f_0.png"), (foreign[1][1], "init_0.png"))
    )
    made, measured = tune([contact], spec), tune([contact], spec, given=given)
    assert made.detector.blob.rest_origin == "contacts" and "`no_contact`" in made.rest.line()
    assert measured.detector.blob.rest_origin == "measured" and "init_0.png" in measured.rest.line()
    assert np.linalg.norm(np.array(measured.detector.pins_px) - foreign[1][1], axis=1).max() < 0.5


def test_names_are_those_of_the_layout(spec, foreign, tuned):
    frames, truths = foreign
    found = make_detector(spec, tuned.detector)(frames[0])
    assert np.linalg.norm(found.pins_px - truths[0], axis=1).max() < 1.0


def test_a_tuning_says_when_it_is_unsure(spec, foreign, tuned):
    frames, _ = foreign
    rng = np.random.default_rng(0)
    noisy = [Frame(np.clip(f.image + rng.normal(0, 60, f.image.shape), 0, 255).astype(np.uint8), f.form, f.name) for f in frames[:1]]
    try:
        doubtful = tune(noisy, spec)
    except FrameError as error:
        assert "shows 127 pins" in str(error)
    else:
        assert doubtful.detector.evidence.sure != "sure" and doubtful.notes
    assert tuned.detector.evidence.threshold_slack > 1 and tuned.detector.evidence.mask_slack_px > 5


def test_a_tuning_survives_its_file(tuned, tmp_path):
    detector = tuned.detector
    path = tmp_path / "mine.toml"
    write_detector(path, detector, "two\nlines")
    assert load_detector(path) == detector.model_copy(update={"name": "mine"})


def test_frames_without_a_layout_are_refused(spec):
    black = Frame(np.zeros((480, 640), np.uint8), Form.RAW)
    with pytest.raises(FrameError, match="none of 1 frame shows 127 pins"):
        tune([black], spec)


@pytest.mark.usefixtures("no_other_layout")
def test_recordings_are_tuned_without_a_crop(spec):
    rest = nominal_reference(spec, Form.PROCESSED).pins_px
    frames = [drawn_frame(spec, Form.PROCESSED, smooth_warp(rest, 4.0, np.random.default_rng(k))) for k in range(2)]
    detector = tune(frames, spec).detector
    assert detector.form == Form.PROCESSED and detector.recording is None and detector.blob.threshold_block_px == 0
    assert all(make_detector(spec, detector)(frame).valid for frame in frames)
    assert make_detector(spec, shipped_detector(spec, Form.PROCESSED, "legacy"))(frames[0]).pins_px is None


def test_a_tuning_that_is_worse_than_the_specification_says_so(spec, tuned, tmp_path, monkeypatch):
    rest = nominal_reference(spec, Form.RAW).pins_px
    for k in range(2):
        frame = drawn_frame(spec, Form.RAW, smooth_warp(rest, 3.0, np.random.default_rng(k)))
        cv2.imwrite(str(tmp_path / f"f_{k}.png"), frame.image)
    for rate in (0.0, 1.0):
        evidence = tuned.detector.evidence.model_copy(update={"exact_rate": rate, "low_rate": 0.0})
        made = replace(tuned, detector=tuned.detector.model_copy(update={"evidence": evidence}))
        monkeypatch.setattr("twin.pins.detectors.tune_files.tune", lambda *_, made=made, **__: made)
        odd = tune_on_frames(tmp_path, spec).odd
        assert any("specification itself finds all pins in 100% of these frames" in note for note in odd) == (rate == 0.0), odd


@pytest.mark.usefixtures("no_other_layout")
def test_frames_of_a_sensor_without_a_recording_form_are_raw(spec, foreign, tmp_path):
    """Whatever they look like: these are thresholded."""
    for frame in foreign[0]:
        cv2.imwrite(str(tmp_path / f"{frame.name}.png"), np.where(frame.image > 70, 255, 0).astype(np.uint8))
    alone = spec.model_copy(update={"recording": None, "pipeline": spec.pipeline.model_copy(update={"processed": None})})
    assert tune_on_frames(tmp_path, alone, limit=2).tuned.detector.form == Form.RAW


@pytest.mark.parametrize("method", [*QUICK, pytest.param("fixed", marks=pytest.mark.slow)])
def test_stricter_raises_the_bar(spec, foreign, tuned_by, method):
    detector = tuned_by(method).detector
    moved = [make_detector(spec, detector.stricter(levels), second_look=False) for levels in (0.0, 250.0)]
    counts = [len(find(foreign[0][0]).claims_px) for find in moved]
    assert counts[1] < 0.5 * counts[0]
    assert detector.stricter(0.0) == detector


def test_wrong_files_are_refused_by_name(spec, tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text('method = "twim"\n')
    with pytest.raises(FrameError, match="bad.toml"):
        load_detector(path)
    write_detector(path, shipped_detector(spec, Form.RAW))
    for method, finder in ("own", ""), ("log", "mine.py:my_pins"):
        wrong = path.read_text().replace('method = "twin"', f'method = "{method}"').replace('finder = ""', f'finder = "{finder}"')
        (tmp_path / "own.toml").write_text(wrong)
        with pytest.raises(FrameError, match="own.toml.*FILE.py:FUNCTION"):
            load_detector(tmp_path / "own.toml")
    tuned = shipped_detector(spec, Form.RAW).model_copy(update={"pins_px": ((0.0, 0.0),)})
    with pytest.raises(FrameError, match="tuned for 1 pins"):
        make_detector(spec, tuned)


OWN = """
import cv2

def my_pins(image):
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    count, _, stats, middle = cv2.connectedComponentsWithStats((gray > 80).astype("uint8"))
    return middle[1:][stats[1:, cv2.CC_STAT_AREA] < 200]

def by_rows(image):
    return [(1.0, 2.0, 3.0)]

def careless(image):
    return 1 / int(image.max() < 10)

def blind(image):
    return []
"""


@pytest.fixture
def own_file(tmp_path):
    """A user's functions in a file."""
    path = tmp_path / "mine.py"
    path.write_text(OWN)
    return path


def test_a_function_of_the_user_is_a_detector_like_the_others(spec, own_file):
    detector = own_detector(f"{own_file}:my_pins", spec, Form.RAW)
    rest = nominal_reference(spec, Form.RAW).pins_px
    frame = Frame(draw_discs(known_sizes(spec)[Form.RAW], rest, 4.0, level=(20, 140), blur_px=0.8), Form.RAW, "drawn")
    found = make_detector(spec, detector)(frame)
    assert detector.name == "my_pins" and found.valid
    np.testing.assert_allclose(found.pins_px, rest, atol=0.5)
    assert pickle.loads(pickle.dumps(detector)) == detector  # it goes to other processes
    assert detector.stricter(20.0) == detector


def test_a_failing_function_is_a_result_and_says_why(spec, own_file):
    frame = Frame(np.full(known_sizes(spec)[Form.RAW][::-1], 128, np.uint8), Form.RAW, "gray")
    for name, why in (
        ("by_rows", r"by_rows returned an array \(1, 3\)"),
        ("careless", "careless failed: ZeroDivisionError"),
        ("blind", "too few pins: 0"),
    ):
        found = make_detector(spec, own_detector(f"{own_file}:{name}", spec, Form.RAW))(frame)
        assert not found.valid and re.search(why, found.reason)


def test_a_changed_file_is_another_detector(spec, own_file):
    before = own_detector(f"{own_file}:blind", spec, Form.RAW)
    own_file.write_text(OWN.replace("return []", "return [(5.0, 6.0)]"))
    after = own_detector(f"{own_file}:blind", spec, Form.RAW)
    assert before != after
    frame = Frame(np.zeros((9, 9), np.uint8), Form.RAW, "dark")
    assert len(own_places(before, frame)) == 0 and own_places(after, frame).tolist() == [[5.0, 6.0]]


@pytest.mark.parametrize(
    ("content", "name", "said"),
    [
        (None, "my_pins", "can't be read"),
        ("def other(image): ...", "my_pins", "has no function 'my_pins'; it has: other"),
        ("import no_such_package", "my_pins", "No module named 'no_such_package'"),
        ("raise SystemExit(3)", "my_pins", "SystemExit"),
        ("def my_pins(", "my_pins", "SyntaxError"),
    ],
)
def test_a_function_that_is_not_there_is_named(tmp_path, content, name, said):
    path = tmp_path / "mine.py"
    if content is not None:
        path.write_text(content)
    with pytest.raises(OptionError, match=re.escape(said)):
        own_name(f"{path}:{name}")
