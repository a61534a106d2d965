"""The composition root of live work: the only module that decides whether a device is simulated, recorded or real.

``build_rig`` builds a camera and an arm in front of an object from the user's options. ``load_rest_frame`` selects the no-contact frame
from which a model measures the pins' displacements.

``check_plan`` looks at the whole way before the first motion: the camera, the path to the object, and a way back from every planned pose.
"""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType

import numpy as np

from hardware.arms.arm import Arm, ArmState, SimulatedArm
from hardware.arms.open_arm import kind_of, open_arm
from hardware.cameras.choose import open_camera
from hardware.cameras.source import FrameSource, await_frame
from hardware.cameras.twin import PoseSource, TwinCamera, preview_of
from hardware.errors import DeviceError, leave
from hardware.rig.geometry import PlacedObject, path_around
from hardware.safety.decide import Action, decide, load_limits
from hardware.safety.eyes import NEAR_MM, ArmWatch
from hardware.safety.safe_arm import RETREAT_SHARES, SafeArm
from hardware.workcell.ros2 import publishing
from scenes import ObjectSpec, PlacementSpec, SensorSpec
from scenes.experiment import ExperimentSpec
from scenes.plugins import offered, others
from twin.errors import ErrorsAs, FrameError, RenderError, format_count
from twin.estimate import Estimate, SensorModel
from twin.frames import open_recording
from twin.optics.preview import Preview
from twin.optics.render import traced_shading
from twin.pins import Pipeline
from twin.rig.arm_pose import matrix_of
from twin.rig.kinematics import Mounting
from twin.types import FIRST, NONE, Form, Frame

# Value of ``camera`` that selects the twin.
TWIN = "twin"
# Longest wait in s for a real camera's frame while the arm stands still.
FRAME_S = 5.0
# Longest wait in s for a frame of the twin while the arm stands still. The twin may take longer to draw a frame than a camera.
TWIN_FRAME_S = 60.0
# Time, s, in which the camera's frames are counted.
COUNT_S = 0.5


def load_rest_frame(at_rest: str, model: SensorModel) -> Frame | None:
    """The no-contact frame from a file or from a recording's folder; None for ``first`` and ``none``.

    Raises
    ------
    FrameError
        There is no such frame.
    """
    if at_rest in (FIRST, NONE):
        return None
    if not Path(at_rest).exists():
        raise FrameError(f"`at_rest` {at_rest}: no such file; expected a frame without contact, '{FIRST}' or '{NONE}'")
    recording = open_recording(at_rest, model.sensor, model.form)
    return recording.reference if recording.reference is not None else recording.read(0)


@dataclass
class Rig:
    """A camera and an arm in front of an object. They are not connected yet.

    Attributes
    ----------
    source : FrameSource
    arm : Arm
        A real or emulated arm is wrapped in a ``SafeArm`` if limits are given, or if its kind has a file in ``hardware/limits``.
    placed : PlacedObject
    knows_truth : bool
        Whether the object's pose is exactly that of ``placed``. This is true in the twin.
    watch : ArmWatch or None
        What keeps the arm's newest states, once the arm has a mover.
    """

    source: FrameSource
    arm: Arm
    placed: PlacedObject
    knows_truth: bool
    watch: ArmWatch | None = None

    @property
    def mounting(self) -> Mounting:
        """Mounting of the sensor on the arm."""
        return self.placed.mounting

    @property
    def frame_timeout_s(self) -> float:
        """Longest wait in s for a frame while the arm stands still."""
        return TWIN_FRAME_S if self.knows_truth else FRAME_S

    def await_frame(self) -> Frame:
        """Wait for the first frame, at most as long as a camera of this kind may need.

        Raises
        ------
        DeviceError
            No frame comes. The message names the camera.
        """
        return await_frame(self.source)

    def publishing(
        self, name: str | None, pipeline: Pipeline, *, estimates: bool = True
    ) -> AbstractContextManager[Callable[[Frame, Estimate], None]]:
        """As ``hardware.workcell.ros2.publishing``, for a connected rig."""
        newest = lambda: self.watch and self.watch.newest  # noqa: E731  (no request, which could delay the arm's own)
        return publishing(name, self.source, pipeline, estimates=estimates, arm=newest, T_tool_sensor=self.mounting.T_tool_sensor)

    def __enter__(self) -> "Rig":
        self.arm.connect()
        try:
            self.source.connect()
        except BaseException:
            self.arm.disconnect()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /) -> None:
        try:
            leave(self.arm.disconnect, error)
        finally:
            self.source.disconnect()


def build_rig(
    sensor: SensorSpec,
    obj: ObjectSpec,
    placement: PlacementSpec,
    experiment: ExperimentSpec,
    *,
    camera: str,
    arm: str,
    form: Form | None = None,
    limits: str | None = None,
    seed: int = 0,
    plain_light: bool = False,
    at_once: bool = False,
) -> Rig:
    """Build a rig from the user's options.

    Parameters
    ----------
    camera : str
        As for ``open_camera``, or ``WORLD:REST``, such as ``mujoco:SCENE``: a scene in the arm's base frame (see ``scenes.plugins``).
    arm : str
        As for ``open_arm``.
    form : Form, optional
        Form of the frames. By default it is the form of the sensor's recordings, or raw if the sensor has none.
    limits : str, optional
        Name or file of the safety limits. By default they are the limits of this kind of arm.
    plain_light : bool
        Draw the twin's frames with the lamps' direct light only. Otherwise a frame is path-traced at the start to add the indirect light.
    at_once : bool
        For callers that wait for a frame at each stop. A simulated arm in front of the twin's camera then moves instantly, and the twin
        draws a frame only while a reader waits for it.
    """
    form = form or (Form.PROCESSED if sensor.recording else Form.RAW)
    placed = PlacedObject(obj, placement, Mounting.of(sensor, experiment))
    device = open_guarded_arm(arm, limits, at_once=at_once and camera == TWIN)
    kind, _, rest = camera.partition(":")
    world = others("worlds")[kind](rest, sensor, placed.mounting.T_tool_sensor) if kind in offered("worlds") else None
    twin = None
    if camera == TWIN or world is not None:
        preview = draw_window(sensor, form, plain_light)
        twin = TwinCamera(sensor, placed, device.state, form, seed=seed, preview=preview, on_demand=at_once, world=world)
    return Rig(open_camera(camera if twin is None else TWIN, sensor, form, twin=twin), device, placed, camera == TWIN)


def open_guarded_arm(arm: str, limits: str | None, *, at_once: bool) -> Arm:
    """An arm as for ``build_rig``, behind its limits unless it is simulated without any. ``at_once``: a simulated arm needs no time."""
    device = open_arm(arm)
    if isinstance(device, SimulatedArm) and at_once:
        device = SimulatedArm(axes=device.axes, time_scale=np.inf)
    if kind_of(arm) == "simulated" and limits is None:  # by its name: an arm of another package is guarded, whatever class it has
        return device
    return SafeArm(device, load_limits(limits or kind_of(arm)))


def twin_camera(sensor: SensorSpec, placed: PlacedObject, pose: PoseSource, form: Form, *, fps: float, plain_light: bool) -> TwinCamera:
    """The twin as a camera on an arm that another process runs. If the connection to the arm is lost, the camera waits for it."""
    return TwinCamera(sensor, placed, pose, form, fps=fps, preview=draw_window(sensor, form, plain_light), waits_for_arm=True)


def draw_window(sensor: SensorSpec, form: Form, plain_light: bool) -> Preview:
    """The preview of the window that a form needs. Its shading comes from a path-traced no-contact frame, which is kept between runs.

    With ``plain_light`` the preview has no such shading.
    """
    preview = preview_of(sensor, form)
    if plain_light:
        return preview

    with ErrorsAs(RenderError, lambda error: RenderError(f"{error}; or draw with `plain_light`, which needs no path tracing")):
        preview.shading = traced_shading(preview)
    return preview


@dataclass(frozen=True)
class DryRunDone:
    """The result of a plan that was checked, and not carried out."""

    failure: str = ""

    def lines(self) -> list[str]:
        """The result as lines of text."""
        return ["nothing was moved; run it without `dry_run` to begin"]


def check_plan(
    rig: Rig,
    pipeline: Pipeline,
    clear: np.ndarray,
    planned: list[np.ndarray],
    *,
    linear_mm_s: float,
    spent_s: float,
    at_rest: Callable[[Frame], object] | None = None,
) -> list[str]:
    """Check a plan on a connected rig. Nothing moves.

    Parameters
    ----------
    pipeline : Pipeline
        Finds the sensor's pins.
    clear : (6,) float
        The pose clear of the object to which the arm goes first.
    planned : list of (6,) float
        The poses in contact, as far as they are known; the first one is the start.
    linear_mm_s : float
        Speed of the arm.
    spent_s : float
        Time of the work at the object, as far as it is known.
    at_rest : callable, optional
        Refuses a frame that can't be one without contact with a ``FrameError``. It gets the present frame if the arm stands clear of the
        object.

    Returns
    -------
    list of str
        The plan, one line for each part.

    Raises
    ------
    DeviceError
        The camera gives no frames, or frames without this sensor's pins; or the limits forbid the way to the object, the start, or the way
        back from the start.
    """
    state = rig.arm.state()
    stands_clear = -rig.placed.touch(state.pose).indent_mm > NEAR_MM
    seen = check_sight(rig.source, pipeline, at_rest=at_rest if stands_clear else None)
    way = [state.pose, *path_around(rig.placed, state.pose, clear), planned[0]]
    for start, end in pairwise(way):
        if why := _forbidden(rig.arm, start, end):
            raise DeviceError(
                f"{rig.arm.name}: the limits forbid the path to the {rig.placed.spec.name}: {why}; correct 'placement' in the file for "
                "`servo` (a Magician reaches that of `servo=magician`), or `safety`"
            )
    blocked = [n for n, pose in enumerate(planned) if not _can_retreat(rig, pose)]
    if blocked[:1] == [0]:
        raise DeviceError(f"{rig.arm.name}: the limits allow no path back from the start; correct 'placement' in the file for `servo`")
    way_mm = sum(float(np.linalg.norm(end[:3] - start[:3])) for start, end in pairwise(way))
    back = f"a path back from all {len(planned)} planned poses"
    if blocked:
        back = f"no straight path back from {len(blocked)} of {len(planned)} planned poses: from there the arm returns on its own path"
    return [
        *seen,
        f"path: {format_count(len(way) - 1, 'moves')}, {way_mm:.0f} mm, to {' '.join(f'{value:.1f}' for value in planned[0])} (mm, deg)",
        f"limits: {back}",
        f"time: about {way_mm / linear_mm_s + spent_s:.0f} s",
    ]


def check_sight(source: FrameSource, pipeline: Pipeline, *, at_rest: Callable[[Frame], object] | None = None) -> list[str]:
    """Check that a connected camera gives frames of the sensor; parameters, lines and errors as for ``check_plan``."""
    frame = await_frame(source, after_s=time.monotonic()) if source.is_live else source.read_latest()
    before = getattr(source, "arrived", 0)
    rate = ""
    if source.streams:
        time.sleep(COUNT_S)
        rate = f", {(source.arrived - before) / COUNT_S:.0f} frames/s" if hasattr(source, "arrived") else ""
    with ErrorsAs(FrameError, lambda error: DeviceError(f"{source.name}: nothing was moved: {error}")):
        pins = pipeline(frame)
        if not pins.valid:
            raise FrameError(f"{pins.reason}; uncover and light the sensor, or give the camera of {pipeline.spec.name}")
        if at_rest is not None:
            at_rest(frame)
    plain = "" if at_rest is None else ", as without contact"
    return [
        f"camera: {source.name}, {frame.image.shape[1]} x {frame.image.shape[0]} px{rate}",
        f"sensor: {pins.found} of {pins.expected} pins of {pipeline.spec.name} found{plain}",
    ]


def check_standing(source: FrameSource, arm: Arm, pipeline: Pipeline) -> list[str]:
    """Check a connected arm that will move in small steps from where it stands; parameters, lines and errors as for
    ``check_plan``."""
    seen, here = check_sight(source, pipeline), arm.state().pose
    if why := _forbidden(arm, here, here):
        raise DeviceError(f"{arm.name}: stands outside its limits, so it could not step back here: {why}; move it inside by hand")
    return [*seen, "limits: the path back of each step is inside"]


def _forbidden(arm: Arm, start: np.ndarray, end: np.ndarray) -> str:
    """Why the limits forbid a straight move between poses (6,); "" if they don't, or there are none."""
    if not isinstance(arm, SafeArm):
        return ""
    limits = arm.limits.model_copy(update={"step_mm": None, "step_deg": None})
    near = start if arm.kinematics is None else arm.kinematics.nearest_pose(start)
    state = ArmState(near, np.zeros(arm.axes), time.monotonic(), True, False)
    decision = decide(end, state, limits, now_s=state.time_s, kinematics=arm.kinematics)
    return "" if decision.action is Action.MOVE else decision.reason


def _can_retreat(rig: Rig, pose: np.ndarray) -> bool:
    """Whether the limits allow a part of the retreat from a pose (6,) in contact."""
    if not isinstance(rig.arm, SafeArm):
        return True
    back = np.zeros(6)
    back[:3] = -matrix_of(pose)[:3, :3] @ rig.mounting.axis * rig.arm.limits.retreat_mm
    return any(not _forbidden(rig.arm, pose, pose + share * back) for share in RETREAT_SHARES)
