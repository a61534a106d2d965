"""A stand-in for a trained model: it knows where the simulated arm was when the frame was exposed, and what is there."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TrueEstimate:
    """As a model's, with no width."""

    names: tuple
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    valid: bool = True
    reason: str = ""
    seen: None = None

    @property
    def units(self) -> tuple:
        return tuple("deg" if name[-1] in "456" else "mm" for name in self.names)


class TrueEstimator:
    """Callable like a model. ``noise_mm`` and ``noise_deg`` are standard deviations; ``fail`` gives a reason to be not valid."""

    def __init__(self, arm, placed, *, noise_mm: float = 0.0, noise_deg: float = 0.0, seed: int = 0) -> None:
        self._arm, self._placed = arm, placed
        self._sd, self._rng = (noise_mm, noise_deg), np.random.default_rng(seed)
        self.fail, self.calls = "", 0

    def __call__(self, frame) -> TrueEstimate:
        self.calls += 1
        touch, mounting = self._placed.touch(self._arm.track.pose(frame.time_s)), self._placed.mounting
        value = np.array(mounting.labels(touch.depth_mm, touch.angle_deg)) + self._rng.normal(0, self._sd)
        return TrueEstimate((mounting.depth_label, mounting.angle_label), value, value, value, not self.fail, self.fail)
