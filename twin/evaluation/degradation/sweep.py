"""Sweep: every case at every severity is a cell. Cells are computed in parallel and stored, and finished cells are not computed again.

A cell holds the measures of each degraded frame, which have limits at which they count as failed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from scenes import load_object
from scenes.sensor import RecordingSpec
from twin.camera.capture import in_form
from twin.estimate import SensorModel
from twin.evaluation.degradation.condition import Condition, DegradedCase
from twin.evaluation.degradation.shots import DegradedFrame, RealSource, RenderedSource
from twin.pins import DetectorSpec, Found, make_detector
from twin.pins.detectors.detector import Detector, reorder_to
from twin.store import Item, find_json, inputs_digest, keep_json, write_bytes
from twin.workers import in_processes

# Largest distance between a detected position and its pin, relative to the distance of the pin's nearest neighbour. It was chosen
# below one half, so that a detection counts for one pin at most.
GATE = 0.35
# Cost of a pair outside the gate, px. It is far above any distance in a picture.
OUT_OF_REACH = 1e6
SEVERITIES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
CELLS = "cells"
"""Name of the folder with the finished cells."""


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


class SweptModel(SensorModel, Protocol):
    """A trained model that a sweep evaluates (``training.estimate.estimator.PoseEstimator``)."""

    @property
    def label_range(self) -> np.ndarray:
        """Extent (K,) of the labels that the model was trained on. An interval wider than a third of it says nothing."""


Models = Callable[[RenderedSource | RealSource], Mapping[str, SweptModel]]
"""Function that returns models of a source's sensor by their names; each process calls it once."""


@dataclass(frozen=True)
class SweepSettings:
    """Settings of a sweep.

    Attributes
    ----------
    source : RenderedSource or RealSource
    detectors : tuple of DetectorSpec
        The detectors to compare. The pictures show the results of the first one.
    cases : tuple of Case
    severities : tuple of float
        Increasing; the first is 0.
    between : set of (str, float)
        Further severities, each with its case's name.
    models : callable, optional
        Returns models by name; each process calls it once.
    model_digests : dict of str to str
        Digest of everything that a model's estimates depend on, by the model's name.
    """

    source: RenderedSource | RealSource
    detectors: tuple[DetectorSpec, ...]
    cases: tuple[DegradedCase, ...]
    severities: tuple[float, ...] = SEVERITIES
    between: frozenset[tuple[str, float]] = frozenset()
    models: Models | None = None
    model_digests: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SweepCell:
    """One case at one severity."""

    case: DegradedCase
    severity: float
    item: Item

    @property
    def file(self) -> str:
        """Name of the cell's files, without suffix."""
        return self.item.file


def cells_of(plan: SweepSettings) -> list[SweepCell]:
    """All cells. For severity 0 there is one cell for all cases; its case is the first one."""
    base = inputs_digest(_inputs(plan))
    cells = []
    for case in plan.cases:
        for severity in sorted({*plan.severities, *(severity for name, severity in plan.between if name == case.name)}):
            degrading = () if severity == 0 else case.conditions
            name = case.name if degrading else "nominal"
            values = [[c.name, c.value(severity)] for c in degrading]
            item = Item(f"{name}-{round(1000 * severity):04d}", (__name__, *_hooks(degrading)), [base, values])
            cells.append(SweepCell(case, severity, item))
    return cells


def run_sweep(plan: SweepSettings, folder: Path, *, jobs: int, progress: Callable[[int, int], None]) -> list[dict]:
    """All rows of a sweep: one for each case, severity, frame and detector (or model).

    Finished cells are stored in ``folder/cells``. Those that were computed with the same sensor, pipelines, models and code are used
    again.
    """
    cells = cells_of(plan)
    (folder / "pictures").mkdir(parents=True, exist_ok=True)
    open_cells = {cell.file: cell for cell in cells if find_json(folder / CELLS, cell.item) is None}
    total = len({cell.file for cell in cells})
    progress(total - len(open_cells), total)
    for done, _ in enumerate(in_processes(_begin, (plan, folder), list(open_cells.values()), processes=jobs)):
        progress(total - len(open_cells) + done + 1, total)
    return [
        row | {"case": cell.case.name, "severity": cell.severity} for cell in cells for row in find_json(folder / CELLS, cell.item) or []
    ]


def _begin(plan: SweepSettings, folder: Path) -> Callable[[SweepCell], None]:
    """Function that computes and stores a cell."""
    cv2.setNumThreads(1)
    return partial(_run_cell, plan, folder, plan.models(plan.source) if plan.models else {})


def _run_cell(plan: SweepSettings, folder: Path, models: Mapping[str, SweptModel], cell: SweepCell) -> None:
    rows: list[dict] = []
    worst: tuple[float, DegradedFrame, Found] | None = None
    detectors = [make_detector(plan.source.spec, cell.case.on_setting(spec, cell.severity)) for spec in plan.detectors]
    recording = plan.source.spec.recording
    for shot in plan.source.render(cell.case, cell.severity):
        for place, detector in enumerate(detectors):
            found = detector(shot.frame)
            rows.append({"pipeline": detector.spec.name, "frame": shot.name, "reason": found.reason} | measure_frame(detector, found, shot))
            if place == 0 and (worst is None or rows[-1]["recall"] < worst[0]):
                worst = rows[-1]["recall"], shot, found
        rows += [{"pipeline": name, "frame": shot.name, "pose": _pose(model, shot, recording)} for name, model in models.items()]
    if worst is not None:
        picture = cv2.imencode(".jpg", overlay(worst[1], worst[2]))[1].tobytes()
        write_bytes(folder / "pictures" / f"{cell.file}.jpg", picture)
    keep_json(folder / CELLS, cell.item, rows)


def _pose(model: SweptModel, degraded: DegradedFrame, recording: RecordingSpec | None) -> dict:
    """A model's estimate for a frame. A raw frame is first recorded if the model was trained on recordings."""
    answer = model(in_form(degraded.frame, model.form, recording))
    numbers = {name: np.asarray(getattr(answer, name), float).tolist() for name in ("value", "low", "high")}
    numbers["range"] = np.asarray(model.label_range, float).tolist()
    return {**numbers, "units": list(answer.units), "valid": bool(answer.valid), "touched": degraded.touched}


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
    cost = np.where(distance < gate_px[known][:, None], distance, OUT_OF_REACH)
    rows, columns = linear_sum_assignment(cost)
    good = cost[rows, columns] < OUT_OF_REACH
    return known[rows[good]], columns[good]


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


def overlay(degraded: DegradedFrame, found: Found) -> np.ndarray:
    """Picture (H, W, 3) uint8 BGR of a frame: true pins that were found in green, missed ones in red, detections as dots."""
    image = degraded.frame.image
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    claims = found.claims_px
    for px, visible in zip(degraded.caps_px, degraded.visible, strict=True):
        if visible:
            near = len(claims) and np.linalg.norm(claims - px, axis=1).min() < 3
            cv2.circle(picture, tuple(int(round(v)) for v in px), 6, (90, 200, 90) if near else (60, 60, 255), 1, cv2.LINE_AA)
    for px in claims:
        cv2.circle(picture, tuple(int(round(v)) for v in px), 1, (0, 220, 255), -1)
    return picture


def _hooks(conditions: tuple[Condition, ...]) -> list[Callable]:
    """The functions of the given conditions. A cell depends on the code of its own conditions, not on that of all conditions."""
    return [hook for c in conditions for hook in (c.spec, c.light, c.frame, c.moves, c.hides, c.setting) if hook is not None]


def _inputs(plan: SweepSettings) -> list[object]:
    """All inputs that the cells have in common."""
    source = plan.source
    shared = [source.spec, plan.detectors, plan.model_digests]
    if isinstance(source, RenderedSource):
        return [*shared, [[c.name, load_object(c.object_name), c.pose] for c in source.contacts]]
    rest = () if source.rest_frame is None or not plan.model_digests else (source.rest_frame.image,)
    return [*shared, [[frame.name, frame.image] for frame in source.frames], source.caps_px, *rest]
