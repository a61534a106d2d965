"""A small labelled data set of drawn pins: what a model is trained on where only the way it takes matters."""

from pathlib import Path

import numpy as np

from scenes import load_sensor
from training.data.dataset import Dataset
from training.data.pins import PinTable
from training.data.targets import Targets
from training.models import recipe_of
from training.runs.config import RunConfig
from twin.pins import make_graph, nominal_reference
from twin.types import Form

FRAMES = 90


def drawn_pins(labels, reference):
    """Pins (M, N, 2) that follow four labels smoothly: a bump that grows with depth, moves with angle and shear."""
    rest = reference.pins_px
    r = (rest - rest.mean(axis=0)) / np.linalg.norm(rest - rest.mean(axis=0), axis=1).max()
    depth, angle, shear, turn = (labels / [4, 20, 5, 5]).T[:, :, None]
    middle = np.stack([0.2 * angle, 0 * angle], axis=-1)
    bump = np.exp(-4 * ((r - middle) ** 2).sum(axis=2))[..., None]
    spun = np.stack([-r[:, 1], r[:, 0]], axis=1)
    moved = (
        5 * (1.2 + depth)[..., None] * bump * (6 * (r - middle) + 4 * np.stack([shear, 0.1 * shear], axis=-1) + 3 * turn[..., None] * spun)
    )
    return rest + moved


def drawn_dataset(folder: Path) -> Dataset:
    """``FRAMES`` frames of ``mg400-127`` with depth and angle as labels; three of ten moves were not executed."""
    spec = load_sensor("mg400-127")
    reference = nominal_reference(spec, Form.PROCESSED)
    rng = np.random.default_rng(0)
    raw = np.column_stack([rng.uniform(-4, 0, FRAMES), rng.uniform(-20, 20, FRAMES), rng.uniform(-5, 5, (FRAMES, 2))])
    executed = (rng.random(FRAMES) < 0.7).astype(float)
    true = raw * np.column_stack([np.ones((FRAMES, 2)), executed, executed])
    true[:, 1] -= (1 - executed) * raw[:, 3]
    nodes = drawn_pins(true, reference) + rng.normal(0, 0.02, (FRAMES, 127, 2))
    area = np.stack([make_graph("voronoi", n, outmost=reference.outmost).area_px2 for n in nodes])
    names = np.array([f"f_{k}.png" for k in range(FRAMES)])
    pins = PinTable(spec, Form.PROCESSED, reference, names, nodes, area, np.zeros((FRAMES, 127), bool), np.ones(FRAMES, bool))
    targets = Targets(("pose_2", "pose_6"), raw[:, :2], true[:, :2], executed, raw[:, 2:])
    return Dataset(pins, targets, (folder,))


def config_of(model: str, **recipe) -> RunConfig:
    """A model's recipe with some settings changed; `vgnn` as small as the rasterised frames need it."""
    size = {"width": 16, "modes": 8, "area_modes": 4, "channels": 2, "frequencies": 3} if model == "vgnn" else {}
    return RunConfig(model, recipe_of(model, **recipe), size=size)
