"""The twin as a camera on the network. It shows the contact at the pose of an arm that another process drives.

``FeedbackPose`` reads this pose from the feedback ports of an MG400.
"""

from hardware.arms.arm import ArmState
from hardware.arms.mg400_link import Feedback
from hardware.arms.mg400_wire import FEEDBACK_PERIOD_S, address_of, pose_in
from hardware.emulators.camera import CameraEmulator
from hardware.rig.geometry import PlacedObject
from hardware.workcell.build import twin_camera
from scenes import ObjectSpec, SensorSpec, ServoSpec, load_experiment
from twin.errors import OptionError
from twin.rig.kinematics import Mounting
from twin.types import Form

# Largest age, s, of feedback that is used.
MAX_AGE_S = 1.0


class FeedbackPose:
    """Reads the newest state from the feedback ports. It opens no command connection, so a driver may be connected at the same time.

    Parameters
    ----------
    host : str
    ports : tuple of int
        Feedback ports, tried in order.
    lenient : bool
        See ``Feedback``.
    """

    def __init__(self, host: str, ports: tuple[int, ...] = tuple(FEEDBACK_PERIOD_S), *, lenient: bool = False) -> None:
        self._feedback = Feedback(f"arm at {host}", host, ports, lenient=lenient)

    @classmethod
    def of(cls, spec: str) -> "FeedbackPose":
        """The reader for ``mg400:ADDRESS[:DASHBOARD_PORT]``. The feedback ports have the same offset as the dashboard port."""
        kind, _, rest = spec.partition(":")
        if kind not in ("mg400", "mg400-lenient") or rest[:1] in ("", ":"):
            raise OptionError(f"`arm` {spec}: expected mg400:ADDRESS, for example mg400:127.0.0.1 with 'twin emulate mg400' running")
        host, offset = address_of(rest)
        return cls(host, tuple(number + offset for number in FEEDBACK_PERIOD_S), lenient=kind != "mg400")

    def __enter__(self) -> "FeedbackPose":
        self._feedback.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._feedback.close()

    def __call__(self) -> ArmState:
        """The newest state; raises ``StaleDataError`` if it is too old."""
        packet, time_s = self._feedback.newest(MAX_AGE_S)
        return ArmState(pose_in(packet), packet["q_actual"][:4].copy(), time_s, bool(packet["enabled"]), False)


def emulate_camera(
    arm: str,
    sensor: SensorSpec,
    obj: ObjectSpec,
    servo: ServoSpec,
    *,
    host: str = "127.0.0.1",
    port: int = 8081,
    fps: float = 30.0,
    faults: tuple[str, ...] = (),
    plain_light: bool = False,
) -> None:
    """Stream the twin's frames as JPEGs over HTTP until it is ended.

    Parameters
    ----------
    arm : str
        Arm whose feedback gives the pose, as text for ``FeedbackPose.of``.
    servo : ServoSpec
        Specification with the object's place.
    port : int
        Port; 0 for a free one.
    fps : float
        Most pictures per second.
    faults : tuple of str
        See ``CameraEmulator``.
    plain_light : bool
        Without path tracing at the start; see ``hardware.workcell.build.draw_window``.
    """
    placed = PlacedObject(obj, servo.placement, Mounting.of(sensor, load_experiment(servo.experiment)))
    pose = FeedbackPose.of(arm)
    source = twin_camera(sensor, placed, pose, Form.RAW, fps=fps, plain_light=plain_light)
    device = CameraEmulator(source, host=host, port=port, faults=faults)
    with pose:
        device.run()
