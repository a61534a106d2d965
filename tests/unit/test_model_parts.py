"""A model is one part: it is registered by one line, nobody else asks for its name, and what it can't do it says."""

import ast
import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from drawn_frames import drawn_frame
from drawn_recording import config_of, drawn_pins
from torch import nn

from training.data.pins import PinTable
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.models import MODELS, model_named, recipe_of, register, variant_named
from training.models.part import PinModel, Recipe
from training.models.vgnn.model import mode_components
from training.models.vgnn.registration import count_modes, fit_registration
from training.runs.config import RunConfig
from training.runs.run import train_run
from training.runs.run_files import SHIPPED, WEIGHTS, pack, shipped_names
from training.studies.judging import measure_errors, rows_to_evaluate
from twin.errors import FrameError
from twin.pins import make_graph
from twin.types import Form, Frame

ROOT = Path(__file__).parents[2]
LEARNT = 0.75  # of the error of who knows nothing: the pins' motion is no straight line of the labels, so that much is left (0.6)
SINGLE = 1e-3  # mm or deg: single precision, summed in another order on another processor


class FlatPins:
    """Displacements in mean spacings, one row a frame."""

    def __init__(self, moved):
        self.x = torch.from_numpy(moved.reshape(len(moved), -1).astype(np.float32))

    def __len__(self):
        return len(self.x)

    def batch(self, rows):
        return (self.x[rows],)


class Straight(nn.Module):
    def __init__(self, pins, outputs):
        super().__init__()
        self.layer = nn.Linear(2 * pins, outputs)
        nn.init.zeros_(self.layer.weight)

    def forward(self, x):
        return {"mean": self.layer(x)}


@dataclass(frozen=True, kw_only=True)
class LinearRegression(PinModel):
    """The smallest model there can be."""

    def build(self, reference, outputs, size):
        return Straight(len(reference.pins_px), outputs)

    def inputs(self, pins, learnt, reference, *, together):
        return FlatPins((pins.nodes_px - pins.reference.pins_px) / pins.reference.spacing_px.mean())


@pytest.fixture
def toy():
    """One line registers it; the test takes it away again."""
    register(
        LinearRegression(name="line", description="linear regression on pins", recipe=Recipe(epochs=100, batch=16, rate=1e-2, average=0.0))
    )
    yield "line"
    del MODELS["line"]


def test_a_new_model_trains_is_judged_estimates_and_is_kept_with_no_other_change(data, toy, tmp_path):
    assert train_run(RunConfig(toy, recipe_of(toy)), data, tmp_path)
    assert json.loads((tmp_path / "config.json").read_text())["model"] == toy and (tmp_path / "weights.pt").is_file()
    estimator = PoseEstimator.load(tmp_path)
    rows = rows_to_evaluate(estimator, data, "validation")
    made = estimator.predict_rows(data, rows)
    errors = measure_errors(made, data, rows)["corrected"]
    for k, name in enumerate(data.targets.names):
        truth = data.targets.corrected[:, k]
        assert errors[name]["mae"] < LEARNT * np.abs(truth - truth.mean()).mean()
    assert (made.half_width > 0).all() and np.isnan(made.executed).all()
    one = estimator(drawn_frame(data.pins.sensor, Form.PROCESSED, data.pins.nodes_px[rows[0]]))
    assert one.valid and (np.abs(one.value - made.mean[0]) < 2 * made.half_width[0]).all()
    blank = estimator(Frame(np.zeros((256, 256), np.uint8), Form.PROCESSED))
    assert not blank.valid and "no pins" in blank.reason
    again = PoseEstimator.load(tmp_path)
    assert np.array_equal(again.predict_rows(data, rows).mean, made.mean)


def test_what_a_new_model_does_not_provide_it_says(data, toy, tmp_path):
    with pytest.raises(TrainingError, match="line has no modes for a Gaussian process; train it with `kernel=False`"):
        recipe_of(toy, kernel=True)
    with pytest.raises(TrainingError, match="line has no part that can be left out"):
        variant_named("line-without-pins")
    train_run(RunConfig(toy, recipe_of(toy, epochs=1)), data, tmp_path)
    with pytest.raises(TrainingError, match="line has no small copy"):
        pack(tmp_path, tmp_path / "small")
    with pytest.raises(FrameError, match="line does not measure displacements from rest"):
        PoseEstimator.load(tmp_path).at_rest(Frame(np.zeros((256, 256), np.uint8), Form.PROCESSED))


def test_a_name_is_registered_once(toy):
    with pytest.raises(ValueError, match="'line'"):
        register(model_named(toy))


@pytest.mark.parametrize("name", list(MODELS))
def test_every_model_is_called_as_it_is_registered_and_can_be_trained_as_it_comes(name):
    model = model_named(name)
    assert model.name == name and model.description and recipe_of(name) == model.recipe
    for part, variant in model.variants.items():
        assert variant_named(f"{name}-without-{part}") == (model, variant)
        recipe_of(name, **variant.recipe)


def test_sizes_that_a_model_does_not_have_are_named(data):
    with pytest.raises(TrainingError, match="vgnn has no size layer; there are channels, layers"):
        model_named("vgnn").build(data.pins.reference, 2, {"layer": 1})
    for name in ("gnn", "cnn-v2"):
        with pytest.raises(TrainingError, match=f"{name} has no size layers; it has no sizes"):
            model_named(name).build(data.pins.reference, 2, {"layers": 1})


def test_a_model_of_pictures_refuses_pins_instead_of_guessing(data):
    model, reference = model_named("cnn-v2"), data.pins.reference
    content = {"networks": [model.build(reference, 2, {}).state_dict()], "kernels": [], "kernel_labels": [], "aside": {}}
    content |= {"shift": np.zeros(2), "scale": np.ones(2), "blend": np.zeros(2), "quantile": np.ones(2), "raw_quantile": np.ones((2, 2))}
    config = {"model": "cnn-v2", "size": {}, "columns": ["pose_2", "pose_6"], "units": ["mm", "deg"]}
    config |= {"sensor": data.pins.sensor.model_dump(mode="json"), "pipeline": {"form": "processed", "graph": "voronoi"}}
    estimator = PoseEstimator(config, content | {"reference_px": torch.from_numpy(reference.pins_px)})
    with pytest.raises(TrainingError, match="cnn-v2 estimates from pictures, not from pins"):
        estimator.predict_table(data.pins)
    assert estimator(drawn_frame(data.pins.sensor, Form.PROCESSED, data.pins.nodes_px[3])).valid


def names_asked_for(source: str, names: set[str]) -> list[int]:
    """Lines of Python text on which something is decided by a model's name: compared, matched, looked up, or asked for its start."""

    def named(node: ast.AST) -> bool:
        return any(isinstance(part, ast.Constant) and part.value in names for part in ast.walk(node))

    def starts(node: ast.Call) -> bool:
        of_text = isinstance(node.func, ast.Attribute) and node.func.attr in ("startswith", "endswith")
        texts = [part.value for argument in node.args for part in ast.walk(argument) if isinstance(part, ast.Constant)]
        return of_text and any(isinstance(text, str) and len(text) > 2 and name.startswith(text) for text in texts for name in names)

    found = []
    if not any(quote + name[:3] in source for quote in "'\"" for name in names):  # most modules: their code need not be read
        return found
    for node in ast.walk(ast.parse(source)):
        ladder = isinstance(node, ast.Compare | ast.MatchValue) and named(node)
        table = isinstance(node, ast.Dict) and any(key is not None and named(key) for key in node.keys)
        if ladder or table or (isinstance(node, ast.Call) and starts(node)):
            found.append(node.lineno)
    return found


@pytest.mark.parametrize(
    "text",
    [
        'if model == "vgnn": pass',
        'if model in ("cnn-v1", "cnn-v2"): pass',
        'x = 2 if "gnn" != model else 3',
        'match model:\n    case "tac-vgnn": pass',
        'STEPS = {"cnn-v1": 2}',
        'if model.startswith("cnn"): pass',
    ],
)
def test_deciding_by_a_models_name_is_found(text):
    assert names_asked_for(text, set(MODELS))
    assert not names_asked_for('config = RunConfig("vgnn", recipe_of("vgnn"), seed=1)', set(MODELS))


def test_nobody_but_the_models_decides_by_a_models_name():
    files = [path for package in ("scenes", "twin", "training", "hardware") for path in sorted((ROOT / package).rglob("*.py"))]
    others = [path for path in files if ROOT / "training" / "models" not in path.parents]
    assert len(others) > 100 and len(files) > len(others)
    found = {str(path.relative_to(ROOT)): lines for path in others if (lines := names_asked_for(path.read_text(), set(MODELS)))}
    assert not found


LIGHT = 2.4  # logarithm of the gray level on all caps, for the model that sees it: the mean of the TacPad's frames
# Depth (mm) and angle (deg) of the two contacts below by the weights that go with the package; for the ur5-331 depth and two angles.
# They were noted when these weights were made: whoever ships others puts theirs here.
SHIPPED_SAY = {
    "mg400-127": [[-2.248451, 2.032925], [-0.32491, -2.655608]],
    "mg400-331": [[-3.613404, -7.44848], [-1.869889, -0.244931]],
    "ur5-tacpad": [
        [1.566376, -121.798529, 98.351301, -25.163328, -14.568247, -7.849769, -10.961728, -1.980839],
        [4.586683, -31.226263, 98.116404, -18.395765, -11.855023, -5.315145, -11.329534, 14.516743],
    ],
    "ur5-331": [[2.247927, -2.373231, 10.129822], [3.462189, -1.69366, -2.085524]],
}
SHIPPED_HALF_WIDTHS = {
    "mg400-127": [[6.427215, 17.053029], [0.3757, 0.634329]],
    "mg400-331": [[11.74886, 264.510265], [1.065038, 19.388576]],
    "ur5-tacpad": [
        [37.498678, 317.129238, 281.0386, 54.476637, 47.813523, 250.754018, 238.60185, 446.133135],
        [37.497783, 298.038751, 268.702522, 45.928408, 47.237173, 250.754018, 238.60185, 446.133135],
    ],
    "ur5-331": [[0.203753, 1.366105, 0.786313], [0.184032, 0.93198, 0.552867]],
}


@pytest.mark.parametrize("name", shipped_names())
def test_shipped_weights_say_what_they_said_when_they_were_made(name):
    estimator = PoseEstimator.load(name)
    reference = estimator.pipeline.reference
    nodes_px = drawn_pins(np.array([[-3.0, -12.0, 2.0, 0.0], [-1.0, 8.0, 0.0, 3.0]]), reference)
    area_px2 = np.stack([make_graph("voronoi", frame, outmost=reference.outmost).area_px2 for frame in nodes_px])
    none, all_valid = np.zeros(nodes_px.shape[:2], bool), np.ones(2, bool)
    pins = PinTable(estimator.sensor, estimator.form, reference, np.array(["a", "b"]), nodes_px, area_px2, none, all_valid, measured=True)
    pins = replace(pins, light=np.full(nodes_px.shape[:2], LIGHT))  # most models do not see it
    made = estimator.predict_table(pins)
    assert made.mean == pytest.approx(np.array(SHIPPED_SAY[name]), abs=SINGLE, rel=SINGLE)
    assert made.half_width == pytest.approx(np.array(SHIPPED_HALF_WIDTHS[name]), abs=SINGLE, rel=SINGLE)


@pytest.mark.parametrize("name", shipped_names())
def test_shipped_files_are_in_the_public_format(name):
    """Read by the format's own text, beside the library: length of the header, header, arrays."""
    from safetensors.numpy import load_file

    path = SHIPPED / name / WEIGHTS
    bytes_ = path.read_bytes()
    begin = 8 + struct.unpack("<Q", bytes_[:8])[0]
    header = json.loads(bytes_[8:begin])
    found = load_file(path)
    types = {"F16": np.float16, "F32": np.float32, "F64": np.float64, "I64": np.int64}
    assert set(found) == set(header) - {"__metadata__"}
    for key, value in found.items():
        first, last = header[key]["data_offsets"]
        plain = np.frombuffer(bytes_[begin + first : begin + last], types[header[key]["dtype"]]).reshape(header[key]["shape"])
        assert plain.dtype == value.dtype and np.array_equal(plain, value)


def test_rounding_is_no_mode_wherever_modes_are_taken():
    """Frames that move in three ways and are kept in single precision: what rounding adds counts neither here nor there."""
    rng = np.random.default_rng(4)
    rest = rng.uniform(-100, 100, (60, 2)) + 128
    x, y = (rest - rest.mean(axis=0)).T
    similar = np.stack([[x, y], [-y, x], [x**0, 0 * y], [0 * x, y**0]]).transpose(0, 2, 1).reshape(4, -1)  # scale, turn, shift
    ways = rng.normal(0, 0.5, (3, 120))
    ways -= ways @ np.linalg.pinv(similar) @ similar  # nothing of them is a similarity, which registration takes out
    flat = (rest.ravel() + rng.normal(size=(12, 3)) @ ways).astype(np.float32).astype(float)
    registration, _ = fit_registration(flat.reshape(12, 60, 2), rest)
    assert registration.components.shape[1] == 3
    assert int((mode_components(torch.from_numpy(flat - flat.mean(axis=0)), 40).norm(dim=0) > 0).sum()) == 3
    assert count_modes(np.array([1.0, 0.5, 0.2]), 2) == 2


def test_a_small_copy_holds_the_processes_beside_the_networks_up_to_a_number_of_rows(data, tmp_path, monkeypatch):
    train_run(config_of("vgnn", epochs=1, batch=16, members=1, kernel=True), data, tmp_path / "run")
    pack(tmp_path / "run", tmp_path / "small")
    whole, small = PoseEstimator.load(tmp_path / "run"), PoseEstimator.load(tmp_path / "small")
    assert small.ensemble.kernels and small.ensemble.kernel_labels == whole.ensemble.kernel_labels
    rows = np.arange(len(data))
    close = {"rtol": 0, "atol": 0.02}  # of half precision, mm and deg
    np.testing.assert_allclose(small.predict_rows(data, rows).mean, whole.predict_rows(data, rows).mean, **close)
    monkeypatch.setattr("training.runs.run_files.MOST_ROWS", 1)
    with pytest.raises(TrainingError, match="has Gaussian processes of .* frames beside its networks.*`kernel=False`"):
        pack(tmp_path / "run", tmp_path / "none")


def test_a_run_whose_processes_are_kept_as_by_an_earlier_version_is_refused_with_advice(data, tmp_path):
    train_run(config_of("vgnn", epochs=1, batch=16, members=1, kernel=True), data, tmp_path)
    content = torch.load(tmp_path / "weights.pt", weights_only=True)
    for kernel in content["kernels"]:
        kernel |= {"smooth": kernel["sizes"][:, 0], "linear": kernel["sizes"][:, 1], "noise": kernel.pop("noises")[:, 0]}
        del kernel["sizes"]
    torch.save(content, tmp_path / "weights.pt")
    with pytest.raises(TrainingError, match="not of a run of this version.*train again"):
        PoseEstimator.load(tmp_path)
