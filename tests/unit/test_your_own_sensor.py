"""From frames to a specification that the program reads: any size, tables and no-contact frames from anywhere, and no nonsense."""

import re
from operator import attrgetter
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame, smooth_warp
from scipy.spatial import cKDTree
from unknown_sensor import RADIUS, SIZE, frames_of, leave_out_other_layouts, rest_of, search_few_sizes

from scenes import load_sensor
from scenes.pins import PinsSpec, layout_from
from training.estimate.estimator import PoseEstimator
from training.studies.evaluation import predict_frames
from twin.calibration.assumptions import AssumptionCost
from twin.calibration.camera_pose import CameraReport
from twin.calibration.new_sensor import _camera, _compare_layout, _doubtful, _health, new_sensor
from twin.camera.projection import project
from twin.errors import FrameError, OptionError, TwinError
from twin.frames import frames_at, open_recording
from twin.geometry.pins import pin_lattice, rest_pins, usual_spacing
from twin.optics.relief import cap_planes
from twin.pins import Pipeline, nominal_reference, with_detector
from twin.pins.batch import draw_overlay, recording_reference
from twin.pins.check import Grade, examine
from twin.pins.detectors.detector_spec import shipped_detector
from twin.pins.detectors.tune import _at_rest, tune
from twin.pins.labelling.identify import Candidate, LayoutInFrame
from twin.pins.labelling.rest import Rest, rest_from_contacts
from twin.pins.labelling.rest import rest_of as rest_found
from twin.types import Form, Frame

DOCS = Path(__file__).parents[2] / "docs" / "your-own-sensor.md"
PINS = PinsSpec(rings=4)
COST = AssumptionCost("radius of the tip, 20 mm", "+25 %", -0.2, 0.1)  # made up: test_assumptions.py computes them


def folder_of(tmp_path, images, names=None):
    folder = tmp_path / "mine"
    folder.mkdir(exist_ok=True)
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / (names[k] if names else f"frame_{k}.png")), image)
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A new sensor from four contacts and a no-contact frame under another name than usual."""
    tmp_path = tmp_path_factory.mktemp("new")
    rest = rest_of(PINS)
    images = [*frames_of(rest, 4), *frames_of(rest, 1, contact_px=1e-9)]
    folder = folder_of(tmp_path, images, [*(f"frame_{k}.png" for k in range(4)), "no_contact.png"])
    (folder / "frame_4.png").write_bytes((folder / "frame_3.png").read_bytes()[:5000])
    with pytest.MonkeyPatch.context() as patch:
        search_few_sizes(patch)
        patch.setattr("twin.calibration.new_sensor.cost_of_assumptions", lambda sensor, *, progress: [COST])
        return new_sensor(folder, tmp_path / "mine.toml"), rest, folder


@pytest.mark.usefixtures("no_other_layout", "few_sizes")
def test_frames_that_a_specification_was_made_from_are_well(made):
    """Also where the picture's border cuts pins off: they are not lost."""
    found, rest, folder = made
    spec = load_sensor(found.written[0])
    frames = list(open_recording(folder, spec))
    findings = {f.name: f for f in examine(frames, spec)}
    assert {findings[name].verdict for name in ("brightness", "focus", "stray light", "pins")} == {Grade.HEALTHY}, findings
    assert spec.pipeline.usual_caps is not None and f"({spec.pipeline.usual_caps.contrast:.0f} expected)" in findings["brightness"].text
    cut = int(rest[:, 0].max()) - 15  # before the outermost pins on the right
    camera = spec.camera.model_copy(update={"width_px": cut})
    cropped = spec.model_copy(update={"camera": camera})
    frames = [Frame(np.ascontiguousarray(frame.image[:, :cut]), Form.RAW, frame.name) for frame in frames]
    pipeline = Pipeline(cropped, Form.RAW)
    assert all(pipeline(frame).expected < 61 for frame in frames)
    pins = next(f for f in examine(frames, cropped) if f.name == "pins")
    assert pins.verdict is Grade.HEALTHY and "lie outside the picture" in pins.text, pins
    health, _ = _health(cropped, Form.RAW, frames, folder)
    assert health.all_pins == 1.0 and not health.steadily_lost


def test_a_folder_of_frames_becomes_a_sensor(made):
    found, rest, folder = made
    spec = load_sensor(found.written[0])
    assert (spec.pins.layout, spec.pins.rings) == ("rings", 4) and found.identified.sure
    assert found.rest.source == "given" and found.rest.frame == "no_contact.png"
    recording = open_recording(folder, spec)
    seen = [Pipeline(spec, recording.form)(frame) for frame in recording]
    assert all(o.valid and o.found == 61 for o in seen)
    reference = Pipeline(spec, Form.RAW).reference.pins_px
    assert np.linalg.norm(reference[:, None] - rest, axis=2).min(axis=1).max() < 0.6
    assert found.camera.rms_px < 1.5 and found.health.all_pins == 1.0
    page = found.written[1].read_text()
    assert "What is assumed" in page and "overlay-1.png" in page and COST.assumed in page
    assert any(line == f"measure first: {COST.line()}" for line in found.lines())
    note, few = [line for line in found.lines() if line.startswith("note: ")]
    assert "skipped frame_4.png: truncated PNG" in note and "skipped frame_4.png" in page, "what was left out is told"
    assert "too few frames (4)" in few, few


@pytest.mark.usefixtures("no_assumption_costs", "few_sizes")
def test_the_next_steps_name_the_files_and_colour_frames_that_were_thresholded_get_no_light(tmp_path):
    """They can be copied to the command line as they stand."""
    rest = rest_of(PINS)
    images = [np.where(image > 70, 255, 0).astype(np.uint8) for image in frames_of(rest, 2)]
    folder = folder_of(tmp_path, [cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in images])
    (folder / "targets.csv").write_text("image_name,pose_2\n" + "".join(f"frame_{k}.png,{-k}\n" for k in range(2)))
    out = tmp_path / "sub" / "mine.toml"
    found = new_sensor(folder, out, form=Form.PROCESSED)
    (contact,) = [step for step in found.next_steps if "calibrate contact" in step]
    assert contact.endswith(f"twin calibrate contact --sensor {out} --frames {folder} --out {tmp_path / 'sub' / 'mine-2.toml'}")
    assert not [step for step in found.next_steps if "calibrate optics" in step]


def test_the_size_of_the_tip_is_said_to_be_assumed(made):
    assert any(line.startswith("assumed: tip of radius 20 mm") and "`radius_mm`" in line for line in made[0].lines())


@pytest.mark.slow
def test_a_tip_of_another_size_is_the_same_picture_with_other_lengths(made, tmp_path):
    usual, _, folder = made
    small = new_sensor(folder, tmp_path / "small.toml", radius_mm=8.0)
    spec = load_sensor(small.written[0])
    assert any(line.startswith("tip of radius 8 mm") for line in small.lines()) and spec.skin.outer_radius_mm == 8.0
    for key in ("skin.thickness_mm", "pins.cap_diameter_mm", "camera.distance_mm", "leds.radius_mm", "lens.z_mm"):
        before, now = (attrgetter(key)(sensor) for sensor in (usual.sensor, spec))
        assert now == pytest.approx(0.4 * before, rel=2e-3), key
    seen = [project(sensor.view, rest_pins(sensor.geometry).caps_mm) for sensor in (usual.sensor, spec)]
    assert np.abs(seen[0] - seen[1]).max() < 0.05
    assert next(f for f in examine(list(open_recording(folder, spec)), spec) if f.name == "twin").verdict is Grade.HEALTHY


@pytest.mark.parametrize("radius_mm", [0.0, -3.0, 1e4, float("nan")])
def test_a_tip_of_no_such_size_is_refused(made, tmp_path, radius_mm):
    with pytest.raises(OptionError, match="radius .* mm: give the radius"):
        new_sensor(made[2], tmp_path / "none.toml", radius_mm=radius_mm)
    assert not (tmp_path / "none.toml").exists()


@pytest.mark.usefixtures("no_other_layout")
def test_lengths_that_do_not_belong_to_the_camera_are_found_by_a_check(made):
    """A tip made smaller by hand: pins are still found in frames, and the twin draws another sensor."""
    spec, frames = made[0].sensor, list(open_recording(made[2], made[0].sensor))
    shrunk = spec.model_copy(update={"skin": spec.skin.model_copy(update={"outer_radius_mm": 10.0})})
    findings = {f.name: f for f in examine(frames, shrunk)}
    assert findings["pins"].verdict is Grade.HEALTHY
    assert findings["twin"].verdict is Grade.FAILED and "`radius_mm`" in findings["twin"].remedy


def test_a_layout_of_too_few_pins_for_a_camera_is_told(tmp_path):
    folder = folder_of(tmp_path, frames_of(rest_of(PinsSpec(rings=2)), 2))
    with pytest.raises(FrameError, match="too few pins .19, as 19 pins in 2 rings. to fit a camera.*light fades"):
        new_sensor(folder, tmp_path / "few.toml")
    assert not (tmp_path / "few.toml").exists()


def test_the_specification_is_short_and_commented(made):
    text = made[0].written[0].read_text()
    assert len([line for line in text.splitlines() if line.strip() and not line.startswith("#")]) < 35
    assert "# assumed" in text and "# seen in the frames" in text


def test_the_minimal_specification_of_the_documentation_is_one(tmp_path):
    (block,) = re.findall(r"```toml\n(.*?)```", DOCS.read_text(), re.S)
    file = tmp_path / "documented.toml"
    file.write_text(block)
    spec = load_sensor(file)
    assert spec.pins.count == 331 and spec.skin.outer_radius_mm == 20.0
    assert len([line for line in block.splitlines() if line.strip()]) <= 28


@pytest.mark.parametrize("spacing", ["polar", pytest.param("plan", marks=pytest.mark.slow)])
def test_the_sizes_of_caps_decide_how_rings_are_spaced_where_contacts_blur_their_places(spacing):
    """Pins spread by contacts fit a lens of another kind better; their caps' sizes from the middle to the rim do not."""
    start = load_sensor("ur5-331")
    cap_mm = 1.4
    pins = start.pins.model_copy(update={"spacing": spacing, "cap_diameter_mm": cap_mm})
    truth = start.model_copy(update={"pins": pins})
    state = rest_pins(truth.geometry)
    middle, plane = cap_planes(truth.view, truth.pins, state)
    away = (middle - middle[0]) / np.linalg.norm(middle - middle[0], axis=1).max()
    swing = 2.5 * np.sin(np.pi * np.linalg.norm(away, axis=1, keepdims=True))  # px, as other spacings and lenses move pins
    seen = middle + (swing if spacing == "polar" else -swing) * away
    sizes = 2 * np.sqrt(np.abs(np.linalg.det(plane))) * np.random.default_rng(0).normal(1, 0.04, len(plane))
    found, _, _ = _camera(start, seen, "made", sizes)
    assert found.pins.spacing == spacing
    assert found.pins.cap_diameter_mm == pytest.approx(cap_mm, rel=0.06)


def test_other_cameras_that_fit_as_well_are_named():
    """Pins at rest alone are seen alike by a pinhole and a fisheye, unless their spacing is one that only one of them explains."""
    start = load_sensor("ur5-331")
    seen = project(start.view, rest_pins(start.geometry).caps_mm)
    _, _, others = _camera(start, seen + np.random.default_rng(0).normal(0, 0.5, seen.shape), "given", None)
    assert any(words.startswith("fisheye") for words in others)
    away = (seen - seen[0]) / np.linalg.norm(seen - seen[0], axis=1).max()
    _, _, others = _camera(start, seen + 2.5 * np.sin(np.pi * np.linalg.norm(away, axis=1, keepdims=True)) * away, "given", None)
    assert not others


def test_without_a_no_contact_frame_a_rest_layout_is_made_and_said():
    rest = rest_of(PINS)
    rng = np.random.default_rng(0)
    contacts = []
    for depth in np.linspace(0.2, 1.0, 12):  # a contact spreads the inner pins, and shears them
        away = rest - rest.mean(axis=0)
        fade = np.clip(1 - (np.linalg.norm(away, axis=1, keepdims=True) / RADIUS) ** 2, 0, None)
        contacts.append(rest + depth * fade * (0.25 * away + rng.normal(0, 1.8, 2)))
    contacts = [px + rng.normal(0, 0.9, px.shape) for px in contacts]  # none looks like a frame without contact
    nothing = np.zeros((0, 2))
    seen = tuple(LayoutInFrame(px, px, 0, nothing) for px in contacts)
    layout = Candidate(PINS, 1.0, 1.0, 0, 0, 0.0, np.median(contacts, axis=0), np.ones(61), seen)
    found = rest_found(layout, [str(k) for k in range(12)])
    error = np.sqrt(np.mean(np.sum((found.pins_px - rest) ** 2, axis=1)))
    median = np.sqrt(np.mean(np.sum((layout.rest_px - rest) ** 2, axis=1)))
    assert found.source == "made" and "`no_contact`" in found.line()
    assert error < 0.6 * median


@pytest.mark.parametrize("kind", ["rings", "hexagon"])
def test_deep_contacts_alone_state_the_places_at_rest(kind):
    """None is light, and all spread the middle: the median of the pins, and a line through their spread, are far off."""
    pins, rng = PinsSpec(layout=kind, rings=6), np.random.default_rng(1)
    places = pin_lattice(pins).places
    radius = np.linalg.norm(places, axis=1)
    rest = 150 + 130 * places * (0.85 + 0.15 * radius**3)[:, None] @ [[1.0, 0.03], [-0.03, 0.98]]
    contacts = []
    for _ in range(30):
        away = places - rng.uniform(-0.3, 0.3, 2)
        ridge = np.array([np.cos(angle := rng.uniform(0, np.pi)), np.sin(angle)])
        pressed = np.exp(-((away @ ridge / 0.5) ** 2)) * np.clip(1 - radius**4, 0, None)
        contacts.append(rest + 130 * rng.uniform(0.4, 0.7) * (pressed * (away @ ridge))[:, None] * ridge + rng.normal(0, 0.3, rest.shape))
    nothing = np.zeros((0, 2))
    seen = tuple(LayoutInFrame(px, px, 0, nothing) for px in contacts)
    found = rest_from_contacts(Candidate(pins, 1.0, 1.0, 0, 0, 0.0, np.median(contacts, axis=0), np.ones(127), seen))
    away_px = np.linalg.norm(found - rest, axis=1)
    assert np.median(away_px) < 0.08 * usual_spacing(rest) and away_px.max() < 0.2 * usual_spacing(rest)


def test_places_at_rest_that_were_made_from_contacts_are_said_to_be(tmp_path):
    spec = load_sensor("mg400-127")
    rest_px = tuple(map(tuple, nominal_reference(spec, Form.RAW).pins_px.tolist()))
    cv2.imwrite(str(tmp_path / "f_0.png"), drawn_frame(spec, Form.RAW, np.array(rest_px)).image)
    told = {}
    for origin in ("measured", "contacts"):
        blob = spec.pipeline.raw.model_copy(update={"rest_px": rest_px, "rest_origin": origin})
        own = spec.model_copy(update={"pipeline": spec.pipeline.model_copy(update={"raw": blob})})
        told[origin] = []
        told[origin].append(recording_reference(own, open_recording(tmp_path, own), told[origin])[1])
    assert "tenth of a spacing" in told["contacts"][0] and "measured before" in told["measured"][0]
    assert (told["contacts"][1], told["measured"][1]) == ("made from contacts", "measured before"), "summary.json has it so"
    layout = Candidate(PINS, 1.0, 1.0, 0, 0, 0.0, rest_of(PINS), np.ones(61), ())
    detector = shipped_detector(spec, Form.RAW)
    for source, origin in (("made", "contacts"), ("found", "measured")):
        assert _at_rest(detector, PINS, Rest(rest_of(PINS), source), layout).blob.rest_origin == origin


@pytest.mark.usefixtures("few_sizes")
def test_a_layout_that_was_given_and_is_wrong_is_told_which_one_is_right():
    images = frames_of(rest_of(PINS), 2)
    found = _compare_layout(PinsSpec(rings=3), images)
    assert not found.sure and "61 pins in 4 rings explain 100.0 %" in found.doubts[0], found.doubts
    with pytest.raises(FrameError, match="they show 61 pins in 4 rings; leave `layout` out"):
        _compare_layout(PinsSpec(rings=2), images)
    assert _compare_layout(PINS, images).sure


def test_pins_of_a_dark_frame_are_seen_in_its_overlay_beside_a_bright_housing_and_have_numbers():
    spec = load_sensor("mg400-127")
    pipeline = Pipeline(spec, Form.RAW)
    frame = drawn_frame(spec, Form.RAW, pipeline.reference.pins_px)
    seen = pipeline(frame)
    dark = (frame.image // 16).astype(np.uint8)
    cv2.circle(dark, tuple(seen.pins_px.mean(axis=0).round().astype(int).tolist()), 230, 255, 12)
    pictures = [draw_overlay(Frame(dark, Form.RAW), seen, scale=3, numbers=numbers) for numbers in (False, True)]
    x, y = np.rint(3 * seen.pins_px[0]).astype(int)
    beside = pictures[0][y - 8 : y + 9, x - 8 : x + 9].min(axis=2)
    assert np.percentile(beside, 75) > 60, "the cap around the first pin's dot"
    assert (pictures[0] != pictures[1]).any(axis=2).sum() > 10 * spec.pins.count


def test_a_refused_estimate_of_a_sensor_whose_layout_is_unsure_points_at_the_layout(tmp_path):
    image = np.zeros(PoseEstimator.load("mg400-127").pipeline.size_px[::-1], np.uint8)
    cv2.imwrite(str(tmp_path / "f_0.png"), image)
    for unsure in (False, True):
        predictions = predict_frames("mg400-127", tmp_path)
        sensor = predictions.estimator.sensor
        predictions.estimator.sensor = sensor.alter(layout_unsure=unsure)
        said = []
        with pytest.raises(FrameError, match="none of 1 frame gave a pose"):
            for line in predictions.lines():
                said.append(line)
        assert any("unsure of the layout" in line for line in said) == unsure


@pytest.mark.usefixtures("no_assumption_costs", "few_sizes")
def test_a_pin_that_the_nearest_layouts_have_too_many_is_named_by_its_place_and_the_way_out_ends(tmp_path):
    """29 pins: of 5 columns and 6 rows one is missing, of 7 rows more are; neither is given in turn, and corrected pins are sure."""
    rest = rest_of(PinsSpec(layout="grid", columns=5, rows=6))
    images = frames_of(np.delete(rest, 29, axis=0), 2)
    folder = folder_of(tmp_path, images)
    found = new_sensor(folder, tmp_path / "mine.toml")
    place = re.search(r"no pin is seen at \((\d+), (\d+)\) px", found.lines()[0])
    assert not found.identified.sure and np.linalg.norm(np.array(place.groups(), float) - rest[29]) < 8, found.lines()[0]
    taller = _compare_layout(PinsSpec(layout="grid", columns=5, rows=7), images)
    (doubt,) = taller.doubts
    assert not taller.sure and doubt.count("no pin is seen at") == 2 and "leave `layout` out" not in doubt, doubt
    (step,) = [line for line in found.next_steps if "pins.csv" in line]
    offered, copy = re.search(r"copy (\S+) to (\S+),", step).groups()
    Path(copy).write_text(Path(offered).read_text())
    assert f"`layout` positions:{copy}" in step
    again = new_sensor(folder, tmp_path / "mine.toml", layout=layout_from(f"positions:{copy}"))
    assert again.identified.sure and again.health.all_pins == 1.0, again.lines()


@pytest.mark.usefixtures("few_sizes")
def test_a_layout_of_no_known_kind_is_asked_for(tmp_path):
    """Rings of 8, 16 and 24 pins: the frame without contact is not what is wrong."""
    places = [(0.0, 0.0)] + [(5.2 * r * np.cos(a), 5.2 * r * np.sin(a)) for r in (1, 2, 3) for a in np.arange(8 * r) * np.pi / (4 * r)]
    spec = load_sensor("mg400-331")
    spec = spec.model_copy(update={"pins": PinsSpec(layout="positions", positions=tuple(places))})
    rest = project(spec.view, rest_pins(spec.geometry).caps_mm)
    warped = (rest if k == 0 else smooth_warp(rest, 3.0, np.random.default_rng(k)) for k in range(2))
    folder = folder_of(tmp_path, [drawn_frame(spec, Form.RAW, px).image for px in warped], ["init_0.png", "a.png"])
    with pytest.raises(FrameError, match=r"layout is not recognised.*`layout` positions:FILE.csv"):
        new_sensor(folder, tmp_path / "mine.toml")


def test_places_that_do_not_count_from_the_axis_are_refused():
    """As typed from a picture in px: the camera would lie beside the sensor, and every later command would believe it."""
    rest_px = rest_of(PinsSpec(rings=4))
    from_axis, from_corner = (
        PinsSpec(layout="positions", positions=tuple(map(tuple, (rest_px - axis).tolist()))) for axis in (rest_px.mean(axis=0), np.zeros(2))
    )
    assert _compare_layout(from_axis, frames_of(rest_px)).sure
    with pytest.raises(FrameError, match="subtract the place of the middle pin"):
        _compare_layout(from_corner, frames_of(rest_px))


def test_stretched_and_few_frames_are_told():
    rest = Rest(rest_of(PINS), "given")
    spacing = float(np.median(cKDTree(rest.pins_px).query(rest.pins_px, k=2)[0][:, 1]))
    assert not _doubtful(CameraReport(0.05 * spacing, 61, {}, {}), rest, 40)
    (much,) = _doubtful(CameraReport(0.15 * spacing, 61, {}, {}), rest, 40)
    assert "which is much for a frame without contact" in much
    assert not _doubtful(CameraReport(0.15 * spacing, 61, {}, {}), Rest(rest.pins_px, "made"), 40), "contacts tell rest places no better"
    assert "stretched" in _doubtful(CameraReport(0.3 * spacing, 61, {}, {}), rest, 40)[0]
    assert "too few frames (3)" in _doubtful(CameraReport(0.05 * spacing, 61, {}, {}), rest, 3)[0]


def test_a_place_that_was_forgotten_is_asked_for():
    """A list of all pins but one explains nearly all there is, and is not sure."""
    rest_px, left_out = rest_of(PINS), 45
    places = rest_px - rest_px.mean(axis=0)
    short = np.delete(places, left_out, axis=0)
    images = frames_of(rest_px)
    whole, found = (
        _compare_layout(PinsSpec(layout="positions", positions=tuple(map(tuple, of.tolist()))), images) for of in (places, short)
    )
    assert whole.sure and not whole.doubts
    assert not found.sure and len(found.doubts) == 1 and "is its position missing in the file?" in found.doubts[0]
    x, y = map(float, re.findall(r"-?\d+", found.doubts[0])[:2])
    assert np.hypot(*(rest_px[left_out] - (x, y))) < usual_spacing(rest_px) / 2


@pytest.fixture(scope="module")
def other_size():
    """A sensor, frames of another size, pins at rest in them, and the sensor tuned to them."""
    spec = load_sensor("mg400-127")
    rest = rest_of(spec.pins, turn_deg=spec.pins.phase_deg)
    frames = [Frame(image, Form.RAW, f"f{k}") for k, image in enumerate(frames_of(rest, 2))]
    with pytest.MonkeyPatch.context() as patch:
        leave_out_other_layouts(patch)
        search_few_sizes(patch)
        return spec, frames, rest, with_detector(spec, tune(frames, spec).detector)


def test_frames_of_another_size_are_tuned_and_then_observed(other_size):
    spec, frames, _, tuned = other_size
    with pytest.raises(FrameError, match="expected 640x480"):
        Pipeline(spec, Form.RAW)(frames[0])
    assert (tuned.camera.width_px, tuned.camera.height_px) == SIZE
    assert all(Pipeline(tuned, Form.RAW)(frame).found == 127 for frame in frames)


def test_stray_pins_between_caps_are_not_valid(other_size):
    _, _, rest, tuned = other_size
    frame = Frame(frames_of(rest, 1, contact_px=1e-9)[0], Form.RAW)
    pipeline = Pipeline(tuned, Form.RAW)
    moved = np.roll(frame.image, int(np.median(pipeline.reference.spacing_px) / 2), axis=1)
    assert pipeline(frame).valid
    assert pipeline._between_caps(Frame(moved, Form.RAW), pipeline(frame).pins_px) > 0.3


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("sensor_image,pose_x,pose_z,pose_Rx,shear_x", "{},0.5,2.5,-7,1.5"),
        ("image_name;POSE_X;pose_z;pose_rx;Shear_X", "{};0,5;2,5;-7;1,5"),
        ("file_name,observation.state.x,observation.state.z,observation.state.rx,shear_x", "{},0.5,2.5,-7,1.5"),
    ],
)
def test_every_convention_of_labels_is_read_from_any_table(tmp_path, header, row):
    folder = folder_of(tmp_path, [np.zeros((50, 60), np.uint8)] * 2)
    table = tmp_path / "elsewhere.csv"
    table.write_text("\ufeff" + "\n".join([header, *(row.format(f"frame_{k}.png") for k in (1, 0))]) + "\n", encoding="utf-8")
    labels = open_recording(frames_at(folder, table)).labels
    assert [labels[name][0] for name in ("pose_1", "pose_3", "pose_4", "move_1")] == [0.5, 2.5, -7, 1.5]


def test_a_table_or_no_contact_frame_of_no_use_is_an_error(tmp_path):
    folder = folder_of(tmp_path, [np.zeros((50, 60), np.uint8)] * 2)
    table, small = tmp_path / "t.csv", tmp_path / "small.png"
    table.write_text("image_name,pose_1\nother.png,1\n")
    cv2.imwrite(str(small), np.zeros((9, 9), np.uint8))
    for at in (
        frames_at(folder, table),
        frames_at(folder, tmp_path / "nowhere.csv"),
        frames_at(folder, None, small),
        frames_at(folder, None, tmp_path / "no.png"),
    ):
        with pytest.raises(FrameError, match="`table`|`no_contact`"):
            open_recording(at)


def _inverted(image):
    return 255 - image


FUZZ = {
    "one pixel": lambda image: image[:1, :1],
    "a line": lambda image: np.ascontiguousarray(np.repeat(image[120:121], 10, axis=0))[:, :180],
    "long": lambda image: np.zeros((10, 8000), np.uint8),
    "black": lambda image: np.zeros_like(image),
    "white": lambda image: np.full_like(image, 255),
    "inverted": _inverted,
    "turned": lambda image: np.rot90(image).copy(),
    "masked": lambda image: np.where(np.arange(image.shape[1]) < 150, image, 0).astype(np.uint8),
    "colour": lambda image: np.repeat(image[..., None], 3, axis=2),
    "16 bits": lambda image: image.astype(np.uint16) * 257,
    "noise": lambda image: np.random.default_rng(0).integers(0, 255, (150, 200)).astype(np.uint8),
}


SLOW_FUZZ = ("turned", "16 bits", "masked", "colour")


@pytest.mark.usefixtures("no_assumption_costs")
@pytest.mark.parametrize(
    "change", [pytest.param(change, id=name, marks=[pytest.mark.slow] * (name in SLOW_FUZZ)) for name, change in FUZZ.items()]
)
def test_strange_frames_give_a_right_answer_or_an_error_in_words(tmp_path, change):
    images = [change(image) for image in frames_of(rest_of(PINS), 1)]
    try:
        found = new_sensor(folder_of(tmp_path, images), tmp_path / "odd.toml")
    except (TwinError, ValueError) as error:
        assert "\n" not in str(error).strip() and isinstance(error, TwinError)
        assert not (tmp_path / "odd.toml").exists()
    else:
        right = found.sensor.pins.layout == "rings" and found.sensor.pins.rings == 4
        assert right or not found.identified.sure


@pytest.mark.parametrize("name", ["mg400-127", "mg400-331"])
def test_without_a_no_contact_frame_shipped_weights_count_from_their_units_pins(tmp_path, name):
    """The frames show contacts of a unit whose pins stand a little beside the specification's, as the weights know."""
    model = PoseEstimator.load(name)
    known = np.array(model.recorded_sensor.pipeline.processed.rest_px)
    image = drawn_frame(model.sensor, Form.PROCESSED, known).image
    cv2.imwrite(str(tmp_path / "f_0.png"), image)
    predictions = predict_frames(name, tmp_path)
    assert np.allclose(predictions.estimator.pipeline.reference.pins_px, known)
    assert any("no frame without contact was used" in problem for problem in predictions.recording.problems)
    cv2.imwrite(str(tmp_path / "init_0.png"), image)
    again = predict_frames(name, tmp_path)
    assert not any("no-contact" in problem for problem in again.recording.problems)


@pytest.mark.parametrize("inside", [False, True], ids=["beside the picture", "where a recording has it"])
def test_a_single_picture_is_counted_from_the_frame_without_contact_of_its_folder(tmp_path, inside):
    model = PoseEstimator.load("mg400-127")
    rest = np.array(model.recorded_sensor.pipeline.processed.rest_px) + [1.0, -2.0]  # this unit's camera looks a little elsewhere
    folder = tmp_path / "frames_bw" if inside else tmp_path
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(tmp_path / "init_0.png"), drawn_frame(model.sensor, Form.PROCESSED, rest).image)
    cv2.imwrite(str(folder / "f_0.png"), drawn_frame(model.sensor, Form.PROCESSED, smooth_warp(rest, 3.0, np.random.default_rng(0))).image)
    alone, of_folder = predict_frames("mg400-127", folder / "f_0.png"), predict_frames("mg400-127", tmp_path)
    assert "displacements of pins are measured from init_0.png, which is beside the picture" in alone.recording.problems
    ((_, one),), ((_, other),) = list(alone), list(of_folder)
    np.testing.assert_array_equal(one.value, other.value)
