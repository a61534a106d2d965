"""Simulated pins beside recorded ones: the arm's own way into the plate, frame by frame (make validate).

Pins are compared in px of the recordings as they are. A simulated pin is the recorded no-contact pin plus the simulated
displacement: where each pin of a printed sensor really sits is not the mechanics' matter (the offsets at rest are printed).
"""

from dataclasses import replace

import numpy as np
import pytest

from scenes import load_sensor
from training.pin_error import binned_means, pin_errors, ring_bias
from training.recorded_contact import RECORDED_TAPS, read_surface_rows, recorded_path
from twin.errors import ContactError
from twin.mechanics.solver import SkinSolver
from twin.preprocess import Pipeline
from twin.preprocess.batch import recording_reference
from twin.preprocess.forms import raw_to_recording
from twin.projection import project
from twin.recordings import open_recording
from twin.stimulus.analytic import Plane

pytestmark = [pytest.mark.real, pytest.mark.slow]

SETS = {"tac-vgnn-331": "mg400-331", "tac-vgnn-127": "mg400-127"}
FRAMES, FRICTION_FRAMES, SEED = 80, 10, 20
STEP_MM = 0.4
FRICTION = {"mg400-331": 0.36, "mg400-127": 0.32}  # fitted with the sensors' other values
FRICTION_GRID = (0.0, 0.15, 0.25, 0.32, 0.4, 0.5, 0.65, 1.0, 2.0)
MOST_PX = {"mg400-331": 0.9, "mg400-127": 1.1}  # one friction for all frames
MOST_PER_FRAME_PX = {"mg400-331": 0.75, "mg400-127": 0.75}  # one friction a frame
MOST_NOT_EXECUTED_PX = {"mg400-331": 0.6, "mg400-127": 0.55}
MOST_RING_BIAS_PX = 0.4
UNLIKELY_PX, DECISIVE = 0.8, 0.5  # a move counts as not executed after all where a tap alone leaves less than this, and half the error
MOST_FAILED = 0.02  # of the contacts
PROTOTYPE_PX = {"mg400-331": 0.85, "mg400-127": 0.76}  # an earlier half-dome FEM, with one friction fitted to each frame
DEPTH_EDGES_MM, ANGLE_EDGES_DEG, SHEAR_EDGES_MM = (-4, -3, -2, -1, 0), (0, 5, 10, 15, 25), (0, 1, 2, 3.5, 5)


class Comparison:
    """A random sample of a recording's frames with their pins, and the solver that follows them."""

    def __init__(self, folder, name):
        self.name, self.spec = name, load_sensor(name)
        recording = open_recording(folder, self.spec)
        reference, _ = recording_reference(self.spec, recording, [])
        pipeline = Pipeline(self.spec, recording.form, reference)
        rows = read_surface_rows(folder)
        chosen = np.sort(np.random.default_rng(SEED).permutation(len(rows))[:FRAMES])
        self.rows = [rows[k] for k in chosen]
        self.measured_px = np.stack([pipeline(recording.read(int(k))).pins_px for k in chosen])
        self.no_contact_px = reference.pins_px
        self.solver = SkinSolver(self.spec)
        self.rest_px = self._pixels(self.solver.rest())

    def simulate(self, row, friction):
        """Pins (N, 2) of a row, NaN where the contact did not converge."""
        path = recorded_path(RECORDED_TAPS[self.name], row)
        if path is None:
            return self.no_contact_px
        try:
            *_, (_, state) = self.solver.path(Plane(), path, friction=friction, step_mm=STEP_MM)
        except ContactError as error:
            print(row, error)
            return np.full_like(self.rest_px, np.nan)
        return self.no_contact_px + self._pixels(state) - self.rest_px

    def _pixels(self, state):
        return raw_to_recording(self.spec, project(self.spec, state.caps_mm))


@pytest.fixture(scope="module", params=SETS)
def comparison(request, real_dir):
    folder = real_dir / request.param
    if not folder.is_dir():
        pytest.skip(f"no {request.param}")
    return Comparison(folder, SETS[request.param])


def table(comparison, error, executed):
    row = comparison.rows
    angle = np.abs([r.pose_6_deg - (0 if r.executed else r.move_6_deg) for r in row])
    shear = np.abs([r.move_1_mm if r.executed else 0 for r in row])
    for label, chosen in (("executed", executed), ("not executed", ~executed), ("all", executed | ~executed)):
        bins = [
            binned_means(error[chosen], np.asarray(values)[chosen], edges)
            for values, edges in (([r.pose_2_mm for r in row], DEPTH_EDGES_MM), (angle, ANGLE_EDGES_DEG), (shear, SHEAR_EDGES_MM))
        ]
        depth, angles, shears = (" ".join(f"{v:5.2f}" for v in b) for b in bins)
        print(f"  {label:13s}{np.mean(error[chosen]):5.2f} px | depth {depth} | |angle| {angles} | |shear| {shears}")


def test_pins_with_one_set_of_parameters(comparison):
    name, rows = comparison.name, comparison.rows
    simulated = np.stack([comparison.simulate(row, FRICTION[name]) for row in rows])
    solved = ~np.isnan(simulated[:, 0, 0])
    assert solved.mean() >= 1 - MOST_FAILED
    error = pin_errors(np.where(solved[:, None, None], simulated, comparison.no_contact_px), comparison.measured_px)
    executed = np.array([row.executed for row in rows])
    bias = ring_bias(comparison.no_contact_px, simulated[solved], comparison.measured_px[solved], comparison.spec.pins.rings)
    at_rest = np.linalg.norm(comparison.rest_px - comparison.no_contact_px, axis=1).mean()
    print(f"\n{name}: {len(rows)} frames, friction {FRICTION[name]}; prototype, one friction a frame: {PROTOTYPE_PX[name]} px")
    table(comparison, error, executed)
    relabelled = error.copy()
    for k in np.flatnonzero(executed & (error > UNLIKELY_PX)):
        tapped = pin_errors(comparison.simulate(replace(rows[k], executed=False), FRICTION[name]), comparison.measured_px[k])
        if tapped < min(UNLIKELY_PX, DECISIVE * error[k]):
            relabelled[k] = tapped
    print(f"  {np.count_nonzero(relabelled < error)} moves were not executed by the twin: {relabelled.mean():.2f} px with them relabelled")
    print(f"  outward bias by ring {np.round(bias, 2)} px; pins at rest off by {at_rest:.2f} px")
    assert error.mean() < MOST_PX[name] and error[~executed].mean() < MOST_NOT_EXECUTED_PX[name]
    assert np.abs(bias).max() < MOST_RING_BIAS_PX


def test_pins_with_one_friction_a_frame(comparison):
    """A not executed tap has its friction, too, but hardly shows it: it is left at the common one."""
    name = comparison.name
    executed = np.array([row.executed for row in comparison.rows])
    chosen = np.flatnonzero(executed)[:: max(1, executed.sum() // FRICTION_FRAMES)][:FRICTION_FRAMES]
    errors = np.full((len(FRICTION_GRID), len(chosen)), np.inf)
    for k, friction in enumerate(FRICTION_GRID):
        simulated = np.stack([comparison.simulate(comparison.rows[i], friction) for i in chosen])
        solved = ~np.isnan(simulated[:, 0, 0])
        errors[k, solved] = pin_errors(simulated[solved], comparison.measured_px[chosen[solved]])
    best = errors.min(axis=0)
    print(f"\n{name}: {len(chosen)} executed frames, one friction each: {best.mean():.2f} px (prototype, all frames: {PROTOTYPE_PX[name]})")
    print(f"  frictions {np.sort(np.array(FRICTION_GRID)[errors.argmin(axis=0)])}")
    assert best.mean() < MOST_PER_FRAME_PX[name]
