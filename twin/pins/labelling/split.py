"""Splitting of components that consist of several touching caps into one disc for each cap, if the pixels allow it."""

from dataclasses import replace

import numpy as np

from twin.frames.forms import levels_at
from twin.pins.finding.blobs import Blobs
from twin.pins.labelling.matching import Match
from twin.pins.labelling.reference import Reference

# All limits were chosen, not derived.
# Largest distance, in spacings, from a pin's predicted place to a component that the pin may claim, and to the part that it gets.
REACH = 0.4
# Least area of a component that is split, relative to the sum of the areas expected of all pins that claim it. A smaller one is one cap.
MIN_AREA_SHARE = 0.65
# Largest such area. A larger component is glare, or a hole in the threshold, and its shape states no pins' places.
MAX_AREA_SHARE = 1.5
# Number of neighbours of a pin towards which the surroundings of its part are compared. A part is in a bright area if it is not brighter
# than at least half of these places by a share of the component's height above the darkest, and largest share of such parts.
AROUND_PART, LEAST_ABOVE, MOST_BRIGHT = 6, 0.15, 0.25
# Least distance of two parts, in cap diameters.
MIN_SEPARATION = 0.6
# Least weight of the smallest part, relative to the mean weight of the parts.
MIN_PART = 0.4
# Rounds of k-means.
ROUNDS = 12
# Number of parts above which a component is a net of scratches or glare, and number of k-means rounds for such a component. The number is
# smaller, because the component is large and each round is slow.
MANY, ROUNDS_OF_MANY = 24, 3
# Shift of the parts' centres, px, below which k-means ends.
SETTLED_PX = 1e-3
# Least elongation of a chain of caps. Two touching discs have an elongation of 5.
MIN_ELONGATION = 2.0
# Least elongation of a chain, relative to the median of the blobs around it, because near the rim all caps are elongated.
ODD_ELONGATION = 1.5
# Least and largest area of a chain, in median areas of the blobs around it.
MIN_CAPS, MAX_CAPS = 1.35, 5.0
# Largest width of a neck, relative to the narrower one of the parts beside it.
NECK = 0.7
# Least area of a chain with a neck, in median areas of the blobs around it.
MIN_CAPS_NECKED = 1.0
# Number of blobs, including the chain itself, over which these medians are taken.
AROUND = 13


def _label_near(blobs: Blobs, px: np.ndarray, reach_px: float) -> int:
    """Label of the component at a place (2,) in the frame, or of the nearest one within reach; 0 if there is none."""
    column, row = np.round(px - blobs.corner_px).astype(int)
    reach = int(np.ceil(reach_px))
    height, width = blobs.labels.shape
    if not (0 <= column < width and 0 <= row < height):
        return 0
    top, left = max(row - reach, 0), max(column - reach, 0)
    patch = blobs.labels[top : row + reach + 1, left : column + reach + 1]
    rows, columns = np.nonzero(patch)
    if not len(rows):
        return 0
    nearest = np.argmin((rows + top - row) ** 2 + (columns + left - column) ** 2)
    return int(patch[rows[nearest], columns[nearest]])


def _weight(level: np.ndarray) -> np.ndarray:
    """Weights (p,) of pixels: their levels above the darkest one; 1 if all levels are equal."""
    return level - float(level.min()) if np.ptp(level) else np.ones(len(level))


def _average(pixels: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted mean (2,) of pixels (p, 2): as ``np.average``, in a quarter of its time."""
    mean: np.ndarray = (pixels * weight[:, None]).sum(axis=0) / weight.sum()
    return mean


def _neck(along: np.ndarray, weight: np.ndarray) -> float | None:
    """Place along a component's axis at which it is narrow between two wide parts; None if there is no such neck.

    ``along`` (p,) are the places of its pixels along the axis, px; ``weight`` (p,) their weights.
    """
    low = np.floor(along.min())
    width = np.convolve(np.bincount((along - low).astype(int), weight), [0.25, 0.5, 0.25])[1:-1]  # smoothed, for each px of the axis
    inner = np.arange(2, len(width) - 2)
    if not len(inner):
        return None
    left, right = np.maximum.accumulate(width), np.maximum.accumulate(width[::-1])[::-1]
    ratio = width[inner] / np.minimum(left[inner], right[inner])
    narrowest = ratio.argmin()
    return float(low + inner[narrowest] + 0.5) if ratio[narrowest] < NECK else None


def _parts(blobs: Blobs, label: int, seeds_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted k-means of a component's pixels from seeds: centres (n, 2) px of the frame, shares of the weight (n,)."""
    pixels, level = blobs.pixels(label)
    weight = _weight(level)
    middle = _average(pixels, weight)
    pixels = pixels - middle
    centers = seeds_px - seeds_px.mean(axis=0)
    share: np.ndarray = np.zeros(len(centers))
    for _ in range(ROUNDS if len(centers) < MANY else ROUNDS_OF_MANY):
        owner = ((centers**2).sum(axis=1) - 2 * pixels @ centers.T).argmin(axis=1)  # nearest centre, by an array of only (p, n)
        share = np.bincount(owner, weight, len(centers))
        if (share <= 0).any():
            break
        moved = np.stack([np.bincount(owner, weight * pixels[:, axis], len(centers)) / share for axis in (0, 1)], axis=1)
        if np.abs(moved - centers).max() < SETTLED_PX:
            break
        centers = moved
    return middle + centers, share / weight.sum()


def _with_parts(blobs: Blobs, parts: dict[int, tuple[np.ndarray, np.ndarray]]) -> Blobs:
    """The blobs, in which those with the labels of ``parts`` are replaced by their parts at places (n, 2) with areas (n,)."""
    if not parts:
        return blobs
    rest, (px, area_px2) = ~np.isin(blobs.label, list(parts)), map(np.concatenate, zip(*parts.values(), strict=True))
    label = np.repeat(list(parts), [len(places) for places, _ in parts.values()])
    return replace(
        blobs,
        px=np.concatenate([blobs.px[rest], px]),
        area_px2=np.concatenate([blobs.area_px2[rest], area_px2]),
        elongation=np.concatenate([blobs.elongation[rest], np.ones(len(px))]),
        label=np.concatenate([blobs.label[rest], label]),
    )


def _both_sides(pixels: np.ndarray, weight: np.ndarray, beyond: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (2, 2) and shares of the weight (2,) of the pixels (p, 2) on both sides of a neck; ``beyond`` (p,) is the second side."""
    share = np.array([weight[~beyond].sum(), weight[beyond].sum()]) / weight.sum()
    return np.stack([_average(pixels[part], weight[part]) for part in (~beyond, beyond)]), share


def split_chains(blobs: Blobs) -> Blobs:
    """Split each blob that is as long and as large as two or more of its neighbours into that many parts. Returns the new blobs."""
    long = np.flatnonzero(blobs.elongation > MIN_ELONGATION)
    if not len(long) or len(blobs.px) < AROUND:
        return blobs
    distance2 = ((blobs.px - blobs.px[long, None]) ** 2).sum(axis=2)
    around = np.argpartition(distance2, AROUND - 1, axis=1)[:, :AROUND]
    odd = blobs.elongation[long] > ODD_ELONGATION * np.median(blobs.elongation[around], axis=1)
    caps_in = blobs.area_px2[long] / np.median(blobs.area_px2[around], axis=1)
    parts: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    odd &= (caps_in > MIN_CAPS_NECKED) & (caps_in < MAX_CAPS)
    for k, caps in zip(long[odd], caps_in[odd], strict=True):
        pixels, level = blobs.pixels(int(blobs.label[k]))
        weight = _weight(level)
        middle = _average(pixels, weight)
        away = pixels - middle
        axis = np.linalg.eigh(np.dot(away.T, away * weight[:, None]))[1][:, 1]
        along = away @ axis
        neck = _neck(along, weight)
        if neck is None and caps <= MIN_CAPS:
            continue
        count = 2 if neck is not None else max(int(np.round(caps)), 2)
        if neck is not None:
            centers, share = _both_sides(pixels, weight, along > neck)
        else:
            seeds = middle + np.outer(np.quantile(along, (np.arange(count) + 0.5) / count), axis)
            centers, share = _parts(blobs, int(blobs.label[k]), seeds)
        if share.min() > MIN_PART / count:
            parts[int(blobs.label[k])] = centers, share * blobs.area_px2[k]
    return _with_parts(blobs, parts)


def _bright_around(reference: Reference, blobs: Blobs, found: Match, pins: list[int], centers: np.ndarray) -> bool:
    """Whether the parts of a component at ``centers`` (n, 2), for ``pins`` (n,), lie in or along a bright area: glare, which hides pins.

    Touching caps form a chain or a small clump. Half of the way to most of its neighbours, a cap's surroundings are dark.
    """
    middle = (centers[:, None] + found.predicted_px[reference.neighbours[pins, :AROUND_PART]]) / 2
    between = levels_at(blobs.gray, np.nan_to_num(middle - blobs.corner_px))
    height = levels_at(blobs.gray, centers - blobs.corner_px)[:, None] - np.sort(between, axis=1)
    return bool(np.mean(height[:, AROUND_PART // 2] <= LEAST_ABOVE * height[:, 0].max()) > MOST_BRIGHT)


def split_merged(reference: Reference, blobs: Blobs, found: Match) -> Blobs:
    """Split each component that several pins claim into as many parts. Returns the new blobs.

    A pin claims a component if the component or a part of it was matched to the pin, or if the pin is lost and its predicted place is
    there. The component is split if it is large enough for all pins that claim it, and its parts have the size of caps.
    """
    labelled = found.blob >= 0
    claims: dict[int, list[int]] = {}
    for pin in np.flatnonzero(~labelled & np.isfinite(found.predicted_px).all(axis=1)):
        label = _label_near(blobs, found.predicted_px[pin], REACH * reference.spacing_px[pin])
        if label:
            claims.setdefault(label, []).append(int(pin))
    if not claims:
        return blobs
    owned_label = np.where(labelled, blobs.label[found.blob], 0)
    area = np.full(len(found.blob), np.nan)
    area[labelled] = blobs.area_px2[found.blob[labelled]]
    parts: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for label, pins in claims.items():
        pins += np.flatnonzero(owned_label == label).tolist()
        around = area[reference.neighbours[pins]]
        if len(pins) < 2 or not np.isfinite(around).any():
            continue
        expected = float(np.nanmedian(around))
        whole = blobs.label_area_px2[label]
        if not MIN_AREA_SHARE < whole / (expected * len(pins)) < MAX_AREA_SHARE:
            continue
        centers, share = _parts(blobs, label, found.predicted_px[pins])
        away = np.linalg.norm(centers - found.predicted_px[pins], axis=1) / reference.spacing_px[pins]
        apart = np.linalg.norm(centers[:, None] - centers, axis=2) + np.diag(np.full(len(pins), np.inf))
        separate = apart.min() > MIN_SEPARATION * 2 * np.sqrt(expected / np.pi) and share.min() > MIN_PART / len(pins)
        if separate and away.max() < REACH and not _bright_around(reference, blobs, found, pins, centers):
            parts[label] = centers, share * whole
    return _with_parts(blobs, parts)
