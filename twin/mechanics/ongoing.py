"""A contact in progress: its state, its history, and the step to the object's next pose."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np

from scenes.body import RelaxationTerm
from twin.errors import ContactError
from twin.geometry.mesh import NodeView
from twin.geometry.solid import Solid, pin_pose
from twin.mechanics.balance import Balance, Body, LoadState
from twin.mechanics.body.relaxation import History
from twin.mechanics.newton import RESIDUAL_TOLERANCE, LoadStepper, NoConvergence
from twin.types import ContactState, FloatArray, IntArray

_PENALTY_MPA_MM = 30.0
"""Penalty at the start of every contact, MPa per mm of penetration. With it, usual pressures give penetrations below
``newton.GAP_BOUND_MM``."""
_SMALLEST_STRIDE = 1 / 64
"""Smallest fraction of a regular load step. If a step of this length does not converge, the contact does not converge."""


@dataclass(frozen=True)
class Setting:
    """A solid and the quantities derived from it.

    Attributes
    ----------
    solid : Solid
    body : Body
    view : NodeView
    relaxation : tuple of tuples of RelaxationTerm
        Relaxation terms for each kind of the body's elements; empty for an elastic material.
    """

    solid: Solid
    body: Body
    view: NodeView
    relaxation: tuple[tuple[RelaxationTerm, ...], ...]


class OngoingContact:
    """One contact from its first touch on, with the history of friction and relaxation from step to step.

    Parameters
    ----------
    setting : Setting
    stepper : LoadStepper
    T : (4, 4) float
        The object's pose at the start, without contact.
    one_thread : callable
        Returns a context manager that limits BLAS to one thread.

    Attributes
    ----------
    load : LoadState
        The last converged state.
    """

    def __init__(self, setting: Setting, stepper: LoadStepper, T: FloatArray, one_thread: Callable[[], AbstractContextManager]) -> None:
        self.setting, self.stepper, self._one_thread = setting, stepper, one_thread
        body = setting.body
        count = len(body.points.area_mm2)
        self.load = LoadState(
            control_mm=setting.solid.control_mm,
            border=np.zeros(2),
            anchor_mm=np.zeros((count, 3)),
            held=np.zeros(count, bool),
            slid_mm=np.zeros(count),
            limit_n=np.zeros(count),
            gap_mm=np.zeros(count),
            penalty_mpa_mm=_PENALTY_MPA_MM,
            T=T,
        )
        self._terms = setting.relaxation
        self._past = [History.at_rest(kind, term) for kind, term in zip(body.kinds, self._terms, strict=True)]

    def step(self, T: FloatArray, span_s: float) -> ContactState:
        """The converged state with the object at ``T`` (4, 4), ``span_s`` after the last one. ``NoConvergence`` changes nothing."""
        kinds = self.setting.body.kinds
        now = [p.before(kind, term, span_s) for p, kind, term in zip(self._past, kinds, self._terms, strict=True)]
        with self._one_thread():
            self.stepper.follow(replace(self.setting.body, kinds=tuple(kind for kind, _ in now)))
            self.load, balance, looked = self.stepper.step(self.load, T, [given for _, given in now])
            result = contact_state(self.setting, self.load, balance, looked, self.stepper.touching_mm2(self.load))
        control_mm = self.load.control_mm
        self._past = [p.after(kind, term, span_s, control_mm) for p, kind, term in zip(self._past, kinds, self._terms, strict=True)]
        return result

    def advance(
        self, pose_at: Callable[[float], FloatArray], start: float, stop: float, time_at: Callable[[float], float], where: str
    ) -> Iterator[tuple[float, ContactState]]:
        """Compute one regular load step, or several shorter ones where it does not converge.

        Parameters
        ----------
        pose_at, time_at : callable
            Functions that return the object's pose (4, 4) and the time (s) at a progress from ``start`` to ``stop``.
        where : str
            Name of the load step, for the message of an error.

        Yields
        ------
        progress : float
        state : ContactState

        Raises
        ------
        ContactError
            If the smallest step does not converge.
        """
        done, stride = 0.0, 1.0
        while done < 1:
            stride = min(stride, 1 - done)
            before, at = start + done * (stop - start), start + (done + stride) * (stop - start)
            try:
                result = self.step(pose_at(at), time_at(at) - time_at(before))
            except NoConvergence as failure:
                stride /= 2
                if stride >= _SMALLEST_STRIDE:
                    continue
                raise ContactError(
                    f"no convergence in {where}: relative residual "
                    f"{failure.relative:.1e}, needed {RESIDUAL_TOLERANCE:.0e}; try less indentation, shear or friction, "
                    f"a rounder object, or another resolution"
                ) from None
            done += stride
            stride = min(2 * stride, 1.0)
            yield at, result


def contact_state(setting: Setting, state: LoadState, balance: Balance, looked: IntArray, touching_mm2: float) -> ContactState:
    """The public state of a converged load step.

    ``looked`` (q,) int are the indices of the contact points in ``balance``. ``touching_mm2`` is the area of skin near the object; it is
    the contact area if any point is in contact.
    """
    contact, points = balance.contact, setting.body.points
    touched = np.flatnonzero(contact.penetration_mm > 0)
    where = looked[touched]
    turn = state.T[:3, :3]
    at = points.positions(state.control_mm)[where]
    normal = contact.normal[touched] @ turn.T
    force = -balance.point_force_n[touched]
    normal_n = contact.normal_n[touched]
    base, axis, caps = pin_pose(setting.solid, state.control_mm)
    pose = state.T.copy()
    pose[2, 3] += state.border[0]
    return ContactState(
        nodes_mm=setting.view.nodes(state.control_mm),
        base_mm=base,
        axis=axis,
        caps_mm=caps,
        force_n=force.sum(axis=0),
        torque_nmm=np.cross(at, force).sum(axis=0),
        area_mm2=touching_mm2 if len(where) else 0.0,
        contact_mm=at,
        contact_place=points.place[where],
        normal=normal,
        normal_n=normal_n,
        tangential_n=force + normal_n[:, None] * normal,
        point_area_mm2=points.area_mm2[where],
        slipping=contact.slipping[touched],
        T_sensor_object=pose,
        elastic_nmm=state.elastic_nmm,
        dissipated_nmm=state.dissipated_nmm,
        residual=balance.relative,
    )
