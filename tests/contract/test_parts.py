"""Layouts, material laws, degradations, models and tasks under the contracts that packages of others use for their parts."""

import numpy as np
import pytest

from scenes.layouts.grid import Grid
from scenes.layouts.hexagon import Hexagon
from scenes.layouts.rings import Rings
from scenes.materials.mooney_rivlin import MooneyRivlin
from scenes.materials.neo_hookean import NeoHookean
from scenes.materials.yeoh import Yeoh
from twin.contracts import ConditionContract, LayoutContract, MaterialContract, ModelContract, TaskContract
from twin.evaluation.degradation.condition import Condition
from twin.evaluation.degradation.conditions import CONDITIONS


class TestRings(LayoutContract):
    name, layout = "rings", Rings(rings=5)


class TestHexagon(LayoutContract):
    name, layout = "hexagon", Hexagon(rings=4)


class TestGrid(LayoutContract):
    name, layout = "grid", Grid(columns=7, rows=9)


class TestNeoHookean(MaterialContract):
    law = NeoHookean()


class TestMooneyRivlin(MaterialContract):
    law = MooneyRivlin(second_invariant_share=0.3)


class TestYeoh(MaterialContract):
    law = Yeoh(c20_c10=0.1)


class TestNoise(ConditionContract):
    condition = CONDITIONS["noise"]


class TestTorn(ConditionContract):
    condition = CONDITIONS["picture-torn"]


@pytest.mark.slow
class TestVgnn(ModelContract):
    name = "vgnn"


@pytest.mark.slow
class TestCnn(ModelContract):
    name = "cnn-v2"


class TestGentlePress(TaskContract):
    name = "GentlePress"


class Heap(Rings):
    """Pins at one place."""

    def places(self):
        return np.zeros((self.count, 2))


class Softening(NeoHookean):
    """A law whose rubber gives way."""

    def coefficients(self):
        return 1.0, 0.0, -1.0, 0.0


IDLE = Condition("idle", "without effect", "optics", "shift", "levels", 1.0, frame=lambda image, value, view, rng: image)


@pytest.mark.parametrize(
    ("contract", "part", "law"),
    [
        (LayoutContract, {"layout": Heap(rings=1)}, "test_its_places_are_as_many_as_it_counts_and_apart"),
        (MaterialContract, {"law": Softening()}, "test_more_stretch_takes_more_stress"),
        (ConditionContract, {"condition": IDLE}, "test_severity_0_changes_nothing_and_severity_1_does"),
    ],
)
def test_a_part_that_breaks_its_contract_fails(contract, part, law):
    with pytest.raises(AssertionError):
        getattr(type("Broken", (contract,), part)(), law)()
