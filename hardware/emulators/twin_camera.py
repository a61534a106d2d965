"""The twin as a camera on the network: it shows what the pose of an arm in another process makes of the contact."""

from collections.abc import Callable

from hardware.emulators.arm_pose import FeedbackPose
from hardware.emulators.camera import CameraEmulator
from hardware.emulators.running import run_until_told, say
from hardware.rig import twin_camera
from hardware.rig_geometry import PlacedObject
from scenes import ObjectSpec, SensorSpec, ServoSpec, load_experiment
from twin.rig.mounting import Mounting
from twin.types import Form


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
    with FeedbackPose.of(arm) as pose:
        source = twin_camera(sensor, placed, pose, Form.RAW, fps=fps, plain_light=plain_light)
        device = CameraEmulator(source, host=host, port=port, faults=faults)
        run_until_told(device, lambda: f"camera {device.url}", lambda: device.error, on_ready=on_ready)
