"""``twin collect``: labelled frames from a camera and an arm."""

from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import ArmOption, Camera, FormOrAuto, Limits, Out, PlainLight, Sensor, ServoName, writable_folder

HELP = """Collect labelled frames: for each contact a random pose and shear, a tap, and one frame.

A frame is taken only after the arm has said that it stands at the commanded pose, and it is exposed after that. The pose that
the arm said is the label. The arm goes around the object to 50 mm before it. Where the object has no end (a plane, an edge), it goes
straight, and stays in front of it. It lifts between contacts, and ends 50 mm clear, disabled. The arm's links and the object's holder
are not known: make sure that both have room. The frame without contact is refused if the sensor seems pressed in it.
The folder has the recordings' own format (targets.csv, frames_bw/ or images/, init_0.png without contact, meta.json);
contacts.jsonl has the times. The same command goes on where it was ended.

\b
  twin collect --camera twin --arm simulated --sensor mg400-331 --experiment surface-2d --count 200 --out data/first
  twin collect --camera /dev/video0 --arm mg400 --sensor mg400-331 --experiment surface-2d --count 5000 --out data/real
"""


@app.command("collect", help=HELP)
def collect_command(
    camera: Camera,
    arm: ArmOption,
    sensor: Sensor,
    out: Out,
    experiment: Annotated[
        str, typer.Option("--experiment", metavar="E", help="experiment name ('twin experiments') or file")
    ] = "surface-2d",
    count: Annotated[int, typer.Option("--count", min=1, help="contacts in the folder at the end")] = 100,
    object_name: Annotated[str | None, typer.Option("--object", metavar="O", help="the experiment's own if not given")] = None,
    parameters: ServoName = "surface",
    form: FormOrAuto = None,
    limits: Limits = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="of the draws; the experiment's own if not given")] = None,
    plain_light: PlainLight = False,
) -> None:
    from hardware.collecting import CollectPlan, collect_frames
    from scenes import load_experiment, load_object, load_sensor, load_servo
    from twin.cli.endings import arm_let_go
    from twin.cli.output import say
    from twin.cli.progress import shown

    asked = load_experiment(experiment)
    plan = CollectPlan(
        sensor=load_sensor(sensor),
        stimulus=load_object(object_name or asked.object),
        experiment=asked,
        servo=load_servo(parameters),
        camera=camera,
        arm=arm,
        count=count,
        seed=seed,
        form=form,
        limits=limits,
        plain_light=plain_light,
    )
    with arm_let_go(), shown() as progress:
        collected = collect_frames(plan, writable_folder(out), progress=progress)
    say(collected.lines())
