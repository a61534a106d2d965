"""``twin emulate camera``: the twin as a camera on the network."""

from typing import Annotated

import typer

from twin.cli.emulate import FaultOption, emulate, faults_of
from twin.cli.options import Object, PlainLight, Sensor, ServoName

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
    fault: FaultOption = None,
    plain_light: PlainLight = False,
) -> None:
    from hardware.emulators.camera import FAULTS
    from hardware.emulators.twin_camera import emulate_camera
    from scenes import load_object, load_sensor, load_servo

    faults = faults_of(fault, FAULTS)
    things = load_sensor(sensor), load_object(object_name), load_servo(parameters)
    emulate_camera(arm, *things, host=host, port=port, fps=fps, faults=faults, plain_light=plain_light)
