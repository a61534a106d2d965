"""Commands that work with a camera and an arm, real or emulated.

- ``twin live``: a model's estimates on a camera's frames, shown as they come.
- ``twin collect``: labelled frames from a camera and an arm.
- ``twin servo``: follow an object's outline.
- ``twin policy``: a trained policy on a camera and an arm.
- ``twin grasp``: a trained policy on two sensors of a gripper.
- ``twin emulate``: arms, and the sensor's camera, emulated on this machine for any client.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option

from twin.cli import app, group, options
from twin.cli.options import Formerly, call, print_lines
from twin.progress import Progress
from twin.signals import signals_as_ctrl_c
from twin.types import FIRST, NONE

if TYPE_CHECKING:
    from hardware.collect.collect import Collected
    from hardware.emulators.faults import Fault
    from hardware.live.live import WatchResult
    from hardware.servo.following import Followed
    from hardware.servo.grip import Gripped

# Sensor whose trained weights are shipped with the package.
SHIPPED_MODEL = Path("mg400-331")
Model = Annotated[Path, Option("--model", metavar="RUN", help="folder of a run, or a sensor whose weights are shipped")]
CAMERAS = "twin, a number, /dev/videoN, http://..., rtsp://..., ros2:/TOPIC, a folder or video, mujoco:SCENE"
Camera = Annotated[str, Option("--camera", metavar="C", help=CAMERAS)]
Steps = Annotated[int | None, Option("--steps", min=1, help="number of steps, instead of once around the object")]
Record = Annotated[bool, Option("--record", help="keep every frame and step in OUT/session")]
NoiseSeed = Annotated[int, Option("--seed", min=0, help="seed of the twin's noise")]
KnownPlace = Annotated[bool, Option("--known-place", help="the object stands exactly at --servo: measure errors against it")]
ARMS = "simulated, simulated:4, mg400[-lenient]:ADDRESS[:DASHBOARD_PORT], magician:PORT, ros2:twist, ros2:pose, ur:ADDRESS"
ArmOption = Annotated[str, Option("--arm", metavar="A", help=ARMS)]
DryRun = Annotated[bool, Option("--dry-run", help="check and print the plan, without motion")]
Limits = Annotated[str | None, Option("--safety", help="limits: mg400, magician, ros2, ur, or a TOML file"), Formerly("limits")]
TOPICS = "publish frames, pins and estimates as ROS 2 topics /NAME/..., such as tactip"
Ros2 = Annotated[str | None, Option("--ros2", metavar="NAME", help=TOPICS)]
ZERO = (
    "frame without contact, the zero of displacements: a file, the first frame (an error if it shows a contact), "
    "or none (positions at rest of the model, or estimated from some forty contacts)"
)
AtRest = Annotated[str, Option("--at-rest", metavar="FRAME|first|none", help=ZERO)]


@app.command("live")
def live(
    model: Model = SHIPPED_MODEL,
    camera: Camera = "",
    record: Annotated[Path | None, Option(metavar="DIR", help="new folder for the session")] = None,
    replay: Annotated[Path | None, Option(metavar="DIR", help="recorded session, instead of a camera")] = None,
    headless: Annotated[bool, Option("--headless", help="no page: only print the figures at the end")] = False,
    rerun: Annotated[str | None, Option(metavar="T", help="viewer, a new file *.rrd, or a viewer's address rerun+http://...")] = None,
    seconds: Annotated[float | None, Option(min=0, help="stop after this time")] = None,
    count: Annotated[int | None, Option(min=1, help="stop after this number of frames")] = None,
    rate: Annotated[float | None, Option(min=0.1, help="most frames a second that are used, each time the newest")] = None,
    at_rest: AtRest = NONE,
    also: options.Also = None,
    ros2: Ros2 = None,
    port: Annotated[int, Option(min=0, max=65535, help="port of the page; if it is taken, the next free one")] = 8080,
) -> "WatchResult":
    """Show a model's estimates on a camera's frames.

    A page for the browser shows pins, graph, Voronoi map, the pose with its 90 % interval, and rates. The command prints its address.
    With --rerun (package rerun-sdk) they go to Rerun's viewer or to a file: frame, pins, graph and pose on a time line. The studio shows
    the same in its mode 'Live', with an arm and the sensor's health.

    With --record DIR every frame is written, lossless, with its estimate. The folder can be read even if the program was killed. --replay
    DIR runs the model on the same frames again, and prints whether the estimates are the same. With --at-rest first there must be no
    contact at the start; the first frame is then written with the session. Otherwise displacements of pins are relative to the model's
    positions at rest. After 40 different contacts these are replaced by estimated positions, as in 'twin predict'. --also writes the
    session in further formats when it ends.

    A model that was trained on simulated drags also uses earlier frames and estimates slip: see 'twin predict --help', --sequence.

    \b
    Example:
      twin live --camera /dev/video0 --model RUN
      twin live --camera http://127.0.0.1:8081/stream.mjpg --model RUN \\
          --record out/session --headless --seconds 60
      twin live --replay out/session --model RUN --headless
    """
    from hardware.live.live import WatchPlan, watch
    from training.estimate.estimator import load_with_history

    plan = call(WatchPlan, locals(), shown=not headless)
    with signals_as_ctrl_c():
        return watch(plan, load_with_history(model), name=str(model), on_shown=print_view)


def print_view(url: str) -> None:
    """Print where the frames are shown."""
    print(f"showing in {url}; Ctrl-C ends it", flush=True)


@app.command("collect", goes_on=True)
def collect(
    camera: Camera,
    arm: ArmOption,
    sensor: options.Sensor,
    out: options.Out,
    experiment: options.Experiment = "surface-2d",
    count: Annotated[int, Option(min=1, help="contacts in the folder at the end")] = 100,
    obj: Annotated[str | None, Option("--object", metavar="O", help="object; the experiment's own if not given")] = None,
    servo: options.ServoName = "surface",
    form: options.FormOrAuto = None,
    safety: Limits = None,
    seed: Annotated[int | None, Option(min=0, help="seed of the sampled contacts; the experiment's own if not given")] = None,
    design: Annotated[str, Option(help="random, or even (spread over the ranges)")] = "random",
    plain_light: options.PlainLight = False,
    also: options.Also = None,
    ros2: Ros2 = None,
    dry_run: DryRun = False,
    *,
    progress: Progress,
) -> "Collected":
    """Collect labelled frames with a camera and an arm.

    Each contact has a random pose and shear, a tap, and one frame. With --design even the contacts are spread evenly over the
    experiment's ranges, for any number of contacts: use it if labels are expensive. The frame is exposed after the arm has reported that it
    stands at the commanded pose. The label is the reported pose.

    The arm moves around the object to a place 50 mm in front of it. If the object has no end (a plane, an edge), the arm moves straight and
    stays in front of it. It lifts off between contacts; at the end it stands 50 mm away, disabled. The program has no model of the arm's
    links and the object's holder: make sure that both have room. A frame without contact is refused if it seems to show a contact.

    The folder has the format of recordings (targets.csv, frames_bw/ or images/, init_0.png without contact, meta.json). The times are in
    contacts.jsonl. The same command resumes an interrupted collection. With --also each contact is written in further formats before the
    next one is made.

    \b
    Example:
      twin collect --camera twin --arm simulated --sensor mg400-331 \\
          --experiment surface-2d --count 200 --out data/first
      twin collect --camera /dev/video0 --arm mg400 --sensor mg400-331 \\
          --experiment surface-2d --count 5000 --out data/real
    """
    from hardware.collect.collect import CollectPlan, collect_frames
    from scenes import load_experiment, load_object

    plan = call(CollectPlan, locals(), obj=load_object(obj or load_experiment(experiment).object))
    with signals_as_ctrl_c():
        return collect_frames(plan, out, progress=progress)


def ended_early(followed: "Followed") -> int:
    """Exit code of a command that follows an outline."""
    return 1 if followed.failure else 0


@app.command("servo", exit_code=ended_early)
def servo(
    obj: Annotated[str, Option("--object", metavar="O", help="can, mesh-can, square, prism, tin-box, or another")],
    out: options.Out,
    model: Model = SHIPPED_MODEL,
    camera: Camera = "",
    arm: ArmOption = "simulated",
    servo: options.ServoName = "surface",
    steps: Steps = None,
    stream: Annotated[bool, Option("--stream", help="decide at a fixed rate on the newest frame, without waiting for moves")] = False,
    rate: Annotated[float, Option(min=0.1, help="decisions a second with --stream")] = 10.0,
    safety: Limits = None,
    record: Record = False,
    seed: NoiseSeed = 0,
    known_place: KnownPlace = False,
    plain_light: options.PlainLight = False,
    at_rest: AtRest = FIRST,
    also: options.Also = None,
    ros2: Ros2 = None,
    dry_run: DryRun = False,
    *,
    progress: Progress,
) -> "Followed":
    """Follow an object's outline with the sensor.

    This is pose-based tactile servoing, frame by frame. By default it runs in the twin: the arm is simulated, and the frames are rendered
    for the contact at its pose. With --camera and --arm the same loop runs on devices, real or emulated.

    The arm moves around the object to a place 50 mm in front of it. If the object has no end (a plane, an edge), the arm moves straight and
    stays in front of it. The program has no model of the arm's links and the object's holder: make sure that both have room. At the
    end, also after Ctrl-C, the arm stops, retreats along the surface's normal and is disabled.

    Once in a round the last axis of an MG400 reaches its limit. Then the sensor leaves the object by 50 mm, the axis turns back by a full
    turn, and the sensor touches the same place again. The command prints the place before the arm moves.

    Before the first contact a frame is taken, the zero of pin displacements. With --at-rest none the model uses its own
    positions at rest, or those estimated from contacts. Models on graphs use the specification's layout.

    \b
    Example:
      twin servo --object can --model RUN --out out/servo
      twin emulate mg400 &  twin emulate camera --arm mg400:127.0.0.1 \\
          --sensor mg400-331 --object can --port 8081 &
      twin servo --object can --model RUN \\
          --camera http://127.0.0.1:8081/stream.mjpg --arm mg400:127.0.0.1 \\
          --stream --steps 60 --out out/live

    \b
    Writes to --out:
      index.html      the trajectory and its measures
      trajectory.csv, trajectory.png
      measures.json   smoothness S as the Tac-VGNN paper defines it, path, depth
                      and angle errors, jerk, share of the path, lost contacts;
                      rate, latency and age of the frames
      session/        with --record; in further formats with --also

    The exit code is 1 if it ended early.
    """
    from hardware.servo.following import FollowPlan, follow
    from training.estimate.estimator import load_with_history

    stream_hz = rate if stream else None
    plan = call(FollowPlan, locals())
    with signals_as_ctrl_c():
        # a dry run has nothing but its lines
        return follow(plan, load_with_history(model), out, about={"model": str(model)}, progress=progress)  # type: ignore[return-value]


@app.command("policy", exit_code=ended_early)
def run_policy(
    policy: Annotated[Path, Argument(help="policy.safetensors of 'twin learn'")],
    obj: Annotated[str, Option("--object", metavar="O", help="can, square, prism, tin-box, or another")],
    out: options.Out,
    camera: Camera = "",
    arm: ArmOption = "simulated",
    servo: options.ServoName = "surface",
    steps: Steps = None,
    safety: Limits = None,
    record: Record = False,
    seed: NoiseSeed = 0,
    known_place: KnownPlace = False,
    plain_light: options.PlainLight = False,
    also: options.Also = None,
    ros2: Ros2 = None,
    dry_run: DryRun = False,
    *,
    progress: Progress,
) -> "Followed":
    """Run a trained policy on a camera and an arm.

    The policy of 'twin learn' gets the pins of each frame from the live pipeline, and moves the tool. Approach, frame without contact,
    safety layer, retreat, files and options are those of 'twin servo'. It always waits for the end of a move (it has no --stream), and
    displacements of pins are relative to its own first frame (it has no --at-rest). By default it runs in the
    twin. The exit code is 1 if it ended early.

    \b
    Example:
      twin learn --task SurfaceFollow --sensor mg400-331 --out out/learnt
      twin policy out/learnt/policy.safetensors --object can --out out/can
      twin policy out/learnt/policy.safetensors --object can --out out/live \\
          --camera http://127.0.0.1:8081/stream.mjpg --arm mg400:127.0.0.1
    """
    from hardware.servo.following import FollowPlan, follow, load_for_outlines
    from training.environments.policy_domain import contacts_of

    plan = call(FollowPlan, locals())
    with signals_as_ctrl_c():
        learnt = load_for_outlines(policy, contacts_of)
        return follow(plan, learnt, out, about={"policy": str(policy)}, progress=progress)  # type: ignore[return-value]  # as above


@app.command("grasp")
def grasp(
    policy: Annotated[str, Argument(help="ZIP file of stable-baselines3 (PPO), or the name of a package's policy")],
    out: options.Out,
    sensor: options.Sensor = str(SHIPPED_MODEL),
    gripper: Annotated[
        str, Option("--gripper", metavar="G", help="mujoco:SCENE, output:N,OPEN_MM,CLOSED_MM (of an MG400), ros2:TOPIC[,JOINTS]")
    ] = "mujoco:gripper",
    left: Annotated[str, Option(metavar="C", help="camera of the left sensor, as --camera of 'twin policy'")] = "",
    right: Annotated[str, Option(metavar="C", help="camera of the right sensor")] = "",
    arm: ArmOption = "simulated",
    object_mm: Annotated[float, Option(min=1, max=200, help="width of the object between the fingers")] = 40.0,
    safety: Limits = None,
    also: options.Also = None,
    ros2: Ros2 = None,
    dry_run: DryRun = False,
    *,
    progress: Progress,
) -> "Gripped":
    """Run a policy of GraspLift on two sensors of a gripper.

    The policy of 'tactip/GraspLift-v0' with the observation 'pins' gets the pins of both sensors from the live pipeline, and commands the
    fingers. The arm lifts the object by 50 mm, holds it and sets it down in 6 s, as in the environment. First the gripper opens, and the
    pins at rest are taken; then it closes on the object. By default all of this runs in a MuJoCo scene, with rasterised frames of both
    sensors. With --gripper, --left, --right and --arm the same loop runs on devices.

    A ZIP file of stable-baselines3 can contain code, which is run: give only one that you trust. At the end the arm is disabled, and the
    gripper keeps its width. With --ros2 NAME the topics are those of the sensors NAME/left and NAME/right.

    \b
    Example:
      twin grasp policy.zip --out out/grasp --also lerobot
      twin grasp policy.zip --gripper output:3,44,30 --arm mg400 \\
          --left /dev/video0 --right /dev/video2 --out out/live

    \b
    Writes to --out:
      left/, right/  a session for each sensor, with the same steps
      lerobot/, ...  with --also: both in one record
    """
    from hardware.servo.grip import GripPlan, grip
    from training.environments.grasp import PERIOD_S, GraspPolicy, load_grasp_policy

    plan, decide = call(GripPlan, locals()), GraspPolicy(load_grasp_policy(policy), object_mm)
    with signals_as_ctrl_c():
        return grip(plan, decide, out, steps=decide.steps, period_s=PERIOD_S, progress=progress)  # type: ignore[return-value]  # as above


emulate = group("emulate", "Emulate a device on this machine.\n\nIt prints 'ready ...' when it listens, and runs until SIGTERM or Ctrl-C.")

FAULT = "switch a fault on; '--fault help' lists them; may be repeated"
FaultOption = Annotated[list[str] | None, Option("--fault", metavar="NAME[=VALUE]", help=FAULT)]
TimeScale = Annotated[float, Option("--time-scale", help="speed relative to the real arm", min=1e-3)]


def faults_of(wanted: list[str] | None, known: dict[str, "Fault"]) -> tuple[str, ...]:
    """The faults that the user asks for. If the user asks for help, the known faults are printed and the command ends."""
    from hardware.emulators.faults import fault_lines

    if wanted and "help" in wanted:
        print_lines(fault_lines(known))
        raise Exit
    return tuple(wanted or ())


@emulate.command("mg400")
def mg400(
    host: Annotated[str, Option(help="address to listen on")] = "127.0.0.1",
    port_offset: Annotated[int, Option(help="added to 29999 and 30003 to 30006")] = 0,
    fault: FaultOption = None,
    firmware: Annotated[str, Option(help="emulated version; below 1.5.6 replies are bare echoes, and moves get none")] = "1.7.0",
    lenient: Annotated[
        bool, Option("--lenient", help="like firmware 1.5.5, but with echoes of moves too, for clients that wait for them")
    ] = False,
    time_scale: TimeScale = 1.0,
) -> None:
    """Emulate a Dobot MG400 on its network ports.

    The ports are 29999 (dashboard), 30003 (motion), and 30004 (every 8 ms), 30005 (200 ms) and 30006 (50 ms) for feedback.

    In Python: open_arm("mg400:127.0.0.1").

    \b
    Example:
      twin emulate mg400
    """
    from hardware.emulators.mg400 import FAULTS, Mg400Emulator

    call(Mg400Emulator, locals(), faults=faults_of(fault, FAULTS)).run()


@emulate.command("magician")
def magician(
    link: Annotated[Path | None, Option(help="symbolic link to make to the pseudo-terminal")] = None,
    fault: FaultOption = None,
    time_scale: TimeScale = 1.0,
) -> None:
    """Emulate a Dobot Magician on a pseudo-terminal.

    The name of its device is printed.

    In Python: open_arm("magician:/tmp/magician").

    \b
    Example:
      twin emulate magician --link /tmp/magician
    """
    from hardware.emulators.magician import FAULTS, MagicianEmulator

    call(MagicianEmulator, locals(), faults=faults_of(fault, FAULTS)).run()


@emulate.command("ros2")
def ros2_arm(
    form: Annotated[str, Option(help="commands: twist, as for MoveIt Servo, or pose, as for a cartesian controller")] = "twist",
    namespace: Annotated[str, Option(help="namespace of its topics")] = "",
    fault: FaultOption = None,
) -> None:
    """Emulate an arm behind ROS 2.

    It publishes current_pose and joint_states, and obeys servo_node/delta_twist_cmds or target_pose.

    In Python: open_arm("ros2:twist").

    \b
    Example:
      twin emulate ros2 --namespace left
      twin servo --object can --arm ros2:twist,namespace=left --out out/servo
    """
    from hardware.emulators.ros2 import FAULTS, Ros2Emulator

    call(Ros2Emulator, locals(), faults=faults_of(fault, FAULTS)).run()


@emulate.command("ur")
def ur(
    host: Annotated[str, Option(help="address to listen on; a second emulated UR needs another one, such as 127.0.0.2")] = "127.0.0.1",
    fault: FaultOption = None,
    time_scale: TimeScale = 1.0,
) -> None:
    """Emulate a Universal Robots UR5, as far as ur_rtde uses it.

    The ports are 29999 (dashboard), 30003 (script) and 30004 (RTDE).

    In Python: open_arm("ur:127.0.0.1").

    \b
    Example:
      twin emulate ur
    """
    from hardware.emulators.ur import FAULTS, UrEmulator

    call(UrEmulator, locals(), faults=faults_of(fault, FAULTS)).run()


@emulate.command("camera")
def camera(
    arm: Annotated[str, Option(metavar="A", help="mg400:ADDRESS[:DASHBOARD_PORT]")],
    sensor: options.Sensor,
    obj: options.Object,
    host: Annotated[str, Option(help="address to listen on")] = "127.0.0.1",
    port: Annotated[int, Option(min=0, max=65535, help="0: a free one")] = 8081,
    fps: Annotated[float, Option(min=0.1, help="largest number of pictures a second")] = 30.0,
    servo: options.ServoName = "surface",
    fault: FaultOption = None,
    plain_light: options.PlainLight = False,
) -> None:
    """Emulate the sensor's camera as a stream over HTTP.

    The stream of JPEGs shows the contact at the pose of an emulated arm. It reads the pose from the arm's feedback ports, so camera and arm
    may run in different processes.

    \b
    Example:
      twin emulate mg400 &
      twin emulate camera --arm mg400:127.0.0.1 --sensor mg400-331 --object can \\
          --port 8081
    """
    from hardware.emulators.camera import FAULTS, emulate_camera

    call(emulate_camera, locals(), faults=faults_of(fault, FAULTS))
