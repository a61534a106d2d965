"""The skin against CalculiX (make validate): force, pins' feet and caps on a plane and a ball, without friction.

``tests/reference/calculix.json`` holds axisymmetric results on a mesh of its own, converged to 0.2 % of force; made by
``calculix.py`` beside it. Skin, gel and lens come from that file, whatever the sensor's own are now; the pins are the sensor's.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from scenes import load_sensor
from scenes.sensor import GelSpec, SensorSpec, SkinSpec
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.stimulus.analytic import Plane, Sphere

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "calculix.json").read_text())
DEFAULT, FINER = Resolution().across, 24
BOUNDS = {DEFAULT: (0.03, 0.03), FINER: (0.03, 0.015)}  # at 3 mm: of force, and of displacement relative to the largest
SHALLOW = {DEFAULT: (0.06, 0.07), FINER: (0.03, 0.015)}  # at 1 and 2 mm: the ball's contact is as small as the default's elements


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


@pytest.mark.slow
@pytest.mark.parametrize("across", BOUNDS)
@pytest.mark.parametrize("name", REFERENCE["cases"])
def test_force_and_pins_agree_with_calculix(name, across):
    *shallow, deepest = np.abs(compare(name, across))
    for found, (force, move) in ((deepest, BOUNDS[across]), (np.max(shallow, axis=0), SHALLOW[across])):
        assert found[0] < force and found[1:].max() < move


def test_the_reference_is_complete_and_consistent():
    assert {"plane", "sphere", "plane_mooney_rivlin"} <= set(REFERENCE["cases"])
    for case in REFERENCE["cases"].values():
        spec, polar = reference_spec(case), np.array(case["polar_deg"])
        assert polar[0] == 0 and polar[-1] == 90 and (np.diff(polar) > 0).all()
        for part in ("skin", "gel"):
            c10, c01, d1 = case[f"{part}_c10_c01_d1"]
            young, poisson = getattr(spec, part).young_modulus_mpa, getattr(spec, part).poisson_ratio
            assert 2 * (c10 + c01) == pytest.approx(young / (2 * (1 + poisson)), rel=1e-4)
            assert 2 / d1 == pytest.approx(young / (3 * (1 - 2 * poisson)), rel=1e-4)
        forces = [state["force_n"] for state in case["states"]]
        assert [state["indent_mm"] for state in case["states"]] == [1.0, 2.0, 3.0] and forces == sorted(forces)
        for state in case["states"]:
            moved = np.array(state["u_rz_mm"])
            assert moved.shape == (len(polar), 2) and moved[0, 0] == 0 and not moved[-1].any()
            assert state["clamp_force_n"] == pytest.approx(state["force_n"], rel=1e-3)
            assert state["penetration_mm"] < 0.005
        assert max(map(abs, case["coarse_against_fine"]["force_percent"])) < 0.5
