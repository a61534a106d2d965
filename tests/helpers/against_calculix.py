"""The skin beside CalculiX in ``tests/reference/calculix.json``: axisymmetric, on a mesh of its own, made by ``calculix.py`` there."""

import json
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from scenes import load_sensor
from scenes.body import GelSpec, SkinSpec
from scenes.sensor import SensorSpec
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.objects.analytic import Plane, Sphere

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "calculix.json").read_text())


def reference_spec(case: dict) -> SensorSpec:
    """The sensor with the reference's geometry and material."""
    given, spec = REFERENCE["sensor"], load_sensor(REFERENCE["sensor"]["name"])
    c10, c01, _ = case["skin_c10_c01_d1"]
    law = {"law": "mooney-rivlin", "second_invariant_share": c01 / (c10 + c01)} if c01 else {}
    lens = spec.lens.model_copy(update={"z_mm": given["lens_z_mm"]})
    parts = {"skin": SkinSpec(**given["skin"], **law), "gel": GelSpec(**given["gel"], **law), "lens": lens}
    return SensorSpec.model_validate(spec.model_copy(update=parts).model_dump())


def reference_pins(spec: SensorSpec, case: dict, state: dict, base_mm: np.ndarray, length_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacement (N, 3) of feet and caps: splines along the meridian; a pin turns as the skin's inside does."""
    inner_mm = spec.skin.outer_radius_mm - spec.skin.thickness_mm
    polar = np.radians(case["polar_deg"])
    shape = CubicSpline(polar, np.array(state["u_rz_mm"]) + inner_mm * np.column_stack([np.sin(polar), np.cos(polar)]))
    across = np.hypot(base_mm[:, 0], base_mm[:, 1])
    at = np.arctan2(across, base_mm[:, 2])
    along = shape(at, 1)
    rest, inwards = (np.column_stack([np.sin(a), np.cos(a)]) for a in (at, np.arctan2(-along[:, 1], along[:, 0])))
    feet = shape(at) - inner_mm * rest
    caps = feet - length_mm * (inwards - rest)
    outwards = base_mm[:, :2] / np.maximum(across, 1e-12)[:, None]
    return tuple(np.column_stack([moved[:, :1] * outwards, moved[:, 1]]) for moved in (feet, caps))


def compare(name: str, across: int) -> np.ndarray:
    """By depth: relative error of the force, and the largest error of feet and of caps over the largest displacement."""
    case = REFERENCE["cases"][name]
    spec = reference_spec(case)
    solver = SkinSolver(spec, resolution=Resolution(across=across))
    rest = solver.rest()
    field = Sphere(case["sphere_radius_mm"]) if case["sphere_radius_mm"] else Plane()
    length_mm = spec.pins.length_mm + spec.pins.cap_height_mm / 2
    rows = []
    for state in case["states"]:
        got = solver.press(field, ContactPose(indent_mm=state["indent_mm"]), friction=0.0)
        feet, caps = reference_pins(spec, case, state, rest.base_mm, length_mm)
        largest = np.linalg.norm(feet, axis=1).max()
        pairs = ((got.base_mm - rest.base_mm, feet), (got.caps_mm - rest.caps_mm, caps))
        off = [np.linalg.norm(moved - wanted, axis=1).max() / largest for moved, wanted in pairs]
        rows.append((got.force_n[2] / state["force_n"] - 1, *off))
        print(
            f"\n{name}, across {across}, {state['indent_mm']:g} mm: {got.force_n[2]:.4f} N, CalculiX {state['force_n']:.4f} N, "
            f"{100 * rows[-1][0]:+.2f} %; largest error of feet {100 * off[0]:.2f} %, caps {100 * off[1]:.2f} % of {largest:.2f} mm",
            end="",
        )
    return np.array(rows)
