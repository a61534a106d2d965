"""The twins of a study that lack one ingredient each."""

import numpy as np
import pytest

from scenes import load_experiment, load_object, load_randomisation, load_sensor
from scenes.randomisation import FrictionSpread
from training.studies.sim_to_real.discrepancy import FRICTIONS
from training.studies.sim_to_real.steps import Twin, as_mounted, without_one_ingredient


@pytest.fixture(scope="module")
def twins():
    sensor = load_sensor("mg400-331")
    moves, contact = load_randomisation("moves"), load_randomisation("contact")
    seen = moves.model_copy(update={"friction": FrictionSpread(low=0.3, high=0.6)})
    full = Twin("sim_only", "simulated", "sim", sensor, load_experiment("surface-2d", wide=True), seen, 20)
    return full, {twin.name: twin for twin in without_one_ingredient(full, as_mounted(sensor), moves, contact)}


def test_each_twin_lacks_one_ingredient_and_shares_contacts_only_if_they_are_equal(twins):
    full, others = twins
    plane = load_object("plane")
    for twin in others.values():
        assert (twin.config(plane, 0) == full.config(plane, 0)) == (twin.contacts == full.contacts)
        differ = [key for key in ("sensor", "experiment", "randomisation", "across", "share") if getattr(twin, key) != getattr(full, key)]
        assert len(differ) == (0 if twin.name == "sim_bare" else 1)
    assert len({twin.contacts for twin in others.values()} - {full.contacts}) == 6


def test_friction_that_is_never_drawn_is_not_tried_on_frames_either(twins):
    full, others = twins
    assert full.frictions == FRICTIONS and others["sim_one_friction"].frictions == (full.sensor.rig.friction,)


def test_an_uncalibrated_rig_has_only_directions():
    sensor = load_sensor("mg400-331")
    rig = as_mounted(sensor).rig
    assert rig.turn_sign == sensor.rig.turn_sign and rig.image_turn_deg == 90 and rig.contact_offset_mm == 0
    assert rig.tcp_to_dome_mm == -20 and np.allclose(rig.turn_offset_deg, 0)


def test_without_moves_every_contact_is_a_tap(twins):
    assert all(low == high == 0 for low, high in twins[1]["sim_taps"].experiment.move.model_dump().values())
