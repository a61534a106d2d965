"""A classifier two-sample test (Lopez-Paz & Oquab 2017): can a network distinguish two sets of frames?

The inputs of a fixed network of four convolutions are colour patches of the lens disc. It is trained on some frames and tested on the
others. Frame k of one set is always held out together with frame k of the other, because both may show the same contact, and a network
that knew one of them could recognise the other. An accuracy of 50 % means that the network can't distinguish the sets, 100 % that it
assigns every patch to the right set.

A stronger network may see more. There are two (`JUDGES`), and both can also be applied to two halves of the
real frames (`real_halves`), which shows the result where there is nothing to distinguish.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from twin.errors import FrameError
from twin.progress import Step, unheard

# Side of a patch, px.
PATCH_PX = 64
# Number of patches of each frame, in each epoch and in the test.
PATCHES = 16
# Number of patches in a batch.
BATCH = 64
# Number of parts of the frames; each is held out once.
FOLDS = 5
# Largest learning rate of AdamW.
RATE = 2e-3
# Weight decay of AdamW.
WEIGHT_DECAY = 1e-2
# Least share of a patch's area that lies in the lens disc.
INSIDE = 0.9
# Number of random divisions of the real frames into halves.
DIVISIONS = 2
# Number of bootstrap samples of the frame pairs, from which the interval is computed.
RESAMPLES = 2000
# Gray levels that the value 1 of the network's input stands for.
LEVEL_SCALE = 64.0


@dataclass(frozen=True)
class PatchClassifier:
    """A network of the test, and how long it is trained.

    Attributes
    ----------
    channels : tuple of int
        Channels of its convolutions.
    first_stride : int
        Step of the first convolution, px; the others have 2. With 1 it sees the texture of single pixels.
    epochs : int
    """

    channels: tuple[int, ...]
    first_stride: int
    epochs: int


SMALL = PatchClassifier((16, 32, 64, 64), first_stride=2, epochs=12)
STRONGER = PatchClassifier((24, 48, 96, 96), first_stride=1, epochs=24)
JUDGES = {"small": SMALL, "stronger": STRONGER}
"""The networks of a thorough test."""
Pictures = list[np.ndarray]
"""Frames (H, W, 3) or (H, W) uint8."""


@dataclass(frozen=True)
class TwoSample:
    """Result of a test.

    Attributes
    ----------
    accuracy : float
        Share of the patches of held-out frames that are assigned to the right set.
    low, high : float
        95 % bootstrap interval over the held-out pairs of frames.
    by_pair : (M,) float
        Accuracy of each held-out pair of frames.
    """

    accuracy: float
    low: float
    high: float
    by_pair: np.ndarray

    def text(self) -> str:
        """The accuracy and its interval in words."""
        return accuracy_text(self.accuracy, self.low, self.high)


def two_sample(
    first: Pictures, second: Pictures, inside: np.ndarray, *, classifier: PatchClassifier = SMALL, seed: int = 0, progress: Step = unheard
) -> TwoSample:
    """Test two sets of equally many frames.

    Parameters
    ----------
    first, second : list of (H, W, 3) or (H, W) uint8
        M frames each; the k-th frames of both sets are held out together.
    inside : (H, W) bool
        The lens disc.
    classifier : PatchClassifier
    seed : int
        Seed of patches, network and folds. The same seed gives the same result.
    progress : callable, optional
        ``progress(done, total)`` after each fold.

    Raises
    ------
    FrameError
        The sets differ in length, or have fewer than two frames each.
    """
    if len(first) != len(second) or len(first) < 2:
        raise FrameError(f"the two-sample test needs equally many frames of both kinds, at least 2; got {len(first)} and {len(second)}")
    rng, corners = np.random.default_rng(seed), patch_corners(inside)
    sets = [np.stack([as_color(image) for image in images]) for images in (first, second)]
    pairs, folds = len(first), min(FOLDS, len(first))
    fold_of = rng.permutation(np.arange(pairs) % folds)
    correct = np.zeros(pairs)
    for fold in range(folds):
        train, held = np.flatnonzero(fold_of != fold), np.flatnonzero(fold_of == fold)
        network = _train_classifier(classifier, sets, train, corners, np.random.default_rng([seed, fold]), seed + fold)
        for k in held:
            patches, truth = _patches(sets, np.array([k]), corners, rng, turned=False)
            correct[k] = ((network(patches) > 0) == (truth > 0.5)).double().mean().item()
        progress(fold + 1, folds)
    return _outcome(correct, rng)


def evaluate_classifiers(
    real: Pictures, rendered: Pictures, inside: np.ndarray, *, judges: Mapping[str, PatchClassifier] = JUDGES, progress: Step = unheard
) -> dict[str, TwoSample]:
    """Results of several classifiers for real and rendered frames, by the classifiers' names. Parameters are those of `two_sample`."""
    return {name: two_sample(real, rendered, inside, classifier=judge, progress=progress) for name, judge in judges.items()}


def evaluate_halves(images: Pictures, inside: np.ndarray, *, progress: Step = unheard) -> dict[str, TwoSample]:
    """Results of each classifier for halves of the real frames, by the classifiers' names. Parameters are those of `real_halves`."""
    return {name: real_halves(images, inside, classifier=judge, progress=progress) for name, judge in JUDGES.items()}


def accuracy_text(accuracy: float, low: float, high: float) -> str:
    """The accuracy of a two-sample test, and its interval, in words."""
    return f"{100 * accuracy:.1f} % ({100 * low:.1f} to {100 * high:.1f} %)"


def real_halves(images: Pictures, inside: np.ndarray, *, classifier: PatchClassifier = SMALL, progress: Step = unheard) -> TwoSample:
    """Test two halves of one set of frames, for ``DIVISIONS`` random divisions: all pairs of frames together.

    Parameters
    ----------
    images : list of (H, W, 3) or (H, W) uint8
        4 or more frames; of an odd number one is left out of each division.
    inside, classifier, progress
        As `two_sample` takes them.

    Raises
    ------
    FrameError
        There are fewer than four frames.
    """
    rng, half, correct = np.random.default_rng(0), len(images) // 2, []
    for division in range(DIVISIONS):
        order = rng.permutation(len(images))
        first, second = ([images[k] for k in part] for part in (order[:half], order[half : 2 * half]))
        step = partial(_part, progress, division, DIVISIONS)
        correct.append(two_sample(first, second, inside, classifier=classifier, seed=division, progress=step).by_pair)
    return _outcome(np.concatenate(correct), rng)


def _part(progress: Step, number: int, parts: int, done: int, total: int) -> None:
    """Tell the progress of one of several equal parts as that of the whole."""
    progress(number * total + done, parts * total)


def _outcome(correct: np.ndarray, rng: np.random.Generator) -> TwoSample:
    """The result of the accuracies (M,) of pairs of frames."""
    means = correct[rng.integers(len(correct), size=(RESAMPLES, len(correct)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return TwoSample(float(correct.mean()), float(low), float(high), correct)


def as_color(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of a colour or gray frame."""
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


def patch_corners(inside: np.ndarray) -> np.ndarray:
    """(k, 2) row and column of the first pixel of every patch with at least nine tenths of its area in the disc.

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


def patch_network(classifier: PatchClassifier = SMALL) -> nn.Module:
    """A network, not trained, that gives patches (B, 3, p, p) one number each, (B,): the larger, the likelier they are real."""
    layers, before, stride = [], 3, classifier.first_stride
    for channels in classifier.channels:
        layers += [nn.Conv2d(before, channels, 3, stride=stride, padding=1), nn.BatchNorm2d(channels), nn.ReLU()]
        before, stride = channels, 2
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(before, 1), nn.Flatten(0))


def _train_classifier(
    classifier: PatchClassifier, sets: list[np.ndarray], frames: np.ndarray, corners: np.ndarray, rng: np.random.Generator, seed: int
) -> nn.Module:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = patch_network(classifier)
    steps = classifier.epochs * -(-2 * len(frames) * PATCHES // BATCH)
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    network.train()
    for _ in range(classifier.epochs):
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
