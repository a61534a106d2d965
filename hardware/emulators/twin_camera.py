"""The twin as a camera on the network: it shows the contact at the pose of an arm that runs in another process.

``FeedbackPose`` reads this pose from the feedback ports of an MG400.
"""

from collections.abc import Callable

import numpy as np

from hardware.arms.arm import ArmState
from hardware.arms.mg400_link import Feedback
from hardware.arms.mg400_wire import DASHBOARD_PORT, FEEDBACK_PERIOD_S, require_ports
from hardware.emulators.camera import CameraEmulator
from hardware.emulators.running import run_until_told, say
from hardware.rig import twin_camera
from hardware.rig_geometry import PlacedObject
from scenes import ObjectSpec, SensorSpec, ServoSpec, load_experiment
from twin.errors import OptionError
from twin.rig.mounting import Mounting
from twin.types import Form

# Feedback older than this (s) is not used.
MAX_AGE_S = 1.0


class FeedbackPose:
    """Reads the newest state from the feedback ports. It opens no command connection, so a driver may be connected at the same time.

    Parameters
    ----------
    host : str
    ports : tuple of int
        Feedback ports, tried in order.
    """

    def __init__(self, host: str, ports: tuple[int, ...] = tuple(FEEDBACK_PERIOD_S)) -> None:
        self._feedback = Feedback(f"arm at {host}", host, ports)

    @classmethod
    def of(cls, spec: str) -> "FeedbackPose":
        """From ``mg400:ADDRESS[:DASHBOARD_PORT]``. The feedback ports have the same offset as the dashboard port."""
        kind, _, rest = spec.partition(":")
        host, _, port = rest.partition(":")
        if kind != "mg400" or not host or (port and not port.isdecimal()):
            raise OptionError(f"--arm {spec}: expected mg400:ADDRESS, for example mg400:127.0.0.1 with 'twin emulate mg400' running")
        offset = int(port) - DASHBOARD_PORT if port else 0
        require_ports(offset)
        return cls(host, tuple(number + offset for number in FEEDBACK_PERIOD_S))

    def __enter__(self) -> "FeedbackPose":
        self._feedback.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._feedback.close()

    def __call__(self) -> ArmState:
        """The newest state; ``StaleDataError``."""
        packet, time_s = self._feedback.newest(MAX_AGE_S)
        x, y, z, turn = packet["tool_actual"][:4]
        return ArmState(np.array([x, y, z, 0.0, 0.0, turn]), packet["q_actual"][:4].copy(), time_s, bool(packet["enabled"]), False)


def emulate_camera(
    arm: str,
    sensor: SensorSpec,
    stimulus: ObjectSpec,
    servo: ServoSpec,
    *,
    host: str = "127.0.0.1",
    port: int = 8081,
    fps: float = 30.0,
    faults: tuple[str, ...] = (),
    plain_light: bool = False,
    on_ready: Callable[[str], None] = say,
) -> None:
    """Stream the twin's frames as JPEGs over HTTP until told to end.

    Parameters
    ----------
    arm : str
        Whose feedback tells the pose, as ``FeedbackPose.of`` takes it.
    servo : ServoSpec
        Where the object stands.
    port : int
        0: a free one.
    fps : float
        Most pictures a second.
    faults : tuple of str
        See ``CameraEmulator``.
    plain_light : bool
        Without path tracing at the start; see ``hardware.rig.drawn``.
    """
    placed = PlacedObject(stimulus, servo.placement, Mounting.of(sensor, load_experiment(servo.experiment)))
    pose = FeedbackPose.of(arm)
    source = twin_camera(sensor, placed, pose, Form.RAW, fps=fps, plain_light=plain_light)
    device = CameraEmulator(source, host=host, port=port, faults=faults)
    with pose:
        run_until_told(device, lambda: f"camera {device.url}", lambda: device.error, on_ready=on_ready)
