"""How real the renders are, and what they cost."""

import json
from pathlib import Path

import numpy as np
from bench_render import CHOSEN, DRAWN, Bench

from figures.jobs import NO_RESIDUAL, Measured, Value, job, real_folder, run_twin
from scenes import load_sensor
from training.runs.residual import calibrate_residual
from twin.evaluation.pictures.compare import compare_images
from twin.frames import open_recording
from twin.optics.relief import DETAILS
from twin.simulator import Simulator
from twin.types import Form

RECORDED = {"mg400-331": "tac-vgnn-331", "mg400-127": "tac-vgnn-127"}
RENDERED = {"psnr_db": "dB", "psnr_gray_db": "dB", "ssim": "", "flip": "", "psnr_whole_db": "dB"}
REPEATS = 5
FITTED = 6
"""Frames of the folder to which the shipped specification was fitted."""


@job(
    "render.realism.ur5-331",
    "twin realism DIR --sensor ur5-331 --fitted 6 --thorough --out OUT",
    sensors=("ur5-331",),
    code=("training.studies.realism",),
    recordings=("ur5-331-raw",),
    minutes=23,
    beside=NO_RESIDUAL,
)
def realism(work: Path) -> Measured:
    """Unfitted frames, caps where they stand in the real ones: likeness, what is fixed to each cap, the worst radius."""
    metrics = judged(work, work / "realism", "--thorough")
    images, seen = metrics["pin_aligned"], metrics["statistics"]
    found = {name: Value(part["mean"], RENDERED.get(name, "px")) for name, part in images.items() if isinstance(part, dict)}
    found |= {"frames": Value(metrics["frames"]), "exact": Value(images["exact_fraction"])}
    found |= {f"worst_{name}": Value(value) for name, value in seen["worst_relative_difference"].items()}
    fixed = metrics["fixed_residual"]
    found |= {"fixed_share": Value(fixed["share"]), "caps_missed": Value(fixed["levels"], "gray levels")}
    noise = seen["scalars"]["noise_sd"]
    found |= {"noise_real": Value(noise["real"], "gray levels"), "noise_rendered": Value(noise["rendered"], "gray levels")}
    names = {
        "small": "told_apart",
        "stronger": "told_apart_stronger",
        "small, real halves": "told_apart_real",
        "stronger, real halves": "told_apart_real_stronger",
    }
    return found | {figure: Value(metrics["two_sample"][name]["accuracy"]) for name, figure in names.items()}


def judged(work: Path, out: Path, *options: str) -> dict:
    """The figures of ``twin realism`` with further options, on the frames to which the UR5's sensor was not fitted."""
    run_twin(work, "realism", real_folder("ur5-331-raw"), "--sensor", "ur5-331", "--fitted", str(FITTED), "--out", out, *options)
    return json.loads((out / "metrics.json").read_text())


@job(
    "render.residual.ur5-331",
    "training.runs.residual.calibrate_residual(DIR, load_sensor('ur5-331'), OUT)",
    sensors=("ur5-331",),
    code=("training.runs.residual",),
    recordings=("ur5-331-raw",),
    minutes=35,
    beside=NO_RESIDUAL,
)
def residual(work: Path) -> Measured:
    """The residual network, taught on half of the unfitted frames and evaluated on the other half: what the two-sample test tells of
    them."""
    found = calibrate_residual(real_folder("ur5-331-raw"), load_sensor("ur5-331"), work / "taught.toml", fitted=FITTED)
    tests = {"before": found.before, "after": found.after, "real": found.real}
    endings = {"small": "", "stronger": "_stronger"}
    told = {f"told_apart_{name}{endings[judge]}": Value(each.accuracy) for name, test in tests.items() for judge, each in test.items()}
    psnr = dict(zip(("psnr_before_db", "psnr_after_db"), (Value(value, "dB") for value in found.psnr_db), strict=True))
    shift = dict(zip(("shift_px", "shift_95_px"), (Value(value, "px") for value in found.shift_px), strict=True))
    return told | psnr | shift | {"frames": Value(found.frames)}


@job(
    "render.details",
    "twin realism DIR --sensor ur5-331 --fitted 6 --quality rasterised --without DETAIL --out OUT",
    sensors=("ur5-331",),
    code=("training.studies.realism",),
    recordings=("ur5-331-raw",),
    minutes=20,
    beside=NO_RESIDUAL,
)
def details(work: Path) -> Measured:
    """Ablation of each measured detail: likeness of rasterised pictures with all, and without each."""
    found: Measured = {}
    for name in ("all", *DETAILS):
        left_out = [] if name == "all" else ["--without", name]
        metrics = judged(work, work / name, "--quality", "rasterised", *left_out)
        found |= {f"{name}_{key}": Value(metrics["pin_aligned"][key]["mean"], unit) for key, unit in RENDERED.items()}
        found[f"{name}_told_apart"] = Value(metrics["two_sample"]["small"]["accuracy"])
    return found


@job("render.speed", "tests/bench/bench_render.py", sensors=("mg400-331", "ur5-331"), code=("bench_render",), minutes=8)
def speed(work: Path) -> Measured:
    """A frame of a data set, plain path tracing for the same errors in the same run, a large colour picture, and the preview."""
    bench = Bench("mg400-331", REPEATS)
    truth, rows = bench.samples()
    ratios = bench.plain(rows)
    _, wall_ms, _, _, centroid_px = next(row for row in rows if row[0] == CHOSEN)
    _, drawn_ms, _, drawn_gray, drawn_px = next(row for row in rows if row[0] == DRAWN)
    half_px = next(row for row in rows if row[0] == CHOSEN // 2)[4]
    preview_ms, preview_px = bench.preview(truth)
    return {
        "frame_s": Value(wall_ms / 1e3, "s"),
        "centroid_px": Value(centroid_px, "px"),
        "centroid_half_px": Value(half_px, "px"),
        "plain_ratio_centroids": Value(ratios[CHOSEN, "centroids"]),
        "plain_ratio_grays": Value(ratios[CHOSEN, "gray levels"]),
        "drawn_s": Value(drawn_ms / 1e3, "s"),
        "drawn_gray": Value(drawn_gray, "gray levels"),
        "drawn_px": Value(drawn_px, "px"),
        "plain_ratio_drawn_centroids": Value(ratios[DRAWN, "centroids"]),
        "plain_ratio_drawn_grays": Value(ratios[DRAWN, "gray levels"]),
        "photo_s": Value(bench.photo(), "s"),
        "preview_s": Value(preview_ms / 1e3, "s"),
        "preview_px": Value(preview_px, "px"),
    }


@job(
    "render.at_rest",
    "pytest -m slow -s tests/system/test_real.py",
    sensors=tuple(RECORDED),
    code=("twin.simulator", "twin.evaluation.pictures.compare"),
    recordings=tuple(RECORDED.values()),
    minutes=1,
)
def at_rest(work: Path) -> Measured:
    """SSIM of rendered and recorded frames without contact, in the recordings' thresholded form."""
    found = {}
    for name, recording in RECORDED.items():
        simulator = Simulator(load_sensor(name))
        recorded = open_recording(real_folder(recording), simulator.spec).reference.image
        rendered = simulator.render(simulator.rest, form=Form.PROCESSED).frame.image
        found[f"{name}_ssim"] = Value(compare_images(recorded, rendered, np.ones(recorded.shape[:2], bool)).ssim)
    return found
