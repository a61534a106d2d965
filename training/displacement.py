"""Pin displacement by indentation depth: the first thing a twin must get right on a real sensor."""

import numpy as np

from training.labels import SurfaceLabels

DEPTH_EDGES_MM = (-4.0, -3.0, -2.0, -1.0, 0.0)
NEAR_ZERO = {"angle_deg": 3.0, "shear_mm": 1.0, "shear_deg": 1.0}  # frames this close to a pure press count


def displacement_by_depth(labels: SurfaceLabels, pins_px: np.ndarray, rest_px: np.ndarray) -> np.ndarray:
    """Mean pin displacement from no contact in the four 1 mm bins of ``pose_2``, pure presses only.

    Parameters
    ----------
    labels : SurfaceLabels
        M rows.
    pins_px : (M, N, 2) float
        NaN for lost pins.
    rest_px : (N, 2) float

    Returns
    -------
    (4,) float
        px; NaN where a bin has no pure press.
    """
    pure = np.all([np.abs(getattr(labels, key)) < limit for key, limit in NEAR_ZERO.items()], axis=0)
    moved = np.nanmean(np.hypot(*np.moveaxis(pins_px - rest_px, -1, 0)), axis=1)
    means = []
    for low, high in zip(DEPTH_EDGES_MM[:-1], DEPTH_EDGES_MM[1:], strict=True):
        inside = pure & (labels.depth_mm >= low) & (labels.depth_mm < high)
        means.append(float(moved[inside].mean()) if inside.any() else np.nan)
    return np.array(means)
