"""The composition root of live work: the only module that decides whether a device is simulated, recorded or real.

``build_rig`` builds a camera and an arm in front of an object from the user's options. ``load_rest_frame`` selects the no-contact frame
from which a model measures the pins' displacements.

``check_plan`` looks at the whole way before the first motion: the camera, the path to the object, and a way back from every planned pose.

``Mover`` is the one way in which a program moves an arm to an object and away from it. Towards the object the arm moves only while the
camera gives fresh frames (``FreshFrames``). A thread stops it if it no longer answers (``ArmWatch``). At the end it leaves the object
straight, or the way it came if the limits forbid that.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import KW_ONLY, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from hardware.arms.arm import Arm, ArmState, SimulatedArm
from hardware.arms.motion import turn_between_deg
from hardware.arms.open_arm import kind_of, open_arm
from hardware.cameras.source import FrameSource, await_frame, open_camera
from hardware.cameras.twin import TwinCamera, preview_of
from hardware.errors import DeviceError, leave, on_error
from hardware.rig.geometry import HOLD_DEG, LastAxis, PlacedObject, path_around, shift_in_tool
from hardware.safety.decide import Action, Sensed, decide, load_limits
from hardware.safety.eyes import NEAR_MM, ArmWatch, FreshFrames
from hardware.safety.safe_arm import RETREAT_SHARES, NoWayBackError, SafeArm, try_each
from hardware.workcell.ros2 import publishing
from scenes import ExperimentSpec, ObjectSpec, SensorSpec, ServoSpec
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
        with on_error(self.arm.disconnect):
            self.source.connect()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object, /) -> None:
        try:
            leave(self.arm.disconnect, error)
        finally:
            self.source.disconnect()


@dataclass(frozen=True)
class RigPlan:
    """What the plans of all runs with a rig contain.

    Attributes
    ----------
    obj : ObjectSpec
        The object that is touched.
    servo : ServoSpec
        The arm's speeds, and the object's place.
    camera : str
        As for ``open_camera``, or ``WORLD:REST``, such as ``mujoco:SCENE``: a scene in the arm's base frame (see ``scenes.plugins``).
    arm : str
        As for ``open_arm``.
    limits : str or None
        Safety limits, by name or file. None: those of the arm's kind.
    plain_light : bool
        Draw the twin's frames with the lamps' direct light only. Otherwise a frame is path-traced at the start to add the indirect light.
    also : tuple of str
        Further formats in which the results are kept, each in a subfolder.
    dry_run : bool
        End after the check of the plan, before anything moves.
    ros2 : str or None
        Namespace in which frames, estimates or pins, and the arm's pose are published as ROS 2 topics.
    """

    obj: ObjectSpec
    servo: ServoSpec
    _: KW_ONLY
    camera: str
    arm: str
    limits: str | None = None
    plain_light: bool = False
    also: tuple[str, ...] = ()
    dry_run: bool = False
    ros2: str | None = None


def build_rig(
    plan: RigPlan, sensor: SensorSpec, experiment: ExperimentSpec, *, form: Form | None = None, seed: int = 0, at_once: bool = False
) -> Rig:
    """Build a rig from the user's options.

    Parameters
    ----------
    plan : RigPlan
    sensor : SensorSpec
    experiment : ExperimentSpec
    form : Form, optional
        Form of the frames. By default it is the form of the sensor's recordings, or raw if the sensor has none.
    seed : int
        Seed of the twin's noise.
    at_once : bool
        For callers that wait for a frame at each stop. A simulated arm in front of the twin's camera then moves instantly, and the twin
        draws a frame only while a reader waits for it.
    """
    form = form or (Form.PROCESSED if sensor.recording else Form.RAW)
    placed = PlacedObject(plan.obj, plan.servo.placement, Mounting.of(sensor, experiment))
    device = open_guarded_arm(plan.arm, plan.limits, at_once=at_once and plan.camera == TWIN)
    camera, twin = plan.camera, None
    kind, _, rest = camera.partition(":")
    world = others("worlds")[kind](rest, sensor, placed.mounting.T_tool_sensor) if kind in offered("worlds") else None
    if camera == TWIN or world is not None:
        preview = draw_window(sensor, form, plan.plain_light)
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
            remedy = "correct 'placement' in the file for `servo` (a Magician reaches that of `servo=magician`), or `safety`"
            raise DeviceError(f"{rig.arm.name}: the limits forbid the path to the {rig.placed.spec.name}: {why}; {remedy}")
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


LOG = logging.getLogger(__name__)
# Largest number of pieces into which the limits may divide a move.
MOST_PIECES = 200
# Largest distance, mm, and turn, deg, between the end of a move and its target at which no further piece is needed.
THERE_MM, THERE_DEG = 0.5, 0.5
# Time in s that a move may take in addition to the duration that its path and speed give.
MOVE_TIMEOUT_S = 10.0
# Factor on the duration that a move's path and speed give, because arms round their speed to whole percents.
SPARE = 2.0


class Mover:
    """Moves the arm of a connected rig to its object and away from it.

    Parameters
    ----------
    rig : Rig
    speed : (float, float)
        Speed of the arm in mm/s and deg/s.
    clear_mm : float
        Distance by which an arm without limits is withdrawn.
    patience_s : float
        Longest wait for a fresh frame before a move.

    Attributes
    ----------
    notes : list of str
        Problems at the release.
    """

    def __init__(self, rig: Rig, speed: tuple[float, float], *, clear_mm: float, patience_s: float) -> None:
        self.arm, self.source = rig.arm, rig.source
        self.notes: list[str] = []
        self.watch = rig.watch = ArmWatch(rig.arm)
        self.eyes = FreshFrames(rig.arm, rig.source, self.watch.pose_at, lambda pose: float(rig.placed.touch(pose).indent_mm))
        self.axis = LastAxis(getattr(rig.arm, "kinematics", None), rig.mounting.centre_mm)
        self._placed, self._speed, self._clear_mm, self._patience_s = rig.placed, speed, clear_mm, patience_s
        self._safe = rig.arm if isinstance(rig.arm, SafeArm) else None
        self._came: list[np.ndarray] = []  # the poses (6,) at which the arm was since it stood clear of the object

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Context in which the threads look at arm and camera."""
        with self.watch.watching(), self.eyes.watching():
            yield

    def enable(self) -> None:
        """Wait for a fresh frame, then enable the arm and set its speed."""
        self.forget()  # the contact of an earlier run
        with self.watch.doing("waiting for a fresh frame"):
            self.eyes.await_frame(timeout_s=max(self._patience_s, self.source.first_frame_s))
        with self.watch.doing("enabling"):
            self.arm.enable()
            self.arm.set_speed(*self._speed)

    def state(self) -> ArmState:
        """The arm's newest state, which the watch also keeps; ``DeviceError`` if the arm was lost or reports an error."""
        self.watch.require()
        state = self.arm.state()
        if state.error:
            raise DeviceError(f"{self.arm.name}: {state.error}")
        self.watch.add(state)
        return state

    def sense(self, sensed: Sensed) -> None:
        """Report the estimated contact to the limits of a ``SafeArm``."""
        if self._safe is not None:
            self._safe.sense(sensed)

    def forget(self) -> None:
        """Drop this contact, because the sensor leaves the object."""
        if self._safe is not None:
            self._safe.forget_contact()

    def go_around(self, clear: np.ndarray) -> ArmState:
        """Move around the object to a pose (6,) clear of it. Returns the state there."""
        for pose in path_around(self._placed, self.state().pose, clear):
            state = self.go(self.turned_for(pose))
        self._came.clear()
        return state

    def go(self, target: np.ndarray) -> ArmState:
        """Move straight to a pose (6,), in several pieces if the limits shorten the move. Returns the state that confirms it."""
        for _ in range(MOST_PIECES):
            self.eyes.await_frame(timeout_s=self._patience_s)
            sent = self.send(target)
            state = self.settle(sent)
            if np.linalg.norm(sent[:3] - target[:3]) < THERE_MM and turn_between_deg(sent, target) < THERE_DEG:
                return state
        short_mm = float(np.linalg.norm(sent[:3] - target[:3]))
        raise DeviceError(f"{self.arm.name}: {MOST_PIECES} moves end {short_mm:.1f} mm from the target; allow longer steps in `safety`")

    def send(self, target: np.ndarray) -> np.ndarray:
        """Send a move to a pose (6,), while frames are fresh. Returns the pose that was commanded."""
        here = self.state().pose
        self._came.append(here)
        return self.eyes.move(partial(self.arm.move_linear, target, wait=False, timeout_s=self._lasts_s(here, target)), ends=False)

    def settle(self, sent: np.ndarray) -> ArmState:
        """Wait for the end of a move to a pose (6,), while frames are fresh. Returns the state there."""
        return self.eyes.move(partial(self.arm.wait_settled, sent, timeout_s=self._lasts_s(self.arm.state().pose, sent)))

    def turned_for(self, target: np.ndarray) -> np.ndarray:
        """The target (6,) on the present turn of the last axis, after a turn back if one is needed."""
        here = self.state().pose
        pose, held_deg = self.axis.on_turn(target, here[5])
        if held_deg <= HOLD_DEG:
            return pose
        turned = self.axis.turned_back(here, target)
        if turned is None:
            remedy = "turn the object ('placement.turn_deg' in a file for `servo`), or give no more `steps` than were made"
            raise DeviceError(f"{self.arm.name}: its last axis can't turn the sensor that far, {held_deg:.0f} deg are missing; {remedy}")
        for share in (1 / 3, 2 / 3, 1.0):  # each part is less than half a turn, so that its direction is unambiguous
            self.go(here + share * (turned - here))
        return self.axis.on_turn(target, turned[5])[0]

    def away_from(self, pose: np.ndarray) -> np.ndarray:
        """The pose (6,) withdrawn by ``clear_mm`` along the sensor's axis."""
        return shift_in_tool(pose, -self._clear_mm * self._placed.mounting.axis)

    def release(self, *, touching: bool) -> list[str]:
        """Stop the arm, withdraw it if it may touch the object, and disable it. Every step is tried, even if one before it failed.

        Returns the failures, which are also added to ``notes``.
        """
        back: dict[str, Callable[[], object]] = {"retreat": self._withdraw} if touching else {}
        with self.watch.doing("withdrawing"):
            failed = try_each(stop=self.arm.stop, **back, disable=self.arm.disable)
        self.notes += failed
        return failed

    def _withdraw(self) -> None:
        """Leave the object straight, or through the poses at which the arm was. This needs no frames."""
        try:
            self._retreat(self.arm.state().pose)
        except NoWayBackError as error:
            if not self._came:
                raise
            self.notes.append(f"{error}; returned on its own path instead")
            LOG.warning("%s: %s", self.arm.name, self.notes[-1])
            self.forget()
            for there in reversed(self._came):
                self.arm.move_linear(there, timeout_s=MOVE_TIMEOUT_S)

    def _retreat(self, pose: np.ndarray) -> None:
        """Withdraw the arm straight; ``NoWayBackError`` if its limits do not allow it."""
        if self._safe is None:
            self.arm.move_linear(self.axis.on_turn(self.away_from(pose), pose[5])[0], timeout_s=MOVE_TIMEOUT_S)
            return
        self._safe.normal = -matrix_of(pose)[:3, :3] @ self._placed.mounting.axis
        if self._safe.retreat() is None:
            raise NoWayBackError(f"the limits allow no path back: {self._safe.decisions[-1].decision.reason}; free the sensor by hand")

    def _lasts_s(self, here: np.ndarray, target: np.ndarray) -> float:
        """Longest time that a move between poses (6,) may take."""
        way_s = max(float(np.linalg.norm(target[:3] - here[:3])) / self._speed[0], abs(target[5] - here[5]) / self._speed[1])
        return MOVE_TIMEOUT_S + SPARE * way_s
