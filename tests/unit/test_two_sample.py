"""Laws of the two-sample test, on small pictures: nothing to tell apart, everything to tell apart, repeatable."""

import numpy as np
import pytest
import torch

from scenes import load_sensor
from training.data import two_sample as module
from training.data.two_sample import (
    JUDGES,
    PatchClassifier,
    accuracy_text,
    evaluate_classifiers,
    patch_corners,
    patch_network,
    real_halves,
    two_sample,
)
from training.studies.realism import _verdict, compare_with_renders
from twin.errors import FrameError, OptionError

INSIDE = np.ones((72, 72), bool)
PAIRS = 10
QUICK, QUICKER = PatchClassifier((16, 32, 64, 64), first_stride=2, epochs=5), PatchClassifier((16, 32, 64, 64), first_stride=2, epochs=1)
CHANCE = 0.2  # few held-out pairs of few patches


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(module, "BATCH", 16)
    monkeypatch.setattr(module, "PATCHES", 6)
    monkeypatch.setattr(module, "FOLDS", 3)


def pictures(count, seed, *, blue=1.0):
    """Bright stripes of a random phase and mean level: frames have an identity, sets only a colour."""
    rng, x = np.random.default_rng(seed), np.mgrid[:72, :72][1]
    out = []
    for _ in range(count):
        wave = rng.uniform(80, 120) + 60 * np.sin(2 * np.pi * x / 12 + rng.uniform(0, 6)) + rng.normal(0, 5, x.shape)
        out.append(np.clip(wave[..., None] * [1.0, 1.0, blue], 0, 255).astype(np.uint8))
    return out


@pytest.mark.slow
def test_sets_of_one_distribution_are_not_distinguished():
    outcome = two_sample(pictures(PAIRS, 0), pictures(PAIRS, 1), INSIDE, classifier=QUICK)
    assert outcome.accuracy == pytest.approx(0.5, abs=CHANCE)
    assert outcome.low <= outcome.accuracy <= outcome.high


def test_different_sets_are_distinguished_in_unseen_frames():
    outcome = two_sample(pictures(PAIRS, 0), pictures(PAIRS, 1, blue=0.8), INSIDE, classifier=QUICK)
    assert outcome.accuracy > 0.95


def test_the_same_seed_gives_the_same_outcome():
    first, second = (two_sample(pictures(6, 0), pictures(6, 1), INSIDE, classifier=QUICKER, seed=2) for _ in range(2))
    assert (first.by_pair == second.by_pair).all()


def test_halves_of_one_set_are_not_distinguished_however_different_their_frames_are():
    """Frames of two kinds, as contacts are of many: a half has some of each."""
    images, steps = pictures(PAIRS, 0) + pictures(PAIRS, 1, blue=0.8), []
    outcome = real_halves(images, INSIDE, classifier=QUICK, progress=lambda done, total: steps.append((done, total)))
    assert outcome.accuracy == pytest.approx(0.5, abs=CHANCE)
    assert len(outcome.by_pair) == module.DIVISIONS * PAIRS
    parts = module.DIVISIONS * module.FOLDS
    assert steps == [(k + 1, parts) for k in range(parts)]


def test_judges_grow_in_strength_and_see_the_patches_of_any_texture():
    """The stronger classifier has more weights and more epochs, and its first convolution has an output for every pixel."""
    small, stronger = (patch_network(judge) for judge in JUDGES.values())
    weights = [sum(part.numel() for part in network.parameters()) for network in (small, stronger)]
    assert weights[1] > 2 * weights[0] and JUDGES["stronger"].epochs > JUDGES["small"].epochs
    patches = torch.zeros(2, 3, module.PATCH_PX, module.PATCH_PX)
    assert stronger[0](patches).shape[2:] == patches.shape[2:]
    assert small(patches).shape == stronger(patches).shape == (2,)


def test_patches_lie_in_the_disc():
    y, x = np.mgrid[:200, :240]
    inside = (x - 120) ** 2 + (y - 100) ** 2 < 90**2
    for row, column in patch_corners(inside)[::97]:
        assert inside[row : row + 64, column : column + 64].mean() >= 0.9
    with pytest.raises(FrameError, match="too small"):
        patch_corners(np.zeros((200, 240), bool))


def test_sets_of_different_length_are_refused():
    with pytest.raises(FrameError, match="3 and 2"):
        two_sample(pictures(3, 0), pictures(2, 1), INSIDE)


def test_each_judge_tells_what_it_tells_alone():
    sets = pictures(6, 0), pictures(6, 1)
    told = evaluate_classifiers(*sets, INSIDE, judges={"quick": QUICKER})
    assert (told["quick"].by_pair == two_sample(*sets, INSIDE, classifier=QUICKER).by_pair).all()
    assert told["quick"].text() == accuracy_text(told["quick"].accuracy, told["quick"].low, told["quick"].high)
    assert accuracy_text(0.5, 0.4, 0.625) == "50.0 % (40.0 to 62.5 %)"


def test_a_thorough_test_that_is_left_out_is_an_error(tmp_path):
    with pytest.raises(OptionError, match="`thorough` adds to the two-sample test, but `two_sample=False` leaves it out"):
        compare_with_renders(tmp_path, load_sensor("ur5-331"), tmp_path / "out", test=False, thorough=True)


def test_the_verdict_names_what_differs_and_what_fits_it():
    assert _verdict(0.05, {"level": True, "edge_px": True}).endswith("within 5 % of the real ones at every radius")
    one, two = _verdict(0.05, {"level": True, "edge_px": False}), _verdict(0.05, {"level": False, "edge_px": False})
    assert "the caps' edge differs" in one and "the caps' level, edge differ " in two and "twin calibrate optics" in one
