"""The camera's view: a displaced picture is corrected or refused, never believed; pushes to known sides tell a turn and a mirror."""

from functools import cache

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame

from scenes import load_object, load_sensor
from scenes.pins import PinsSpec
from training.data.pins import PinTable
from training.estimate.estimator import PoseEstimator
from training.studies.evaluation import predict_frames
from twin.calibration.camera_view import register_files, registered_view
from twin.camera.projection import pixel_rays, project
from twin.errors import FrameError
from twin.frames import open_recording
from twin.frames.forms import from_raw
from twin.geometry.pins import namings, pin_lattice, rest_pins
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.pins import Pipeline, make_reference, measure_reference, nominal_reference, view_of
from twin.pins.check import Grade, examine
from twin.pins.labelling.identify import symmetries
from twin.pins.labelling.reference import MOST_TURN_DEG
from twin.rig.labels import read_arm_labels
from twin.types import Form, Frame

WEIGHTS = ("mg400-127", "mg400-331")
PRINT_PITCHES = 0.03  # sd of a print's tolerances
LIKE_STRAIGHT = 0.2  # of half an interval: resampling the picture moves a real estimate by 0.14 of it where it loses a pin


def carried(px, *, turn_deg=0.0, scale=(1.0, 1.0), mirrored=False, shift_px=(0.0, 0.0)):
    """Points (N, 2), mirrored left to right, stretched, turned about their middle and shifted."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    matrix = np.array([[c, -s], [s, c]]) @ np.diag([scale[0] * (-1 if mirrored else 1), scale[1]])
    middle = px.mean(axis=0)
    return (px - middle) @ matrix.T + middle + shift_px


@cache
def model_of(name):
    return PoseEstimator.load(name)


def known_of(name):
    return np.array(model_of(name).recorded_sensor.pipeline.processed.rest_px)


def drawn(model, px, name="init_0.png"):
    return drawn_frame(model.sensor, Form.PROCESSED, px, name=name)


@pytest.mark.parametrize(
    ("pins", "turns"),
    [
        (PinsSpec(layout="rings", rings=4), 6),
        (PinsSpec(layout="hexagon", rings=3), 6),
        (PinsSpec(layout="grid", columns=5, rows=5), 4),
        (PinsSpec(layout="grid", columns=5, rows=7), 2),
        (PinsSpec(layout="positions", positions=tuple((np.cos(a), np.sin(a)) for a in np.arange(5) * 2 * np.pi / 5)), 5),
        (PinsSpec(layout="positions", positions=((0, 0), (1, 0), (2, 0), (2.5, 0.7), (-1, 1.2), (-0.3, 1.9))), 1),
    ],
    ids=str,
)
def test_every_symmetry_of_a_layout_is_a_naming(pins, turns):
    places, found = pin_lattice(pins).places, namings(pins)
    assert np.array_equal(found[0], np.arange(pins.count)) and len(symmetries(pins)) == turns
    assert len(found) == (2 * turns if turns > 1 else 1)
    for order in found:
        moved = np.linalg.lstsq(places, places[order], rcond=None)[0]
        assert np.allclose(places @ moved, places[order], atol=1e-3) and np.allclose(moved @ moved.T, np.eye(2), atol=1e-3)


def test_a_missing_pin_has_no_partner_in_another_naming():
    pins = PinsSpec(layout="hexagon", rings=3, missing=(7,))
    assert len(namings(pins)) == 12 and sorted({int((order < 0).sum()) for order in namings(pins)}) == [0, 1]


@pytest.mark.parametrize("name", WEIGHTS)
@pytest.mark.parametrize("turn_deg", [-170.0, -60.0, 3.0, 37.0, 120.0, 180.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_the_known_units_pins_tell_every_view(name, turn_deg, mirrored):
    """However the pins are named, of a symmetric layout, with noise of 0.1 px."""
    known, pins = known_of(name), model_of(name).sensor.pins
    rng = np.random.default_rng(0)
    seen = carried(known, turn_deg=turn_deg, mirrored=mirrored, scale=(1.02, 1.0), shift_px=(2.0, -1.0)) + rng.normal(0, 0.1, known.shape)
    for order in namings(pins)[:: len(namings(pins)) // 3]:
        view = view_of(seen[order], make_reference(known, pins), pins)
        assert view.sure and view.same and view.mirrored == mirrored
        assert abs((view.turn_deg - turn_deg + 180) % 360 - 180) < 0.1 and view.stretch == pytest.approx(0.02, abs=0.002)
        assert view.scale == pytest.approx(np.sqrt(1.02), abs=0.001) and np.allclose(view.shift_px, [2, -1], atol=0.05)


@pytest.mark.parametrize("name", WEIGHTS)
def test_another_unit_is_not_taken_for_the_known_one(name):
    model, rng = model_of(name), np.random.default_rng(1)
    nominal = nominal_reference(model.sensor, Form.PROCESSED)
    for _ in range(10):
        other = nominal.pins_px + PRINT_PITCHES * nominal.spacing_px.mean() * rng.standard_normal(nominal.pins_px.shape)
        view = view_of(carried(other, turn_deg=1.0), make_reference(known_of(name), model.sensor.pins), model.sensor.pins)
        assert (
            not view.sure and not view.same and not view.mirrored and not view.displacements() and "two pushes" in view.describe_ambiguity()
        )


@pytest.mark.parametrize("name", WEIGHTS)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"turn_deg": 180.0}, "turned by -?180.0 deg"),
        ({"turn_deg": 60.0}, "turned by 60.0 deg"),
        ({"turn_deg": 37.0}, "turned by (37|36.9|37.1)"),
        ({"turn_deg": 90.0}, "turned by (90.0|89.9|90.1)"),
        ({"mirrored": True}, "mirrored"),
        ({"scale": (1.08, 1.0)}, "stretched by (8|7.9)"),
        ({"scale": (0.9, 0.9)}, "zoomed by -(10|9.9)"),
        ({"shift_px": (19.0, 0.0)}, "shifted by 1.[45] spacings"),
    ],
    ids=str,
)
def test_weights_refuse_a_displaced_picture_of_their_unit(name, change, words):
    model = model_of(name)
    with pytest.raises(FrameError, match=f"init_0.png: the camera's picture is .*{words}.*twin check"):
        model.at_rest(drawn(model, carried(known_of(name), **change)))


@cache
def pressed_nodes(name, real_dir):
    """Pins (N, 2) of a real contact."""
    recording = open_recording(real_dir / name.replace("mg400", "tac-vgnn"), model_of(name).sensor, None)
    return model_of(name).at_known_rest().pipeline(recording.read(len(recording) // 2)).graph.nodes_px


@pytest.mark.parametrize("name", WEIGHTS)
@pytest.mark.parametrize("change", [{"turn_deg": 4.0}, {"scale": (1.04, 1.04)}, {"shift_px": (8.0, -5.0)}], ids=str)
def test_a_small_displacement_of_the_picture_is_corrected(name, change, real_dir):
    """Both frames are displaced alike. Without the correction 4 deg change the angle by up to a degree."""
    model, known = model_of(name), known_of(name)
    pressed = pressed_nodes(name, real_dir)
    both = np.concatenate([known, pressed])
    straight = model.at_rest(drawn(model, known))(drawn(model, pressed))
    seen = carried(both, **change)
    made = model.at_rest(drawn(model, seen[: len(known)]))(drawn(model, seen[len(known) :]))
    assert straight.valid and made.valid
    assert np.all(np.abs(made.value - straight.value) < 0.4 * (straight.high - straight.low))


def test_displacements_from_rest_are_turned_scaled_and_stretched_as_their_view():
    spec = load_sensor("mg400-127")
    rest = nominal_reference(spec, Form.PROCESSED)
    nodes = rest.pins_px[None] + np.random.default_rng(0).normal(0, 2, (3, *rest.pins_px.shape))
    middle, area = rest.pins_px.mean(axis=0), np.tile(rest.area_px2, (3, 1))
    linear = 1.03 * np.array([[np.cos(0.05), np.sin(0.05)], [-np.sin(0.05), np.cos(0.05)]]) @ np.diag([1.02, 1.0])
    view = lambda px: (px - middle) @ linear + middle + [3.0, -2.0]  # noqa: E731
    own = make_reference(view(rest.pins_px), spec.pins)
    none = np.zeros(area.shape, bool)
    area_px2 = area * np.linalg.det(linear)
    table = PinTable(spec, Form.PROCESSED, own, np.array(list("abc")), view(nodes), area_px2, none, np.ones(3, bool), measured=True)
    again = table.relative_to(rest)
    assert np.allclose(again.nodes_px, nodes) and np.allclose(again.area_px2, area, rtol=0.02)  # cells at rest are not stretched exactly


def test_recorded_contacts_without_a_frame_at_rest_refuse_a_turned_picture(tmp_path):
    """Nothing but contacts, all seen by a camera that is turned by 37 deg."""
    model, rng, known = model_of("mg400-127"), np.random.default_rng(0), known_of("mg400-127")
    away = (known - known.mean(axis=0)) / np.abs(known - known.mean(axis=0)).max()
    for k in range(10):
        pressed = known + rng.uniform(1, 4) * (away + rng.uniform(-0.5, 0.5, 2)) * np.exp(-2 * (away**2).sum(axis=1))[:, None]
        turned = carried(np.concatenate([known, pressed]), turn_deg=37.0)[len(known) :]
        cv2.imwrite(str(tmp_path / f"frame_{k}_0.png"), drawn(model, turned).image)
    with pytest.raises(FrameError, match="these contacts: the camera's picture is turned by"):
        predict_frames("mg400-127", tmp_path)


def test_a_pressed_or_foreign_frame_at_rest_is_an_error_of_every_reader(tmp_path):
    model, known = model_of("mg400-127"), known_of("mg400-127")
    away = (known - known.mean(axis=0)) / np.abs(known - known.mean(axis=0)).max()
    cv2.imwrite(str(tmp_path / "frame_1_0.png"), drawn(model, known).image)
    pressed = known + 15.0 * away * np.exp(-4 * (away**2).sum(axis=1))[:, None]
    for image, words in (
        (drawn(model, pressed).image, "seems pressed"),
        (np.zeros((256, 256), np.uint8), "not usable as a no-contact frame"),
    ):
        cv2.imwrite(str(tmp_path / "init_0.png"), image)
        with pytest.raises(FrameError, match=f"init_0.png: .*{words}.*`no_contact` FRAME"):
            predict_frames("mg400-127", tmp_path)


@cache
def pushed(name):
    """Caps (N, 3), mm, at rest and after contacts with a plate that was then moved, or turned."""
    spec = load_sensor(name)
    solver, plane = SkinSolver(spec, resolution=Resolution(across=12)), load_object("plane")
    moves = {"x": {"shear_mm": (2.0, 0.0)}, "y": {"shear_mm": (0.0, 2.0)}, "twist": {"twist_deg": 8.0}}
    states = {side: solver.press(plane, ContactPose(indent_mm=2.5, **move)).caps_mm for side, move in moves.items()}
    return spec, {"rest": rest_pins(spec.geometry).caps_mm} | states


def frames_of(name, **change):
    spec, caps = pushed(name)
    places = [from_raw(spec.recording, Form.PROCESSED, project(spec.view, each)) for each in caps.values()]
    seen = np.split(carried(np.concatenate([places[0], *places]), **change)[len(places[0]) :], len(places))
    return spec, {side: drawn_frame(spec, Form.PROCESSED, px, name=f"{side}.png") for side, px in zip(caps, seen, strict=True)}


@pytest.mark.parametrize(
    "change", [{"turn_deg": 60.0}, {"turn_deg": 180.0}, {"mirrored": True}, {"mirrored": True, "turn_deg": -100.0}], ids=str
)
@pytest.mark.parametrize("by", [("x", "y"), ("x", "twist")], ids=str)
def test_pushes_to_known_sides_tell_turn_and_mirror(tmp_path, change, by):
    """With the corrected copy every pin of every contact is where the twin's camera sees the pin of this name."""
    name = "mg400-127"
    spec, frames = frames_of(name, **change)
    made, view = registered_view(
        spec, frames["rest"], {side: frames[side] for side in by if side != "twist"}, twist=frames.get("twist" if "twist" in by else "")
    )
    assert view.mirrored == change.get("mirrored", False) == made.camera.mirrored
    assert abs((made.camera.turn_deg - change.get("turn_deg", 0.0) + 180) % 360 - 180) < 0.5
    pipeline, spacing = Pipeline(made, Form.PROCESSED), nominal_reference(spec, Form.PROCESSED).spacing_px.mean()
    for side, caps_mm in pushed(name)[1].items():
        away = pipeline(frames[side]).pins_px - from_raw(made.recording, Form.PROCESSED, project(made.view, caps_mm))
        assert np.nanmax(np.linalg.norm(away, axis=1)) < 0.2 * spacing


@pytest.mark.usefixtures("no_other_layout")
def test_the_written_copy_is_a_sensor_and_wrong_sides_are_refused(tmp_path):
    spec, frames = frames_of("mg400-127", turn_deg=180.0)
    for side, frame in frames.items():
        cv2.imwrite(str(tmp_path / f"{side}.png"), frame.image)
    rest, pushes = tmp_path / "rest.png", [f"x:{tmp_path / 'x.png'}", f"y:{tmp_path / 'y.png'}"]
    made, _ = register_files(spec, rest, pushes, form=Form.PROCESSED, out=tmp_path / "mine.toml")
    again = load_sensor(tmp_path / "mine.toml")
    assert (
        again.camera.turn_deg == pytest.approx(made.camera.turn_deg) and again.pipeline.processed.rest_px == made.pipeline.processed.rest_px
    )
    found = {each.name: each for each in examine([frames["rest"]], again)}
    assert all(found[name].verdict is Grade.HEALTHY for name in ("shift", "turn", "scale", "stretch", "mirror"))
    with pytest.raises(FrameError, match="need two pushes, or one and a twist"):
        registered_view(spec, frames["rest"], {"x": frames["x"]})
    with pytest.raises(FrameError, match="hardly moves the pins"):
        registered_view(spec, frames["rest"], {"x": frames["x"], "y": frames["rest"]})
    with pytest.raises(FrameError, match="fit no view"):
        registered_view(spec, frames["rest"], {"x": frames["x"], "-x": frames["x"], "y": frames["y"]})
    with pytest.raises(FrameError, match="`push` left: must be"):
        registered_view(spec, frames["rest"], {"left": frames["x"], "y": frames["y"]})


@pytest.mark.usefixtures("no_other_layout")
def test_check_names_stretch_and_mirror():
    """The specification holds its unit's own places at rest."""
    spec = model_of("mg400-127").recorded_sensor
    found = {
        f.name: f for f in examine([drawn(model_of("mg400-127"), carried(known_of("mg400-127"), mirrored=True, scale=(1.1, 1)))], spec)
    }
    assert found["mirror"].verdict is Grade.FAILED and found["stretch"].verdict is Grade.FAILED and "10" in found["stretch"].text
    plain = {f.name: f for f in examine([drawn(model_of("mg400-127"), known_of("mg400-127"))], load_sensor("mg400-127"))}
    assert plain["mirror"].verdict is Grade.UNSURE and "can't be seen" in plain["mirror"].text and "two pushes" in plain["mirror"].remedy


@pytest.mark.parametrize(("turn_deg", "mirrored"), [(30.0, False), (-100.0, True), (0.0, True)])
def test_a_turned_camera_sees_the_straight_picture_turned(turn_deg, mirrored):
    spec = load_sensor("ur5-331")
    camera = spec.camera.model_copy(update={"turn_deg": turn_deg, "mirrored": mirrored, "fy_px": spec.camera.fx_px})
    points = rest_pins(spec.geometry).caps_mm
    plain = project(spec.view.model_copy(update={"camera": camera.model_copy(update={"turn_deg": 0.0, "mirrored": False})}), points)
    view = spec.view.model_copy(update={"camera": camera})
    seen, centre = project(view, points), np.array([camera.cx_px, camera.cy_px])
    flip, c, s = (-1.0 if mirrored else 1.0), np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    assert np.allclose(seen - centre, ((plain - centre) * [flip, 1.0]) @ np.array([[c, s], [-s, c]]), atol=1e-6)
    place, direction = pixel_rays(view, seen)
    along = (points[:, 2] - place[:, 2]) / direction[:, 2]
    assert np.allclose(place + along[:, None] * direction, points, atol=1e-4)


def test_a_turn_at_the_limit_is_measured(tmp_path):
    model = model_of("mg400-331")
    inside = carried(known_of("mg400-331"), turn_deg=MOST_TURN_DEG - 0.5)
    assert isinstance(model.at_rest(drawn(model, inside)), PoseEstimator)
    with pytest.raises(FrameError, match="turned by"):
        model.at_rest(drawn(model, carried(known_of("mg400-331"), turn_deg=MOST_TURN_DEG + 0.5)))


def test_a_dark_frame_is_no_frame_at_rest():
    spec = load_sensor("mg400-127")
    with pytest.raises(FrameError, match="not usable as a no-contact frame: no pins"):
        measure_reference(spec, Form.PROCESSED, Frame(np.zeros((256, 256), np.uint8), Form.PROCESSED, "init_0.png"))


def warped(frame, centre_px, *, turn_deg=0.0, scale=1.0):
    matrix = cv2.getRotationMatrix2D(tuple(centre_px), -turn_deg, scale)
    return Frame(cv2.warpAffine(frame.image, matrix, frame.image.shape[::-1], borderMode=cv2.BORDER_REPLICATE), frame.form, frame.name)


@pytest.mark.real
@pytest.mark.parametrize(("folder", "name"), [("tac-vgnn-331", "mg400-331"), ("tac-vgnn-127", "mg400-127")])
def test_real_frames_of_a_displaced_camera_keep_their_estimates(real_dir, folder, name):
    recording, model, centre = open_recording(real_dir / folder, load_sensor(name)), model_of(name), known_of(name).mean(axis=0)
    frames = [recording.read(k) for k in range(50, len(recording), 600)]
    straight = [model.at_rest(recording.reference)(frame) for frame in frames]
    for change in ({"turn_deg": 4.5}, {"scale": 1.04}, {"scale": 0.96, "turn_deg": -3.0}):
        at_rest = model.at_rest(warped(recording.reference, centre, **change))
        for frame, before in zip(frames, straight, strict=True):
            made = at_rest(warped(frame, centre, **change))
            assert made.valid and np.all(np.abs(made.value - before.value) < LIKE_STRAIGHT * (before.high - before.low) / 2), change
    with pytest.raises(FrameError, match="turned by -?180"):
        model.at_rest(warped(recording.reference, centre, turn_deg=180.0))
    shallow = [k for k, label in enumerate(read_arm_labels(recording)) if 1.5 < label.pose[1] + 5.0 < 1.8][::60][:2]
    for k in shallow:
        with pytest.raises(FrameError, match="seems pressed"):
            model.at_rest(recording.read(k))
    assert len(shallow) == 2
