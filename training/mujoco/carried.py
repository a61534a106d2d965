"""A sensor that an arm carries through a MuJoCo scene, in which it moves what it touches.

The scene's world is the arm's base frame, in m. The sensor follows the arm's path exactly. Between two of the arm's poses the scene is
stepped by the time that has passed.
"""

import threading
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from scenes.sensor import SensorSpec
from training.mujoco.model import MM, load_scene, scene_file
from training.mujoco.scene import TactileScene
from twin.errors import ContactError
from twin.geometry.mesh import build_mesh
from twin.rig.arm_pose import matrix_of
from twin.types import PinState

CARRIED = "carried_tactip"
OPEN_MM = 44.0
"""Width of a scene's gripper at the start."""
LONGEST_S = 0.2
"""Most time that passes in the scene between two poses. If the arm needs more, the objects stand still for the rest of it."""


@dataclass
class CarriedSensor:
    """Moves a sensor through a scene.

    Attributes
    ----------
    scene : TactileScene
    T_tool_sensor : (4, 4) float
    """

    scene: TactileScene
    T_tool_sensor: np.ndarray
    _last: tuple[np.ndarray, float] | None = None  # pose of the sensor (4, 4), and time

    def warm_up(self) -> None:
        """Compile what a step needs."""
        self.scene.apply()

    def move(self, pose: np.ndarray, time_s: float) -> PinState:
        """Move the arm to a pose (6,), where it is at ``time_s``. Returns the sensor's pins.

        Raises
        ------
        ContactError
            The contact can't be computed.
        """
        data, dt = self.scene.data, self.scene.model.opt.timestep
        T = matrix_of(pose) @ self.T_tool_sensor
        before, before_s = self._last or (T, time_s)
        steps = max(round(min(time_s - before_s, LONGEST_S) / dt), 1)
        turns = Slerp([0.0, 1.0], Rotation.from_matrix([before[:3, :3], T[:3, :3]]))
        for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
            data.mocap_pos[0] = (before[:3, 3] + share * (T[:3, 3] - before[:3, 3])) / MM
            data.mocap_quat[0] = turns(share).as_quat(scalar_first=True)
            self.scene.step()
        self._last = T, time_s
        return pins_at(self.scene, CARRIED)


def pins_at(scene: TactileScene, site: str) -> PinState:
    """A sensor's pins; ``ContactError`` if its contact can't be computed."""
    if lost := scene.read(site).lost:
        raise ContactError(lost)
    return scene.pins(site)


def open_world(scene: str, sensor: SensorSpec, T_tool_sensor: np.ndarray) -> CarriedSensor:
    """A sensor in a scene's file, or in a scene of this package; see ``scene_file`` for the error."""
    spec = mujoco.MjSpec.from_file(str(scene_file(scene)))
    spec.worldbody.add_body(name=CARRIED, mocap=True).add_site(name=CARRIED)
    return CarriedSensor(TactileScene(spec.compile(), {CARRIED: sensor}), T_tool_sensor)


class SceneGripper:
    """The gripper of a scene, with a sensor at each finger, whose hand an arm lifts: both a gripper, and a world for each sensor's camera.

    The scene has actuators ``lift``, along the arm's z, and ``grip``, which closes each finger. The height at the first frame counts as the
    scene's own; the hand does not follow the arm in other directions.

    Parameters
    ----------
    scene : str
        As for ``load_scene``.
    sensor : SensorSpec
    width_mm : float
        Width at the start, between the two apices.

    Attributes
    ----------
    scene : TactileScene
    """

    def __init__(self, scene: str, sensor: SensorSpec, *, width_mm: float = OPEN_MM) -> None:
        spec, sensors = load_scene(scene, sensor)
        self.name, self.scene = f"gripper of {scene}", TactileScene(spec.compile(), sensors)
        self._lock, self._from_mm, self._last_s = threading.Lock(), np.nan, np.nan
        data = self.scene.data
        mujoco.mj_forward(self.scene.model, data)
        first, second = (data.site(site).xpos for site in sensors)
        self._widest_mm = MM * float(np.linalg.norm(first - second)) - 2 * float(build_mesh(sensor.geometry).nodes_mm[:, 2].max())
        self.move(width_mm)
        for finger in ("left", "right"):
            data.joint(finger).qpos[0] = data.actuator("grip").ctrl[0]

    @property
    def width_mm(self) -> float:
        """The width that was commanded last."""
        return self._widest_mm - 2 * MM * float(self.scene.data.actuator("grip").ctrl[0])

    def move(self, width_mm: float) -> None:
        """Open or close to a width, within the fingers' travel."""
        self.scene.data.actuator("grip").ctrl = np.clip((self._widest_mm - width_mm) / 2 / MM, *self.scene.model.actuator("grip").ctrlrange)

    def worlds(self) -> dict[str, "GrippedWorld"]:
        """What each sensor touches, by the sensors' sites."""
        return {site: GrippedWorld(self, site) for site in self.scene.sensors}

    def pins(self, site: str, pose: np.ndarray, time_s: float) -> PinState:
        """A sensor's pins with the arm at a pose (6,), where it is at ``time_s``. The first sensor that is asked moves the scene on."""
        with self._lock:
            if np.isnan(self._last_s):
                self._from_mm, self._last_s = pose[2], time_s
            self.scene.data.actuator("lift").ctrl = (pose[2] - self._from_mm) / MM
            passed_s = float(np.clip(time_s - self._last_s, 0.0, LONGEST_S))
            self.scene.step(round(passed_s / self.scene.model.opt.timestep))
            self._last_s = max(self._last_s, time_s)
            return pins_at(self.scene, site)


@dataclass(frozen=True)
class GrippedWorld:
    """A world (``hardware.cameras.twin.World``): what one sensor of a gripper touches."""

    gripper: SceneGripper
    site: str

    def warm_up(self) -> None:
        """Compile what a step needs."""
        with self.gripper._lock:
            self.gripper.scene.apply()

    def move(self, pose: np.ndarray, time_s: float) -> PinState:
        """See ``SceneGripper.pins``."""
        return self.gripper.pins(self.site, pose, time_s)
