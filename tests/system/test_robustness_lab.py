"""The lab's commands, and real frames beside rendered ones."""

import numpy as np
import pytest
from command import run_twin as run

from scenes import load_sensor
from twin.evaluation.degradation.condition import DegradedCase
from twin.evaluation.degradation.conditions import CONDITIONS
from twin.evaluation.degradation.envelope import curves_of, envelopes_of
from twin.evaluation.degradation.shots import CONTACTS, RenderedSource
from twin.evaluation.degradation.study import consensus
from twin.evaluation.degradation.sweep import SweepSettings, run_sweep
from twin.frames import open_recording
from twin.frames.images import write_image
from twin.pins import make_detector, shipped_detector
from twin.pins.detectors.tune import tune
from twin.pins.labelling.reference import nominal_reference
from twin.types import Form

SETS = {"tac-vgnn-331": "mg400-331", "tac-vgnn-127": "mg400-127", "ur5-331-raw": "ur5-331"}
COMPARED = ("noise", "defocus", "jpeg", "exposure-low", "resolution", "motion-blur", "room-light")
STEPS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.6, 0.8, 0.95, 1.0)
FRAMES = 4
AGREEMENT = 1.25  # ratio of the real and the rendered failing severity


def evenly(recording, count):
    return [recording.read(int(k)) for k in np.linspace(0, len(recording) - 1, count)]


@pytest.mark.slow
def test_tune_check_and_robustness_from_the_command_line(tmp_path):
    spec = load_sensor("mg400-127")
    source = RenderedSource(spec, CONTACTS[:1])
    frames = tmp_path / "frames"
    frames.mkdir()
    for k, name in enumerate(("noise", "motion-blur")):
        shot = source.render(DegradedCase((CONDITIONS[name],)), 0.01)[0]
        write_image(frames / f"{k}.png", shot.frame.image)
    tuned = run("tune", "--sensor", "mg400-127", "--frames", frames, "--out", tmp_path / "mine.toml")
    assert tuned.returncode == 0, tuned.stderr
    assert "all pins in view found in 100 %" in tuned.stdout and (tmp_path / "mine.toml").is_file()
    checked = run("check", frames, "--sensor", "mg400-127", "--pipeline", tmp_path / "mine.toml")
    assert checked.returncode == 0 and "HEALTHY" in checked.stdout, checked.stdout + checked.stderr
    plan = tmp_path / "plan.toml"
    plan.write_text('steps = [1.0]\n[[condition]]\nname = "hot-pixels"\n[[condition]]\nname = "caps-faded"\n')
    pipelines = ("--pipeline", "twin", "--pipeline", tmp_path / "mine.toml", "--conditions", plan, "--jobs", "1", "--max-frames", "2")
    swept = run("robustness", "--sensor", "mg400-127", "--frames", frames, "--out", tmp_path / "out", *pipelines)
    assert swept.returncode == 0, swept.stderr
    assert "hot-pixels" in swept.stdout and "caps-faded" in (tmp_path / "out" / "index.html").read_text()  # named as left out
    assert (tmp_path / "out" / "envelope.csv").read_text().count("hot-pixels") == 2
    assert "This sensor on the rendered envelope" in (tmp_path / "out" / "index.html").read_text()
    assert (tmp_path / "out" / "real-on-rendered.csv").read_text().count("hot-pixels") == 1


def test_errors_are_one_line_and_say_what_to_do(tmp_path):
    unknown = run("robustness", "--sensor", "mg400-127", "--pipeline", "magic", "--frames", tmp_path, "--out", tmp_path / "out")
    assert unknown.returncode == 2 and unknown.stderr.count("\n") <= 2 and "error" in unknown.stderr
    nothing = run("robustness", "--sensor", "mg400-127", "--model", tmp_path / "none", "--out", tmp_path / "out")
    assert nothing.returncode == 1 and "holds no trained model" in nothing.stderr and "Traceback" not in nothing.stderr
    listed = run("robustness", "--sensor", "mg400-127", "--list", "--out", tmp_path / "out")
    assert listed.returncode == 0 and all(name in listed.stdout for name in CONDITIONS)


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize("folder", SETS)
def test_tuning_reaches_the_hand_tuned_rates(real_dir, folder):
    spec = load_sensor(SETS[folder])
    recording = open_recording(real_dir / folder, spec)
    frames = evenly(recording, 20)
    rates = []
    for detector in (tune(frames, spec).detector, shipped_detector(spec, recording.form)):
        find = make_detector(spec, detector)
        rates.append(np.mean([len(find(frame).claims_px) == spec.pins.count for frame in frames]))
    print(f"\n{folder}: tuned {rates[0]:.2f}, by hand {rates[1]:.2f}")
    assert rates[0] >= rates[1]


@pytest.mark.real
@pytest.mark.slow
def test_real_frames_fail_where_rendered_ones_do(real_dir, tmp_path):
    spec = load_sensor("ur5-331")
    frames = evenly(open_recording(real_dir / "ur5-331-raw", spec), FRAMES)
    ours = shipped_detector(spec, Form.RAW)
    real, refused = consensus(spec, frames, [ours, tune(frames, spec, "adaptive").detector])
    assert len(refused) <= 1
    cases = tuple(DegradedCase((CONDITIONS[name],)) for name in COMPARED)
    pitch_px = float(nominal_reference(spec, Form.RAW).spacing_px.mean())
    found = []
    for kind, source in (("real", real), ("rendered", RenderedSource(spec, CONTACTS))):
        rows = run_sweep(SweepSettings(source, (ours,), cases, STEPS), tmp_path / kind, jobs=2, progress=lambda done, total: None)
        found.append([e.severity for e in envelopes_of(curves_of(rows, cases, pitch_px), cases)])
    ends = np.minimum(found, 1.0)  # where neither fails within the range they agree
    ratio = ends[0] / ends[1]
    for name, *pair in zip(COMPARED, *found, ratio, strict=True):
        print(f"\n{name}: real {pair[0]:.3f}, rendered {pair[1]:.3f}, ratio {pair[2]:.2f}")
    assert (ends < 1).all(axis=0).sum() >= 4 and (np.maximum(ratio, 1 / ratio) < AGREEMENT).all()
