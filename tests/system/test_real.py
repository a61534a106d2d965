"""Real recordings, every frame (make validate): pins found, in order, and the twin beside them."""

from itertools import pairwise

import numpy as np
import pytest

from scenes import load_object, load_sensor
from twin.camera.projection import project
from twin.evaluation.pictures.compare import compare_images
from twin.frames import open_recording
from twin.frames.forms import recording_to_raw
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.pins import Pipeline, make_detector, nominal_reference, shipped_detector
from twin.pins.batch import recording_reference
from twin.rig.labels import read_arm_labels
from twin.simulator import Simulator
from twin.types import Form

pytestmark = [pytest.mark.real, pytest.mark.slow]

SETS = {"tac-vgnn-331": "mg400-331", "tac-vgnn-127": "mg400-127", "ur5-331-raw": "ur5-331"}
# What is left of a pin's displacement after the set's own smooth modes, px: measured (0.90, 0.82, 1.23) and a tenth.
# A swapped pin leaves a pitch, 11 px or more.
SMOOTH_PX = {"tac-vgnn-331": 0.99, "tac-vgnn-127": 0.90, "ur5-331-raw": 1.35}
MOST_LOST = 0.001  # of all pins of all frames
DEPTH_EDGES_MM = (-4.0, -3.0, -2.0, -1.0, 0.0)  # of pose_2
DEPTH_MIDDLES_MM = (1.5, 2.5, 3.5, 4.5)  # indentation, about pose_2 + 5 mm, in the middle of the four bins
PURE = {"angle_deg": 3.0, "shear_mm": 1.0, "shear_deg": 1.0}  # contacts with less of each count as straight presses
LEAST_SSIM = {"tac-vgnn-331": 0.77, "tac-vgnn-127": 0.82}  # a tenth below measured 0.857, 0.911; caps half a pixel off cost a rim each
ORDER_OF_MAGNITUDE = (0.7, 1.3)  # simulated to measured displacement; nothing is fitted to the table


def observe(real_dir, folder):
    spec = load_sensor(SETS[folder])
    recording = open_recording(real_dir / folder, spec)
    reference, _ = recording_reference(spec, recording, [])
    pipeline = Pipeline(spec, recording.form, reference)
    names, seen = zip(*[(frame.name, pipeline(frame)) for frame in recording], strict=True)
    return spec, reference, np.array(names), seen


@pytest.fixture(scope="module", params=SETS)
def observed(request, real_dir):
    return request.param, *observe(real_dir, request.param)


def test_every_pin_is_found_in_its_place(observed):
    folder, spec, reference, names, seen = observed
    pins_px = np.stack([o.pins_px for o in seen])
    lost = np.isnan(pins_px[..., 0])
    exact = np.mean([o.found == spec.pins.count for o in seen])
    moved = np.where(lost[..., None], 0, pins_px - reference.pins_px).reshape(len(seen), -1)
    moved = moved - moved.mean(axis=0)
    modes = np.linalg.svd(moved, full_matrices=False)[2][: 40 if len(seen) > 100 else 10]
    left = np.linalg.norm((moved - moved @ modes.T @ modes).reshape(len(seen), -1, 2), axis=2)[~lost].max()
    print(f"\n{folder}: {len(seen)} frames, exact {100 * exact:.2f} %, lost pins {100 * lost.mean():.4f} %, worst residual {left:.2f} px")
    assert all(o.valid for o in seen) and not lost.any() and left < SMOOTH_PX[folder]
    assert exact == 1


def test_legacy_throws_away_what_the_release_does(real_dir):
    """160 of the 5000 published frames; 59 of them are not among these 3763."""
    if not (real_dir / "tac-vgnn-331").is_dir():
        pytest.skip("no tac-vgnn-331")
    spec = load_sensor("mg400-331")
    recording = open_recording(real_dir / "tac-vgnn-331", spec)
    if len(recording) != 3763:
        pytest.skip(f"the figure is for the 3763 frames of the usual split, not for {len(recording)}")
    detect = make_detector(spec, shipped_detector(spec, Form.PROCESSED, "legacy"))
    assert sum(not detect(frame).valid for frame in recording) == 101


def displacement_by_depth(labels, pins_px, rest_px):
    """Mean displacement of the pins (M, N, 2) px from no contact in the bins of ``DEPTH_EDGES_MM``, over straight presses."""
    done = np.array([label.executed for label in labels])
    pose, move = (np.array([getattr(label, kind) for label in labels]) for kind in ("pose", "move"))
    sizes = {"angle_deg": pose[:, 5] - ~done * move[:, 5], "shear_mm": done * move[:, 0], "shear_deg": done * move[:, 5]}
    pure = np.all([np.abs(sizes[key]) < limit for key, limit in PURE.items()], axis=0)
    moved = np.nanmean(np.linalg.norm(pins_px - rest_px, axis=-1), axis=1)
    inside = [pure & (pose[:, 1] >= low) & (pose[:, 1] < high) for low, high in pairwise(DEPTH_EDGES_MM)]
    return np.array([moved[rows].mean() for rows in inside])


@pytest.mark.parametrize("folder", ["tac-vgnn-331", "tac-vgnn-127"])
def test_displacement_by_depth_beside_the_simulated_one(real_dir, folder):
    spec, reference, names, seen = observe(real_dir, folder)
    recording = open_recording(real_dir / folder, spec)
    labels = read_arm_labels(recording)
    assert np.array_equal(recording.names, names)
    raw_px = recording_to_raw(spec.recording, np.stack([o.pins_px for o in seen]))
    measured = displacement_by_depth(labels, raw_px, recording_to_raw(spec.recording, reference.pins_px))
    solver = SkinSolver(spec)
    rest_px = project(spec.view, solver.rest().caps_mm)
    states = [solver.press(load_object("plane"), ContactPose(indent_mm=d)) for d in DEPTH_MIDDLES_MM]
    simulated = np.array([np.linalg.norm(project(spec.view, s.caps_mm) - rest_px, axis=1).mean() for s in states])
    print(f"\n{folder}: measured {np.round(measured, 2)} px, simulated {np.round(simulated, 2)} px")
    low, high = ORDER_OF_MAGNITUDE
    assert ((simulated > low * measured) & (simulated < high * measured)).all()


def test_the_shipped_layout_alone_is_enough(real_dir):
    spec = load_sensor("mg400-331")
    recording = open_recording(real_dir / "tac-vgnn-331", spec)
    pipeline = Pipeline(spec, recording.form, nominal_reference(spec, recording.form))
    found = [pipeline(recording.read(k)).found for k in range(0, len(recording), 25)]
    assert np.mean(np.array(found) == spec.pins.count) > 0.99


@pytest.mark.parametrize("folder", ["tac-vgnn-331", "tac-vgnn-127"])
def test_the_rendered_frame_without_contact_is_like_the_recorded_one(real_dir, folder):
    """Uncalibrated: the floor keeps the pattern in place (a pattern turned by half a pitch falls far below it)."""
    spec = load_sensor(SETS[folder])
    recorded = open_recording(real_dir / folder, spec).reference.image
    simulator = Simulator(spec)
    rendered = simulator.render(simulator.rest, form=Form.PROCESSED).frame.image
    likeness = compare_images(recorded, rendered, np.ones(recorded.shape[:2], bool))
    turned = compare_images(recorded, np.ascontiguousarray(rendered[::-1]), np.ones(recorded.shape[:2], bool))
    print(f"\n{folder}: SSIM {likeness.ssim:.3f}, PSNR {likeness.psnr_db:.1f} dB; mirrored {turned.ssim:.3f}, {turned.psnr_db:.1f} dB")
    assert likeness.ssim > LEAST_SSIM[folder] and likeness.ssim > turned.ssim + 0.05
