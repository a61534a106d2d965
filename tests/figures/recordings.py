"""The UR5's labelled recordings: the twin's pins beside theirs, the audit of their labels, and the kinds of contact told."""

import json
from functools import partial
from pathlib import Path

import numpy as np

from figures.jobs import NO_PICTURES, Measured, Value, job, real_folder, run_twin
from training.data.dataset import load_dataset
from training.studies.evaluation import models_of_kinds

SENSOR, TACPAD = "ur5-331", "ur5-tacpad"
KINDS = {  # of contact, by recording
    "ur5-331-surface-3d-tap": "plate",
    "ur5-331-surface-3d-shear": "plate-sheared",
    "ur5-331-edge-2d-tap": "edge",
    "ur5-331-edge-2d-shear": "edge-sheared",
}
SETS = {  # by recording: sensor, experiment, elements across
    "ur5-331-surface-3d-tap": (SENSOR, "surface-3d", 20),
    "ur5-331-surface-3d-shear": (SENSOR, "surface-3d-sheared", 20),
    "ur5-331-edge-2d-tap": (SENSOR, "edge-circle", 20),
    "ur5-331-edge-2d-shear": (SENSOR, "edge-circle-sheared", 20),
    "tacpad-force": (TACPAD, "surface-3d-tool", 10),
}
VALIDATED, OWN_FRICTION, SEED = 40, 5, 20  # frames sampled at random; of the sheared ones with a friction of their own


def options_of(recording: str) -> tuple[object, ...]:
    """Options of ``twin validate`` without folders."""
    sensor, experiment, across = SETS[recording]
    drawn = ("--max-frames", VALIDATED, "--friction-frames", OWN_FRICTION, "--seed", SEED)
    return "--sensor", sensor, "--experiment", experiment, "--elements", across, *drawn


def against_recorded(work: Path, *, recording: str) -> Measured:
    """Mean distance between the twin's pins and the recorded ones, without anything free, and with one friction a frame."""
    run_twin(work, "validate", *options_of(recording), "--frames", real_folder(recording), "--out", work / "validate")
    summary = json.loads((work / "validate" / "validation.json").read_text())
    errors = {row["group"]: row["error_px"] for row in summary["table"]}
    found = {"all": errors["all"], "displacement": summary["mean_displacement_px"]}
    if own := summary["one_friction_a_frame"]:
        found |= {"own_friction": own["error_px"], "common_friction": own["error_with_common_friction_px"]}
    return {name: Value(error, "px") for name, error in found.items()}


def audited(work: Path, *, recording: str) -> Measured:
    """What the audit finds."""
    run_twin(work, "audit", real_folder(recording), "--sensor", SENSOR, "--out", work / "audit")
    summary = json.loads((work / "audit" / "audit.json").read_text())
    counted = {
        "wrong_sign": "wrong_sign",
        "fit_no_label": "fit_no_story",
        "no_contact": "no_contact",
        "twice": "same_pins_as_an_earlier_frame",
    }
    found = {"frames": Value(summary["frames"]), "lost_pins": Value(summary["frames_with_lost_pins"] / summary["frames"])}
    found |= {name: Value(len(summary[key])) for name, key in counted.items()}
    return found | {"not_executed": Value(summary["moves_not_executed"]["frames"]), "undecided": Value(summary["undecided"])}


def kinds_told(work: Path, *, recording: str) -> Measured:
    """For what the shipped weights take the frames that they did not learn from."""
    folder, kind = real_folder(recording), KINDS[recording]
    several = models_of_kinds(SENSOR, folder)
    assert several is not None
    estimator = several.parts[kind]
    data = load_dataset(folder, estimator.recorded_sensor, estimator.names, form=estimator.form)
    kept_out = estimator.config["rows"]["kept_out"]
    rows = np.flatnonzero(np.isin([f"{recording}/{name}" for name in data.pins.image_name], kept_out))
    shares = several.taken_for(data.pins.rows(rows))
    return {"frames": Value(len(rows)), "right": Value(shares[kind]), "none": Value(shares["none"])}


for _recording, (_sensor, _, _) in SETS.items():
    job(
        f"pins.real.{_recording}",
        f"twin validate {' '.join(map(str, options_of(_recording)))} --frames {_recording} --out OUT",
        sensors=(_sensor,),
        recordings=(_recording,),
        code=("training.studies.validation",),
        minutes=5,
    )(partial(against_recorded, recording=_recording))
for _recording in KINDS:
    _command = f"twin audit {_recording} --sensor {SENSOR} --out OUT"
    _common = {"sensors": (SENSOR,), "recordings": (_recording,), "minutes": 2, "beside": NO_PICTURES}
    job(f"audit.{_recording}", _command, code=("training.studies.label_audit",), **_common)(partial(audited, recording=_recording))
    job(
        f"kinds.{_recording}",
        f"ContactEstimator.taken_for: shipped weights of {SENSOR} on frames of {_recording} that they did not learn from",
        code=("training.studies.evaluation",),
        shipped=(f"training/weights/{SENSOR}",),
        **_common,
    )(partial(kinds_told, recording=_recording))
