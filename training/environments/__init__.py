"""Gymnasium environments of a TacTip's tasks, on the finite elements or on their surrogate.

Importing this package registers them, and so does ``import twin`` together with gymnasium: ``gymnasium.make("twin:tactip/EdgeFollow-v0")``.
Neither imports the tasks themselves.
"""

from typing import Any

from twin.errors import extras_named

with extras_named():
    import gymnasium

from gymnasium.envs.registration import register, registry

from scenes.plugins import offered
from twin.lazy import offered_name

NAMESPACE = "tactip"
"""First part of the environments' ids."""
VERSION = 0
OWN = ("EdgeFollow", "SurfaceFollow", "ContourFollow", "GentlePress", "ObjectRoll", "ObjectPush")
"""Names of this package's tasks."""
IN_SCENES = {name: f"training.mujoco.task:{name}" for name in ("GraspLift", "PegInsert")}
"""By name: the environments in MuJoCo scenes (extra ``mujoco``)."""
_PLACES = {
    "Options": "training.environments.batch",
    "TactileEnv": "training.environments.environment",
    "TactileVectorEnv": "training.environments.environment",
}
"""By public name: its module."""


def ids() -> tuple[str, ...]:
    """The ids of the environments whose sensor touches one object, without a robot scene."""
    return tuple(f"{NAMESPACE}/{name}-v{VERSION}" for name in dict.fromkeys((*OWN, *offered("tasks"))))


def register_all() -> None:
    """Register the environments; a second call has no effect. Some versions of gymnasium call it where the package is installed."""
    where = _PLACES["TactileEnv"]
    for name, place in IN_SCENES.items():
        if (full := f"{NAMESPACE}/{name}-v{VERSION}") not in registry:
            register(id=full, entry_point=place)
    for full in ids():
        if full not in registry:
            task = full.removeprefix(f"{NAMESPACE}/").removesuffix(f"-v{VERSION}")
            register(id=full, entry_point=f"{where}:TactileEnv", vector_entry_point=f"{where}:TactileVectorEnv", kwargs={"task": task})


def __getattr__(name: str) -> Any:
    return offered_name(_PLACES, "training.environments", name)


register_all()

__all__ = ["NAMESPACE", "OWN", "gymnasium", "ids", "register_all"]
