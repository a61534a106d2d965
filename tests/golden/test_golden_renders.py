"""Renders look as they did when they were last looked at: block by block within their noise (`make golden` after a wanted change)."""

from pathlib import Path

import numpy as np
import pytest
from golden_renders import CASES, COMPARED, chance, renders
from plain_sensor import changed

from twin.optics.variant import choose_variant

REFERENCE = Path(__file__).with_name("renders.npz")
CHANCE = 1e-4  # of refusing a right renderer


@pytest.fixture(scope="module", autouse=True)
def vectorised():
    """The reference is the vectorised renderer's; the scalar one approximates the window."""
    if choose_variant("mono").backend == "scalar":
        pytest.skip("golden renders are those of a vectorised variant")


def reference(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of a case's blocks; a missing file is a failure, not a skip."""
    assert REFERENCE.is_file(), f"{REFERENCE} is missing: make it with 'make golden', look at the pictures, and commit it"
    with np.load(REFERENCE) as file:
        assert f"{name}/mean" in file.files, f"{REFERENCE} knows no {name!r}: make it anew with 'make golden'"
        return file[f"{name}/mean"].astype(float), file[f"{name}/variance"].astype(float)


@pytest.mark.parametrize("name", CASES)
def test_a_render_is_the_golden_one_within_its_noise(name):
    case = CASES[name]
    found = renders(case, case.spec(), range(COMPARED))
    chances = chance(found, *reference(name))
    print(f"{name}: chance {chances:.3f}, light {found.mean() / reference(name)[0].mean() - 1:+.3%}")
    assert chances > CHANCE


def brighter_pins(spec):
    """Caps that reflect 4 % more."""
    return changed(spec, appearance={"cap_albedo": tuple(1.04 * v for v in spec.appearance.cap_albedo)})


def a_darker_led(spec):
    """One LED of six that gives 5 % less."""
    lit = next(k for k in range(6) if k not in spec.leds.off)
    balance = np.array(spec.leds.balance or np.ones(6))
    balance[lit] *= 0.95
    return changed(spec, leds={"balance": tuple(balance)})


def a_turned_camera(spec):
    """A camera that is tilted by a fiftieth of a degree more."""
    return changed(spec, camera={"tilt_x_deg": spec.camera.tilt_x_deg + 0.02})


@pytest.mark.parametrize("wrong", [brighter_pins, a_darker_led, a_turned_camera])
def test_the_comparison_refuses_what_is_wrong(wrong):
    name = "mg400-127 pressed"
    case = CASES[name]
    found = renders(case, wrong(case.spec()), range(COMPARED))
    chances = chance(found, *reference(name))
    print(f"{wrong.__name__}: chance {chances:.2g}, light {found.mean() / reference(name)[0].mean() - 1:+.3%}")
    assert chances < CHANCE
