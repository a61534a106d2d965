"""Time the preview, and compare its frames with path-traced ones in the same run.

Run: python tests/bench/bench_preview.py [--sensor mg400-331] [--frames 100] [--spp 64] [--indent-mm 2]. One thread.
"""

import argparse
import os
import sys
from pathlib import Path
from time import perf_counter

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[2]))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from scenes import load_object, load_sensor  # noqa: E402
from twin.camera import expose  # noqa: E402
from twin.mechanics.path import ContactPose  # noqa: E402
from twin.mechanics.solver import SkinSolver  # noqa: E402
from twin.optics.preview import Preview  # noqa: E402
from twin.optics.render import Renderer  # noqa: E402
from twin.projection import project  # noqa: E402

WARM_UP = 3
SPOT = 0.5  # of the distance to the next cap: what counts to a cap's centroid
SKIN_SHARE = 20  # percentile of the gray levels around a cap that is skin


def median_ms(frames, call):
    """Median time of a call over frames, after a few."""
    taken = []
    for _ in range(WARM_UP + frames):
        start = perf_counter()
        call()
        taken.append(1e3 * (perf_counter() - start))
    return np.median(taken[WARM_UP:])


def centroids(gray, places_px):
    """Centroids (N, 2) of what is brighter than half way between each cap and the skin around it."""
    apart = np.linalg.norm(places_px[:, None] - places_px, axis=2) + 1e9 * np.eye(len(places_px))
    y, x = np.mgrid[: gray.shape[0], : gray.shape[1]]
    found = []
    for (u, v), near in zip(places_px, SPOT * apart.min(axis=1), strict=True):
        box = np.s_[max(int(v - near), 0) : int(v + near) + 2, max(int(u - near), 0) : int(u + near) + 2]
        inside = np.hypot(x[box] - u, y[box] - v) < near
        level = np.percentile(gray[box][inside], (SKIN_SHARE, 100)).mean()
        weight = np.where(inside, np.maximum(gray[box] - level, 0), 0)
        found.append([(weight * x[box]).sum() / weight.sum(), (weight * y[box]).sum() / weight.sum()])
    return np.array(found)


def compare(spec, preview, traced, state):
    """Rms of gray levels within the sensor's mask, and of the caps' centroids (px), of noiseless frames."""
    origin = preview.window_px[:2]
    grays = [expose(linear, spec, origin_px=origin).astype(float) for linear in (preview.render(state), traced)]
    grays = [gray.mean(axis=2) if gray.ndim == 3 else gray for gray in grays]
    mask, (cx, cy) = spec.pipeline.raw, np.array(spec.pipeline.raw.mask_center_px) - origin
    y, x = np.mgrid[: grays[0].shape[0], : grays[0].shape[1]]
    inside = np.hypot(x - cx, y - cy) < mask.mask_radius_px
    places = project(spec, state.caps_mm) - origin
    apart = np.linalg.norm(np.subtract(*(centroids(gray, places) for gray in grays)), axis=1)
    return np.sqrt(np.mean((grays[0] - grays[1])[inside] ** 2)), np.sqrt(np.mean(apart**2)), np.median(apart)


def main():
    """Print ms per frame, and the differences at rest and under a ball."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensor", default="mg400-331")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--indent-mm", type=float, default=2.0)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    spec = load_sensor(options.sensor)
    window = spec.recording.crop_px if spec.recording else (0, 0, spec.camera.width_px, spec.camera.height_px)
    start = perf_counter()
    preview = Preview(spec, window_px=window)
    print(f"{spec.name}, {preview.render().shape[1]} x {preview.render().shape[0]} px, built in {perf_counter() - start:.1f} s")
    rng, linear = np.random.default_rng(0), preview.render()
    draw = median_ms(options.frames, preview.render)
    shoot = median_ms(options.frames, lambda: expose(linear, spec, rng, origin_px=window[:2]))
    print(f"ms per frame, one thread: drawn {draw:.1f}, exposed {shoot:.1f}, together {draw + shoot:.1f}")

    solver = SkinSolver(spec)
    states = {"at rest": solver.rest(), "pressed": solver.press(load_object("sphere"), ContactPose(indent_mm=options.indent_mm))}
    renderer = Renderer(spec, window_px=window, spp=options.spp, mesh=solver.mesh)
    start = perf_counter()
    traced = {name: renderer.render(state) for name, state in states.items()}
    print(f"path-traced with {options.spp} samples in {1e3 * (perf_counter() - start) / len(states):.0f} ms per frame with compilation")
    for title in ("direct light alone", "calibrated"):
        for name, state in states.items():
            gray, rms, median = compare(spec, preview, traced[name], state)
            print(f"{title}, {name}: gray levels {gray:.2f} rms, centroids {rms:.3f} px rms, {median:.3f} px median")
        preview.calibrate(renderer)


if __name__ == "__main__":
    main()
