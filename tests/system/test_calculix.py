"""The skin against CalculiX (make validate): force, pins' feet and caps on a plane and a ball, without friction.

``tests/reference/calculix.json`` holds axisymmetric results on a mesh of its own, converged to 0.2 % of force; made by
``calculix.py`` beside it. Skin, gel and lens come from that file, whatever the sensor's own are now; the pins are the sensor's.
"""

import numpy as np
import pytest
from against_calculix import REFERENCE, compare, reference_spec

from twin.geometry.solid import Resolution

DEFAULT, FINER = Resolution().across, 24
# relative errors of force, and of displacement over the largest one: the worst of the cases (measured) and a tenth
BOUNDS = {DEFAULT: (0.0139, 0.0154), FINER: (0.0041, 0.0092)}  # at 3 mm (1.26 %, 1.40 %; 0.37 %, 0.83 %)
SHALLOW = {DEFAULT: (0.0094, 0.0130), FINER: (0.0033, 0.0118)}  # at 1 and 2 mm (0.85 %, 1.18 %; 0.30 %, 1.07 %)


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
