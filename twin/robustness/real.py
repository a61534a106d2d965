"""Real frames as a source: pins that several detectors agree on are taken as the truth."""

import numpy as np

from scenes.sensor import SensorSpec
from twin.detectors import DetectorSpec, make_detector
from twin.errors import FrameError
from twin.robustness.shots import RealSource
from twin.types import Frame

# Two detectors agree on a pin if their places differ by less than this share of the pins' median spacing. Chosen.
AGREE = 0.15
# Least share of the pins that must be agreed on: else the frame is refused.
LEAST_KNOWN = 0.97
# Detectors that must agree on a pin.
LEAST_AGREEING = 2


def consensus(spec: SensorSpec, frames: list[Frame], detectors: list[DetectorSpec]) -> tuple[RealSource, list[str]]:
    """Frames whose pins at least two detectors see at the same places, and why others were refused.

    Raises
    ------
    FrameError
        No frame is left.
    """
    finders = [make_detector(spec, detector) for detector in detectors]
    kept, truth, refused = [], [], []
    for frame in frames:
        seen = np.stack([found.pins_px for found in (find(frame) for find in finders) if found.pins_px is not None])
        middle, agreeing = _agreed(seen)
        known = agreeing >= LEAST_AGREEING
        if known.mean() < LEAST_KNOWN:
            refused.append(f"{frame.name}: the detectors agree on {int(known.sum())} of {len(known)} pins only")
            continue
        kept.append(frame)
        truth.append(np.where(known[:, None], middle, np.nan))
    if not kept:
        raise FrameError(
            f"none of {len(frames)} frames is good enough to start from; the first: {refused[0]}; try 'twin tune', then 'twin check'"
        )
    return RealSource(spec, tuple(kept), np.stack(truth)), refused


def _agreed(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Place (N, 2) of each pin, the first detector's among those that agree with it, and how many (N,) agree, by D detectors (D, N, 2)."""
    pitch = np.nanmedian(np.sort(np.linalg.norm(seen[0][:, None] - seen[0][None], axis=2), axis=1)[:, 1])
    near = np.linalg.norm(seen - seen[0], axis=2) < AGREE * pitch
    return np.where(np.isfinite(seen[0]), seen[0], np.nan), near.sum(axis=0)
