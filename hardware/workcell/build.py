"""The composition root of live work: the only module that decides whether a device is simulated, recorded or real.

``build_rig`` builds a camera and an arm in front of an object from the user's options. ``load_rest_frame`` selects the no-contact frame
from which a model measures the pins' displacements.
"""

from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from hardware.arms.arm import Arm
from hardware.arms.open_arm import kind_of, open_arm
from hardware.arms.simulated import SimulatedArm
from hardware.cameras.choose import open_camera
from hardware.cameras.source import FrameSource, await_frame
from hardware.cameras.twin import PoseSource, TwinCamera, preview_of
from hardware.errors import leave
from hardware.rig.geometry import PlacedObject
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm
from scenes import ObjectSpec, PlacementSpec, SensorSpec
from scenes.experiment import ExperimentSpec
from scenes.plugins import offered, others
from twin.errors import FrameError, RenderError
from twin.estimate import SensorModel
from twin.frames import open_recording
from twin.optics.preview import Preview
from twin.optics.render import traced_shading
from twin.rig.mounting import Mounting
from twin.types import FIRST, NONE, Form, Frame

# Value of ``camera`` that selects the twin.
TWIN = "twin"
# Longest wait in s for a real camera's frame while the arm stands still.
FRAME_S = 5.0
# Longest wait in s for a frame of the twin while the arm stands still. The twin may take longer to draw a frame than a camera.
TWIN_FRAME_S = 60.0


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
    """

    source: FrameSource
    arm: Arm
    placed: PlacedObject
    knows_truth: bool

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
    device: Arm = open_arm(arm)
    simulated = kind_of(arm) == "simulated"  # by its name: an arm of another package is guarded, whatever class it has
    kind, _, rest = camera.partition(":")
    world = others("worlds")[kind](rest, sensor, placed.mounting.T_tool_sensor) if kind in offered("worlds") else None
    if isinstance(device, SimulatedArm) and camera == TWIN and at_once:
        device = SimulatedArm(axes=device.axes, time_scale=np.inf, name=device.name)
    if not simulated or limits is not None:
        device = SafeArm(device, load_limits(limits or kind_of(arm)))
    twin = None
    if camera == TWIN or world is not None:
        preview = draw_window(sensor, form, plain_light)
        twin = TwinCamera(sensor, placed, device.state, form, seed=seed, preview=preview, on_demand=at_once, world=world)
    return Rig(open_camera(camera if twin is None else TWIN, sensor, form, twin=twin), device, placed, camera == TWIN)


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

    try:
        preview.shading = traced_shading(preview)
    except RenderError as error:
        raise RenderError(f"{error}; or draw with `plain_light`, which needs no path tracing") from error
    return preview
