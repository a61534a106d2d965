"""Contact maps: the force that is told is the force of the map, and what is learnt from simulated contacts is found again."""

from dataclasses import replace

import numpy as np
import pytest

from training.data.dataset import load_dataset
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.models.part import OneFrame
from training.models.touch.model import TOUCH
from training.runs.run_files import MAPS, pack
from training.studies.evaluation import Predictions, write_frame_maps
from training.touch.contact_maps import compare_maps, read_maps, write_maps
from twin.errors import StoreError
from twin.geometry.mesh import build_mesh
from twin.mechanics.skin_map import SIDE, ContactMaps, between_nodes, skin_grid
from twin.types import Form, Frame

ALMOST = 1e-9  # N and N mm: rounding
ON_A_SPHERE = 0.999  # cosine between a normal of the grid and the dome's own
EXACT_MM = 1e-9  # rounding
FACET_MM = 0.3  # by which the middle of a facet lies below the sphere at the rim, where facets are largest


def pressed_maps(geometry):
    """Maps of a pressure that falls off around a place beside the apex, with some shear."""
    grid = skin_grid(geometry)
    away = grid.nodes_mm - grid.nodes_mm[SIDE * (SIDE // 2) + SIDE // 2 + 3]
    pressure = 0.02 * np.exp(-(away**2).sum(axis=1) / 8)
    outward = grid.nodes_mm / np.linalg.norm(grid.nodes_mm, axis=1, keepdims=True)
    return ContactMaps(grid.nodes_mm, grid.area_mm2, grid.area_mm2[:, None] * pressure[:, None] * (outward + [0.2, 0.1, 0.0]))


def test_normals_point_out_of_the_dome_and_pressure_and_shear_are_the_force(sensor):
    maps = pressed_maps(sensor.geometry)
    outward = maps.nodes_mm / np.linalg.norm(maps.nodes_mm, axis=1, keepdims=True)
    assert np.median((maps.normal * outward).sum(axis=1)) > ON_A_SPHERE
    again = maps.pressure_mpa[:, None] * maps.normal + maps.traction_mpa
    np.testing.assert_allclose(again * maps.area_mm2[:, None], maps.force_n, atol=ALMOST)
    assert 10 < maps.patch.sum() < 200


def test_the_totals_are_those_that_are_told_and_nothing_is_added_where_nothing_presses(sensor):
    maps = pressed_maps(sensor.geometry)
    told = np.array([0.7, -0.4, 3.0])
    found = maps.with_resultants(told, -4.0)
    np.testing.assert_allclose(found.resultant_n, told, atol=ALMOST)
    assert found.torque_z_nmm == pytest.approx(-4.0, abs=ALMOST)
    assert not (found.force_n - maps.force_n)[maps.pressure_mpa == 0].any()
    force_alone = maps.with_resultants(told)
    np.testing.assert_allclose(force_alone.resultant_n, told, atol=ALMOST)
    none = replace(maps, force_n=np.zeros_like(maps.force_n))
    assert none.with_resultants(told, 5.0) is none and not none.patch.any()


def test_every_second_node_of_the_grid_is_one_of_the_mesh_and_averaging_keeps_the_total(sensor):
    mesh, grid = build_mesh(sensor.geometry), skin_grid(sensor.geometry)
    between = between_nodes(mesh.nodes_mm[: mesh.outer_count])
    apart = np.linalg.norm(between - grid.nodes_mm, axis=1).reshape(SIDE, SIDE)
    assert apart[::2, ::2].max() < EXACT_MM and apart.max() < FACET_MM
    values = np.random.default_rng(0).random((2, SIDE * SIDE))
    found = grid.smooth_values(values, 1.0)
    np.testing.assert_allclose(found.sum(axis=1), values.sum(axis=1), rtol=1e-5)
    assert found.std() < 0.5 * values.std()


def test_maps_of_simulated_contacts_are_learnt_and_agree_with_the_forces_told(contacts):
    folder, run, sensor = contacts
    estimator = PoseEstimator.load(run)
    data = load_dataset(folder, sensor, estimator.names)
    made = estimator.predict_table(data.pins)
    maps = estimator.maps_of(data.pins, made.mean)
    rated = compare_maps(maps, data, np.arange(len(data)))
    assert rated["states"] > 20 and rated["patch_iou"] > 0.8 and rated["pressure_correlation"] > 0.9 and rated["skin_mm"] < 0.1
    column = [estimator.names.index(name) for name in ("force_x", "force_y", "force_z")]
    k = int(made.mean[:, column[2]].argmax())
    np.testing.assert_allclose(maps[k].resultant_n, made.mean[k, column], atol=1e-6)
    turned = compare_maps([replace(each, force_n=each.force_n[::-1]) for each in maps], data, np.arange(len(data)))
    assert turned["pressure_correlation"] < rated["pressure_correlation"]  # the classifier can tell


def test_a_small_copy_keeps_its_maps_and_damaged_ones_are_refused(contacts, tmp_path):
    _, run, sensor = contacts
    pack(run, tmp_path / "small")
    assert PoseEstimator.load(tmp_path / "small").maps is not None
    model = read_maps(run / MAPS, sensor.geometry)
    write_maps(tmp_path / MAPS, replace(model, limit=model.limit[:-1]))
    with pytest.raises(TrainingError, match="maps.safetensors"):
        read_maps(tmp_path / MAPS, sensor.geometry)
    (tmp_path / MAPS).write_bytes((run / MAPS).read_bytes()[:-40])
    with pytest.raises(TrainingError, match="maps.safetensors"):
        read_maps(tmp_path / MAPS, sensor.geometry)


def test_maps_are_written_as_arrays_and_as_a_picture(contacts, tmp_path):
    _, run, sensor = contacts
    estimator = PoseEstimator.load(run)
    frame = Frame(np.zeros((300, 300), np.uint8), Form.PROCESSED, name="frame_7.png")
    arrays, picture = write_frame_maps(tmp_path, estimator, frame, pressed_maps(sensor.geometry))
    with np.load(arrays) as file:
        np.testing.assert_allclose(file["force_n"].sum(axis=0), file["resultant_n"])
        assert file["nodes_px"].shape == (SIDE * SIDE, 2) and file["patch"].any()
    assert picture.name == "frame_7.png" and picture.stat().st_size > 10_000


def test_maps_overwrite_nothing_foreign(contacts, tmp_path):
    _, run, _ = contacts
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "mine.png").write_bytes(b"mine")
    made = Predictions(PoseEstimator.load(run), [], tmp_path / "maps")
    with pytest.raises(StoreError, match="mine.png"):
        list(made)


def test_a_frame_unlike_any_of_the_training_has_no_maps(contacts, monkeypatch):
    folder, run, sensor = contacts
    estimator = PoseEstimator.load(run)
    pins = load_dataset(folder, sensor, estimator.names).pins.rows(np.array([0]))
    strange = replace(pins, nodes_px=pins.nodes_px + np.random.default_rng(0).normal(0, 5, pins.nodes_px.shape))
    monkeypatch.setattr(estimator, "pins_in", lambda frame: OneFrame(strange))
    made, maps = estimator.contact_maps(Frame(np.zeros((300, 300), np.uint8), Form.PROCESSED))
    assert not made.valid and maps is None


def test_a_model_of_recordings_says_that_it_makes_no_maps(trained):
    with pytest.raises(TrainingError, match="makes no contact maps.*train touch on simulated contacts"):
        PoseEstimator.load(trained).require_maps()


def test_lost_pins_an_unknown_place_of_the_camera_and_an_assumed_stiffness_widen_the_intervals_in_words(contacts):
    folder, run, sensor = contacts
    estimator = PoseEstimator.load(run)
    data = load_dataset(folder, sensor, estimator.names)
    pins = data.pins.rows(np.array([int(data.targets.raw[:, estimator.names.index("force_z")].argmax())]))
    made = estimator.predict_table(pins)
    whole, holed = (estimator.estimate_one(OneFrame(pins, lost_share=share), 0.0, "") for share in (0.0, 0.3))
    force = np.array([name.startswith(("force", "torque")) for name in estimator.names])
    bounded = np.array([name in ("contact_area", "slip_share") for name in estimator.names])
    plain = ~force & ~bounded
    np.testing.assert_allclose((whole.high - whole.value)[plain], TOUCH.unmeasured_widens * made.half_width[0][plain], rtol=1e-6)
    np.testing.assert_allclose((holed.high - holed.low)[plain], 1.6 * (whole.high - whole.low)[plain], rtol=1e-6)
    assert not whole.notes and "30% of the pins were not found" in holed.notes[0]
    z = estimator.names.index("force_z")
    assert whole.high[z] > 1.6 * whole.value[z] and whole.low[z] < whole.value[z] / 1.6
    assert len(estimator.caveats) == 2 and "without a frame" in estimator.caveats[0] and "1.6 times larger" in estimator.caveats[1]
    estimator.sensor = sensor.model_copy(update={"skin": sensor.skin.model_copy(update={"stiffness_factor": 1.0})})
    known = estimator.estimate_one(OneFrame(pins), 0.0, "")
    np.testing.assert_allclose((known.high - known.value)[force], TOUCH.unmeasured_widens * made.half_width[0][force], rtol=1e-6)
    assert len(estimator.caveats) == 1
