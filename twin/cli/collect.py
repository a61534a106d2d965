"""``twin collect``: labelled frames from a camera and an arm."""

from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Out, Sensor
from twin.cli.servo import ArmOption, Camera, PlainLight, ServoName

HELP = """Collect labelled frames: for each contact a random pose and shear, a tap, and one frame.

A frame is taken only after the arm has said that it stands at the commanded pose, and only one exposed after that; the
pose that it said is the label. The arm goes around the object to 50 mm before it (straight, and in front of it, where the
object has no end: a plane, an edge), lifts between contacts, and ends 50 mm clear, disabled. Its links and the object's holder
are not known: look that both have room. The frame without contact is refused where the sensor seems pressed in it.
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
    limits: Annotated[str | None, typer.Option("--limits", help="safety limits: mg400, magician, or a TOML file")] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="of the draws; the experiment's own if not given")] = None,
    plain_light: PlainLight = False,
) -> None:
    from hardware.collect import Collection, collect
    from scenes import load_experiment, load_object, load_sensor, load_servo
    from twin.cli.endings import signals_as_ctrl_c
    from twin.cli.options import writable_folder
    from twin.cli.progress import count_bar
    from twin.cli.rig import build_rig
    from twin.preprocess import require_untouched

    asked, spec, servo = load_experiment(experiment), load_sensor(sensor), load_servo(parameters)
    stimulus = load_object(object_name or asked.object)
    seed = asked.seed if seed is None else seed
    rig = build_rig(
        spec,
        stimulus,
        servo.placement,
        asked,
        camera=camera,
        arm=arm,
        form=form,
        limits=limits,
        seed=seed,
        plain_light=plain_light,
        at_once=True,
    )
    low, high = zip(*asked.ranges().values(), strict=True)
    about = {
        "comments": f"collected: {asked.name}, {spec.name}, {stimulus.name}",
        "camera": camera,
        "arm": arm,
        "sensor": spec.name,
        "form": str(rig.source.form),
        "seed": seed,
        "experiment": asked.model_dump(mode="json"),
        "placement": servo.placement.model_dump(mode="json"),
        "tap_move": asked.tap,
        "poses_rng": [high[:6], low[:6]],
        "moves_rng": [high[6:], low[6:]],
        "linear_speed": servo.linear_mm_s,
        "angular_speed": servo.angular_deg_s,
    }
    collection = Collection(writable_folder(out), about, rig.source.form)
    begun = collection.count

    def on_rest(frame) -> None:
        remedy = (
            f"look what touches it, remove {collection.rest} and give the same command again to have it taken anew; "
            "or the same command alone, to go on with it"
        )
        require_untouched(spec, rig.source.form, frame, remedy)

    if begun < count:
        with signals_as_ctrl_c(), rig, count_bar("contacts") as progress:
            rig.await_frame()
            speed = (servo.linear_mm_s, servo.angular_deg_s)
            options = {"seed": seed, "speed": speed, "frame_timeout_s": rig.frame_timeout_s, "on_rest": on_rest, "progress": progress}
            collect(rig.source, rig.arm, asked, rig.placed, collection, count, **options)
    print(f"{collection.count} contacts in {out} ({collection.count - begun} new)")
