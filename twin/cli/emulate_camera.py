"""``twin emulate camera``: the twin as a camera on the network."""

from typing import Annotated

import typer

from twin.cli.emulate import FaultOption, emulate, list_faults, run_until_told
from twin.cli.options import Object, Sensor
from twin.cli.servo import PlainLight, ServoName

HELP = """Emulate the sensor's camera: a stream of JPEGs over HTTP that shows what an emulated arm's pose makes of the contact.

The pose comes from the arm's feedback ports, so that camera and arm are processes of their own.

\b
  twin emulate mg400 &
  twin emulate camera --arm mg400:127.0.0.1 --sensor mg400-331 --object can --port 8081
"""


@emulate.command("camera", help=HELP)
def camera(
    arm: Annotated[str, typer.Option("--arm", metavar="A", help="mg400:ADDRESS[:DASHBOARD_PORT]")],
    sensor: Sensor,
    object_name: Object,
    host: Annotated[str, typer.Option("--host", help="address to listen on")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: a free one")] = 8081,
    fps: Annotated[float, typer.Option("--fps", min=0.1, help="no more pictures a second")] = 30.0,
    parameters: ServoName = "surface",
    fault: FaultOption = (),
    plain_light: PlainLight = False,
) -> None:
    from hardware.emulators.arm_pose import FeedbackPose
    from hardware.emulators.camera import FAULTS, CameraEmulator
    from hardware.rig_geometry import PlacedObject
    from scenes import load_experiment, load_object, load_sensor, load_servo
    from twin.cli.rig import twin_camera
    from twin.rig.mounting import Mounting
    from twin.types import Form

    list_faults(fault, FAULTS)
    spec, servo = load_sensor(sensor), load_servo(parameters)
    placed = PlacedObject(load_object(object_name), servo.placement, Mounting.of(spec, load_experiment(servo.experiment)))
    with FeedbackPose.of(arm) as pose:
        source = twin_camera(spec, placed, pose, Form.RAW, fps=fps, plain_light=plain_light)
        device = CameraEmulator(source, host=host, port=port, faults=tuple(fault))
        run_until_told(device, lambda: f"camera {device.url}", lambda: device.error)
