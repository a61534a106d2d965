"""Small renders of the shipped sensors, and their means and variances: what ``make golden`` keeps and the golden test compares with.

Not pixels but statistics are kept, because another compiler or another order of samples changes pixels and nothing that matters: of blocks
of ``BLOCK_PX`` x ``BLOCK_PX`` px the mean over independent renders and the variance of one of them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scaled_sensor import scaled
from scipy import stats

from scenes import load_sensor
from scenes.sensor import SensorSpec
from twin.geometry.pins import PinRest, rest_pins
from twin.optics.relief import DETAILS, without
from twin.optics.render import Renderer

BLOCK_PX = 4
SPP = 16
KEPT, COMPARED = 48, 6  # renders of the reference, with seeds of their own, and of the test
FIRST_KEPT_SEED = 1000
DIM = 0.02  # of the brightest block: below, rare paths make the noise, and no variance of a few renders knows them; they may differ by this
LEAST_NOISE = 1e-3  # relative standard deviation: below it a block shows little but the static layer, which has none
STEADY = 5e-3  # relative: what such a block may differ by, five times that noise


@dataclass(frozen=True)
class Case:
    """A sensor on a smaller film, at rest or pressed by ``dent_mm``."""

    sensor: str
    scale: float
    dent_mm: float

    def spec(self) -> SensorSpec:
        """The shipped specification's smooth model, which does not change with what was measured on top of it, with the case's film."""
        return scaled(without(load_sensor(self.sensor), DETAILS), self.scale)


CASES = {
    "mg400-331 at rest": Case("mg400-331", 0.2, 0.0),
    "mg400-127 pressed": Case("mg400-127", 0.2, 2.0),
    "ur5-331 pressed": Case("ur5-331", 0.15, 2.0),
}


def dented(spec: SensorSpec, depth_mm: float) -> PinRest:
    """Pins of a skin that is pushed in by a smooth dent beside the tip, by a formula: golden renders do not depend on mechanics."""
    rest = rest_pins(spec.geometry)
    way = np.exp(-np.sum((rest.base_mm[:, :2] - [3.0, -2.0]) ** 2, axis=1) / 2 / 6.0**2)
    shift = -depth_mm * way[:, None] * np.array([0.2, 0.1, 1.0])
    return PinRest(rest.base_mm + shift, rest.axis, rest.caps_mm + shift)


def block_means(image: np.ndarray) -> np.ndarray:
    """(rows, columns) or (rows, columns, 3) means of whole blocks of an image."""
    rows, columns = image.shape[0] // BLOCK_PX, image.shape[1] // BLOCK_PX
    parts = image[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX, *image.shape[2:])
    return parts.mean(axis=(1, 3))


def renders(case: Case, spec: SensorSpec, seeds: range) -> np.ndarray:
    """(k, rows, columns[, 3]) block means of independent renders of a specification, in the case's state."""
    renderer = Renderer(spec, "llvm", spp=SPP)
    state = dented(spec, case.dent_mm)
    return np.stack([block_means(renderer.render(state, seed=seed)) for seed in seeds]).astype(float)


def chance(found: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> float:
    """How probable renders (k, ...) at least as far from a reference would be by noise alone; 0 where a dim or steady block is another.

    Twice the smaller chance of two tests over the other blocks. Each block's t (its difference of means over what the reference's
    variance gives for k and ``KEPT`` renders, with ``KEPT - 1`` degrees of freedom) becomes a normal score z. The sum of z^2 is a
    chi-square; the sum of z over the root of their number is normal again: it sees what makes every block a little brighter.
    """
    off = found.mean(axis=0) - mean
    noisy = (mean > DIM * mean.max()) & (variance > (LEAST_NOISE * mean) ** 2)
    if (np.abs(off[~noisy]) > np.maximum(STEADY * mean, DIM * mean.max())[~noisy]).any():
        return 0.0
    t = off[noisy] / np.sqrt(variance[noisy] * (1 / len(found) + 1 / KEPT))
    z = np.sign(t) * stats.norm.isf(np.maximum(stats.t.sf(np.abs(t), KEPT - 1), 1e-300))
    return float(2 * min(stats.chi2.sf(np.sum(z**2), z.size), 2 * stats.norm.sf(abs(z.sum()) / np.sqrt(z.size))))


def make(path: Path) -> None:
    """Write the reference of all cases."""
    arrays = {}
    for name, case in CASES.items():
        kept = renders(case, case.spec(), range(FIRST_KEPT_SEED, FIRST_KEPT_SEED + KEPT))
        arrays[f"{name}/mean"] = kept.mean(axis=0).astype(np.float32)
        arrays[f"{name}/variance"] = kept.var(axis=0, ddof=1).astype(np.float32)
        print(f"{name}: {arrays[f'{name}/mean'].shape} blocks, light {kept.mean():.4g} +- {kept.std(axis=0).mean():.2g}")
    np.savez_compressed(path, **arrays)
    print(f"wrote {path}, {path.stat().st_size / 1e3:.0f} kB; look at the renders before it is committed (--pictures DIR)")
