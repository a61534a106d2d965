"""Caps that touch and merged into one component: one disc each, where the pixels allow."""

from dataclasses import replace

import numpy as np

from twin.preprocess.blobs import Blobs
from twin.preprocess.matching import Match
from twin.preprocess.reference import Reference

REACH = 0.4  # how far from a pin's predicted place a component may lie to be claimed, in spacings
MIN_AREA_SHARE = 0.65  # of the areas expected of all claimants: less is one cap, not several
MIN_SEPARATION = 0.6  # of two parts, in cap diameters
MIN_PART = 0.4  # of the weight of the smallest part, to an equal share
ROUNDS = 12
MANY, ROUNDS_OF_MANY = 24, 3  # parts of a net that scratches or glare make: it is large, and each round takes its time
MIN_ELONGATION = 2.0  # of a chain: two touching discs have 5
ODD_ELONGATION = 1.5  # of a chain, to the median of the blobs around: all caps near the rim are long
MIN_CAPS, MAX_CAPS = 1.35, 5.0  # area of a chain, in median areas of its neighbours
NECK = 0.7  # width of a neck to that of the narrower part beside it
MIN_CAPS_NECKED = 1.0  # area of a necked chain, likewise
AROUND = 13  # blobs that median is taken over


def _label_near(blobs: Blobs, px: np.ndarray, reach_px: float) -> int:
    """Label of the component at a place (2,) in the frame, or of the nearest within reach; 0 for none."""
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
    return level - float(level.min()) if np.ptp(level) else np.ones(len(level))


def _neck(along: np.ndarray, weight: np.ndarray) -> float | None:
    """Where along its axis a component is narrow between two wide parts, from its pixels' places (p,) along it; else None."""
    low = np.floor(along.min())
    width = np.bincount((along - low).astype(int), weight)
    width = np.convolve(width, [0.25, 0.5, 0.25])[1:-1]
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
    middle = np.average(pixels, axis=0, weights=weight)
    pixels = pixels - middle
    centers = seeds_px - seeds_px.mean(axis=0)
    share = np.zeros(len(centers))
    for _ in range(ROUNDS if len(centers) < MANY else ROUNDS_OF_MANY):
        owner = ((centers**2).sum(axis=1) - 2 * pixels @ centers.T).argmin(axis=1)  # nearest; a large component has many of both
        share = np.bincount(owner, weight, len(centers))
        if (share <= 0).any():
            break
        moved = np.stack([np.bincount(owner, weight * pixels[:, axis], len(centers)) / share for axis in (0, 1)], axis=1)
        if np.abs(moved - centers).max() < 1e-3:
            break
        centers = moved
    return middle + centers, share / weight.sum()


def _with_parts(blobs: Blobs, split: list[int], px: list, area_px2: list, label: list) -> Blobs:
    rest = ~np.isin(blobs.label, split)
    return replace(
        blobs,
        px=np.concatenate([blobs.px[rest], px]),
        area_px2=np.concatenate([blobs.area_px2[rest], area_px2]),
        elongation=np.concatenate([blobs.elongation[rest], np.ones(len(px))]),
        label=np.concatenate([blobs.label[rest], label]),
    )


def split_chains(blobs: Blobs) -> Blobs:
    """The blobs, with each that is as long and large as two (or more) of its neighbours replaced by that many parts."""
    long = np.flatnonzero(blobs.elongation > MIN_ELONGATION)
    if not len(long) or len(blobs.px) < AROUND:
        return blobs
    distance2 = ((blobs.px - blobs.px[long, None]) ** 2).sum(axis=2)
    around = np.argpartition(distance2, AROUND - 1, axis=1)[:, :AROUND]
    odd = blobs.elongation[long] > ODD_ELONGATION * np.median(blobs.elongation[around], axis=1)
    caps_in = blobs.area_px2[long] / np.median(blobs.area_px2[around], axis=1)
    split, px, part_area, part_label = [], [], [], []
    for k, caps in zip(long[odd], caps_in[odd], strict=True):
        pixels, level = blobs.pixels(int(blobs.label[k]))
        weight = _weight(level)
        middle = np.average(pixels, axis=0, weights=weight)
        axis = np.linalg.eigh(np.cov(pixels.T, aweights=weight))[1][:, 1]
        along = (pixels - middle) @ axis
        neck = _neck(along, weight)
        if not (MIN_CAPS_NECKED if neck is not None else MIN_CAPS) < caps < MAX_CAPS:
            continue
        count = 2 if neck is not None else max(int(np.round(caps)), 2)
        if neck is not None:
            owner = along > neck
            share = np.array([weight[~owner].sum(), weight[owner].sum()]) / weight.sum()
            centers = [np.average(pixels[part], axis=0, weights=weight[part]) for part in (~owner, owner)]
        else:
            seeds = middle + np.outer(np.quantile(along, (np.arange(count) + 0.5) / count), axis)
            centers, share = _parts(blobs, int(blobs.label[k]), seeds)
        if share.min() > MIN_PART / count:
            split.append(int(blobs.label[k]))
            px += list(centers)
            part_area += list(share * blobs.area_px2[k])
            part_label += [int(blobs.label[k])] * count
    return _with_parts(blobs, split, px, part_area, part_label) if split else blobs


def split_merged(reference: Reference, blobs: Blobs, found: Match) -> Blobs:
    """The blobs, with each component that several pins claim replaced by as many parts.

    A component is claimed by the pins it, or part of it, was matched to and by lost pins predicted on it. It is split if it is large
    enough for all claimants and falls into as many parts of a cap's size.
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
    px, part_area, part_label, split = [], [], [], []
    for label, pins in claims.items():
        pins += np.flatnonzero(owned_label == label).tolist()
        around = area[reference.neighbours[pins]]
        if len(pins) < 2 or not np.isfinite(around).any():
            continue
        expected = float(np.nanmedian(around))
        whole = blobs.label_area_px2[label]
        if whole < MIN_AREA_SHARE * expected * len(pins):
            continue
        centers, share = _parts(blobs, label, found.predicted_px[pins])
        apart = np.linalg.norm(centers[:, None] - centers, axis=2) + np.diag(np.full(len(pins), np.inf))
        if apart.min() > MIN_SEPARATION * 2 * np.sqrt(expected / np.pi) and share.min() > MIN_PART / len(pins):
            split.append(label)
            px += list(centers)
            part_area += list(share * whole)
            part_label += [label] * len(pins)
    if not split:
        return blobs
    return _with_parts(blobs, split, px, part_area, part_label)
