"""Can a small network tell two sets of frames apart? A classifier two-sample test (Lopez-Paz & Oquab 2017).

A fixed network of four convolutions sees colour patches of the lens disc. It is trained on some frames and asked about
others it has never seen: frame k of one set is always held out together with frame k of the other, so a pair that
shows the same contact can't give the answer away. 50 %: not to be told apart; 100 %: always.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from twin.errors import FrameError
from twin.progress import Step

PATCH_PX = 64
PATCHES = 16  # of each frame in each epoch, and in the test
CHANNELS = (16, 32, 64, 64)
EPOCHS = 12
BATCH = 64
FOLDS = 5
RATE = 2e-3
WEIGHT_DECAY = 1e-2
INSIDE = 0.9  # of a patch lies in the disc at least
RESAMPLES = 2000  # of the frames, for the interval
LEVEL_SCALE = 64.0  # gray levels


@dataclass(frozen=True)
class TwoSample:
    """Outcome of a test.

    Attributes
    ----------
    accuracy : float
        Share of the patches of unseen frames that are assigned to their set.
    low, high : float
        95 % interval by resampling the held-out pairs of frames.
    by_pair : (M,) float
        Accuracy of each held-out pair of frames.
    """

    accuracy: float
    low: float
    high: float
    by_pair: np.ndarray


def two_sample(
    first: list[np.ndarray], second: list[np.ndarray], inside: np.ndarray, *, seed: int = 0, progress: Step | None = None
) -> TwoSample:
    """Test two sets of as many frames.

    Parameters
    ----------
    first, second : list of (H, W, 3) or (H, W) uint8
        M frames each, at least one per fold; pairs (k-th and k-th) are held out together.
    inside : (H, W) bool
        The lens disc.
    seed : int
        Of patches, network and folds: the same seed gives the same outcome.
    progress : callable, optional
        ``progress(done, total)`` after each fold.

    Raises
    ------
    FrameError
        Sets of different length, or fewer than two pairs.
    """
    if len(first) != len(second) or len(first) < 2:
        raise FrameError(f"the two-sample test needs as many frames of both kinds, at least 2; got {len(first)} and {len(second)}")
    rng = np.random.default_rng(seed)
    corners = patch_corners(inside)
    sets = [np.stack([as_color(image) for image in images]) for images in (first, second)]
    pairs, folds = len(first), min(FOLDS, len(first))
    fold_of = rng.permutation(np.arange(pairs) % folds)
    correct = np.zeros(pairs)
    for fold in range(folds):
        train, held = np.flatnonzero(fold_of != fold), np.flatnonzero(fold_of == fold)
        network = _trained(sets, train, corners, np.random.default_rng([seed, fold]), seed + fold)
        for k in held:
            patches, truth = _patches(sets, np.array([k]), corners, rng, turned=False)
            correct[k] = ((network(patches) > 0) == (truth > 0.5)).double().mean().item()
        if progress:
            progress(fold + 1, folds)
    means = correct[rng.integers(pairs, size=(RESAMPLES, pairs))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return TwoSample(float(correct.mean()), float(low), float(high), correct)


def random_halves(images: list[np.ndarray], inside: np.ndarray, *, splits: int = 4, seed: int = 0) -> TwoSample:
    """The same test on one set of frames, divided at random again and again: what no difference looks like."""
    rng, outcomes = np.random.default_rng(seed), []
    half = len(images) // 2
    for split in range(splits):
        order = rng.permutation(len(images))
        first, second = ([images[k] for k in part] for part in (order[:half], order[half : 2 * half]))
        outcomes.append(two_sample(first, second, inside, seed=seed + split).by_pair)
    every = np.concatenate(outcomes)
    means = every[rng.integers(len(every), size=(RESAMPLES, len(every)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return TwoSample(float(every.mean()), float(low), float(high), every)


def as_color(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of a colour or gray frame."""
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


def patch_corners(inside: np.ndarray) -> np.ndarray:
    """(k, 2) row and column of all patches that lie in the disc for nine tenths.

    Raises
    ------
    FrameError
        The disc is too small for a patch.
    """
    total = np.pad(inside.astype(np.int64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    p = PATCH_PX
    covered = total[p:, p:] - total[:-p, p:] - total[p:, :-p] + total[:-p, :-p]
    corners = np.argwhere(covered >= INSIDE * p * p)
    if not len(corners):
        raise FrameError(f"the lens disc is too small for the two-sample test's patches of {p} px")
    return corners


def _network() -> nn.Module:
    layers, before = [], 3
    for channels in CHANNELS:
        layers += [nn.Conv2d(before, channels, 3, stride=2, padding=1), nn.BatchNorm2d(channels), nn.ReLU()]
        before = channels
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(before, 1), nn.Flatten(0))


def _trained(sets: list[np.ndarray], frames: np.ndarray, corners: np.ndarray, rng: np.random.Generator, seed: int) -> nn.Module:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _network()
    steps = EPOCHS * -(-2 * len(frames) * PATCHES // BATCH)
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    network.train()
    for _ in range(EPOCHS):
        patches, truth = _patches(sets, frames, corners, rng, turned=True)
        order = torch.from_numpy(rng.permutation(len(truth)))
        for batch in order.split(BATCH):
            loss = functional.binary_cross_entropy_with_logits(network(patches[batch]), truth[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    network.eval()
    return network.requires_grad_(False)


def _patches(
    sets: list[np.ndarray], frames: np.ndarray, corners: np.ndarray, rng: np.random.Generator, *, turned: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """(p, 3, 64, 64) patches of the frames of both sets at random places, and (p,) which set each is from."""
    patches, truth = [], []
    for k in frames:
        for kind, images in enumerate(sets):
            for row, column in corners[rng.integers(len(corners), size=PATCHES)]:
                patch = images[k, row : row + PATCH_PX, column : column + PATCH_PX]
                if turned:
                    patch = np.rot90(patch, int(rng.integers(4)))
                    patch = patch[:, ::-1] if rng.random() < 0.5 else patch
                patches.append(patch.transpose(2, 0, 1))
                truth.append(kind)
    stack = torch.from_numpy(np.stack(patches).astype(np.float32) / np.float32(LEVEL_SCALE) - 1)
    return stack, torch.tensor(truth, dtype=torch.float32)
