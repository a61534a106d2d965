"""Pins found on the published recordings, time a frame, and the simulated pins beside the recorded ones."""

import json
from functools import partial
from pathlib import Path

import bench_pipeline

from figures.jobs import Measured, Value, job, real_folder, run_twin

SETS = {"mg400-331": "tac-vgnn-331", "mg400-127": "tac-vgnn-127", "ur5-331": "ur5-331-raw"}
FRAMES = 200  # of the bench
VALIDATED, OWN_FRICTION, SEED = 80, 10, 20  # frames drawn at random; of these with a friction of their own


def found_on(work: Path, *, sensor: str) -> Measured:
    """Of all frames of a recording."""
    run_twin(work, "preprocess", real_folder(SETS[sensor]), "--sensor", sensor, "--out", work / "pins")
    summary = json.loads((work / "pins" / "summary.json").read_text())
    return {"frames": Value(summary["frames"]), "all_found": Value(summary["exact_fraction"])}


def speed(work: Path, *, sensor: str) -> Measured:
    """Median of pins, areas and graph together on one thread, and how many times slower the published method is in the same run."""
    found = bench_pipeline.measure(sensor, FRAMES)
    return {"ms": Value(found.ours_ms, "ms"), "times_faster": Value(found.ratio)}


def against_recorded(work: Path, *, sensor: str) -> Measured:
    """The whole twin without anything free, and with one friction a frame."""
    options = ("--limit", VALIDATED, "--friction-frames", OWN_FRICTION, "--seed", SEED)
    run_twin(work, "validate", "--sensor", sensor, "--frames", real_folder(SETS[sensor]), "--out", work / "validate", *options)
    summary = json.loads((work / "validate" / "validation.json").read_text())
    errors = {row["group"]: row["error_px"] for row in summary["table"]}
    found = {"taps": errors["move not executed"], "all": errors["all"], "own_friction": summary["one_friction_a_frame"]["error_px"]}
    return {name: Value(error, "px") for name, error in found.items()}


for _sensor in SETS:
    _command = f"twin preprocess DIR --sensor {_sensor} --out OUT"
    job(
        f"pins.found.{_sensor}",
        _command,
        sensors=(_sensor,),
        code=("twin.pins.batch",),
        recordings=(SETS[_sensor],),
        minutes=1,
    )(partial(found_on, sensor=_sensor))
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
    _command = f"twin validate --sensor {_sensor} --frames DIR --limit {VALIDATED} --friction-frames {OWN_FRICTION} --seed {SEED} --out OUT"
    job(f"pins.real.{_sensor}", _command, sensors=(_sensor,), code=("training.studies.validation",), recordings=_recording, minutes=8)(
        partial(against_recorded, sensor=_sensor)
    )
