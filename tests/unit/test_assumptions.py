"""What assumptions cost: lengths scale depths, angles stay, and a picture alone tells no stiffness."""

import pytest

from scenes import load_sensor
from twin.calibration import assumptions
from twin.calibration.assumptions import MORE, cost_of_assumptions


@pytest.fixture(scope="module")
def costs():
    return {cost.assumed.split(",")[0]: cost for cost in cost_of_assumptions(load_sensor("mg400-127"))}


def test_a_larger_tip_is_pressed_deeper_by_the_same_picture(costs):
    """All lengths in proportion show the same frame, so the estimate is that of the smaller tip."""
    found = costs["radius of the tip"]
    assert found.depth_share == pytest.approx(1 / MORE - 1, abs=0.02) and found.tilt_deg == pytest.approx(0.0, abs=0.1)


def test_a_modulus_moves_less_than_a_length(costs):
    assert max(abs(costs[f"stiffness of the {part}"].depth_share) for part in ("skin", "gel")) < 0.05
    assert abs(costs["angle of the outermost pins"].depth_share) > 0.04
    assert len(costs) == 7 and list(costs) == sorted(costs, key=lambda k: -abs(costs[k].depth_share) - abs(costs[k].tilt_deg) / 5)


def test_the_table_adds_no_cost_of_its_own(monkeypatch):
    """A number that is not changed costs nothing."""
    monkeypatch.setattr(assumptions, "_changes", lambda spec: {("nothing", "+0 %"): (spec, False)})
    (found,) = cost_of_assumptions(load_sensor("mg400-127"))
    assert found.depth_share == found.tilt_deg == 0.0
