"""How work that moves an arm may be ended from outside.

Which frame without contact a model counts pins from: a given one, the first that is taken, or none.

The composition root of live work: the one place that decides what is simulated, recorded or real."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from hardware.approach import way_around
from hardware.arms.arm import Arm, ArmState
from hardware.arms.open_arm import open_arm
from hardware.arms.simulated import SimulatedArm
from hardware.cameras.choose import open_camera
from hardware.cameras.source import FrameSource, await_frame
from hardware.cameras.twin import PoseSource, TwinCamera, preview_of
from hardware.errors import DeviceError
from hardware.loop import ServoLoop
from hardware.rig_geometry import PlacedObject
from hardware.safe_arm import SafeArm
from hardware.safety import SHIPPED_LIMITS, load_limits
from hardware.step import Estimate, Estimator, Guard, LoopSettings, SensorModel, StepRecord
from scenes import ObjectSpec, PlacementSpec, SensorSpec, ServoSpec
from scenes.experiment import ExperimentSpec
from twin.errors import FrameError, RenderError
from twin.frames import open_recording
from twin.optics.preview import Preview, Shading
from twin.optics.render import Renderer
from twin.pins import require_untouched
from twin.rig.mounting import Mounting
from twin.store import cached_arrays
from twin.types import Form, Frame


@contextmanager
def signals_as_ctrl_c() -> Iterator[None]:
    """SIGTERM and a closed terminal (SIGHUP) raise ``KeyboardInterrupt``, as Ctrl-C does, so that the arm is let go of.

    For the main thread only. A signal that is ignored outside (``nohup``) stays ignored. The handlers of before are put back at the end.
    """

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = {ended: signal.getsignal(ended) for ended in (signal.SIGTERM, signal.SIGHUP)}
    for ended, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(ended, interrupt)
    try:
        yield
    finally:
        for ended, handler in before.items():
            signal.signal(ended, handler)


FIRST, NONE = "first", "none"


def given_frame(at_rest: str, model: SensorModel) -> Frame | None:
    """The no-contact frame of a file, or of a recording's folder; None for ``first`` and ``none``.

    Raises
    ------
    FrameError
        There is no such frame.
    """
    if at_rest in (FIRST, NONE):
        return None
    if not Path(at_rest).exists():
        raise FrameError(f"--at-rest {at_rest}: no such file; expected a frame without contact, '{FIRST}' or '{NONE}'")
    recording = open_recording(at_rest, model.sensor, model.form)
    return recording.reference if recording.reference is not None else recording.read(0)


def counting_from_first(model: SensorModel, frame: Frame) -> SensorModel:
    """The model that counts pins from the first frame that was taken.

    Raises
    ------
    FrameError
        The sensor seems pressed in it, or the model can't count from it.
    """
    found = model.at_rest(frame)
    remedy = "move it clear of everything and begin again, or give a frame that was taken without contact: --at-rest FRAME"
    require_untouched(model.sensor, model.form, frame, remedy)
    return found


TWIN = "twin"
SHADING_QUALITY: Literal["standard"] = "standard"
FRAME_S, TWIN_FRAME_S = 5.0, 60.0  # the twin may take its time over a frame while a simulated arm stands


@dataclass
class Rig:
    """A camera and an arm before an object, not yet connected.

    Attributes
    ----------
    source : FrameSource
    arm : Arm
        A real or emulated one is a ``SafeArm``.
    placed : PlacedObject
    knows_truth : bool
        Whether the object is where ``placed`` has it for certain: in the twin.
    """

    source: FrameSource
    arm: Arm
    placed: PlacedObject
    knows_truth: bool

    @property
    def mounting(self) -> Mounting:
        return self.placed.mounting

    @property
    def frame_timeout_s(self) -> float:
        """For so long a frame of an arm that stands is waited for."""
        return TWIN_FRAME_S if self.knows_truth else FRAME_S

    def await_frame(self) -> Frame:
        """The first frame, for which the camera is given the time that one of its kind may need.

        Raises
        ------
        DeviceError
            None comes; it names the camera.
        """
        return await_frame(self.source)

    def __enter__(self) -> "Rig":
        self.arm.connect()
        try:
            self.source.connect()
        except BaseException:
            self.arm.disconnect()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.arm.disconnect()
        finally:
            self.source.disconnect()


def build_rig(
    sensor: SensorSpec,
    stimulus: ObjectSpec,
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
    """A rig from what a user writes.

    Parameters
    ----------
    camera : str
        As for ``open_camera``.
    arm : str
        As for ``open_arm``.
    form : Form, optional
        Of the frames; that of the sensor's recordings where it has one.
    limits : str, optional
        Name or file; that of the arm's kind by default.
    plain_light : bool
        Draw the twin's frames with the lamps' direct light alone, without the path-traced frame that sets what comes on top.
    at_once : bool
        A simulated arm before the twin's camera takes no time, and frames are drawn when they are waited for: for whoever waits for
        frames at each stop.
    """
    form = form or (Form.RECORDING if sensor.recording else Form.RAW)
    placed = PlacedObject(stimulus, placement, Mounting.of(sensor, experiment))
    device: Arm = open_arm(arm)
    simulated = isinstance(device, SimulatedArm)
    if simulated and camera == TWIN and at_once:
        device = SimulatedArm(axes=device.axes, time_scale=np.inf, name=device.name)
    if not simulated or limits is not None:
        kind = arm.partition(":")[0]
        if limits or (SHIPPED_LIMITS / f"{kind}.toml").is_file():
            device = SafeArm(device, load_limits(limits or kind))
    twin = None
    if camera == TWIN:
        preview = drawn(sensor, form, plain_light)
        twin = TwinCamera(sensor, placed, device.state, form, seed=seed, preview=preview, on_demand=at_once)
    return Rig(open_camera(camera, sensor, form, twin=twin), device, placed, camera == TWIN)


def twin_camera(sensor: SensorSpec, placed: PlacedObject, pose: PoseSource, form: Form, *, fps: float, plain_light: bool) -> TwinCamera:
    """The twin as a camera on an arm whose pose comes from elsewhere."""
    return TwinCamera(sensor, placed, pose, form, fps=fps, preview=drawn(sensor, form, plain_light))


def drawn(sensor: SensorSpec, form: Form, plain_light: bool) -> Preview:
    """The preview of a form's window, its shading from a path-traced frame at rest, which is kept between runs."""
    preview = preview_of(sensor, form)
    if plain_light:
        return preview

    def trace() -> dict[str, np.ndarray]:
        shading = preview.calibrate(Renderer(sensor, quality=SHADING_QUALITY, window_px=preview.window_px))
        return {"gain": shading.gain, "offset": shading.offset, "skin": shading.skin}

    key = {"sensor": sensor.model_dump(mode="json"), "window_px": list(preview.window_px), "quality": SHADING_QUALITY}
    try:
        preview.shading = Shading(**cached_arrays("shading", key, trace, code=(Preview, Renderer)))
    except RenderError as error:
        raise RenderError(f"{error}; or draw with --plain-light, which needs no path tracing") from error
    return preview


def servo_loop(
    rig: Rig,
    servo: ServoSpec,
    estimator: Estimator,
    settings: LoopSettings,
    on_step: Callable[[StepRecord, Frame, Estimate], None] | None = None,
) -> ServoLoop:
    """The loop on a connected rig; a safe arm is told what the sensor feels, and retreats in its own way."""
    loop = ServoLoop(rig.source, estimator, rig.arm, servo, rig.mounting, settings, guards=[no_full_turn(rig.arm)], on_step=on_step)
    loop.way = lambda start, clear: way_around(rig.placed, start, clear)
    if isinstance(rig.arm, SafeArm):
        loop.sense = lambda depth_mm, time_s: rig.arm.sense(depth_mm=depth_mm, frame_time_s=time_s)

        def retreat(away: np.ndarray) -> None:
            rig.arm.normal = away
            if rig.arm.retreat() is None:
                raise DeviceError(f"the limits allow no way back: {rig.arm.decisions[-1].decision.reason}; free the sensor by hand")

        loop.retreat = retreat
    return loop


def steps_round(placed: PlacedObject, servo: ServoSpec, rounds: float) -> tuple[int, float]:
    """Steps that ``rounds`` around the object take, and the outline's length in mm; a tool off the surface goes farther than that."""
    outline = placed.outline()
    length_mm = float(np.linalg.norm(np.diff(outline, axis=0), axis=1).sum())
    tool_mm = placed.mounting.apex_mm @ placed.mounting.axis - servo.indent_mm  # of the tool from the surface
    closed = bool(np.allclose(outline[0], outline[-1]))
    way_mm = rounds * (length_mm + closed * 2 * np.pi * max(tool_mm, 0.0))
    return int(np.ceil(way_mm / servo.feed_mm)), rounds * length_mm


def no_full_turn(arm: Arm) -> Guard:
    """A guard: where an arm of four axes would have to turn back by a full turn at the object, it ends."""
    kinematics = getattr(arm, "kinematics", None)

    def guard(state: ArmState, target: np.ndarray) -> np.ndarray:
        if kinematics is not None and abs(kinematics.nearest_pose(target)[5] - state.pose[5]) > 180.0:
            raise DeviceError(
                f"{arm.name}: its last axis turns no farther than here (R {state.pose[5]:.0f} deg, J4 {state.joints_deg[3]:.0f} deg), and "
                "to go on it would have to turn the sensor back by a full turn at the object; give no more --steps than were made, or "
                "turn the object ('placement.turn_deg' in a file for --servo) so that the way begins near the axis' other end"
            )
        return target

    return guard
