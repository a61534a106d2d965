"""TacTips in robot scenes of MuJoCo: the surrogate's forces on sensors and objects, and the sensors' pins and frames."""

from training.mujoco.scene import TactileReading, TactileScene

__all__ = ["TactileReading", "TactileScene"]
