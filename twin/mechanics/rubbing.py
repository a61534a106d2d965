"""Friction within a load step.

Friction remembers its way. A point at the front of a growing contact is pressed lightly at first and slips; once the front has passed, it
sticks. In one long load step it would stick from where it meets the object, and side forces would be up to a tenth too small.
Therefore a step with friction is gone through once more in short substeps, on the body eliminated at the step's end: its force is taken
as linear in the controls, plus what makes it right at the step's start,

    f(x, t) = f_1 + K (x - x_1) + (1 - t) [f_0 - f_1 - K (x_0 - x_1)],    t from 0 to 1

Each substep solves contact and friction exactly on this small problem. What it leaves of anchors and slip decides the step's end.
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
"""Largest motion of a place of the contact in a substep: half as long ones change side forces by less than 1 %."""
_MOST_SUBSTEPS = 16
"""Most substeps of a load step."""
_TOLERANCE = 5e-3
"""Residual of a substep, relative to the contact forces at the step's end."""
_ITERATIONS = 20
"""Most iterations of a substep; three are usual."""


def substeps(moved_mm: float) -> int:
    """Number of substeps of a load step in which a place of the contact moves this far."""
    return min(int(np.ceil(moved_mm / SUBSTEP_MM)), _MOST_SUBSTEPS)


def rubbed(
    problem: Problem,
    state: LoadState,
    anchor_mm: FloatArray,
    field: ObjectField,
    near: Near,
    tangent: Tangent,
    turns: FloatArray | None,
    forward: FloatArray,
    local: IntArray,
    control: FloatArray,
    border: FloatArray,
    balance: Balance,
    *,
    count: int,
) -> LoadState | None:
    """What friction remembers before the last substep of a load step, with the anchors for that one.

    Parameters
    ----------
    problem : Problem
        The step's.
    state : LoadState
        The step's start.
    anchor_mm : (p, 3) float
        Anchors of all points, of which those looked at are replaced.
    near, tangent : Near, Tangent
        The body eliminated near the step's end.
    local : (q, 9) int
        Place of each looked point's controls among the kept ones.
    control, border, balance
        The step's end, solved roughly at least.
    count : int
        Substeps.

    Returns
    -------
    LoadState
        The start's state with ``held``, ``slid_mm``, ``limit_n`` as they are one substep before the end, ``dissipated_nmm`` until there,
        and ``anchor_mm`` for the last one. None where a substep was not solved.
    """
    looked, kept = problem.looked, tangent.eliminated.kept
    volume = balance.border_residual[1]
    start: FloatArray = (state.control_mm - control)[problem.body.free].ravel()[kept]
    y = np.concatenate([start[near.near], state.border - border])
    if turns is not None:
        turns = turns[kept[::3] // 3]
        start = turned_back(turns, start)
    start = start.astype(np.float32)
    at_start = in_object(positions(problem.controls, problem.weights, problem.lift, state.control_mm), state.T, state.border)
    held = state.held[looked]
    pressed = problem.moved(state.T, state.anchor_mm[looked], state.slid_mm[looked]).contact(at_start).force_n @ state.T[:3, :3].T
    spread = np.zeros((len(kept) // 3 + 1, 3))
    spread_forces(local, problem.weights, pressed * held[:, None], spread)
    residual, volume_start = forward[kept], 0.0
    residual_start = (spread[:-1].ravel() if turns is None else turned_back(turns, spread[:-1].ravel())) - tangent.matrix @ start
    if tangent.volume_column is not None:
        inner = np.ones(len(forward), bool)
        inner[kept] = False
        volume = volume - tangent.volume_column[inner] @ forward[inner]
        pressure = state.border[1] - border[1]
        residual_start -= tangent.volume_column[kept] * pressure
        volume_start = -float(tangent.volume_column[kept] @ start + tangent.volume_pivot * pressure)

    way = ContactPath(np.stack([state.T, problem.T]))
    anchor, slid, limit, lost = state.anchor_mm[looked], state.slid_mm[looked], state.limit_n[looked], 0.0
    wanted, before, gap_before = _TOLERANCE * balance.scale_n, at_start, field.distance(at_start)
    for number in range(1, count + 1):
        share, predicted = number / count, y * (1 - 1 / (count + 1 - number))
        T = way.at(share)
        substep = problem.moved(T, anchor, slid)
        small = SmallContact(
            substep,
            near,
            tangent.volume_pivot,
            (1 - share) * residual_start + share * residual,
            (1 - share) * volume_start + share * volume,
            control,
            border,
        )
        after = small.places(predicted)
        substep.anchor_mm = anchor = met(held, anchor, before, after, gap_before, field.distance(after))
        if number == count:
            break
        y, done = small.newton(predicted, wanted, _ITERATIONS)
        if not done:
            near.solved = None
            return None
        contact, before = small.contact(y), small.places(y)
        held, gap, gap_before = contact.penetration_mm > 0, gap_before, field.distance(before)
        anchor, slid, limit, more = rub(substep, contact, limit, gap, gap_before)
        lost += more
    anchors, all_held, all_slid, all_limit = anchor_mm.copy(), state.held.copy(), state.slid_mm.copy(), state.limit_n.copy()
    gap = state.gap_mm.copy()
    anchors[looked], all_held[looked], all_slid[looked], all_limit[looked], gap[looked] = anchor, held, slid, limit, gap_before
    return replace(state, anchor_mm=anchors, held=all_held, slid_mm=all_slid, limit_n=all_limit, gap_mm=gap, dissipated_nmm=lost)


def met(held: BoolArray, anchor: FloatArray, before: FloatArray, after: FloatArray, gap_before: FloatArray, gap: FloatArray) -> FloatArray:
    """Anchors (q, 3) of a step: of a held point its own; a point that is driven into the object is anchored where it meets the surface.

    ``before``, ``after`` (q, 3): the points in the object's frame, on a straight way; ``gap_before``, ``gap`` (q,) their distances from it.
    """
    driven = (gap_before > 0) & (gap < 0)
    share = np.where(driven, gap_before / np.where(driven, gap_before - gap, 1.0), 0.0)[:, None]
    return np.where(held[:, None], anchor, (1 - share) * before + share * after)


def rub(
    problem: Problem, contact: ContactForces, limit_n: FloatArray, gap_before: FloatArray, gap: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """After a step: anchors (q, 3), slip since the points last stuck (q,), largest friction forces (q,) in N, and the work lost in N mm.

    A point that slips bears the limit of friction, which changes from ``limit_n`` in the step with its normal force and its slip. A point
    that slipped and leaves the object bears it until its distance, ``gap_before`` (q,) and then ``gap`` (q,), is 0.
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
