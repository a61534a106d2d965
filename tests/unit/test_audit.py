"""The audit finds what was planted."""

import json

import numpy as np
import pytest
from drawn_recording import drawn_pins

from scenes import load_sensor
from training.data.audit import audit_labels
from training.data.dataset import Dataset
from training.data.pins import PinTable
from training.data.targets import PRESETS, Targets
from training.studies.label_audit import LabelAudit, summary_of, write_audit
from twin.pins import nominal_reference
from twin.rig.labels import read_executed
from twin.types import Form

FRAMES = 600


def arm(labels):
    """Pose and move (M, 6) each, from depth, angle and both shears."""
    pose, move = np.zeros((2, len(labels), 6))
    pose[:, [1, 5]], move[:, [0, 5]] = labels[:, :2], labels[:, 2:]
    return pose, move


@pytest.fixture(scope="module")
def planted():
    """Labels of which some are wrong, pins that tell the truth, and which is which."""
    spec = load_sensor("mg400-127")
    reference = nominal_reference(spec, Form.PROCESSED)
    rng = np.random.default_rng(1)
    labels = np.column_stack([rng.uniform(-3.6, 0, FRAMES), np.sort(rng.uniform(-20, 20, FRAMES)), rng.uniform(-5, 5, (FRAMES, 2))])
    executed = rng.random(FRAMES) < 0.65
    true = labels.copy()
    true[~executed, 1] -= labels[~executed, 3]
    true[~executed, 2:] = 0
    true[~executed, 0] += 0.015 * labels[~executed, 2]
    sign = np.zeros(FRAMES, bool)
    sign[[40, 250, 520]] = True
    labels[sign, 1] *= -1
    nodes = drawn_pins(true, reference) + rng.normal(0, 0.05, (FRAMES, 127, 2))
    untouched = np.array([100, 300])
    nodes[untouched] = reference.pins_px + rng.normal(0, 0.05, (2, 127, 2))
    nodes[411] = nodes[410]
    names = np.array([f"f_{k}.png" for k in range(FRAMES)])
    shape = (FRAMES, 127)
    pins = PinTable(spec, Form.PROCESSED, reference, names, nodes, np.ones(shape), np.zeros(shape, bool), np.ones(FRAMES, bool))
    return pins, labels, executed, sign, untouched


def test_planted_faults_are_found(planted):
    pins, labels, executed, sign, untouched = planted
    found = audit_labels(pins, *arm(labels))
    assert np.flatnonzero(found.no_contact).tolist() == untouched.tolist()
    assert found.duplicates[411] == 410 and (found.duplicates == np.arange(FRAMES)).sum() == FRAMES - 1
    clear = (np.abs(labels[:, 2:]).max(axis=1) > 1) & ~found.no_contact & ~sign
    clear[411] = False
    assert ((found.executed > 0.5) == executed)[clear].mean() > 0.97
    assert set(np.flatnonzero(sign & (np.abs(labels[:, 1]) > 3))) <= set(np.flatnonzero(found.wrong_sign))
    assert (found.wrong_sign & ~sign).mean() < 0.01
    assert abs(found.depth_per_move - 0.015) < 0.006


def test_a_clean_recording_has_nothing_to_find(planted):
    pins, labels, _, _, _ = planted
    reference = pins.reference
    rng = np.random.default_rng(2)
    nodes = drawn_pins(labels, reference) + rng.normal(0, 0.05, (FRAMES, 127, 2))
    clean = PinTable(pins.sensor, pins.form, reference, pins.image_name, nodes, pins.area_px2, pins.lost, pins.valid)
    found = audit_labels(clean, *arm(labels))
    clear = np.abs(labels[:, 2:]).max(axis=1) > 1
    assert (found.executed > 0.5)[clear].mean() > 0.98
    assert not found.no_contact.any() and found.wrong_sign.mean() < 0.01 and found.drift["r2_of_row_number_beyond_labels"] < 0.1


def test_drift_is_seen_beyond_what_the_labels_tell(planted):
    pins, labels, _, _, _ = planted
    rng = np.random.default_rng(3)
    time = np.linspace(-0.5, 0.5, FRAMES)[rng.permutation(FRAMES)]  # taken in another order than by angle
    order = np.argsort(time)
    nodes = drawn_pins(labels, pins.reference) + rng.normal(0, 0.05, (FRAMES, 127, 2)) + time[:, None, None] * [2.0, 0.0]
    drifting = PinTable(pins.sensor, pins.form, pins.reference, pins.image_name, nodes, pins.area_px2, pins.lost, pins.valid).rows(order)
    found = audit_labels(drifting, *arm(labels[order]))
    assert found.drift["r2_of_row_number_beyond_labels"] > 0.5
    assert abs(found.drift["px_first_to_last"]["x"] - 2.0) < 0.6


@pytest.mark.parametrize("frames", [1, 2, 60, 279])
def test_too_few_frames_are_an_answer_and_not_a_clean_bill(planted, frames):
    pins, labels, _, _, _ = planted
    touching = np.setdiff1d(np.arange(FRAMES), [100, 300])
    rows = touching[:frames]
    found = audit_labels(pins.rows(rows), *arm(labels[rows]))
    assert (
        f"too few frames in contact ({frames}) to find out which moves were executed" in found.not_assessed
        and "280 are needed" in found.not_assessed
    )
    assert np.isnan(found.executed).all() and np.isnan(found.chi2).all() and np.isnan(found.depth_per_move)
    enough = audit_labels(pins.rows(touching[:280]), *arm(labels[touching[:280]]))
    assert not enough.not_assessed and np.isfinite(enough.executed).all()


@pytest.mark.usefixtures("undrawn_charts")
def test_of_too_few_frames_no_corrected_labels_are_written(planted, tmp_path):
    pins, labels, executed, _, _ = planted
    for count in (30, 600):
        rows, out = np.arange(count), tmp_path / str(count)
        out.mkdir()
        targets = Targets(PRESETS["surface-2d-shear"], labels[rows], labels[rows], executed[rows].astype(float), labels[rows, 2:])
        data = Dataset(pins.rows(rows), targets, (tmp_path / "taps",))
        found = audit_labels(data.pins, *arm(labels[rows]))
        summary = summary_of(found, data)
        written = write_audit(out, found, data, summary)
        said = " ".join(LabelAudit(found, summary, count, written).lines())
        page = (out / "audit.html").read_text()
        assert all(path.is_file() for path in written) and json.loads((out / "audit.json").read_text())["frames"] == count
        assert (out / "labels_corrected.csv").exists() == (count == 600)
        if count == 600:  # training reads them
            problems: list[str] = []
            assert len(read_executed(out, data.pins.image_name.tolist(), problems)) == count and not problems
        assert ("too few" in said) == ("too few" in page) == (count == 30)


def test_a_recording_of_an_edge_around_the_circle_is_audited_as_a_plate_is():
    """Pins that follow the edge as the turned tool sees it; a third of the moves were not made, some directions have the other sign."""
    rng = np.random.default_rng(4)
    pose, move = np.zeros((2, 900, 6))
    pose[:, [1, 2]] = rng.uniform([-6, 3], [6, 5], (900, 2))
    pose[:, 5] = np.linspace(-179, 179, 900)
    move[:, [0, 1, 5]] = rng.uniform(-5, 5, (900, 3))
    executed = rng.random(900) < 0.67
    before = pose - ~executed[:, None] * move
    turn = np.exp(1j * np.radians(before[:, 5]))
    dragged = (move[:, 0] + 1j * move[:, 1]) / turn * executed
    columns = [before[:, 2], before[:, 1], turn.real, turn.imag, before[:, 1] * turn.real, before[:, 1] * turn.imag]
    columns += [dragged.real, dragged.imag, move[:, 5] * executed]
    spec = load_sensor("mg400-127")
    reference = nominal_reference(spec, Form.PROCESSED)
    nodes = reference.pins_px + np.einsum("mc,cnd->mnd", np.array(columns).T, rng.normal(0, 0.4, (9, 127, 2)))
    nodes += rng.normal(0, 0.05, nodes.shape)
    pose[[40, 500], 5] *= -1
    names, shape = np.array([f"f_{k}.png" for k in range(900)]), (900, 127)
    pins = PinTable(spec, Form.PROCESSED, reference, names, nodes, np.ones(shape), np.zeros(shape, bool), np.ones(900, bool))
    found = audit_labels(pins, pose, move)
    assert not found.not_assessed and set(np.flatnonzero(found.wrong_sign)) >= {40, 500} and found.wrong_sign.sum() < 5
    clear = (np.abs(move[:, :2]).max(axis=1) > 1) & ~found.wrong_sign
    assert ((found.executed > 0.5) == executed)[clear].mean() > 0.98
    taps = audit_labels(pins.rows(np.flatnonzero(executed)), pose[executed], 0 * move[executed])
    assert (taps.executed == 1).all()
