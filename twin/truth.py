"""Exact ground truth of a rendered contact: where every cap is, in space and in the frame."""

from dataclasses import dataclass

import numpy as np

from scenes.sensor import SensorSpec
from twin.preprocess.forms import frame_size, from_raw
from twin.projection import pixel_rays, project
from twin.types import ContactState, Form


@dataclass(frozen=True)
class CapTruth:
    """Caps of one contact, in the specification's pin order.

    Attributes
    ----------
    caps_mm : (N, 3) float
        Cap centres, sensor frame.
    caps_px, rest_px : (N, 2) float
        Their projections in px of the frame, now and at rest.
    visible : (N,) bool
        Inside the frame, and the line of sight to the cap's centre meets no other pin.
    """

    caps_mm: np.ndarray
    caps_px: np.ndarray
    rest_px: np.ndarray
    visible: np.ndarray


def cap_truth(spec: SensorSpec, rest: ContactState, state: ContactState, form: Form) -> CapTruth:
    """Ground truth of a contact for frames of the given form."""
    caps_px = from_raw(spec, form, project(spec, state.caps_mm))
    rest_px = from_raw(spec, form, project(spec, rest.caps_mm))
    inside = np.all((caps_px >= -0.5) & (caps_px <= np.array(frame_size(spec, form)) - 0.5), axis=1)
    return CapTruth(state.caps_mm, caps_px, rest_px, inside & ~occluded(spec, state))


def occluded(spec: SensorSpec, state: ContactState) -> np.ndarray:
    """(N,) bool: the ray in the gel from the window to the cap's centre passes through another pin.

    Pins count as capsules of the cap's radius around the axis from foot to cap.
    """
    window_mm, _ = pixel_rays(spec, project(spec, state.caps_mm))
    radius = spec.pins.cap_diameter_mm / 2
    count = len(state.caps_mm)
    hidden = np.zeros(count, bool)
    for i in range(count):
        gap = _segment_distance(window_mm[i], state.caps_mm[i], state.base_mm, state.caps_mm)
        gap[i] = np.inf
        hidden[i] = gap.min(initial=np.inf) < radius
    return hidden


def _segment_distance(p0: np.ndarray, p1: np.ndarray, q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """Distance of the segment p0-p1 (3,) to each of the segments q0-q1 (n, 3) (Ericson 2004, 5.1.9)."""
    d1, d2, r = p1 - p0, q1 - q0, p0 - q0
    a, e, f = d1 @ d1, np.einsum("ij,ij->i", d2, d2), np.einsum("ij,ij->i", d2, r)
    b, c = d2 @ d1, r @ d1
    denominator = a * e - b * b
    s = np.clip(np.divide(b * f - c * e, denominator, out=np.zeros_like(f), where=denominator > 1e-12), 0, 1)
    t = np.clip((b * s + f) / e, 0, 1)
    s = np.clip((t * b - c) / a, 0, 1)
    return np.linalg.norm(p0 + s[:, None] * d1 - (q0 + t[:, None] * d2), axis=1)
