"""A contact that is followed pose by pose is the contact that a path gives, with its memory, and is let go of when the object leaves."""

import numpy as np
import pytest

from scenes import load_object, load_sensor
from twin.errors import ContactError
from twin.geometry.solid import Resolution
from twin.mechanics.follow import Follower
from twin.mechanics.law import ContactLaw
from twin.mechanics.path import ContactPath
from twin.mechanics.solver import SkinSolver

SAME_N = 2e-3  # the solvers choose their load steps differently; friction remembers the way there
COARSE = Resolution(across=8)
OWN = ContactLaw.of_object(load_object("plane")).override(compliance_mm_per_n=0.068)


@pytest.fixture(scope="module")
def solver():
    return SkinSolver(load_sensor("mg400-331"), resolution=COARSE)


def plate(indent_mm: float, along_mm: float = 0.0, *, radius_mm: float = 20.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = [along_mm, 0, radius_mm - indent_mm]
    return T


def test_pose_by_pose_it_is_what_the_path_gives(solver):
    plane = load_object("plane")
    stops = [plate(-0.5), plate(1.0), plate(2.0), plate(2.0, 1.0)]
    follower = Follower(solver, plane, OWN)
    for k, stop in enumerate(stops):
        followed = follower.move(stop, float(k))
    *_, (_, wanted) = solver.path(plane, ContactPath(np.stack(stops)), law=OWN)
    assert followed.force_n[2] > 0.1 and abs(followed.force_n[0]) > 0.02
    np.testing.assert_allclose(followed.force_n, wanted.force_n, atol=0.02 * np.linalg.norm(wanted.force_n))
    np.testing.assert_allclose(followed.caps_mm, wanted.caps_mm, atol=0.02)


def test_the_way_there_is_remembered(solver):
    """Pressed and then dragged is another state than dragged in the air and then pressed."""
    plane = load_object("plane")
    pressed_first, dragged_first = Follower(solver, plane, OWN), Follower(solver, plane, OWN)
    for k, T in enumerate([plate(-0.5), plate(2.0), plate(2.0, 1.5)]):
        one = pressed_first.move(T, float(k))
    for k, T in enumerate([plate(-0.5), plate(-0.5, 1.5), plate(2.0, 1.5)]):
        other = dragged_first.move(T, float(k))
    assert abs(one.force_n[0]) > 0.05
    assert abs(other.force_n[0]) < SAME_N


def test_an_object_that_just_touches_presses_nothing(solver):
    follower = Follower(solver, load_object("plane"), OWN)
    follower.move(plate(-1.0), 0.0)
    assert not follower.move(plate(0.0), 1.0).force_n.any()
    assert follower.move(plate(1.0), 2.0).force_n[2] > 0.1


def test_it_lets_go_and_begins_again(solver):
    follower = Follower(solver, load_object("plane"), OWN)
    follower.move(plate(-1.0), 0.0)
    first = follower.move(plate(1.5), 1.0)
    follower.move(plate(1.5, 2.0), 2.0)
    free = follower.move(plate(-2.0, 2.0), 3.0)
    assert not free.force_n.any()
    np.testing.assert_array_equal(free.caps_mm, solver.rest().caps_mm)
    follower.move(plate(-1.0), 4.0)
    again = follower.move(plate(1.5), 5.0)
    np.testing.assert_allclose(again.force_n, first.force_n, atol=SAME_N)
    assert follower.restarts == 0


def test_a_pose_that_stays_costs_and_changes_nothing(solver):
    follower = Follower(solver, load_object("plane"), OWN)
    follower.move(plate(-1.0), 0.0)
    state = follower.move(plate(1.0), 1.0)
    assert follower.move(plate(1.0), 2.0) is state


def test_it_may_begin_in_contact(solver):
    follower = Follower(solver, load_object("plane"), OWN)
    state = follower.move(plate(1.0), 0.0)
    assert state.force_n[2] > 0


def test_too_deep_is_an_error_and_coming_back_is_not(solver):
    follower = Follower(solver, load_object("plane"), OWN)
    follower.move(plate(-1.0), 0.0)
    with pytest.raises(ContactError, match="inside the skin"):
        follower.move(plate(15.0), 1.0)
    assert follower.move(plate(1.0), 2.0).force_n[2] > 0


def test_a_long_way_around_a_can_does_not_wear_it_out(solver):
    """Slid along a curved surface at one depth, the force settles."""
    follower = Follower(solver, load_object("can"), ContactLaw.of_object(load_object("can")))
    forces = []
    for k in range(45):
        turn = -max(0, k - 4) / 33.0
        c, s = np.cos(turn), np.sin(turn)
        T = np.eye(4)
        T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        indent = min(2.0, k * 0.6)
        T[:3, 3] = np.array([0, 0, 53 - indent]) - T[:3, :3] @ [0, 0, 33]
        forces.append(follower.move(T, 0.1 * k).force_n)
    late = np.array(forces[-10:])
    assert np.ptp(late[:, 2]) < 0.05 * late[:, 2].mean()
    assert follower.restarts == 0


def test_warmed_up_it_is_as_new(solver):
    plane = load_object("plane")
    warm, cold = Follower(solver, plane, OWN), Follower(solver, plane, OWN)
    warm.warm_up()
    for k, stop in enumerate([plate(-0.5), plate(1.5)]):
        one, other = warm.move(stop, float(k)), cold.move(stop, float(k))
    np.testing.assert_array_equal(one.caps_mm, other.caps_mm)


@pytest.mark.slow
def test_skin_is_not_carried_past_wires():
    """Load steps stay below a wire's radius: farther, skin ends up beneath a wire and hooks; the mesh drags far less than it is pressed."""
    can = load_object("mesh-can")
    follower = Follower(SkinSolver(load_sensor("mg400-331")), can, ContactLaw.of_object(can))
    for k, T in enumerate([plate(-2.0), plate(2.0)]):
        follower.move(T, float(k))
    for k in range(6):
        T = plate(2.0)
        T[1, 3] = 0.8 * (k + 1)  # along the wires of one family, across the other
        state = follower.move(T, 2.0 + k)
    assert np.linalg.norm(state.force_n[:2]) < state.force_n[2]
