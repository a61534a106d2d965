"""Friction within a load step, computed in short substeps.

Friction depends on the path. A point at the edge of a growing contact first bears a small pressure and slips; when the edge has passed,
the point sticks. In one long load step it would stick from the moment it touches, and the shear forces would be up to 10 % too small.
Therefore a load step with friction in which new places touch is computed a second time in short substeps. They use the body's tangent K,
condensed at the end of the step. The elastic force is linear in the controls x, plus a term that makes it exact at the start of the step
(0) as well as at its end (1):

    f(x, t) = f_1 + K (x - x_1) + (1 - t) [f_0 - f_1 - K (x_0 - x_1)],    t from 0 to 1

Each substep solves contact and friction exactly on this small problem. The anchors and slips after the substeps then enter the equations of
the whole load step.
"""

from dataclasses import replace

import numpy as np

from twin.mechanics.balance import Balance, LoadState, Problem, in_object
from twin.mechanics.condensed import Near, SmallContact, Tangent
from twin.mechanics.contact import ContactForces, positions, spread_forces
from twin.mechanics.path import ContactPath
from twin.mechanics.turns import turned_back
from twin.objects import ObjectField
from twin.types import BoolArray, FloatArray, IntArray

SUBSTEP_MM = 0.05
"""Largest motion of the object at a contact point in one substep, mm. Substeps of half this length change the shear forces by less
than 1 %."""
_MOST_SUBSTEPS = 16
"""Largest number of substeps in a load step."""
_TOLERANCE = 5e-3
"""Convergence threshold of a substep: norm of the residual relative to the sum of the contact forces at the end of the load step."""
_ITERATIONS = 20
"""Largest number of iterations of a substep; three are usual."""


def substeps(moved_mm: float) -> int:
    """Number of substeps of a load step in which the object moves by ``moved_mm`` at a contact point."""
    return min(int(np.ceil(moved_mm / SUBSTEP_MM)), _MOST_SUBSTEPS)


def friction_substeps(
    problem: Problem,
    state: LoadState,
    anchor_mm: FloatArray,
    field: ObjectField,
    near: Near,
    tangent: Tangent,
    turns: FloatArray | None,
    forward: FloatArray,
    local: IntArray,
    balance: Balance,
    *,
    count: int,
) -> LoadState | None:
    """The history of friction up to the last substep of a load step, and the anchors for the last substep.

    Parameters
    ----------
    problem : Problem
        Equations of the load step.
    state : LoadState
        State at the start of the load step.
    anchor_mm : (p, 3) float
        Anchors of all contact points. Those of the candidate points are replaced in the result.
    field : ObjectField
    near, tangent : Near, Tangent
        The body's condensed tangent, near the end of the load step.
    turns : (free, 3, 3) float, optional
        Rotation of each free control since the tangent was computed; None for a new tangent.
    forward : (unknowns,) float
        Elastic force at the end of the load step, after forward elimination.
    local : (q, 9) int
        Index of each candidate point's controls among the kept controls.
    balance : Balance
        State at the end of the load step, at least approximately solved.
    count : int
        Number of substeps.

    Returns
    -------
    LoadState
        The state at the start, except for ``held``, ``slid_mm``, ``limit_n`` and ``gap_mm``, which are those one substep before the end,
        ``dissipated_nmm`` up to there, and ``T`` and ``anchor_mm`` of the last substep. None if a substep did not converge.
    """
    looked, kept = problem.looked, tangent.eliminated.kept
    volume = balance.border_residual[1]
    start: FloatArray = (state.control_mm - balance.control_mm)[problem.body.free].ravel()[kept]
    y = np.concatenate([start[near.near], state.border - balance.border])
    if turns is not None:
        turns = turns[kept[::3] // 3]
        start = turned_back(turns, start)
    start = start.astype(np.float32)
    at_start = in_object(positions(problem.controls, problem.weights, problem.lift, state.control_mm), state.T, state.border)
    held = state.held[looked]
    pressed = problem.move_object(state.T, state.anchor_mm[looked], state.slid_mm[looked]).contact(at_start).force_n @ state.T[:3, :3].T
    spread = np.zeros((len(kept) // 3 + 1, 3))
    spread_forces(local, problem.weights, pressed * held[:, None], spread)
    residual, volume_start = forward[kept], 0.0
    residual_start = (spread[:-1].ravel() if turns is None else turned_back(turns, spread[:-1].ravel())) - tangent.matrix @ start
    if tangent.volume_column is not None:
        volume = volume - tangent.eliminated.inner(tangent.volume_column) @ tangent.eliminated.inner(forward)
        pressure = state.border[1] - balance.border[1]
        residual_start -= tangent.volume_column[kept] * pressure
        volume_start = -float(tangent.volume_column[kept] @ start + tangent.volume_pivot * pressure)

    way = ContactPath(np.stack([state.T, problem.T]))
    anchor, slid, limit, lost = state.anchor_mm[looked], state.slid_mm[looked], state.limit_n[looked], 0.0
    wanted, before, gap_before = _TOLERANCE * balance.scale_n, at_start, field.distance(at_start)
    for number in range(1, count + 1):
        share, predicted = number / count, y * (1 - 1 / (count + 1 - number))
        T = way.at(share)
        substep = problem.move_object(T, anchor, slid)
        residual_now, volume_now = (1 - share) * residual_start + share * residual, (1 - share) * volume_start + share * volume
        small = SmallContact(substep, near, tangent.volume_pivot, residual_now, volume_now, balance)
        after = small.places(predicted)
        substep.anchor_mm = anchor = first_touch(held, anchor, before, after, gap_before, field.distance(after))
        if number == count:
            break
        y, done = small.newton(predicted, wanted, _ITERATIONS)
        if not done:
            near.solved = None
            return None
        contact, before = small.contact(y), small.places(y)
        held, gap, gap_before = contact.penetration_mm > 0, gap_before, field.distance(before)
        anchor, slid, limit, more = update_friction(substep, contact, limit, gap, gap_before)
        lost += more
    anchors, all_held, all_slid, all_limit = anchor_mm.copy(), state.held.copy(), state.slid_mm.copy(), state.limit_n.copy()
    gap = state.gap_mm.copy()
    anchors[looked], all_held[looked], all_slid[looked], all_limit[looked], gap[looked] = anchor, held, slid, limit, gap_before
    history = replace(state, held=all_held, slid_mm=all_slid, limit_n=all_limit, gap_mm=gap, dissipated_nmm=lost)
    return replace(history, T=problem.T, anchor_mm=anchors)


def first_touch(
    held: BoolArray, anchor: FloatArray, before: FloatArray, after: FloatArray, gap_before: FloatArray, gap: FloatArray
) -> FloatArray:
    """Anchors (q, 3) for a step. A point in contact keeps its anchor. A point that enters the object is anchored at its place of entry.

    ``before`` and ``after`` (q, 3) are the points in the object's frame; between them each point moves on a straight line. ``gap_before``
    and ``gap`` (q,) are the points' distances from the object at both ends.
    """
    driven = (gap_before > 0) & (gap < 0)
    share = np.where(driven, gap_before / np.where(driven, gap_before - gap, 1.0), 0.0)[:, None]
    return np.where(held[:, None], anchor, (1 - share) * before + share * after)


def update_friction(
    problem: Problem, contact: ContactForces, limit_n: FloatArray, gap_before: FloatArray, gap: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Friction after a step: anchors (q, 3), slip since each point last stuck (q,), limits of friction (q,) in N, dissipated work in N mm.

    The friction force of a slipping point equals its limit. During the step the limit changes from ``limit_n`` (q,) to its new value, with
    the point's normal force and slip. A point that slipped and leaves the object bears friction until its distance, which goes from
    ``gap_before`` (q,) to ``gap`` (q,), reaches 0.
    """
    limit = np.minimum(problem.friction * contact.normal_n, problem.bound_n)
    way = contact.anchor_mm - problem.anchor_mm
    moved = np.linalg.norm(way, axis=1)
    slid = np.where(contact.slipping, problem.slid_mm + moved, 0.0)
    lost = float(((limit_n + limit) / 2 * moved)[contact.slipping].sum())
    left = np.flatnonzero((gap >= 0) & (gap_before < 0) & (problem.slid_mm > 0))
    across = way[left] - (way[left] * contact.normal[left]).sum(axis=1, keepdims=True) * contact.normal[left]
    share = gap_before[left] / (gap_before[left] - gap[left])
    lost += float((limit_n[left] / 2 * share * np.linalg.norm(across, axis=1)).sum())
    return contact.anchor_mm, slid, limit, lost
