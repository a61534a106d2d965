"""Pins found on the published recordings, time a frame, and the simulated pins beside the recorded ones."""

import json
from functools import partial
from pathlib import Path

import bench_pipeline
import cv2
import numpy as np

from figures.jobs import Measured, Value, job, real_folder, run_twin
from scenes import load_sensor
from scenes.pins import PinsSpec
from twin.frames import open_recording
from twin.geometry.pins import namings
from twin.pins import Pipeline, Reference, nominal_reference

SETS = {"mg400-331": "tac-vgnn-331", "mg400-127": "tac-vgnn-127", "ur5-331": "ur5-331-raw"}
FRAMES = 200  # of the bench
AT_REST = "hex127-flat"  # has frames without contact
UNKNOWN = (AT_REST, "hex127-deep", "hex127-shapes")  # of another laboratory's sensor
WHITE, LEAST_PX = 127, 8  # level above which a pixel is white, and least pixels of a component
VALIDATED, OWN_FRICTION, SEED = 80, 10, 20  # frames sampled at random; of these with a friction of their own


def found_on(work: Path, *, sensor: str) -> Measured:
    """Of all frames of a recording."""
    run_twin(work, "preprocess", real_folder(SETS[sensor]), "--sensor", sensor, "--out", work / "pins")
    summary = json.loads((work / "pins" / "summary.json").read_text())
    return {"frames": Value(summary["frames"]), "all_found": Value(summary["exact_fraction"])}


def named_by_a_new_sensor(work: Path, *, recording: str) -> Measured:
    """Of the frames of an unknown sensor, those in which all pins are named, and the others that are valid with three pins lost at most.

    Connected components show in which frames all pins are separate.
    """
    run_twin(work, "new", real_folder(recording), "--out", work / "new.toml")
    sensor = load_sensor(work / "new.toml")
    frames = open_recording(real_folder(recording), sensor)
    pipeline, count = Pipeline(sensor, frames.form), sensor.pins.count
    separate, named, fair = [], [], []
    for frame in frames:
        stats = cv2.connectedComponentsWithStats((frame.image > WHITE).astype(np.uint8), connectivity=8)[2]
        seen = pipeline(frame)
        separate.append((stats[1:, cv2.CC_STAT_AREA] >= LEAST_PX).sum() == count)
        named.append(seen.valid and seen.found == count)
        fair.append(seen.valid and seen.found >= count - 3)
    whole = np.array(separate)
    found = {"frames": Value(int(whole.sum())), "named": Value(float(np.mean(np.array(named)[whole])))}
    found |= {"others": Value(int((~whole).sum())), "others_named": Value(float(np.mean(np.array(fair)[~whole])))}
    if recording == AT_REST:
        return found
    run_twin(work, "new", real_folder(AT_REST), "--out", work / "rest.toml")
    rest_px = nominal_reference(load_sensor(work / "rest.toml"), frames.form).pins_px
    return found | {"rest_off": Value(_apart(pipeline.reference, rest_px, sensor.pins))}


def _apart(made: Reference, rest_px: np.ndarray, pins: PinsSpec) -> float:
    """Median distance, in spacings, of places at rest from those (N, 2) of the same sensor in another window of the same camera."""
    rim = made.outmost
    apart = [made.pins_px - px - np.median((made.pins_px - px)[rim], axis=0) for px in (rest_px[order] for order in namings(pins))]
    return min(float(np.median(np.linalg.norm(one, axis=1) / made.spacing_px)) for one in apart)


def speed(work: Path, *, sensor: str) -> Measured:
    """Median of pins, areas and graph together on one thread, and how many times slower the published method is in the same run.

    Also the ratio of the 99th percentile to the median, and the median of consecutive frames, with the share of them whose pins are those
    of the frame alone.
    """
    found = bench_pipeline.measure(sensor, FRAMES)
    tail = float(np.percentile(found.ours["total"], 99)) / found.ours_ms
    times = {"ms": Value(found.ours_ms, "ms"), "times_faster": Value(found.ratio), "tail": Value(tail)}
    return times | {"consecutive": Value(float(np.median(found.sequence)), "ms"), "same": Value(found.same)}


def against_recorded(work: Path, *, sensor: str) -> Measured:
    """The whole twin without anything free, and with one friction a frame."""
    options = ("--max-frames", VALIDATED, "--friction-frames", OWN_FRICTION, "--seed", SEED)
    run_twin(work, "validate", "--sensor", sensor, "--frames", real_folder(SETS[sensor]), "--out", work / "validate", *options)
    summary = json.loads((work / "validate" / "validation.json").read_text())
    errors = {row["group"]: row["error_px"] for row in summary["table"]}
    found = {"taps": errors["move not executed"], "all": errors["all"], "own_friction": summary["one_friction_a_frame"]["error_px"]}
    return {name: Value(error, "px") for name, error in found.items()}


for _sensor in SETS:
    _command = f"twin preprocess DIR --sensor {_sensor} --out OUT"
    job(f"pins.found.{_sensor}", _command, sensors=(_sensor,), code=("twin.pins.batch",), recordings=(SETS[_sensor],), minutes=1)(
        partial(found_on, sensor=_sensor)
    )
for _sensor in ("mg400-331", "mg400-127"):
    _recording = (SETS[_sensor],)
    job(
        f"pins.speed.{_sensor}",
        f"tests/bench/bench_pipeline.py --sensor {_sensor}",
        sensors=(_sensor,),
        code=("bench_pipeline",),
        recordings=_recording,
        minutes=1,
    )(partial(speed, sensor=_sensor))
    _command = (
        f"twin validate --sensor {_sensor} --frames DIR --max-frames {VALIDATED} --friction-frames {OWN_FRICTION} --seed {SEED} --out OUT"
    )
    job(f"pins.real.{_sensor}", _command, sensors=(_sensor,), code=("training.studies.validation",), recordings=_recording, minutes=8)(
        partial(against_recorded, sensor=_sensor)
    )
for _set in UNKNOWN:
    job(f"pins.new.{_set}", "twin new DIR --out OUT", code=("twin.calibration.new_sensor",), recordings=(_set,), minutes=1)(
        partial(named_by_a_new_sensor, recording=_set)
    )
