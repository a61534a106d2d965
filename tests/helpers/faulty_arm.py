"""A simulated arm with faults that can be switched on."""

import time
from dataclasses import replace
from enum import StrEnum

from hardware.arms.arm import FEEDBACK_AGE_S, SimulatedArm
from hardware.errors import DeviceError, StaleDataError

STALL_AFTER = 0.5  # share of a move's time after which a stalling arm stands still
SLOW_FACTOR = 0.1


class ArmFault(StrEnum):
    SLOW = "slow"  # moves at a tenth of the speed
    STALL = "stall"  # stops halfway and says that it is at rest
    IGNORE = "ignore"  # accepts a move and does not execute it
    COLLIDE = "collide"  # stops halfway with an error
    SILENT = "silent"  # feedback no longer arrives


class FaultyArm(SimulatedArm):
    """``faults`` can be changed at any time. A change applies to later moves; SILENT applies at once."""

    def __init__(self, **options):
        super().__init__(**options)
        self.faults = set()
        self._usual_scale = self._scale
        self._collided_s = float("inf")
        self._silent_since = None

    def clear_error(self):
        super().clear_error()
        self._collided_s = float("inf")

    def stop(self):
        super().stop()
        if self._collided_s > time.monotonic():
            self._collided_s = float("inf")

    def enable(self):
        if error := self.state().error:
            raise DeviceError(f"{self.name}: {error}; call clear_error() first")
        super().enable()

    def state(self, *, max_age_s=FEEDBACK_AGE_S):
        now_s = time.monotonic()
        self._silent_since = (self._silent_since or now_s) if ArmFault.SILENT in self.faults else None
        told_s = self._silent_since or now_s
        if now_s - told_s > max_age_s:
            raise StaleDataError(f"{self.name}: newest feedback is {now_s - told_s:.2f} s old (allowed {max_age_s:g} s)")
        return replace(self._state_at(told_s), error="collision (alarm 112); free the arm" if told_s >= self._collided_s else "")

    def _begin(self, joints, pose):
        if error := self.state(max_age_s=float("inf")).error:
            raise DeviceError(f"{self.name}: {error}; call clear_error(), then enable()")
        if ArmFault.IGNORE in self.faults:
            return None
        self._scale = self._usual_scale * (SLOW_FACTOR if ArmFault.SLOW in self.faults else 1.0)
        piece = super()._begin(joints, pose)
        halfway_s = piece.start_s + STALL_AFTER * piece.duration_s
        if self.faults & {ArmFault.STALL, ArmFault.COLLIDE}:
            self.track.stop(halfway_s)
        if ArmFault.COLLIDE in self.faults:
            self._collided_s = min(self._collided_s, halfway_s)
        return piece
