"""``twin servo``: follow an object's outline."""

from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import (
    FIRST,
    SHIPPED_MODEL,
    ArmOption,
    AtRest,
    Camera,
    Limits,
    Model,
    Out,
    PlainLight,
    ServoName,
    writable_folder,
)

HELP = """Follow an object's outline with the sensor, frame by frame: pose-based tactile servoing.

It runs in the twin unless told otherwise: the arm is simulated, and the frames are drawn for the contact that its pose makes. With
--camera and --arm the same loop runs on devices, real or emulated. The arm goes around the object to 50 mm before it. Where the object
has no end (a plane, an edge), it goes straight, and stays in front of it. The arm's links and the object's holder are not known.
Whatever happens (Ctrl-C too), the arm stops, retreats along the surface's normal and is disabled. Before it touches anything, a frame
is taken that the model counts pins from. With --at-rest none it counts from the specification's layout; models on graphs always do.

\b
  twin servo --object can --model RUN --out out/servo
  twin emulate mg400 &  twin emulate camera --arm mg400:127.0.0.1 --sensor mg400-331 --object can --port 8081 &
  twin servo --object can --model RUN --camera http://127.0.0.1:8081/stream.mjpg --arm mg400:127.0.0.1 --stream --steps 60 --out out/live

\b
Writes to --out: trajectory.csv, trajectory.png, measures.json (smoothness S as the Tac-VGNN paper defines it, path, depth
and angle errors, jerk, share of the way, lost contacts; rate, latency and age of the frames), session/ with --record.
Exit code 1 if it ended early.
"""


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
    limits: Limits = None,
    record: Annotated[bool, typer.Option("--record", help="keep every frame and step in OUT/session")] = False,
    seed: Annotated[int, typer.Option("--seed", help="of the twin's noise")] = 0,
    known_place: Annotated[bool, typer.Option("--known-place", help="the object stands where --servo has it: measure against it")] = False,
    plain_light: PlainLight = False,
    at_rest: AtRest = FIRST,
) -> None:
    from hardware.following import FollowPlan, follow
    from scenes import load_object, load_servo
    from training.estimator import PoseEstimator
    from twin.cli.endings import arm_let_go
    from twin.cli.output import tell
    from twin.cli.progress import shown

    plan = FollowPlan(
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
    with arm_let_go(), shown() as progress:
        followed = follow(plan, PoseEstimator.load(model), writable_folder(out), about={"model": str(model)}, progress=progress)
    tell(followed)
    if followed.failure:
        raise SystemExit(1)
