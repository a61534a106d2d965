"""``twin servo``: follow an object's outline."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.at_rest import FIRST, AtRest
from twin.cli.options import Out

HELP = """Follow an object's outline with the sensor, frame by frame: pose-based tactile servoing.

In the twin unless told otherwise: the arm is simulated, the frames are drawn for the contact that its pose makes. With
--camera and --arm the same loop runs on devices, real or emulated. The arm goes around the object to 50 mm before it (straight,
and in front of it, where the object has no end: a plane, an edge; its links and the object's holder are not known), and whatever
happens (Ctrl-C too) it stops, retreats along the surface's normal and is disabled. Before it touches anything a frame is taken that
the model counts pins from (--at-rest none: the specification's layout; models on graphs always do).

\b
  twin servo --object can --model RUN --out out/servo
  twin emulate mg400 &  twin emulate camera --arm mg400:127.0.0.1 --sensor mg400-331 --object can --port 8081 &
  twin servo --object can --model RUN --camera http://127.0.0.1:8081/stream.mjpg --arm mg400:127.0.0.1 --stream --steps 60 --out out/live

\b
Writes to --out: trajectory.csv, trajectory.png, measures.json (smoothness S as the Tac-VGNN paper defines it, path, depth
and angle errors, jerk, share of the way, lost contacts; rate, latency and age of the frames), session/ with --record.
Exit code 1 if it ended early.
"""

Model = Annotated[Path, typer.Option("--model", metavar="RUN", help="folder of a run, or a sensor whose weights go with the package")]
SHIPPED_MODEL = Path("mg400-331")  # its weights go with the package
Camera = Annotated[str, typer.Option("--camera", metavar="C", help="twin, a number, /dev/videoN, http://..., a folder or a video")]
ArmOption = Annotated[str, typer.Option("--arm", metavar="A", help="simulated, simulated:4, mg400:ADDRESS, magician:PORT")]
PlainLight = Annotated[bool, typer.Option("--plain-light", help="twin: lamps' direct light alone, no path tracing at the start")]
ServoName = Annotated[str, typer.Option("--servo", help="gains, speeds and the object's place: a name, or a TOML file")]


@app.command("servo", help=HELP)
def servo(
    object_name: Annotated[str, typer.Option("--object", metavar="O", help="can, mesh-can, square, prism, tin-box, or another")],
    out: Out,
    model: Model = SHIPPED_MODEL,
    camera: Camera = "twin",
    arm: ArmOption = "simulated",
    parameters: ServoName = "surface",
    steps: Annotated[int | None, typer.Option("--steps", min=1, help="instead of once around the object")] = None,
    stream: Annotated[bool, typer.Option("--stream", help="decide at a fixed rate on the newest frame, without waiting for moves")] = False,
    rate: Annotated[float, typer.Option("--rate", min=0.1, help="decisions a second with --stream")] = 10.0,
    limits: Annotated[str | None, typer.Option("--limits", help="safety limits: mg400, magician, or a TOML file")] = None,
    record: Annotated[bool, typer.Option("--record", help="keep every frame and step in OUT/session")] = False,
    seed: Annotated[int, typer.Option("--seed", help="of the twin's noise")] = 0,
    known_place: Annotated[bool, typer.Option("--known-place", help="the object stands where --servo has it: measure against it")] = False,
    plain_light: PlainLight = False,
    at_rest: AtRest = FIRST,
) -> None:
    from scenes import load_object, load_servo
    from training.estimator import PoseEstimator
    from twin.cli.endings import signals_as_ctrl_c
    from twin.cli.options import writable_folder
    from twin.cli.progress import count_bar
    from twin.cli.servo_run import ServoRun, follow

    estimator = PoseEstimator.load(model)
    run = ServoRun(
        sensor=estimator.sensor,
        form=estimator.form,
        stimulus=load_object(object_name),
        servo=load_servo(parameters),
        camera=camera,
        arm=arm,
        steps=steps,
        stream_hz=rate if stream else None,
        limits=limits,
        record=record,
        seed=seed,
        plain_light=plain_light,
        known_place=known_place,
        at_rest=at_rest,
    )
    with signals_as_ctrl_c(), count_bar(f"following the {object_name}") as progress:
        followed = follow(run, estimator, writable_folder(out), about={"model": str(model)}, progress=progress)
    print("\n".join(followed.lines()))
    for name in followed.written:
        print(f"wrote {name}")
    if followed.failure:
        raise SystemExit(1)
