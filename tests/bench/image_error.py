"""What the renders' bench measures: time, memory, and how far a frame's gray levels and centroids are from a converged one's."""

import resource
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time

import numpy as np

from scenes.sensor import SensorSpec
from twin.camera.capture import expose

SPOT = 0.5  # of the distance to the next cap: what counts to a cap's centroid
SKIN_SHARE = 20  # percentile of the gray levels around a cap that is skin


def timed_ms(call, repeats: int, warm_up: int = 2) -> tuple[float, float]:
    """Medians over ``call(k)`` for k = 0, 1, ..., after a few, in ms: wall-clock time, and CPU time of all threads."""
    taken = []
    for k in range(warm_up + repeats):
        wall, cpu = perf_counter(), process_time()
        call(k)
        taken.append((perf_counter() - wall, process_time() - cpu))
    return tuple((1e3 * np.median(taken[warm_up:], axis=0)).tolist())


def memory_mb() -> tuple[float, float]:
    """Resident memory of this process now, and at its peak."""
    status = Path("/proc/self/status")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    lines = status.read_text().splitlines() if status.exists() else []
    return next((float(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS")), peak), peak


@dataclass(frozen=True)
class Truth:
    """A converged frame's gray levels, and where in it the caps and the sensor's disc are.

    Attributes
    ----------
    spec : SensorSpec
        Its response makes gray levels of light, without noise.
    linear : (H, W) or (H, W, 3) float
    places_px : (N, 2) float
        About where each cap is seen.
    middle_px, radius_px
        The disc in which gray levels are compared.
    """

    spec: SensorSpec
    linear: np.ndarray
    places_px: np.ndarray
    middle_px: np.ndarray
    radius_px: float

    def errors(self, linear: np.ndarray) -> tuple[float, float, float]:
        """Of another picture: gray levels rms, centroids rms (px), centroids median (px)."""
        grays = [self._gray(light) for light in (linear, self.linear)]
        y, x = np.mgrid[: grays[0].shape[0], : grays[0].shape[1]]
        inside = np.hypot(x - self.middle_px[0], y - self.middle_px[1]) < self.radius_px
        apart = np.linalg.norm(np.subtract(*(centroids(gray, self.places_px) for gray in grays)), axis=1)
        return float(np.sqrt(np.mean(np.diff(grays, axis=0)[0][inside] ** 2))), float(np.sqrt(np.mean(apart**2))), float(np.median(apart))

    def _gray(self, linear: np.ndarray) -> np.ndarray:
        gray = expose(linear, self.spec.capture).astype(float)
        return gray.mean(axis=2) if gray.ndim == 3 else gray


def centroids(gray: np.ndarray, places_px: np.ndarray) -> np.ndarray:
    """Centroids (N, 2) of what is brighter than half way between each cap and the skin around it."""
    apart = np.linalg.norm(places_px[:, None] - places_px, axis=2) + 1e9 * np.eye(len(places_px))
    y, x = np.mgrid[: gray.shape[0], : gray.shape[1]]
    found = []
    for (u, v), near in zip(places_px, SPOT * apart.min(axis=1), strict=True):
        box = np.s_[max(int(v - near), 0) : int(v + near) + 2, max(int(u - near), 0) : int(u + near) + 2]
        inside = np.hypot(x[box] - u, y[box] - v) < near
        level = np.percentile(gray[box][inside], (SKIN_SHARE, 100)).mean()
        weight = np.where(inside, np.maximum(gray[box] - level, 0), 0)
        found.append([(weight * x[box]).sum() / weight.sum(), (weight * y[box]).sum() / weight.sum()])
    return np.array(found)
