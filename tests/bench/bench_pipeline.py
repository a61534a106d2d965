"""Time the pipeline against the published method, frame by frame in the same run and thread; and consecutive frames.

Each frame is processed three times by each method, and its time is the median: once in a while another process takes the core.
Recorded contacts are in no order. Consecutive frames are made of them: each is followed by the one whose pins moved least.

Run by ``make bench``, or: PYTHONPATH=.:tests/helpers python tests/bench/bench_pipeline.py [--sensor mg400-331] [--frames 200]. It takes
the recordings named by TACTIP_REAL (default ../shared/real) where they are, else rasterised frames.
"""

import argparse
import os
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).parents[2]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from baseline_release import Baseline  # noqa: E402
from drawn_frames import drawn_frame, smooth_warp  # noqa: E402

from scenes import load_sensor  # noqa: E402
from twin.frames import open_recording  # noqa: E402
from twin.pins import Pipeline, node_features, nominal_reference  # noqa: E402
from twin.types import Form  # noqa: E402

FOLDERS = {"mg400-331": "tac-vgnn-331", "mg400-127": "tac-vgnn-127"}
WARM_UP, PASSES = 5, 3


def take_frames(spec, count):
    """Up to ``count`` frames spread over the recording, or drawn ones; and what they are."""
    folder = Path(os.environ.get("TACTIP_REAL", ROOT / "../shared/real")) / FOLDERS[spec.name]
    if folder.is_dir():
        recording = open_recording(folder, spec)
        picked = np.linspace(0, len(recording) - 1, min(count, len(recording))).astype(int)
        return [recording.read(k) for k in picked], f"recorded frames ({folder.name})"
    rng = np.random.default_rng(0)
    rest = nominal_reference(spec, Form.PROCESSED)
    pitch = rest.spacing_px.mean()
    frames = [drawn_frame(spec, Form.PROCESSED, smooth_warp(rest.pins_px, rng.uniform(0, pitch), rng)) for _ in range(count)]
    return frames, "rasterised frames (no recordings found; set TACTIP_REAL)"


def timed(call, *arguments):
    """Result of a call, and its time in ms."""
    start = perf_counter()
    result = call(*arguments)
    return result, 1e3 * (perf_counter() - start)


@dataclass(frozen=True)
class Times:
    """ms of every frame by stage, ours and the published method's, and what the frames are.

    ``sequence`` has the ms of consecutive frames, and ``same`` the share of them whose pins are those of the frame alone, to the last bit.
    """

    what: str
    ours: dict[str, list[float]]
    theirs: dict[str, list[float]]
    sequence: list[float]
    same: float

    @property
    def ours_ms(self) -> float:
        """Median of pins, areas and graph together."""
        return float(np.median(self.ours["total"]))

    @property
    def ratio(self) -> float:
        """Of the median totals, published method to ours."""
        return float(np.median(self.theirs["total"])) / self.ours_ms


def measure(sensor: str, count: int) -> Times:
    """Times of both methods on the same frames, one after the other, on one thread."""
    cv2.setNumThreads(1)
    spec = load_sensor(sensor)
    frames, what = take_frames(spec, count)
    pipeline, baseline = Pipeline(spec, Form.PROCESSED), Baseline(spec)
    ours: dict[str, list[float]] = {}
    theirs: dict[str, list[float]] = {}
    observed = []
    for k, frame in enumerate(frames[:1] * WARM_UP + frames):
        passes: list[dict[str, float]] = []
        for _ in range(PASSES):
            observation, total = timed(pipeline, frame)
            _, feature_ms = timed(node_features, observation.graph, pipeline.reference) if observation.valid else (None, 0.0)
            nodes, detect_ms = timed(baseline.detect, frame.image)
            _, graph_ms = timed(baseline.graph, nodes)
            their = {"detect": detect_ms, "graph": graph_ms, "total": detect_ms + graph_ms}
            own = {**observation.ms, "features": feature_ms, "total": total + feature_ms}
            passes.append({f"ours {stage}": ms for stage, ms in own.items()} | {f"theirs {stage}": ms for stage, ms in their.items()})
        if k >= WARM_UP:
            observed.append(observation)
            for name in passes[0]:
                whose, _, stage = name.partition(" ")
                (ours if whose == "ours" else theirs).setdefault(stage, []).append(float(np.median([one[name] for one in passes])))
    sequence, same = time_sequence(pipeline, frames, observed)
    return Times(f"{len(frames)} {what}, {spec.name}", ours, theirs, sequence, same)


def time_sequence(pipeline, frames, observed):
    """The ms of frames in an order in which their pins move least, and the share of them with the same pins as alone."""
    order, left = [0], set(range(1, len(frames)))
    nodes_px = [seen.graph.nodes_px if seen.valid else np.full((pipeline.spec.pins.count, 2), np.inf) for seen in observed]
    while left:
        order.append(min(left, key=lambda k: np.abs(nodes_px[k] - nodes_px[order[-1]]).max()))
        left.remove(order[-1])
    spent_ms, same = [], []
    for _ in range(PASSES):
        following = pipeline.with_history()
        spent_ms.append([])
        for k in order[:1] * WARM_UP + order:
            seen, ms = timed(following, frames[k])
            spent_ms[-1].append(ms)
            same.append(np.array_equal(seen.pins_px, observed[k].pins_px, equal_nan=True))
    return np.median(spent_ms, axis=0)[WARM_UP:].tolist(), float(np.mean(same))


def main() -> None:
    """Print p50, p95, p99 of every stage and the ratio of the medians."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensor", choices=FOLDERS, default="mg400-331")
    parser.add_argument("--frames", type=int, default=200)
    options = parser.parse_args()
    found = measure(options.sensor, options.frames)
    print(f"{found.what}, one thread, ms per frame")
    print(f"{'':24s}{'p50':>9s}{'p95':>9s}{'p99':>9s}")
    for title, stages in (("pipeline", found.ours), ("published method", found.theirs)):
        for stage, ms in stages.items():
            print(f"{title + ' ' + stage:24s}" + "".join(f"{value:9.3f}" for value in np.percentile(ms, (50, 95, 99))))
    print(f"{'consecutive frames':24s}" + "".join(f"{value:9.3f}" for value in np.percentile(found.sequence, (50, 95, 99))))
    print(f"pins of consecutive frames as alone: {found.same:.1%}")
    print(f"ratio of the median totals: {found.ratio:.1f}")


if __name__ == "__main__":
    main()
