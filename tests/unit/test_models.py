"""Networks obey the laws of what they work on: pins, graphs, rows."""

import copy

import numpy as np
import pytest
import torch

from training.models import MODELS
from training.models.graphs.model import CHANNELS, Gcn, block_diagonal, graph_rows
from training.models.vgnn.model import Vgnn, VgnnSize, mode_components
from training.models.vgnn.registration import fit_registration
from training.runs.assemble import conformal_quantile, group_quantiles
from training.runs.loop import row_loss
from twin.pins import make_graph

PINS, FRAMES = 40, 6


@pytest.fixture(scope="module")
def layout():
    rng = np.random.default_rng(0)
    rest = rng.uniform(0, 10, (PINS, 2))
    return rest, make_graph("delaunay", rest).edges


def pin_rows(seed=1, frames=FRAMES):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(frames, PINS, 3)).astype(np.float32))


def prepared(edges, x, **size):
    torch.manual_seed(0)
    network = Vgnn(edges, PINS, 2, VgnnSize(width=16, **size))
    torch.nn.init.normal_(network.linear.weight)
    network.prepare(x)
    return network.eval()


def test_vgnn_with_pins_in_another_order_says_the_same(layout):
    _, edges = layout
    x, order = pin_rows(frames=30), np.random.default_rng(2).permutation(PINS)
    here = prepared(edges, x, modes=5, area_modes=5)
    place = np.argsort(order)  # where each pin went
    there = prepared(place[edges], x[:, order], modes=5, area_modes=5)
    weights = here.state_dict()
    for key in weights:  # what belongs to a pin goes with it
        if key.startswith("embedding") or key in ("waves", "area_components", "area_mean"):
            weights[key] = weights[key][order]
        elif key in ("adjacency", "smoothing", "attention"):
            weights[key] = weights[key][order][:, order]
        elif key == "components":
            weights[key] = weights[key].view(PINS, 2, -1)[order].flatten(0, 1)
        elif key == "mode_mean":
            weights[key] = weights[key].view(PINS, 2)[order].flatten()
    there.load_state_dict(weights)
    assert torch.allclose(here(x)["mean"], there(x[:, order])["mean"], atol=1e-4)


@pytest.mark.parametrize("kind", ["knn", "delaunay"])
def test_gcn_does_not_know_the_order_of_pins(layout, kind):
    rest, _ = layout
    torch.manual_seed(0)
    network, order = Gcn(3, 2).eval(), np.random.default_rng(3).permutation(PINS)
    x = pin_rows(frames=1)

    def said(x, nodes):
        edges = [make_graph(kind, nodes).edges]
        matrices = block_diagonal(graph_rows(edges, PINS), np.array([0]))
        return network(x, *matrices)["mean"]

    assert torch.allclose(said(x, rest), said(x[:, order], rest[order]), atol=1e-5)


def test_a_batch_of_graphs_says_what_each_says_alone(layout):
    rng = np.random.default_rng(4)
    edges = [make_graph("knn", rng.uniform(size=(PINS, 2))).edges for _ in range(4)]
    rows_of = graph_rows(edges, PINS)
    torch.manual_seed(0)
    network, x = Gcn(2, 2).eval(), pin_rows(frames=4)[..., :2]
    rows = np.array([2, 0, 3])
    together = network(x[rows], *block_diagonal(rows_of, rows))["mean"]
    alone = [network(x[k : k + 1], *block_diagonal(rows_of, np.array([k])))["mean"] for k in rows]
    assert torch.allclose(together, torch.cat(alone), atol=1e-5)


def test_a_convolution_with_its_norm_is_kipf_and_wellings_with_torchs_norm(layout):
    """Values, gradients and running statistics are those of the dense formula, with the bias that the norm cancels."""
    rest, edges = layout
    for kind in ("delaunay", "knn"):  # symmetric, and not
        edges = make_graph(kind, rest).edges
        rows = np.array([0, 0])
        matrices = block_diagonal(graph_rows([edges], PINS), rows)
        torch.manual_seed(0)
        network = Gcn(3, 2)
        for norm in network.norms:
            torch.nn.init.normal_(norm.weight), torch.nn.init.normal_(norm.bias)
        x = (pin_rows(frames=2) * torch.tensor([80.0, 80.0, 30.0]) + torch.tensor([0, 0, 400.0])).requires_grad_()
        plain = copy.deepcopy(network)
        dense = torch.eye(PINS)
        dense[edges[:, 1], edges[:, 0]] = 1
        root = dense.sum(1).rsqrt()
        dense = root[:, None] * dense * root
        pull = torch.randn(2, 2)
        grads = {}
        for here in (network, plain):
            x.grad = None
            if here is network:
                out = network(x, *matrices)["mean"]
            else:
                h = x
                for layer, norm in zip(plain.convolutions, plain.norms, strict=True):
                    h = torch.nn.functional.leaky_relu(norm((layer(dense @ h) + 3.0).flatten(0, 1))).view(2, PINS, -1)
                out = plain.dense(h.mean(dim=1))
            out.backward(pull)
            grads[here] = [out.detach(), x.grad.clone(), *(p.grad for p in here.parameters())]
        for a, b in zip(grads[network], grads[plain], strict=True):
            assert torch.allclose(a, b, atol=2e-4 * float(b.abs().max()))
        for a, b in zip(network.norms, plain.norms, strict=True):
            assert torch.allclose(a.running_mean, b.running_mean - 0.3, rtol=1e-4, atol=1e-4)
            assert torch.allclose(a.running_var, b.running_var, rtol=1e-4)


@pytest.mark.parametrize("layers", [0, 2])
def test_lost_pins_do_not_influence_the_output(layout, layers):
    _, edges = layout
    x = pin_rows(frames=30)
    network = prepared(edges, x, modes=5, area_modes=5, layers=layers)
    lost = torch.zeros(30, PINS, dtype=torch.bool)
    lost[:, [3, 7, 20]] = True
    spoilt = torch.where(lost[..., None], 1e6, x)
    assert torch.equal(network(x, lost)["mean"], network(spoilt, lost)["mean"])
    assert not torch.allclose(network(x, lost)["mean"], network(x)["mean"])
    assert torch.isfinite(network(torch.where(lost[..., None], torch.nan, x), lost)["mean"]).all()


def test_duplicated_rows_do_not_change_the_loss():
    out = {key: torch.randn(5, 2) for key in ("mean", "log_scale")} | {"executed": torch.randn(5)}
    labels, executed, weight = torch.randn(5, 2), torch.tensor([1.0, 0, 1, 1, 0]), torch.tensor([1.0, 0.3])
    twice = {key: torch.cat([value, value]) for key, value in out.items()}
    once = row_loss(out, labels, executed, weight, "l1")
    assert torch.allclose(once, row_loss(twice, labels.repeat(2, 1), executed.repeat(2), weight, "l1"))


def test_layers_are_the_papers():
    assert CHANNELS == (16, 32, 48, 64, 96)
    count = {variant: sum(p.numel() for p in Gcn(3, 2, variant).parameters()) for variant in ("paper", "release")}
    assert count["release"] + sum(CHANNELS) == 37522  # as the release's network, less the biases that batch norm cancels
    assert count["paper"] < count["release"]
    networks = [MODELS[name].build(None, 2, {}) for name in ("cnn-v1", "cnn-v2")]
    filters = [[m.out_channels for m in network.convolutions if hasattr(m, "out_channels")] for network in networks]
    assert filters == [[256] * 5, [48] * 5]


def test_intervals_cover_what_they_promise():
    rng = np.random.default_rng(5)
    scores = np.abs(rng.standard_t(3, (4000, 2)))
    quantile = conformal_quantile(scores[:1000])
    inside = (scores[1000:] <= quantile).mean(axis=0)
    assert (np.abs(inside - 0.9) < 0.03).all()
    assert conformal_quantile(scores[:5]).tolist() == scores[:5].max(axis=0).tolist()


def test_intervals_of_two_kinds_of_frames_cover_both():
    """Errors of two sizes, as raw labels have them: each group is covered, not only their mixture."""
    rng = np.random.default_rng(5)
    group = (rng.random(4000) < 0.3).astype(int)
    scores = np.where(group, 5 * rng.random(4000), np.abs(rng.normal(0, 0.1, 4000)))[:, None]
    found = group_quantiles(scores[:2000], group[:2000])
    inside = scores[2000:] <= found[group[2000:]]
    assert all(abs(inside[group[2000:] == k].mean() - 0.9) < 0.03 for k in (0, 1))
    few = np.where(np.arange(2000) < 5, 1, 0)
    assert np.array_equal(group_quantiles(scores[:2000], few)[1], conformal_quantile(scores[:2000]))


def test_the_cameras_own_motion_is_taken_out_and_contact_is_left():
    rng = np.random.default_rng(7)
    rest = rng.uniform(-100, 100, (60, 2)) + 128
    states = rng.uniform(-1, 1, (400, 2))
    bump = np.exp(-(((rest - 128) / 60) ** 2).sum(axis=1))[:, None]
    frames = rest + states[:, :1, None] * 6 * bump + states[:, 1:, None] * 8 * bump * [1, 0.2] + rng.normal(0, 0.05, (400, 60, 2))
    area = np.ones((400, 60))
    registration, _ = fit_registration(frames[:300], rest)
    nodes, _, taken, _ = registration(frames[300:], area[300:])
    assert (taken == 0).all(axis=1).mean() > 0.95
    turn = np.exp(1j * np.radians(1.0)) * 1.01
    z = ((frames[300:] - 128) @ [1, 1j]) * turn + (2 - 1j)
    moved = np.stack([z.real, z.imag], axis=-1) + 128
    back, shrunk, taken, share = registration(moved, 1.01**2 * area[300:])
    assert np.abs(back - frames[300:]).max() < 0.4 and np.abs(moved - frames[300:]).mean() > 1.5
    assert np.allclose(shrunk, 1, atol=0.01) and (share == 1).all()


@pytest.mark.parametrize("known", [8, 12, 40])
def test_a_registration_of_few_frames_has_bounded_corrections(known):
    rng = np.random.default_rng(11)
    rest = rng.uniform(-100, 100, (60, 2)) + 128
    waves = np.stack([np.sin((rest - 128) / scale) for scale in (30, 50, 90)])
    frames = rest + np.einsum("mk,knd->mnd", rng.normal(0, 2, (200, 3)), waves) + rng.normal(0, 0.1, (200, 60, 2))
    registration, _ = fit_registration(frames[:known], rest)
    nodes, area, taken, _ = registration(frames[known:], np.ones((200 - known, 60)))
    assert np.isfinite(area).all() and np.abs(taken[:, 2:]).max() < 10 and np.abs(nodes - frames[known:]).max() < 20  # px; pins move by 2


def test_with_all_of_a_difference_taken_out_a_displaced_frame_is_the_same():
    rng = np.random.default_rng(10)
    rest = rng.uniform(-100, 100, (60, 2)) + 128
    bump = np.exp(-(((rest - 128) / 60) ** 2).sum(axis=1))[:, None]
    frames = rest + rng.uniform(-1, 1, (400, 1, 1)) * 6 * bump + rng.normal(0, 0.05, (400, 60, 2))
    registration, left = fit_registration(frames, rest)
    z = ((frames - 128) @ [1, 1j]) * 1.01 * np.exp(1j * np.radians(1.0)) + (2 - 1j)
    moved, area = np.stack([z.real, z.imag], axis=-1) + 128, np.ones((400, 60))
    here, there = (registration.take_out(nodes, area, registration.difference(nodes))[0] for nodes in (frames, moved))
    assert np.abs(there - here).max() < 0.1 and np.abs(moved - frames).mean() > 1.5  # px; the orders of shift and scale differ a little
    assert (np.abs(left) >= np.abs(registration.difference(frames)) - 1e-9).all()  # what was not fitted to lies further off


def test_lost_pins_follow_the_modes_of_the_others():
    rng = np.random.default_rng(8)
    rest = rng.uniform(-100, 100, (60, 2)) + 128
    waves = np.stack([np.sin((rest - 128) / 50), np.cos((rest[:, ::-1] - 128) / 70)])
    frames = rest + np.einsum("mk,knd->mnd", rng.normal(0, 3, (300, 2)), waves)
    registration, _ = fit_registration(frames[:250], rest)
    lost = np.zeros(60, bool)
    lost[[4, 17, 30]] = True
    spoilt = np.where(lost[:, None], frames[270] + 5, frames[270])
    filled = registration.fill(spoilt[None], lost[None])[0]
    assert np.array_equal(filled[~lost], frames[270][~lost]) and np.abs(filled - frames[270]).max() < 0.3


def test_frames_of_one_camera_tell_its_displacement_together():
    rng = np.random.default_rng(9)
    rest = rng.uniform(-100, 100, (60, 2)) + 128
    bump = np.exp(-(((rest - 128) / 60) ** 2).sum(axis=1))[:, None] * [3.0, 1.0]
    frames = rest + rng.uniform(-1, 1, (400, 1, 1)) * bump + rng.normal(0, 0.05, (400, 60, 2))
    registration, _ = fit_registration(frames[:300], rest)
    small = frames[300:] + 4 * registration.usual[2] * np.array([1.0, 0.0])  # too little to be told from one frame
    alone = registration(small, np.ones((100, 60)))[2]
    together = registration(small, np.ones((100, 60)), together=True)[2]
    assert (alone[:, 2] == 0).mean() > 0.8
    assert abs(np.median(together[:, 2]) / (4 * registration.usual[2]) - 1) < 0.3
    assert (registration(frames[300:], np.ones((100, 60)), together=True)[2] == 0).all(axis=1).mean() > 0.9


@pytest.mark.parametrize("rows", [4, 8, 32])
def test_modes_of_few_rows_are_only_directions_that_they_span(rows):
    torch.manual_seed(0)
    seen, others = (torch.randn(count, 6) @ torch.randn(6, 300) + 0.01 * torch.randn(count, 300) for count in (rows, 50))
    components = mode_components(seen - seen.mean(dim=0), 40)
    spanned = components.norm(dim=0) > 0
    assert spanned.sum() == rows - 1
    assert ((others - seen.mean(dim=0)) @ components).abs().max() < 500, "a rounding error, taken for a direction, is thousands long"
