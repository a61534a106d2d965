"""Gymnasium environments of a TacTip's tasks, on the finite elements or on their surrogate.

Importing this package registers them: ``gymnasium.make("tactip/EdgeFollow-v0")``. ``training.environments:tactip/EdgeFollow-v0`` makes
gymnasium import it.
"""

from twin.errors import extras_named

with extras_named():
    import gymnasium

from gymnasium.envs.registration import register, registry

from training.environments.batch import Options
from training.environments.environment import TactileEnv, TactileVectorEnv
from training.environments.tasks import TASKS, add_tasks

NAMESPACE = "tactip"
"""First part of the environments' ids."""
VERSION = 0


def ids() -> tuple[str, ...]:
    """The ids of all environments."""
    add_tasks()
    return tuple(f"{NAMESPACE}/{name}-v{VERSION}" for name in TASKS)


def register_all() -> None:
    """Register the environments; a second call has no effect. Some versions of gymnasium call it where the package is installed."""
    where = "training.environments.environment"
    for full, name in zip(ids(), TASKS, strict=True):
        if full not in registry:
            register(id=full, entry_point=f"{where}:TactileEnv", vector_entry_point=f"{where}:TactileVectorEnv", kwargs={"task": name})


register_all()

__all__ = ["NAMESPACE", "Options", "TactileEnv", "TactileVectorEnv", "gymnasium", "ids", "register_all"]
