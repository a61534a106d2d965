"""Laws of renders from labels: the contact of a label is the rig's, and the rig is found again from the pins it makes."""

import numpy as np
import pytest

from scenes import RigSpec, load_experiment, load_sensor
from twin.errors import FrameError
from twin.evaluation.pictures.compare import (
    EXPERIMENT,
    TapBank,
    bank_labels,
    contacts_of,
    fit_rig,
    halves,
    label_columns,
    labels_of_rows,
    plate_taps,
)
from twin.geometry.solid import Resolution
from twin.mechanics.solver import SkinSolver
from twin.rig.labels import ArmLabel

RADIUS_MM = 20.0
SURFACE = load_experiment(EXPERIMENT)
PLAIN = RigSpec(tcp_to_dome_mm=-RADIUS_MM)
TRUE = RigSpec(
    contact_offset_mm=0.4,
    tcp_to_dome_mm=-17.0,
    tcp_lateral_mm=0.5,
    tcp_binormal_mm=-0.3,
    image_turn_deg=97.0,
    turn_offset_deg=(1.2, -0.8, 0.0),
    turn_sign=-1,
)
SAME_CONTACT = 1e-12  # mm, and of the unit normal: rounding
PENETRATION_MM = 0.0052  # half of what the solver allows; measured: 0.0047


def label(depth_mm, about_x_deg, about_y_deg):
    return ArmLabel(np.array([0, 0, depth_mm, about_x_deg, about_y_deg, 0.0]), np.zeros(6))


def spread(count, seed=1):
    rng = np.random.default_rng(seed)
    return [label(*row) for row in np.column_stack([rng.uniform(2, 5, count), rng.uniform(-15, 15, (count, 2))])]


class AnalyticBank(TapBank):
    """Pins that move with indentation and normal by a known smooth law."""

    def __init__(self):
        pass

    def pins_px(self, contacts):
        place = np.stack(np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)), axis=-1).reshape(-1, 2)
        depth, normal = contacts[:, :1], contacts[:, 1:]
        swell = depth * (1 + 0.3 * normal @ place.T) * (1.5 - (place**2).sum(axis=1))
        return 50 * place + 2 * swell[..., None] * place + 40 * depth[..., None] * normal[:, None] / 3


def test_turns_about_x_and_y_tilt_the_plates_normal():
    """The tool point is the tip, so a turn takes the dome's centre R (1 - cos) nearer to the plate, and the tip stays."""
    found = contacts_of(PLAIN, SURFACE, [label(3.0, 0, 10), label(3.0, 10, 0), label(2.0, 0, 0)], RADIUS_MM)
    s, nearer = np.sin(np.radians(10.0)), RADIUS_MM * (1 - np.cos(np.radians(10.0)))
    np.testing.assert_allclose(found, [[3 + nearer, -s, 0], [3 + nearer, 0, s], [2, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    "start", [PLAIN, pytest.param(TRUE.model_copy(update={"contact_offset_mm": 0.0, "image_turn_deg": 80.0}), marks=pytest.mark.slow)]
)
def test_a_known_rig_is_recovered_from_its_pins(start):
    labels = spread(12)
    pins = AnalyticBank().pins_px(contacts_of(TRUE, SURFACE, labels, RADIUS_MM))
    pins[3, 4] = np.nan
    found = fit_rig(AnalyticBank(), start, SURFACE, labels, pins, RADIUS_MM)
    unseen = spread(20, seed=2)
    np.testing.assert_allclose(
        contacts_of(found, SURFACE, unseen, RADIUS_MM), contacts_of(TRUE, SURFACE, unseen, RADIUS_MM), atol=SAME_CONTACT
    )


@pytest.mark.slow
def test_the_second_round_corrects_the_polynomials_errors():
    """Pins that differ from the polynomial by a constant: only the second round corrects this."""
    labels, off_px = spread(12), np.array([1.5, -0.7])
    meant = contacts_of(TRUE, SURFACE, labels, RADIUS_MM)
    seen = AnalyticBank().pins_px(meant) + off_px

    def simulate(rig):
        return AnalyticBank().pins_px(contacts_of(rig, SURFACE, labels, RADIUS_MM)) + off_px

    first, second = (fit_rig(AnalyticBank(), TRUE, SURFACE, labels, seen, RADIUS_MM, simulate=each) for each in (None, simulate))
    np.testing.assert_allclose(contacts_of(second, SURFACE, labels, RADIUS_MM), meant, atol=SAME_CONTACT)
    assert np.abs(contacts_of(first, SURFACE, labels, RADIUS_MM) - meant).max() > 0.099


def test_the_bank_covers_labels_of_a_wrong_rig():
    labels = spread(30)
    bank = contacts_of(PLAIN, SURFACE, bank_labels(PLAIN, SURFACE, labels, RADIUS_MM), RADIUS_MM)
    true = contacts_of(TRUE, SURFACE, labels, RADIUS_MM)
    assert bank[:, 0].min() < true[:, 0].min() and bank[:, 0].max() > true[:, 0].max()
    assert np.hypot(*bank[:, 1:].T).max() > np.hypot(*true[:, 1:].T).max()


def test_a_label_is_pressed_along_its_normal_to_its_depth():
    solver = SkinSolver(load_sensor("ur5-331"), resolution=Resolution(12))
    rig, pressed = TRUE.model_copy(update={"compliance_mm_per_n": 0.0}), label(2.0, 6.0, -4.0)
    (indent, x, y), state = contacts_of(rig, SURFACE, [pressed], RADIUS_MM)[0], plate_taps(solver, SURFACE, rig).end(pressed)
    normal = np.array([x, y, np.sqrt(1 - x * x - y * y)])
    np.testing.assert_allclose(RADIUS_MM - state.contact_mm @ normal, indent, atol=PENETRATION_MM)
    middle = state.contact_mm.mean(axis=0)
    np.testing.assert_allclose(
        middle / np.linalg.norm(middle), normal, atol=0.0387
    )  # the clamped rim is nearer on one side; measured: 0.0351


def test_half_of_the_frames_are_for_the_test():
    assert halves(30).sum() == 15 and (halves(30) == halves(30)).all()


def test_labels_come_from_the_columns_that_the_experiment_varies():
    assert label_columns(SURFACE) == ("pose_3", "pose_4", "pose_5")
    (read,) = labels_of_rows([{"pose_3": 1.0, "pose_4": 2.0, "pose_5": 3.0, "move_1": 4.0}], SURFACE)
    assert read.pose.tolist() == [0, 0, 1, 2, 3, 0] and read.move.tolist() == [4, 0, 0, 0, 0, 0]
    with pytest.raises(FrameError, match="pose_5"):
        labels_of_rows([{"pose_3": 1.0, "pose_4": 2.0}], SURFACE)


def test_too_few_frames_are_refused():
    with pytest.raises(FrameError, match="too few labelled frames .1."):
        fit_rig(AnalyticBank(), PLAIN, SURFACE, spread(1), np.zeros((1, 25, 2)), RADIUS_MM)
