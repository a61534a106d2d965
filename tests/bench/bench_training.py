"""Seconds an epoch and memory of the models against batch size, in one run, as ratios to tac-vgnn; beside the paper's ratios.

The frames are drawn from smooth motions of a sensor's own layout, as many as asked for: speed does not depend on what they show.
Graphs and features are built once, before the clock starts.
"""

import argparse

import numpy as np
import torch

from scenes import load_sensor
from training.data.pins import PinTable
from training.models import model_named
from training.models.part import ArrayInputs, Inputs, PinModel
from training.studies.tac_vgnn.models import measure_training
from twin.pins import make_graph, nominal_reference
from twin.types import Form

PAPER_RATIO = {"gnn": 0.86 / 1.05, "tac-vgnn": 1.0, "cnn-v1": "about 10", "cnn-v2": "2 to 3"}
DRAWN = 200  # different graphs; repeated up to the number of frames


def drawn_table(sensor: str, frames: int) -> PinTable:
    spec = load_sensor(sensor)
    reference = nominal_reference(spec, Form.PROCESSED)
    rng = np.random.default_rng(0)
    rest, n = reference.pins_px, spec.pins.count
    wave = np.sin((rest - rest.mean(axis=0)) / 40)
    nodes = rest + rng.normal(0, 2, (DRAWN, 1, 2)) + rng.normal(0, 2, (DRAWN, 1, 1)) * wave + rng.normal(0, 0.1, (DRAWN, n, 2))
    area = np.stack([make_graph("voronoi", frame, outmost=reference.outmost).area_px2 for frame in nodes])
    take = np.arange(frames) % DRAWN
    none = np.zeros((frames, n), bool)
    return PinTable(spec, Form.PROCESSED, reference, take.astype(str), nodes[take], area[take], none, np.ones(frames, bool))


def inputs_of(name: str, pins: PinTable) -> Inputs:
    model = model_named(name)
    if isinstance(model, PinModel):
        return model.prepare_pins(pins, np.arange(len(pins))).inputs
    return ArrayInputs(np.random.default_rng(0).integers(0, 256, (len(pins), 128, 128), dtype=np.uint8))


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
    print(f"{given.sensor}, {given.frames} frames, {given.threads} threads; of convolutional networks some batches are timed")
    baseline = {}
    for model in sorted(given.models, key=lambda name: name != "tac-vgnn"):
        inputs = inputs_of(model, pins)
        for batch in given.batches:
            found = measure_training(model, pins, inputs, batch)
            ms = found["ms_per_frame"]
            baseline.setdefault(batch, ms)
            epoch = "" if found["s_per_epoch"] is None else f" ({found['s_per_epoch']:.2f} s an epoch)"
            cost = f"{ms:8.3f} ms a frame{epoch}, {found['memory_mib']:6.0f} MiB, {ms / baseline[batch]:.2f} times tac-vgnn"
            print(f"{model:10} {found['parameters']:8} parameters, batch {batch:4}: {cost} (paper: {PAPER_RATIO.get(model, '-')})")


if __name__ == "__main__":
    main()
