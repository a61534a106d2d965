"""The arms under one contract: each entry makes the arm as a user would, with its emulator beneath it."""

import os
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import count

import numpy as np

from hardware.arms.arm import SimulatedArm
from hardware.arms.magician import Magician
from hardware.arms.mg400 import MG400, Mg400Ports
from hardware.arms.ros2 import Ros2Arm
from hardware.arms.ur.driver import UR
from hardware.emulators.magician import MagicianEmulator
from hardware.emulators.mg400 import Mg400Emulator
from hardware.emulators.ros2 import Ros2Emulator
from hardware.emulators.ur import UrEmulator

ARMS = ("simulated-6", "simulated-4", "mg400", "mg400-old", "magician", "ros2-twist", "ros2-pose", "ur")
NUMBERS = count()


@dataclass
class Bench:
    """An arm that isn't connected yet, a pose well within its reach, and what is beneath it."""

    arm: object
    home: np.ndarray
    device: object  # the emulator, or the simulated arm itself
    reads: object  # pose of the device itself


def mg400_of(emulator, **options) -> MG400:
    ports = emulator.ports
    return MG400("127.0.0.1", ports=Mg400Ports(ports[29999], ports[30003], (ports[30004], ports[30005])), **options)


def own_namespace() -> str:
    """A namespace of topics that no other test uses."""
    return f"t{os.getpid()}/n{next(NUMBERS)}"


@contextmanager
def bench(kind: str, *, faults: tuple[str, ...] = (), time_scale: float = 4.0):
    with ExitStack() as stack:
        if kind.startswith("simulated"):
            axes = int(kind[-1])
            arm = SimulatedArm(axes=axes, time_scale=time_scale)
            yield Bench(arm, np.array([300.0, 0, 0, 0, 0, 0]), arm, lambda: arm.track.pose(np.inf))
        elif kind.startswith("mg400"):
            firmware = "1.5.5" if kind.endswith("old") else "1.7.0"
            emulator = stack.enter_context(Mg400Emulator(port_offset=None, faults=faults, firmware=firmware, time_scale=time_scale))
            arm = mg400_of(emulator)
            yield Bench(arm, np.array([300.0, 0, 0, 0, 0, 10]), emulator, emulator.pose)
        elif kind.startswith("ros2"):
            form, namespace = kind[5:], own_namespace()
            emulator = stack.enter_context(Ros2Emulator(form, namespace=namespace, faults=faults))
            arm = Ros2Arm(form, namespace=namespace)
            yield Bench(arm, np.array([300.0, 0, 0, 0, 0, 0]), emulator, emulator.pose)
        elif kind == "ur":
            emulator = stack.enter_context(UrEmulator(host=None, faults=faults, time_scale=time_scale))
            arm = UR(emulator.host)
            yield Bench(arm, np.array([100.0, -500, 200, 0, 0, -160]), emulator, emulator.pose)
        else:
            emulator = stack.enter_context(MagicianEmulator(faults=faults, time_scale=time_scale))
            arm = Magician(emulator.device)
            yield Bench(arm, np.array([200.0, 0, 30, 0, 0, 10]), emulator, emulator.pose)
        if arm.is_connected:
            arm.disconnect()
