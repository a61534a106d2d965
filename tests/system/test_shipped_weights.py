"""The weights that go with the package tell freshly simulated contacts as well as is stated here, and say so.

Stated is what was measured: mean absolute errors, and the share of labels inside intervals of 90 %, over all converged states of contacts
with ``SEED`` of the experiment that a model was trained for. The same seed gives the same contacts, so there is no sampling error. A number
that is much better than stated fails, too: the twin has changed, and what documents state of these weights has to be measured again.
"""

from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import pytest
from fresh_contacts import read_for, simulate_contacts

from training.estimate.estimator import PoseEstimator
from training.runs.run_files import shipped_names
from training.studies.judging import measure_errors
from twin.frames import open_recording
from twin.pins import make_reference, nominal_reference
from twin.types import Form

SEED = 5  # of contacts that no training drew
RELATIVE = 0.1  # of an error
INSIDE = 0.05  # of a share: 4 of 85 states


@dataclass(frozen=True)
class Stated:
    """Mean absolute errors (mm and deg, in the order of the model's labels) and shares inside the 90 % intervals."""

    error: tuple[float, ...]
    inside: tuple[float, ...]


TACPAD = "ur5-tacpad"  # learnt from real frames alone, and evaluated on them
LOOKED_AT = 30  # of its frames
EXPERIMENTS = {"mg400-331": "surface-2d", "mg400-127": "surface-2d", "ur5-331": "surface-3d"}
QUICK, FULL = (5, 12), (40, 16)  # contacts, elements across
STATED = {
    ("mg400-331", QUICK): Stated((0.0718, 0.2155), (0.919, 0.872)),
    ("mg400-127", QUICK): Stated((0.0671, 0.3077), (0.753, 0.718)),
    ("ur5-331", QUICK): Stated((0.2307, 0.3936, 0.5417), (0.700, 1.000, 0.860)),
    ("mg400-331", FULL): Stated((0.0860, 0.2581), (0.925, 0.902)),
    ("mg400-127", FULL): Stated((0.0998, 0.3734), (0.814, 0.844)),
    ("ur5-331", FULL): Stated((0.1467, 0.3223, 0.2981), (0.834, 0.994, 0.956)),
}


def test_all_shipped_weights_are_judged():
    assert set(EXPERIMENTS) | {TACPAD} == set(shipped_names())


def test_the_tacpads_weights_tell_the_forces_of_its_frames(real_dir):
    """A few of the frames that they learnt: this says that weights, pins and light still belong together, not how good they are."""
    estimator = PoseEstimator.load(TACPAD)
    recording = open_recording(real_dir / "tacpad-force", estimator.sensor, None)
    found, told = [], []
    for frame in islice(recording, LOOKED_AT):
        estimate = estimator(frame)
        assert estimate.valid, estimate.reason
        found.append(estimate.value)
        told.append([float(recording.labels[name][frame.sequence]) for name in estimator.names])
    error = dict(zip(estimator.names, np.abs(np.array(found) - told).mean(axis=0), strict=True))
    assert error["pose_z"] < 0.08 and max(error["Fx"], error["Fy"]) < 0.4 and error["Fz"] < 0.7


@pytest.mark.parametrize("size", [QUICK, pytest.param(FULL, marks=pytest.mark.slow)], ids=["quick", "full"])
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "mg400-331")) for name in EXPERIMENTS])
def test_shipped_weights_predict_within_their_stated_error(name, size, tmp_path):
    contacts, across = size
    estimator = PoseEstimator.load(name)
    raw = estimator.form == Form.RAW
    folder = simulate_contacts(tmp_path, name, EXPERIMENTS[name], contacts, seed=SEED, across=across, raw=raw)
    data = read_for(estimator, folder)
    rows = np.arange(len(data))
    made = estimator.predict_rows(data, rows)  # of units with other skin and gel: the intervals of a single frame are so much wider
    made = replace(made, half_width=made.half_width * estimator.config.get("other_unit_widens", 1.0))
    found = measure_errors(made, data, rows)["corrected"]
    error, inside = ([found[label][key] for label in estimator.names] for key in ("mae", "coverage_90"))
    print(f"{name}, {contacts} contacts, {across} across, {len(rows)} states: errors {np.round(error, 4)}, inside {np.round(inside, 3)}")
    assert error == pytest.approx(STATED[name, size].error, rel=RELATIVE)
    assert inside == pytest.approx(STATED[name, size].inside, abs=INSIDE)


@pytest.mark.parametrize("name", ["mg400-331", "mg400-127"])
def test_intervals_are_wider_on_another_unit_than_that_of_the_weights(name, real_dir):
    """Its pins at rest tell it apart. A camera that moved a little does not make it another unit."""
    estimator = PoseEstimator.load(name)
    recording = open_recording(real_dir / name.replace("mg400", "tac-vgnn"), estimator.sensor, None)
    own, other = estimator.at_rest(recording.reference), estimator.counted_from(nominal_reference(estimator.sensor, estimator.form))
    assert not own.caveats and "wider" in "".join(other.caveats)
    both = [(a, b) for frame in islice(recording, LOOKED_AT) if (a := own(frame)).valid and (b := other(frame)).valid]
    width, wider = (np.median([each[k].high - each[k].low for each in both], axis=0) for k in (0, 1))
    assert len(both) >= 8 and wider[0] > 1.5 * width[0] and estimator.config["other_unit_widens"][0] > 2
    known = estimator.rest.known
    assert not estimator.counted_from(make_reference(known.pins_px * 1.01 + 2.0, estimator.sensor.pins)).caveats
