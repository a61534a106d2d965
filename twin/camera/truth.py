"""Exact ground truth of a rendered contact: the place of every cap in space and in the frame."""

from dataclasses import dataclass

import numpy as np

from scenes.sensor import SensorSpec, ViewSpec
from twin.camera.projection import pixel_rays, project, project_in_form
from twin.compiled import compiled
from twin.frames.forms import frame_size
from twin.types import BoolArray, FloatArray, Form, PinState


@dataclass(frozen=True)
class CapTruth:
    """Caps of one contact, in the specification's pin order.

    Attributes
    ----------
    caps_mm : (N, 3) float
        Cap centres, sensor frame.
    caps_px, rest_px : (N, 2) float
        Projections of the cap centres in px of the frame, in the contact and at rest.
    visible : (N,) bool
        The cap's centre is inside the frame, and the line of sight to it meets no other pin.
    """

    caps_mm: FloatArray
    caps_px: FloatArray
    rest_px: FloatArray
    visible: BoolArray


def cap_truth(spec: SensorSpec, rest: PinState, state: PinState, form: Form) -> CapTruth:
    """Ground truth of a contact for frames of the given form."""
    caps_px = project_in_form(spec, form, state.caps_mm)
    rest_px = project_in_form(spec, form, rest.caps_mm)
    inside = np.all((caps_px >= -0.5) & (caps_px <= np.array(frame_size(spec, form)) - 0.5), axis=1)
    return CapTruth(state.caps_mm, caps_px, rest_px, inside & ~find_occluded(spec.view, 0.5 * spec.pins.cap_diameter_mm, state))


def find_occluded(view: ViewSpec, cap_radius_mm: float, state: PinState) -> BoolArray:
    """(N,) bool: the ray in the gel from the window to the cap's centre passes through another pin.

    Each pin is approximated by a capsule of the cap's radius around the axis from foot to cap.
    """
    window_mm, _ = pixel_rays(view, project(view, state.caps_mm))
    return _meets_another(window_mm, state.base_mm, state.caps_mm, cap_radius_mm)


@compiled()
def _meets_another(eyes: FloatArray, base: FloatArray, caps: FloatArray, radius: float) -> BoolArray:
    """(N,) bool: the segment from ``eyes`` to ``caps``, (N, 3) each, comes nearer than ``radius`` to another pin's axis."""
    hidden = np.zeros(len(caps), np.bool_)
    for i in range(len(caps)):
        for j in range(len(caps)):
            if j != i and segment_distance(eyes[i], caps[i], base[j], caps[j]) < radius:
                hidden[i] = True
                break
    return hidden


@compiled()
def segment_distance(p0: FloatArray, p1: FloatArray, q0: FloatArray, q1: FloatArray) -> float:
    """Distance of the segment p0-p1 to the segment q0-q1, (3,) each (Ericson 2004, 5.1.9)."""
    a = b = c = e = f = 0.0
    for k in range(3):
        d1, d2, r = p1[k] - p0[k], q1[k] - q0[k], p0[k] - q0[k]
        a += d1 * d1
        b += d1 * d2
        c += d1 * r
        e += d2 * d2
        f += d2 * r
    denominator = a * e - b * b
    s = (b * f - c * e) / denominator if denominator > 1e-12 else 0.0
    t = min(max((b * min(max(s, 0.0), 1.0) + f) / e, 0.0), 1.0)
    s = min(max((t * b - c) / a, 0.0), 1.0)
    square = 0.0
    for k in range(3):
        square += (p0[k] - q0[k] + s * (p1[k] - p0[k]) - t * (q1[k] - q0[k])) ** 2
    return np.sqrt(square)
