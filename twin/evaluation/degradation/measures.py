"""The measures of a degraded frame, and the limits at which they count as failed."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from twin.evaluation.degradation.shots import DegradedFrame
from twin.pins.detectors.detector import Detector, Found, reorder_to

# Largest distance between a detected position and its pin, relative to the distance of the pin's nearest neighbour. It was chosen
# below one half, so that a detection counts for one pin at most.
GATE = 0.35
# Cost of a pair outside the gate, px. It is far above any distance in a picture.
OUT_OF_REACH = 1e6


@dataclass(frozen=True)
class Measure:
    """One measured quantity of a frame.

    Attributes
    ----------
    name, title, unit : str
    limit : float
        Limit of the mean over the contacts.
    least : bool
        Whether the limit is the smallest permitted value instead of the largest.
    in_pitches : bool
        Whether the unit of the limit is the mean distance of neighbouring pins instead of ``unit``.
    """

    name: str
    title: str
    unit: str
    limit: float
    least: bool
    in_pitches: bool = False

    def exceeds(self, value: float, limit: float) -> bool:
        """Whether a value exceeds a limit."""
        return value < limit if self.least else value > limit


MEASURES = (
    Measure("valid", "valid frames", "", 0.95, True),
    Measure("recall", "recall of pins", "", 0.97, True),
    Measure("precision", "precision of pins", "", 0.97, True),
    Measure("centroid_px", "centroid error, rms", "px", 0.06, False, in_pitches=True),
    Measure("swaps", "misidentified pins", "", 0.01, False),
    Measure("area_error", "Voronoi area error, median", "", 0.05, False),
    Measure("edges", "edges retained", "", 0.93, True),
)
POSE_MEASURES = (
    Measure("pose_valid", "frames with a pose", "", 0.95, True),
    Measure("pose_wrong", "confidently wrong poses", "", 1 / 30, False),
    Measure("pose_mm", "pose error, lengths", "mm", 0.2, False),
    Measure("pose_deg", "pose error, angles", "deg", 2.0, False),
)


def measure_frame(detector: Detector, found: Found, degraded: DegradedFrame) -> dict[str, float]:
    """The measures of one frame. A measure is NaN if it is undefined (no labels, no graph, or no pairs)."""
    truth_px = degraded.caps_px
    known = np.isfinite(truth_px[:, 0])
    spacing = np.full(len(truth_px), np.nan)
    spacing[known] = cKDTree(truth_px[known]).query(truth_px[known], k=2)[0][:, 1]
    pin, claim = _pairs(found.claims_px, truth_px, GATE * spacing)
    right = degraded.visible[pin]
    apart = np.linalg.norm(found.claims_px[claim[right]] - truth_px[pin[right]], axis=1)
    doubtful = known & ~degraded.visible  # a hidden cap may be partly visible, so a detection there is neither right nor wrong
    beside_unknown = min(len(found.claims_px) - int(known.sum()), int((~known).sum()))  # the consensus of detectors may lack some pins
    claims = len(found.claims_px) - int(doubtful[pin].sum()) - max(0, beside_unknown)
    area, edges = _graph_errors(detector, found, degraded)
    return {
        "valid": float(found.valid),
        "recall": float(right.sum()) / max(int(degraded.visible.sum()), 1),
        "precision": float(right.sum()) / claims if claims > 0 else np.nan,
        "centroid_px": float(np.sqrt(np.mean(apart**2))) if len(apart) else np.nan,
        "swaps": _swaps(found, truth_px, GATE * spacing),
        "area_error": area,
        "edges": edges,
    }


def _pairs(claims_px: np.ndarray, truth_px: np.ndarray, gate_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of pins and detections, one to one within each pin's gate. The nearest are paired first."""
    known = np.flatnonzero(np.isfinite(gate_px))
    distance = np.linalg.norm(truth_px[known][:, None] - claims_px, axis=2)
    near = distance < gate_px[known][:, None]
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    cost = np.where(near, distance, OUT_OF_REACH)[np.ix_(rows, columns)]
    r, c = linear_sum_assignment(cost)
    good = cost[r, c] < OUT_OF_REACH
    return known[rows[r[good]]], columns[c[good]]


def _swaps(found: Found, truth_px: np.ndarray, gate_px: np.ndarray) -> float:
    """Share of the pins whose label is at another pin's place."""
    if found.pins_px is None or not np.isfinite(found.pins_px[:, 0]).any():
        return np.nan
    seen, known = (np.flatnonzero(np.isfinite(px[:, 0])) for px in (found.pins_px, truth_px))
    distance, nearest = cKDTree(truth_px[known]).query(found.pins_px[seen])
    at = known[nearest]
    return float(np.mean((distance < gate_px[at]) & (at != seen)))


def _graph_errors(detector: Detector, found: Found, degraded: DegradedFrame) -> tuple[float, float]:
    """Median relative error of the cells' areas, and share of common edges, compared with the method's own graph of the true pins."""
    if found.graph is None or not np.isfinite(degraded.caps_px).all():
        return np.nan, np.nan
    graph = found.graph if found.pins_px is not None else reorder_to(found.graph, found.claims_px, degraded.caps_px)
    true = detector.graph_of(degraded.caps_px)
    if true is None:
        return np.nan, np.nan
    there = degraded.visible & np.isfinite(graph.area_px2) & np.isfinite(true.area_px2) & (true.area_px2 > 0)
    area = float(np.median(np.abs(graph.area_px2[there] / true.area_px2[there] - 1))) if there.any() else np.nan
    ours, others = ({tuple(edge) for edge in of.edges.tolist()} for of in (graph, true))
    return area, len(ours & others) / max(len(ours | others), 1)
