"""Measures against planted errors, envelopes against known crossings, and a sweep end to end that goes on where it was."""

import csv
import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from drawn_frames import drawn_frame, smooth_warp
from plain_sensor import changed
from sound_page import read_sound_page

from scenes import load_sensor
from training.studies import degradation
from twin.errors import TwinError
from twin.evaluation.degradation.condition import DegradedCase
from twin.evaluation.degradation.conditions import CONDITIONS
from twin.evaluation.degradation.envelope import NEAR, Envelope, crossing, curves_of, envelopes_of, evaluate_sweep, shares_of
from twin.evaluation.degradation.report import _share_row, compare, write_report
from twin.evaluation.degradation.shots import DegradedFrame, RealSource
from twin.evaluation.degradation.study import ConditionPlan, SweepPlan, check_pipelines, consensus, load_plan
from twin.evaluation.degradation.sweep import MEASURES, SweepSettings, cells_of, measure_frame, run_sweep
from twin.pins import Found, make_detector, shipped_detector
from twin.pins.labelling.reference import nominal_reference
from twin.types import Form, Frame

RECALL = next(m for m in MEASURES if m.name == "recall")
CENTROID = next(m for m in MEASURES if m.name == "centroid_px")


@pytest.fixture(scope="module")
def spec():
    return load_sensor("mg400-127")


@pytest.fixture(scope="module")
def rest(spec):
    return nominal_reference(spec, Form.RAW).pins_px


@pytest.fixture(scope="module")
def detector(spec):
    return make_detector(spec, shipped_detector(spec, Form.RAW))


def shot_of(rest, gone=()):
    visible = np.ones(len(rest), bool)
    visible[list(gone)] = False
    return DegradedFrame("planted", Frame(np.zeros((480, 640), np.uint8), Form.RAW), rest, visible)


def found_of(detector, pins_px, extra=()):
    claims = np.concatenate([pins_px[np.isfinite(pins_px[:, 0])], np.reshape(extra, (-1, 2))])
    return Found(claims, pins_px, detector.graph_of(pins_px) if np.isfinite(pins_px).all() else None, len(pins_px), True)


def test_a_perfect_answer_is_perfect(detector, rest):
    assert measure_frame(detector, found_of(detector, rest), shot_of(rest)) == {
        "valid": 1.0, "recall": 1.0, "precision": 1.0, "centroid_px": 0.0, "swaps": 0.0, "area_error": 0.0, "edges": 1.0,
    }  # fmt: skip


def test_injected_errors_are_counted(detector, rest):
    n = len(rest)
    pins = rest.copy()
    pins[:5] = np.nan
    lost = measure_frame(detector, found_of(detector, pins), shot_of(rest))
    assert lost["recall"] == pytest.approx(1 - 5 / n) and lost["precision"] == 1 and np.isnan(lost["area_error"])
    extra = measure_frame(detector, found_of(detector, rest, extra=[[5.0, 5.0], [9.0, 400.0]]), shot_of(rest))
    assert extra["precision"] == pytest.approx(n / (n + 2)) and extra["recall"] == 1
    moved = measure_frame(detector, found_of(detector, rest + [0.3, 0.4]), shot_of(rest))
    assert moved["centroid_px"] == pytest.approx(0.5) and moved["area_error"] < 1e-9
    pins = rest.copy()
    pins[[10, 11]] = pins[[11, 10]]
    swapped = measure_frame(detector, found_of(detector, pins), shot_of(rest))
    assert swapped["swaps"] == pytest.approx(2 / n) and swapped["recall"] == 1


def test_a_pin_that_is_gone_is_not_missed(detector, rest):
    pins = rest.copy()
    pins[[3, 4]] = np.nan
    measured = measure_frame(detector, found_of(detector, pins), shot_of(rest, gone=[3, 4]))
    assert measured["recall"] == 1 and measured["precision"] == 1


def test_crossings_lie_between_the_steps():
    severity = np.array([0.0, 0.2, 0.4, 1.0])
    assert crossing(RECALL, 0.97, severity, np.array([1.0, 0.99, 0.95, 0.1])) == pytest.approx(0.3)
    assert crossing(CENTROID, 0.5, severity, np.array([0.1, 0.4, 0.6, np.nan])) == pytest.approx(0.3)
    assert crossing(RECALL, 0.97, severity, np.array([1.0, 1.0, 0.98, 0.97])) == np.inf
    assert crossing(RECALL, 0.97, severity, np.array([0.5, 1.0, 1.0, 1.0])) == 0.0


def test_curves_envelopes_and_their_comparison():
    case = DegradedCase((CONDITIONS["noise"],))
    rows = [
        {"case": "noise", "severity": s, "pipeline": p, "frame": f, **dict.fromkeys(("valid", "precision", "edges"), 1.0)}
        | {"recall": r, "centroid_px": 0.1, "swaps": 0.0, "area_error": 0.0}
        for p, recalls in (("a", (1.0, 1.0, 0.94)), ("b", (1.0, 0.94, 0.5)))
        for s, r in zip((0.0, 0.5, 1.0), recalls, strict=True)
        for f in ("x", "y")
    ]
    curves = curves_of(rows, (case,), pitch_px=10.0)
    envelopes = envelopes_of(curves, (case,))
    assert [round(e.severity, 6) for e in envelopes] == [0.75, 0.25] and {e.measure for e in envelopes} == {"recall"}
    assert compare(envelopes, "a", "b") == {"ours": "a", "theirs": "b", "cases": 1, "as_wide": 1, "twice": 1, "narrower": []}
    assert compare(envelopes, "b", "a")["narrower"] == ["noise"]
    band = next(c for c in curves if c.pipeline == "a" and c.measure is RECALL)
    assert (band.low <= band.mean + 1e-12).all() and (band.mean <= band.high + 1e-12).all()


def test_between_held_and_failed_it_is_bisected_until_they_are_near(spec, frames, monkeypatch, tmp_path):
    def rows(plan, *_, **__):
        row = {"frame": "x", "pipeline": "a", **dict.fromkeys(("valid", "precision", "edges"), 1.0), "centroid_px": 0.1, "swaps": 0.0}
        row["area_error"] = 0.0
        return [row | {"case": c.case.name, "severity": c.severity, "recall": 1.0 if c.severity < 0.31 else 0.5} for c in cells_of(plan)]

    monkeypatch.setattr("twin.evaluation.degradation.envelope.run_sweep", rows)
    plan = real_plan(spec, frames)
    (envelope,) = (e for e in evaluate_sweep(plan, tmp_path, jobs=1, progress=lambda *_: None).envelopes if e.case is plan.cases[0])
    assert envelope.held < 0.31 <= envelope.failed and envelope.failed - envelope.held <= NEAR * envelope.failed
    assert envelope.held <= envelope.severity <= envelope.failed and envelope.label.startswith("held at ")


def answer(value, half=0.1, valid=True):
    low, high = ([v + sign * half for v in value] for sign in (-1, 1))
    return {"value": value, "low": low, "high": high, "range": [5.0, 60.0], "units": ["mm", "deg"], "valid": valid}


@pytest.mark.parametrize(
    ("now", "wrong"),
    [
        (answer([1.25, 5.0]), 0),  # off by more than the interval, by less than its width
        (answer([1.35, 5.0]), 1),
        (answer([1.0, -5.0]), 1),
        (answer([1.35, 5.0], valid=False), 0),
        (answer([9.0, 5.0], half=0.84), 0),  # an interval wider than a third of the trained range says nothing
        (answer([9.0, 5.0], half=0.82), 1),
    ],
)
def test_a_confidently_wrong_pose_is_narrow_and_far_off(now, wrong):
    case = DegradedCase((CONDITIONS["noise"],))
    poses = {0.0: answer([1.0, 5.0]) | {"touched": True}, 1.0: now | {"touched": True}}
    rows = [{"case": "noise", "severity": s, "pipeline": "run", "frame": "x", "pose": pose} for s, pose in poses.items()]
    curve = next(c for c in curves_of(rows, (case,), pitch_px=10.0) if c.measure.name == "pose_wrong")
    assert curve.mean.tolist() == [0, wrong]


def test_poses_are_judged_against_the_undegraded_frame():
    case = DegradedCase((CONDITIONS["noise"],))
    rows = [
        {
            "case": "noise",
            "severity": s,
            "pipeline": "run",
            "frame": frame,
            "pose": answer([v, 5.0], valid=s < 1) | {"touched": frame == "x"},
        }
        for s, v in ((0.0, 1.0), (0.5, 1.3), (1.0, np.nan))
        for frame in ("x", "no contact")
    ]
    curves = {c.measure.name: c for c in curves_of(rows, (case,), pitch_px=10.0)}
    assert curves["pose_mm"].mean[:2] == pytest.approx([0.0, 0.3]) and np.isnan(curves["pose_mm"].mean[2])
    assert curves["pose_deg"].mean[1] == 0 and curves["pose_valid"].mean.tolist() == [1.0, 1.0, 0.0]


@pytest.fixture(scope="module")
def frames(spec, rest):
    return [drawn_frame(spec, Form.RAW, smooth_warp(rest, 4.0, np.random.default_rng(k)), name=f"drawn-{k}") for k in range(2)]


def real_plan(spec, frames):
    detectors = (shipped_detector(spec, Form.RAW), shipped_detector(spec, Form.RAW, "adaptive"))
    source, refused = consensus(spec, frames, list(detectors))
    assert not refused
    cases = tuple(DegradedCase((CONDITIONS[name],)) for name in ("hot-pixels", "wrong-crop")) + (
        DegradedCase((CONDITIONS["noise"], CONDITIONS["jpeg"])),
    )
    return SweepSettings(source, detectors, cases, (0.0, 0.3, 1.0))


def test_a_sweep_writes_its_page_and_goes_on_where_it_was(spec, frames, tmp_path, undrawn_charts):
    plan = real_plan(spec, frames[:1])
    counts = []

    judged = evaluate_sweep(plan, tmp_path, jobs=1, progress=lambda done, total: counts.append((done, total)))
    envelopes, written = judged.envelopes, write_report(tmp_path, judged, source="drawn", notes=[])
    assert all(path.stat().st_size for path in written)
    page = read_sound_page(written[0].read_text(encoding="utf-8"), tmp_path)
    assert all(case.title in page.text for case in plan.cases)
    assert "Narrower in" in page.text or "narrower in none" in page.text
    assert counts[0] == (0, 7) and (7, 7) in counts  # severity 0 is one cell for all
    assert counts[-1][0] == counts[-1][1] > 7  # between what is held and what fails, severities were added
    assert all(e.severity > 0 for e in envelopes if e.pipeline == "twin")
    assert all(e.middle is None for e in envelopes)
    assert all(e.reached for e in envelopes if e.case.name in ("wrong-crop", "noise+jpeg"))
    whole = {cell.file for cell in cells_of(plan)}
    cells = sorted(path for path in (tmp_path / "cells").iterdir() if path.stem in whole)
    kept = cells[0].stat().st_mtime_ns
    cells[1].write_text("{ torn")
    counts.clear()
    rows = run_sweep(plan, tmp_path, jobs=1, progress=lambda done, total: counts.append((done, total)))
    assert counts == [(6, 7), (7, 7)] and cells[0].stat().st_mtime_ns == kept
    assert len(rows) == 3 * 3 * 2
    assert json.loads(cells[1].read_text())


@pytest.mark.slow
def test_two_processes_find_what_one_does(spec, frames, tmp_path):
    plan = replace(real_plan(spec, frames), severities=(0.0, 1.0))
    rows = [run_sweep(plan, tmp_path / str(jobs), jobs=jobs, progress=lambda done, total: None) for jobs in (1, 2)]
    assert rows[0] == rows[1]


def levels_of_light(source):
    """A model in a sweep's hands: says how bright the frame is."""
    return {"meter": LightMeter()}


class LightMeter:
    form, label_range = Form.RAW, np.array([255.0])

    def __call__(self, frame):
        light = np.array([frame.image.mean()])
        return SimpleNamespace(value=light, low=light - 1, high=light + 1, units=("mm",), valid=True)


def test_models_are_asked_about_every_frame(spec, frames, tmp_path):
    plan = replace(real_plan(spec, frames), severities=(0.0, 1.0), models=levels_of_light, model_digests={"meter": "1"})
    rows = run_sweep(plan, tmp_path, jobs=1, progress=lambda done, total: None)
    asked = [row for row in rows if row["pipeline"] == "meter"]
    assert len(asked) == 3 * 2 * 2
    curves = curves_of(rows, plan.cases, pitch_px=19.0)
    brighter = next(c for c in curves if c.pipeline == "meter" and c.case == "hot-pixels" and c.measure.name == "pose_mm")
    assert brighter.mean[0] == 0 and brighter.mean[1] > 5


def test_cells_depend_on_what_they_were_computed_from(spec, frames):
    plan = real_plan(spec, frames)
    names = {cell.file for cell in cells_of(plan)}
    other = SweepSettings(plan.source, plan.detectors[:1], plan.cases, plan.severities)
    assert names.isdisjoint(cell.file for cell in cells_of(other))
    assert names == {cell.file for cell in cells_of(real_plan(spec, frames))}


def test_cells_are_those_of_their_weights_specification_and_code(spec, frames, monkeypatch):
    plan = replace(real_plan(spec, frames), model_digests={"meter": "1"})
    names = {cell.file for cell in cells_of(plan)}
    retrained = replace(plan, model_digests={"meter": "2"})
    assert names.isdisjoint(cell.file for cell in cells_of(retrained))
    softer = replace(plan.source, spec=changed(spec, gel={"poisson_ratio": spec.gel.poisson_ratio - 0.001}))
    assert names.isdisjoint(cell.file for cell in cells_of(replace(plan, source=softer)))
    monkeypatch.setattr("twin.store.resume.fingerprint", lambda *makers: "of another version")
    assert names.isdisjoint(cell.file for cell in cells_of(plan))


def test_undegraded_real_frames_stay_as_they_are(spec, frames, rest):
    source = RealSource(spec, tuple(frames), np.stack([rest, rest]))
    for condition in CONDITIONS.values():
        if condition.image_level:
            assert all(
                np.array_equal(s.frame.image, f.image) for s, f in zip(source.render(DegradedCase((condition,)), 0.0), frames, strict=True)
            )


def test_a_sweep_can_be_read_from_a_file(tmp_path):
    path = tmp_path / "sweep.toml"
    path.write_text('steps = [0.5, 0.1]\npairs = [["noise", "jpeg"]]\n[[condition]]\nname = "noise"\nsevere = 0.2\n')
    plan = load_plan(path)
    assert plan.severities() == (0.0, 0.1, 0.5)
    single, pair = plan.cases()
    assert single.conditions[0].value(1.0) == 0.2 and pair.name == "noise+jpeg" and pair.conditions[0].value(1.0) == 0.2
    assert len(SweepPlan().cases()) == len(CONDITIONS)
    path.write_text('[[condition]]\nname = "nois"\n')
    with pytest.raises(TwinError, match="did you mean 'noise'"):
        load_plan(path).cases()
    for text, says in (
        ('[[condition]]\nname = "noise"\nsevere = 3\n', "not between 0 .* and 0.4"),
        ('[[condition]]\nname = "resolution"\nsevere = 0.5\n', "not between 1 .* and 9 px"),
        ('[[condition]]\nname = "noise"\n[[condition]]\nname = "noise"\n', "named twice: noise"),
        ('pairs = [["noise", "jpeg"], ["jpeg", "noise"]]\n', "named twice: jpeg\\+noise"),
        ('pairs = [["noise", "noise"]]\n', "with itself"),
    ):
        path.write_text(text)
        with pytest.raises(TwinError, match=says):
            load_plan(path).cases()
    with pytest.raises(TwinError, match="No such file.*--help"):
        load_plan(tmp_path / "none.toml")
    path.write_text("stepps = [1]\n")
    with pytest.raises(TwinError, match="stepps"):
        load_plan(path)


def test_an_envelope_ends_at_the_severest_step(tmp_path):
    """A pipeline that never fails is as wide as the severest step, not as the condition's range."""
    case = DegradedCase((CONDITIONS["noise"],))
    rows = [
        {"case": "noise", "severity": s, "pipeline": "a", "frame": "x", **dict.fromkeys(("valid", "precision", "edges", "recall"), 1.0)}
        | {"centroid_px": 0.1, "swaps": 0.0, "area_error": 0.0}
        for s in (0.0, 0.35)
    ]
    (found,) = envelopes_of(curves_of(rows, (case,), pitch_px=10.0), (case,))
    assert not found.reached and found.width == 0.35 and found.label == "held at 0.14, the last step"
    assert replace(found, severity=0.0, failed=0.0, measure="recall").label == "fails undegraded"


def test_shares_tell_the_bad_side():
    case = DegradedCase((CONDITIONS["noise"],))
    whole, half = Envelope(case, "a", 0.8, "recall"), Envelope(case, "a", 0.4, "recall")
    assert shares_of([half], [whole], "a")[0].short and shares_of([half], [whole], "a")[0].value == 0.5
    assert not shares_of([whole], [half], "a")[0].short
    nothing = Envelope(case, "a", 0.0, "recall")
    assert shares_of([nothing], [nothing], "a")[0].value == 1.0 and shares_of([whole], [nothing], "a")[0].value == np.inf
    json.dumps(_share_row(shares_of([whole], [nothing], "a")[0]), allow_nan=False)  # JSON knows no infinity


def test_pipelines_are_checked_before_the_work(tmp_path):
    for names, says in (
        (["magic"], "magic: give one of twin"),
        ([str(tmp_path / "none.toml")], "No such file"),
        (["twin", "twin"], "a name of its own"),
        ([f"{tmp_path}/none.py:pins"], "none.py can't be read"),
    ):
        with pytest.raises(TwinError, match=says):
            check_pipelines(names)
    for models in (("run", "run"), ("twin",)):
        with pytest.raises(TwinError, match="`model`: each needs a name of its own"):
            check_pipelines(["twin"], models)
    check_pipelines(["twin"], ("run", "other"))


MINE = """
import cv2

def my_pins(image):
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    count, _, stats, middle = cv2.connectedComponentsWithStats((gray > LEVEL).astype("uint8"))
    return middle[1:][stats[1:, cv2.CC_STAT_AREA] < 400]

def careless(image):
    raise ValueError("not today")
"""


@pytest.mark.usefixtures("no_other_layout")
def test_code_of_the_user_is_judged_like_the_others(spec, frames, tmp_path, undrawn_charts):
    mine, recording = tmp_path / "mine.py", tmp_path / "frames"
    recording.mkdir()
    for frame in frames[:1]:
        cv2.imwrite(str(recording / f"{frame.name}.png"), frame.image)
    sweep = SweepPlan(steps=(1.0,), condition=(ConditionPlan(name="hot-pixels"),))
    level = int(np.mean([np.percentile(frame.image, 50) + frame.image.max() for frame in frames]) / 2)
    mine.write_text(f"LEVEL = {level}\n{MINE}")
    out = tmp_path / "out"
    out.mkdir()

    def recall(name):
        plan = degradation.DegradationPlan(spec, pipelines=(f"{mine}:{name}",), sweep=sweep, frames=recording, rendered=False)
        degradation.run(plan, out)
        rows = list(csv.DictReader((out / "frames.csv").read_text().splitlines()))
        return {float(row["severity"]): float(row["recall"]) for row in rows if row["pipeline"] == name}

    assert recall("my_pins")[0.0] == 1.0
    mine.write_text(f"LEVEL = 256\n{MINE}")  # the same function finds nothing now
    assert recall("my_pins")[0.0] == 0.0
    with pytest.raises(TwinError, match=r"undegraded frame .*: careless failed: ValueError: not today"):
        recall("careless")
    with pytest.raises(TwinError, match="careless failed"):
        degradation.run(
            degradation.DegradationPlan(spec, pipelines=(f"{mine}:careless",), sweep=sweep, frames=recording, rendered=False),
            tmp_path / "new",
        )
    assert not (tmp_path / "new").exists()
