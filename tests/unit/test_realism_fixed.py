"""Laws of the share of a residual that is fixed to each cap, and of the patches that it is told from."""

import numpy as np
import pytest
from plain_sensor import plain

from twin.evaluation.pictures.compare import cap_patches, fixed_share
from twin.geometry.pins import rest_pins
from twin.mechanics.skin_fit import FittedPins
from twin.optics.relief import SKIN_FROM, cap_planes

FRAMES, CAPS, PLACES = 8, 200, 60


def test_the_share_is_that_of_the_fixed_part_of_the_power_for_any_number_of_frames():
    """A picture of each cap with the power 1, plus what differs in each frame with the power 3."""
    rng = np.random.default_rng(0)
    fixed = rng.standard_normal((CAPS, PLACES))
    for frames in (2, FRAMES):
        changing = np.sqrt(3.0) * rng.standard_normal((frames, CAPS, PLACES))
        assert fixed_share(fixed + changing) == pytest.approx(0.25, abs=0.02), "a few standard errors of so many values"
        assert fixed_share(changing) == pytest.approx(0.0, abs=0.02)
    assert fixed_share(np.repeat(fixed[None], FRAMES, axis=0)) == pytest.approx(1.0)


def test_a_gain_of_the_residual_does_not_change_the_share_and_one_frame_tells_none():
    patches = np.random.default_rng(1).standard_normal((FRAMES, CAPS, PLACES)) + 0.5
    assert fixed_share(7 * patches) == pytest.approx(fixed_share(patches))
    assert np.isnan(fixed_share(patches[:1])) and np.isnan(fixed_share(0 * patches))


def test_patches_move_with_the_caps():
    """A difference that is linear in the pixels gives each cap's patch the difference at its places, in every channel."""
    spec = plain()
    rest = rest_pins(spec.geometry)
    height, width = spec.camera.height_px, spec.camera.width_px
    ramp = np.tile(np.arange(width) % 200, (height, 1)).astype(np.uint8)
    for move_mm in (0.0, 0.4):
        shift = np.array([move_mm, 0.0, 0.0])
        state = FittedPins(rest.base_mm + shift, rest.axis, rest.caps_mm + shift, np.zeros(len(rest.axis)), np.zeros(3))
        middle, plane = cap_planes(spec.view, spec.pins, state)
        patches = cap_patches(spec.view, spec.pins, state, np.dstack([ramp, ramp]), np.zeros((height, width, 2), np.uint8))
        reach = SKIN_FROM * np.linalg.norm(plane[:, 0], axis=1)
        clear = (middle[:, 0] % 200 > reach + 1) & (middle[:, 0] % 200 < 199 - reach)
        assert clear.sum() > 20
        np.testing.assert_allclose(patches[clear].mean(axis=1), middle[clear, 0] % 200, atol=0.05)
        assert (patches[:, ::2] == patches[:, 1::2]).all()
