"""A contact by an arm that gives way is one by a stiff arm that was sent where the other ended."""

from dataclasses import replace

import numpy as np
import pytest
from small_generation import small_config

from twin.evaluation.labelled.model import ContactModel
from twin.rig.labels import ArmLabel
from twin.types import Form

ACROSS = 8
LIKE = 0.18  # of what giving way changes: forces are those of the load step before (measured 0.163)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return small_config(tmp_path_factory.mktemp("arm"))


def model_of(config, **rig):
    sensor = config.sensor.model_copy(update={"rig": config.sensor.rig.model_copy(update=rig)})
    return ContactModel(sensor, config.experiment, config.object, Form.PROCESSED, across=ACROSS)


def force_across_n(model, label):
    state = model.contact.end(label)
    return float(model.contact.law.given_way.across @ state.force_n if model.contact.law.given_way else 0.0), float(state.force_n[2])


def test_turned_by_the_force_across(config):
    label = ArmLabel(np.array([0, -3.0, 0, 0, 0, 6.0]), np.array([1.5, 0, 0, 0, 0, 0.0]))
    stiff, soft = model_of(config), model_of(config, turn_compliance_deg_per_n=2.0)
    across_n, _ = force_across_n(soft, label)
    assert abs(across_n) > 0.1
    turn = np.array([0, 0, 0, 0, 0, 2.0 * across_n])
    further = replace(label, pose=label.pose + turn, move=label.move + turn)
    meant, found, unturned = stiff.displacement_px(further), soft.displacement_px(label), stiff.displacement_px(label)
    assert np.abs(found - meant).mean() < LIKE * np.abs(found - unturned).mean()


def test_pushed_back_along_the_axis(config):
    """Straight down, where the sensor's axis is the approach."""
    label = ArmLabel(np.array([0, -3.0, 0, 0, 0, -config.sensor.rig.turn_offset_deg[2]]), np.zeros(6))
    stiff, soft = model_of(config, plate_tilt_deg=0.0), model_of(config, plate_tilt_deg=0.0, compliance_mm_per_n=0.2)
    _, along_n = force_across_n(soft, label)
    less = replace(label, pose=label.pose - [0, 0.2 * along_n, 0, 0, 0, 0])
    assert 0.2 * along_n > 0.1
    assert np.abs(soft.displacement_px(label) - stiff.displacement_px(less)).max() < 0.02
