"""Time the renderer: error against samples, beside plain path tracing and the preview; film, pins and threads; memory.

Run by ``make bench``, or: PYTHONPATH=.:tests/helpers python tests/bench/bench_render.py [--sensor mg400-331] [--repeats 5] [--leak 2000].
All in one process, so that the ratios mean something where the times do not. Times are medians, of wall-clock and of all threads' CPU
time, which a busy machine changes less: ratios are of the latter. A frame is a new state: vertices moved, light traced, exposed. Errors
are those of gray levels and of the caps' centroids, of noiseless frames.
"""

import argparse
import os
import platform
from functools import partial
from time import perf_counter

import numpy as np
from image_error import Truth, memory_mb, timed_ms
from plain_path import PlainPath
from scaled_sensor import scaled

from scenes import load_object, load_sensor
from scenes.sensor import SensorSpec
from twin.camera.capture import expose
from twin.camera.projection import project
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.optics.preview import Preview
from twin.optics.render import Renderer

LADDER, CONVERGED = (1, 2, 4, 8, 16), 256  # samples per pixel
PLAIN_LADDER, PLAIN_CONVERGED = (4, 16, 64), 256
CHOSEN = 4  # samples per pixel at which ours is compared with plain path tracing
DRAWN = 0  # samples of a rasterised picture
FRAME_MS, CENTROID_PX = 250, 0.1  # what a frame of a data set may cost, and be wrong
INDENT_MM = 2.0
HEAD = f"{'samples':>8s}{'ms a frame':>12s}{'CPU ms':>8s}{'gray rms':>10s}{'px rms':>8s}"


class Bench:
    """One sensor with a ball pressed into it, seen through the window of its recordings."""

    def __init__(self, sensor: str, repeats: int):
        self.spec, self.repeats = load_sensor(sensor), repeats
        camera = self.spec.camera
        self.window = self.spec.recording.crop_px if self.spec.recording else (0, 0, camera.width_px, camera.height_px)
        self.solver = SkinSolver(self.spec)
        self.states = [self.solver.rest(), self.solver.press(load_object("sphere"), ContactPose(indent_mm=INDENT_MM))]

    def renderer(self, spp: int, spec: SensorSpec | None = None, window=None) -> Renderer:
        """Of the bench's mesh; another film may be asked for."""
        return Renderer(spec or self.spec, spp=spp, window_px=window or self.window, mesh=self.solver.mesh)

    def frame(self, renderer: Renderer, k: int) -> np.ndarray:
        """A frame of a state that the one before was not of."""
        return expose(
            renderer.render(self.states[k % 2], seed=k), renderer.spec.capture, np.random.default_rng(k), origin_px=renderer.window_px[:2]
        )

    def truth(self, linear: np.ndarray) -> Truth:
        """A converged picture of the pressed sensor."""
        mask, origin = self.spec.pipeline.raw, np.array(self.window[:2])
        places = project(self.spec.view, self.states[1].caps_mm) - origin
        return Truth(self.spec, linear, places, np.array(mask.mask_center_px) - origin, mask.mask_radius_px)

    def samples(self) -> tuple[Truth, list]:
        """Print time and errors against samples; what was converged, and the rows (samples, ms, CPU ms, gray levels, centroids)."""
        truth, rows = self.truth(self.renderer(CONVERGED).render(self.states[1], seed=999)), []
        print(f"\n{self.spec.name}, window {self.window}, against {CONVERGED} samples per pixel")
        print(f"{HEAD}{'median':>8s}{'of the CPU ms moving':>22s}{'exposing':>10s}")
        for spp in LADDER:
            renderer = self.renderer(spp)
            wall, cpu = timed_ms(partial(self.frame, renderer), self.repeats)
            _, moving = timed_ms(lambda k, r=renderer: r._view.move(r.surfaces(self.states[k % 2])), self.repeats)
            linear = renderer.render(self.states[1], seed=1)
            _, exposing = timed_ms(lambda k, image=linear: expose(image, self.spec.capture, np.random.default_rng(k)), self.repeats)
            gray, rms, median = truth.errors(linear)
            rows.append((spp, wall, cpu, gray, rms))
            print(f"{spp:8d}{wall:12.0f}{cpu:8.0f}{moving:8.0f}{exposing:10.1f}{gray:10.2f}{rms:8.3f}{median:8.3f}", flush=True)
        renderer = Renderer(self.spec, quality="rasterised", window_px=self.window)
        wall, cpu = timed_ms(partial(self.frame, renderer), 4 * self.repeats)
        gray, rms, median = truth.errors(renderer.render(self.states[1]))
        rows.append((DRAWN, wall, cpu, gray, rms))
        print(f"{'drawn':>8s}{wall:12.0f}{cpu:8.0f}{'':18s}{gray:10.2f}{rms:8.3f}{median:8.3f}", flush=True)
        good = ["rasterised" if spp == DRAWN else spp for spp, wall, _, _, rms in rows if wall <= FRAME_MS and rms <= CENTROID_PX]
        print(f"within {FRAME_MS} ms and {CENTROID_PX} px: {', '.join(map(str, good)) or 'none'} samples")
        return truth, rows

    def plain(self, rows: list) -> dict[tuple[int, str], float]:
        """Print what plain path tracing needs for the same errors against its own converged picture; how many times ours, by error."""
        plain = PlainPath(self.renderer(1), self.window[2] - self.window[0])
        state, theirs = self.states[1], []
        mask = self.spec.pipeline.raw
        middle = np.full(2, (plain.size_px - 1) / 2)
        converged = np.mean([plain.render(state, PLAIN_CONVERGED // 8, 999 + k) for k in range(8)], axis=0)
        truth = Truth(self.spec, converged, plain.project(state.caps_mm), middle, mask.mask_radius_px)
        print(f"\nplain path tracing, against {PLAIN_CONVERGED} samples")
        print(HEAD)
        for spp in PLAIN_LADDER:
            wall, cpu = timed_ms(lambda k, n=spp: expose(plain.render(self.states[k % 2], n, k), self.spec.capture), self.repeats)
            gray, rms, _ = truth.errors(plain.render(state, spp, seed=1))
            theirs.append((spp, wall, cpu, gray, rms))
            print(f"{spp:8d}{wall:12.0f}{cpu:8.0f}{gray:10.2f}{rms:8.3f}", flush=True)
        ratios = {}
        for spp, of in ((CHOSEN, f"{CHOSEN} samples"), (DRAWN, "rasterised picture")):
            _, _, our_ms, *ours = next(row for row in rows if row[0] == spp)
            for name, column, error in zip(("gray levels", "centroids"), (3, 4), ours, strict=True):
                needed = time_for(theirs, column, error)
                print(f"for the {name} of our {of} ({error:.3f}): {needed:.0f} CPU ms, {needed / our_ms:.1f} times ours")
                ratios[spp, name] = needed / our_ms
        return ratios

    def photo(self) -> float:
        """Print the time of a large coloured picture of the highest quality; s of wall-clock time."""
        renderer = Renderer(load_sensor("ur5-331"), quality="high")
        wall, cpu = timed_ms(lambda k: renderer.render(seed=k), 2, warm_up=1)
        print(f"\nur5-331 in colour, 640 x 480 px, quality 'high' ({renderer.spp} samples): {wall / 1e3:.1f} s, {cpu / 1e3:.1f} CPU s")
        return wall / 1e3

    def preview(self, truth: Truth) -> tuple[float, float]:
        """Print the preview's time and errors, with direct light alone and calibrated; ms a frame and centroids' rms error in px."""
        start = perf_counter()
        preview = Preview(self.spec, window_px=self.window)
        shape, built = preview.render().shape, perf_counter() - start
        preview.calibrate(self.renderer(64))
        wall, cpu = timed_ms(
            lambda k: expose(preview.render(self.states[k % 2]), self.spec.capture, np.random.default_rng(k)), 10 * self.repeats
        )
        gray, rms, median = truth.errors(preview.render(self.states[1]))
        print(f"\npreview {shape[1]} x {shape[0]} px, built in {built:.1f} s")
        print(f"{wall:.1f} ms a frame ({1e3 / wall:.0f} per s), {cpu:.1f} CPU ms")
        print(f"against the path-traced frame: gray {gray:.2f} rms, centroids {rms:.3f} px rms, {median:.3f} px median")
        return wall, rms

    def scaling(self) -> None:
        """Print times against film, samples and pins (ratios to the first row), and threads."""
        import drjit as dr

        print(f"\n{'film':>12s}{'samples':>9s}{'ms a frame':>12s}{'CPU ms':>8s}")
        for scale in (0.5, 1.0, 2.0):
            spec, window = scaled(self.spec, scale), tuple(int(scale * v) for v in self.window)
            for spp in (CHOSEN, 8 * CHOSEN):
                wall, cpu = timed_ms(partial(self.frame, self.renderer(spp, spec, window)), self.repeats)
                film = f"{window[2] - window[0]} x {window[3] - window[1]}"
                print(f"{film:>12s}{spp:9d}{wall:12.0f}{cpu:8.0f}", flush=True)
        renderer, threads = self.renderer(16), dr.thread_count()
        for count in sorted({1, 2, threads}):
            dr.set_thread_count(count)
            wall, cpu = timed_ms(partial(self.frame, renderer), self.repeats)
            print(f"{count} threads, 16 samples: {wall:.0f} ms a frame, {cpu:.0f} CPU ms", flush=True)
        dr.set_thread_count(threads)

    def leak(self, frames: int) -> None:
        """Print the memory before and after many small frames."""
        spec = scaled(self.spec, 0.25)
        renderer = self.renderer(1, spec, tuple(int(0.25 * v) for v in self.window))
        for k in range(frames + 1):
            self.frame(renderer, k)
            if k % max(frames // 4, 1) == 0:
                print(f"after {k:5d} frames: {memory_mb()[0]:.0f} MB", flush=True)


def time_for(rows: list, column: int, error: float) -> float:
    """CPU ms after which an error is reached: a power law between the nearest rows, and beyond the last two."""
    known, cost = np.log([row[column] for row in rows]), np.log([row[2] for row in rows])
    k = int(np.clip(np.searchsorted(-known, -np.log(error)), 1, len(rows) - 1))
    share = (np.log(error) - known[k - 1]) / (known[k] - known[k - 1])
    return float(np.exp(cost[k - 1] + share * (cost[k] - cost[k - 1])))


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensor", default="mg400-331")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--leak", type=int, default=0, help="only render this many small frames, and tell the memory")
    options = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}")
    bench = Bench(options.sensor, options.repeats)
    if options.leak:
        bench.leak(options.leak)
        return
    truth, rows = bench.samples()
    bench.plain(rows)
    bench.preview(truth)
    bench.scaling()
    other = Bench("mg400-127", options.repeats)
    many, few = (timed_ms(partial(b.frame, b.renderer(CHOSEN)), options.repeats)[1] for b in (bench, other))
    print(f"{other.spec.pins.count} pins instead of {bench.spec.pins.count}: {few / many:.2f} of the CPU time")
    bench.photo()
    print("memory: {:.0f} MB, at most {:.0f} MB; load average {:.1f}".format(*memory_mb(), os.getloadavg()[0]))


if __name__ == "__main__":
    main()
