"""Every fault of an emulated arm in every phase of a move: what the user is told, after how long, and where the arm stands."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from threading import Timer
from types import SimpleNamespace

import numpy as np
from arms import mg400_of

from hardware.arms.magician import Magician
from hardware.arms.ur.driver import UR
from hardware.emulators.magician import FAULTS as MAGICIAN_FAULTS
from hardware.emulators.magician import MagicianEmulator
from hardware.emulators.mg400 import FAULTS as MG400_FAULTS
from hardware.emulators.mg400 import Mg400Emulator
from hardware.emulators.ur import FAULTS as UR_FAULTS
from hardware.emulators.ur import UrEmulator
from hardware.errors import DeviceError

PHASES = ("before", "during", "waiting", "stopping")
# Values that make a fault show within a short move.
VALUES = dict.fromkeys(("silent-feedback", "frozen", "die", "unplugged", "emergency-stop"), 0) | {
    "slow": 0.02,
    "short-packets": 2,
    "wrong-test-value": 2,
}
DEVICES = {"mg400": MG400_FAULTS, "magician": MAGICIAN_FAULTS, "ur": UR_FAULTS}
STARTS = {"mg400": [300.0, 0, 0, 0, 0, 0], "magician": [200.0, 0, 30, 0, 0, 0], "ur": [100.0, -500, 200, 0, 0, -160]}
CASES = [(device, fault, phase) for device, faults in DEVICES.items() for fault in faults for phase in PHASES]
SPEED_MM_S, WAY_MM, LIMIT_S = 80.0, 60.0, 1.5
FAULT_AFTER_S = 0.2  # of a move of 0.75 s
# What must be said where the arm may still move.
LOUD = ("emergency stop", "Switch it off", "switch it off")


@dataclass(frozen=True)
class Told:
    """What happened in one case.

    Attributes
    ----------
    told : str
        The error; "" if the move or the stop succeeded.
    after_s, longest_s : float
        Time from the fault to the end of the call, and the longest of all calls, the disconnecting included.
    moves : bool
        Whether the arm moves after that, unattended.
    stands_mm : float
        Distance of the arm from the target.
    """

    device: str
    fault: str
    phase: str
    told: str
    after_s: float
    longest_s: float
    moves: bool
    stands_mm: float

    @property
    def loud(self) -> bool:
        """Whether the user is told to stop the arm by hand."""
        return any(word in self.told for word in LOUD)

    def row(self) -> str:
        """A row of a table in Markdown."""
        said = " ".join(self.told.split())[:260].replace("|", "/") or "nothing: it succeeds"
        stands = "MOVES" if self.moves else "at the target" if self.stands_mm < 0.1 else f"{self.stands_mm:.0f} mm before it"
        return f"| {self.device} | {self.fault} | {self.phase} | {said} | {self.after_s:.2f} | {stands} |"


def measure(device: str, fault: str, phase: str) -> Told:
    """Bring an emulated arm into a phase of a move with a fault, and see what happens."""
    known = DEVICES[device][fault]
    text = fault if known.allowed is None else f"{fault}={VALUES.get(fault, known.default)}"
    first = (text,) if phase == "before" and fault not in ("die", "unplugged") else ()
    makes = {"mg400": partial(Mg400Emulator, port_offset=None), "magician": MagicianEmulator, "ur": partial(UrEmulator, host=None)}
    emulator = makes[device](faults=first)
    calls = SimpleNamespace(fault_s=0.0, longest_s=0.0, told="", ended_s=0.0)

    def fail() -> None:
        calls.fault_s = time.monotonic()
        if fault in ("die", "unplugged"):
            emulator.kill() if fault == "die" else emulator.unplug()
        elif fault == "emergency-stop":
            emulator.arm.press_emergency_stop()
        else:
            emulator.faults.add(text)

    def call(act: Callable[[], object]) -> None:
        """One call of a program that ends with its first error."""
        if calls.told:
            return
        begun_s = time.monotonic()
        try:
            act()
        except DeviceError as error:
            calls.told = str(error)
        calls.ended_s = time.monotonic()
        calls.longest_s = max(calls.longest_s, calls.ended_s - begun_s)

    with emulator:
        drives = {"mg400": mg400_of, "magician": lambda emulator: Magician(emulator.device), "ur": lambda emulator: UR(emulator.host)}
        arm, start = drives[device](emulator), np.array(STARTS[device])
        target = start + [0, WAY_MM, 0, 0, 0, 0]
        calls.fault_s = time.monotonic()
        call(arm.connect)
        call(arm.enable)
        call(lambda: arm.set_speed(400.0, 200.0))
        call(lambda: arm.move_linear(start, timeout_s=LIMIT_S))
        call(lambda: arm.set_speed(SPEED_MM_S, 200.0))
        if phase == "before":
            if fault in ("die", "unplugged"):
                fail()
            call(lambda: arm.move_linear(target, timeout_s=LIMIT_S))
        elif phase == "waiting":
            timer = Timer(FAULT_AFTER_S, fail)
            timer.start()
            call(lambda: arm.move_linear(target, timeout_s=LIMIT_S))
            timer.join()
        else:
            call(lambda: arm.move_linear(target, wait=False))
            time.sleep(FAULT_AFTER_S)
            fail()
            call(arm.stop if phase == "stopping" else lambda: arm.move_linear(target + [0, 0, 5, 0, 0, 0], timeout_s=LIMIT_S))
        told, ended_s = calls.told, calls.ended_s
        time.sleep(0.15)
        before = emulator.arm.track.pose(time.monotonic())
        time.sleep(0.05)
        after = emulator.arm.track.pose(time.monotonic())
        calls.told = ""
        call(arm.disconnect)
        distance = float(np.linalg.norm(after[:3] - target[:3]))
        moves = float(np.abs(after - before).max()) > 1e-6
        return Told(device, text, phase, told, max(0.0, ended_s - calls.fault_s), calls.longest_s, moves, distance)
