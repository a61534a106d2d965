"""Laws of the map from a tap's label to its contact."""

import numpy as np
import pytest

from scenes import load_sensor
from twin.errors import FrameError
from twin.mechanics.solver import SkinSolver
from twin.realism.poses import TapMap, fit_taps, halves, tap, tap_labels

PLAIN = TapMap(0.0, 0.0, (0.0, 0.0), 0.0, (0.0, 0.0), mirrored=False)
TRUE = TapMap(0.4, 3.0, (0.5, -0.3), 97.0, (1.2, -0.8), mirrored=True)


class AnalyticBank:
    """Pins that move with indentation and normal by a known smooth law."""

    def pins_px(self, contacts):
        place = np.stack(np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)), axis=-1).reshape(-1, 2)
        depth, normal = contacts[:, :1], contacts[:, 1:]
        swell = depth * (1 + 0.3 * normal @ place.T) * (1.5 - (place**2).sum(axis=1))
        return 50 * place + 2 * swell[..., None] * place + 40 * depth[..., None] * normal[:, None] / 3


def test_turns_about_x_and_y_tilt_the_normal_as_rotations_do():
    contact = PLAIN.contact(np.array([[3.0, 0.0, 10.0], [3.0, 10.0, 0.0], [2.0, 0.0, 0.0]]))
    s = np.sin(np.radians(10.0))
    np.testing.assert_allclose(contact, [[3, s, 0], [3, 0, -s], [2, 0, 0]], atol=1e-12)


def test_a_known_map_is_recovered_from_its_pins():
    rng = np.random.default_rng(1)
    labels = np.column_stack([rng.uniform(2, 5, 12), rng.uniform(-15, 15, (12, 2))])
    pins = AnalyticBank().pins_px(TRUE.contact(labels))
    pins[3, 4] = np.nan
    found = fit_taps(AnalyticBank(), labels, pins)
    np.testing.assert_allclose(found.contact(labels), TRUE.contact(labels), atol=1e-4)


def test_a_tap_presses_along_its_normal():
    state = tap(SkinSolver(load_sensor("ur5-331")), np.array([2.0, 0.15, -0.1]))
    normal = np.array([0.15, -0.1, np.sqrt(1 - 0.15**2 - 0.1**2)])
    radius_mm = 20.0
    depth_mm = radius_mm - (state.contact_mm @ normal)
    np.testing.assert_allclose(depth_mm, 2.0, atol=0.02)  # the plate's plane, within the allowed penetration
    middle = state.contact_mm.mean(axis=0)
    np.testing.assert_allclose(middle / np.linalg.norm(middle), normal, atol=0.05)  # the clamped rim is nearer on one side


def test_half_of_the_frames_are_for_the_test():
    assert halves(30).sum() == 15 and (halves(30) == halves(30)).all()


def test_missing_labels_are_named():
    with pytest.raises(FrameError, match="pose_5"):
        tap_labels([{"pose_3": 1.0, "pose_4": 2.0}])
