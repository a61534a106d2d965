"""Seconds an epoch and memory of the models against batch size, in one run, as ratios to tac-vgnn; beside the paper's ratios.

The frames are drawn from smooth motions of a sensor's own layout, as many as asked for: speed does not depend on what they show.
Graphs and features are built once, before the clock starts.
"""

import argparse
import gc
import threading
import time
from pathlib import Path

import numpy as np
import torch

from scenes import load_sensor
from training.dataset import PinTable
from training.inputs import ImageInputs, PinInputs, graph_inputs, pin_features
from training.loop import Loop, Rows
from training.networks import build_network, parameter_count
from training.recipes import recipe_of
from twin.preprocess import make_graph, nominal_reference
from twin.preprocess.forms import frame_size
from twin.types import Form

PAPER_RATIO = {"gnn": 0.86 / 1.05, "tac-vgnn": 1.0, "cnn-v1": "about 10", "cnn-v2": "2 to 3"}
DRAWN = 200  # different graphs; repeated up to the number of frames


def drawn_table(sensor: str, frames: int) -> PinTable:
    spec = load_sensor(sensor)
    reference = nominal_reference(spec, Form.RECORDING)
    rng = np.random.default_rng(0)
    rest, n = reference.pins_px, spec.pins.count
    wave = np.sin((rest - rest.mean(axis=0)) / 40)
    nodes = rest + rng.normal(0, 2, (DRAWN, 1, 2)) + rng.normal(0, 2, (DRAWN, 1, 1)) * wave + rng.normal(0, 0.1, (DRAWN, n, 2))
    area = np.stack([make_graph("voronoi", frame, outmost=reference.outmost).area_px2 for frame in nodes])
    take = np.arange(frames) % DRAWN
    none = np.zeros((frames, n), bool)
    return PinTable(spec, Form.RECORDING, reference, take.astype(str), nodes[take], area[take], none, np.ones(frames, bool))


def inputs_of(model: str, pins: PinTable):
    if model == "vgnn":
        return PinInputs(pin_features(pins.nodes_px, pins.area_px2, pins.reference), pins.lost)
    if model.startswith("cnn"):
        return ImageInputs(np.random.default_rng(0).integers(0, 256, (len(pins), 128, 128), dtype=np.uint8))
    return graph_inputs(model, pins, frame_size(pins.sensor, pins.form)[0])


class PeakMemory:
    """The process's largest resident set while it is watched, in MB, above what it was at the start."""

    def __enter__(self):
        gc.collect()
        self.start, self.peak, self.watching = self._now(), 0.0, True
        self.thread = threading.Thread(target=self._watch, daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.watching = False
        self.thread.join()

    def _watch(self):
        while self.watching:
            self.peak = max(self.peak, self._now() - self.start)
            time.sleep(0.01)

    @staticmethod
    def _now() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def measure(model: str, pins: PinTable, inputs, batch: int, rows: int) -> tuple[float, float]:
    """Seconds for an epoch over all frames (from ``rows`` of them), and peak MB."""
    torch.manual_seed(0)
    network = build_network(model, pins.reference, 2)
    if hasattr(network, "prepare"):
        network.prepare(inputs.x[:500])
    labels = torch.randn(len(pins), 2)
    executed = torch.full((len(pins),), torch.nan)
    recipe = recipe_of(model, batch=batch)
    none = torch.zeros(0, dtype=torch.long)
    loop = Loop(network, recipe, Rows(inputs, labels, torch.ones(2), executed, torch.arange(min(rows, len(pins))), none), 0)
    with PeakMemory() as memory:
        loop.epoch()
        point = loop.epoch()
    return point["seconds"] * len(pins) / min(rows, len(pins)), memory.peak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="mg400-127")
    parser.add_argument("--frames", type=int, default=3763)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--models", nargs="+", default=["gnn", "tac-vgnn", "vgnn", "cnn-v2", "cnn-v1"])
    parser.add_argument("--batches", nargs="+", type=int, default=[64, 256, 512])
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    pins = drawn_table(given.sensor, given.frames)
    print(f"{given.sensor}, {given.frames} frames, {given.threads} threads; cnn-v1 timed on two batches, others on whole epochs")
    baseline = {}
    for model in sorted(given.models, key=lambda name: name != "tac-vgnn"):
        inputs = inputs_of(model, pins)
        for batch in given.batches:
            rows = {"cnn-v1": 2 * batch, "cnn-v2": 4 * batch}.get(model, len(pins))
            seconds, peak = measure(model, pins, inputs, batch, rows)
            baseline.setdefault(batch, seconds)
            count = parameter_count(build_network(model, pins.reference, 2))
            print(
                f"{model:10} {count:8} parameters, batch {batch:4}: {seconds:7.2f} s an epoch, {peak:6.0f} MB, "
                f"{seconds / baseline[batch]:.2f} times tac-vgnn (paper: {PAPER_RATIO.get(model, '-')})"
            )


if __name__ == "__main__":
    main()
