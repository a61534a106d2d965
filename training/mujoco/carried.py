"""A sensor that an arm carries through a MuJoCo scene, in which it moves what it touches.

The scene's world is the arm's base frame, in m. The sensor follows the arm's path exactly. Between two of the arm's poses the scene is
stepped by the time that has passed.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from scenes.sensor import SensorSpec
from training.mujoco.geoms import MM
from training.mujoco.model import scene_file
from training.mujoco.scene import TactileScene
from twin.errors import ContactError
from twin.rig.arm_pose import matrix_of
from twin.types import PinState

CARRIED = "carried_tactip"
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
        if lost := self.scene.read(CARRIED).lost:
            raise ContactError(lost)
        return self.scene.pins(CARRIED)


def open_world(scene: str, sensor: SensorSpec, T_tool_sensor: np.ndarray) -> CarriedSensor:
    """A sensor in a scene's file, or in a scene of this package; see ``scene_file`` for the error."""
    spec = mujoco.MjSpec.from_file(str(scene_file(scene)))
    spec.worldbody.add_body(name=CARRIED, mocap=True).add_site(name=CARRIED)
    return CarriedSensor(TactileScene(spec.compile(), {CARRIED: sensor}), T_tool_sensor)
