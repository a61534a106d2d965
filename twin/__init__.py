"""Digital twin of the TacTip, a soft tactile sensor with a camera inside.

    import twin

    simulator = twin.Simulator(twin.load_sensor("mg400-331"))
    pose = twin.ContactPose(indent_mm=3.0, tilt_deg=(0.0, 5.0))
    state = simulator.press(twin.load_object("cylinder"), pose)
    rendered = simulator.render(state, form=twin.Form.PROCESSED)
    observation = twin.Pipeline(simulator.spec, rendered.frame.form)(rendered.frame)
    print(state, rendered, observation, sep="\\n")

specifications  load_sensor load_object load_experiment
simulation      Simulator ContactPose
frames, pins    Frame Form Pipeline Observation node_features preprocess tune
your sensor     record new_sensor check calibrate_optics calibrate_contact
how true it is  validate realism robustness audit
models          make_dataset train evaluate predict load_model
policies        register_environments BaselinesVecEnv demonstrate learn
robot scenes    TactileScene attach_sensor load_scene write_urdf
devices         open_camera open_arm SafeArm load_limits collect servo run_policy grasp
other           errors extend __version__

A function such as `train` does what the command of its name does. It takes the command's options as keyword arguments, and returns a
result: `print(str(result))` shows it, `result.written` names its files. `help(twin.train)` explains each argument. `twin.extend` is for
authors of new sensors, arms, cameras, models and tasks. Each name is imported when it is first used.
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from twin.lazy import WhenImported, offered_name

_OFFERED = {
    "hardware.arms.open_arm": ("open_arm",),
    "hardware.cameras.source": ("open_camera",),
    "hardware.safety.decide": ("load_limits",),
    "hardware.safety.safe_arm": ("SafeArm",),
    "scenes": ("load_experiment", "load_object", "load_sensor"),
    "training.environments.baselines": ("BaselinesVecEnv",),
    "training.mujoco.model": ("attach_sensor", "load_scene", "write_urdf"),
    "training.mujoco.scene": ("TactileScene",),
    "twin.cli.calibration": ("audit", "calibrate_contact", "calibrate_optics", "new_sensor", "realism", "record", "robustness", "validate"),
    "twin.cli.frames": ("check", "preprocess", "tune"),
    "twin.cli.learning": ("demonstrate", "evaluate", "learn", "make_dataset", "predict", "train"),
    "twin.cli.live": ("collect", "grasp", "run_policy", "servo"),
    "twin.mechanics.path": ("ContactPose",),
    "twin.pins.graph": ("node_features",),
    "twin.pins.pipeline": ("Pipeline",),
    "twin.simulator": ("Simulator",),
    "twin.types": ("Form", "Frame", "Observation"),
}
"""By module: the names that are taken from it."""
_RENAMED = {"load_model": "training.estimate.estimator:load_with_history", "register_environments": "training.environments:register_all"}
"""By public name: its module, and its other name there."""
_PLACES = {name: place for place, names in _OFFERED.items() for name in names} | _RENAMED
_MODULES = ("errors", "extend")


def require_own(*names: str) -> None:
    """Raise ``ImportError`` if a module of another program is found under the name of a package that belongs to this one."""
    home = Path(__file__).parent.parent
    for name in names:
        spec = find_spec(name)
        if spec is not None and spec.origin and Path(spec.origin).parent.parent != home:
            hiding = Path(spec.origin).parent if spec.submodule_search_locations else spec.origin
            raise ImportError(f"{hiding} hides {home / name} of tactip-twin; rename it, or start in another folder")


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata

        return metadata.version("tactip-twin")
    if name in _MODULES:
        return import_module(f"twin.{name}")
    require_own("training", "hardware")
    return offered_name(_PLACES, "twin", name)


__all__ = ["__version__", *sorted([*_PLACES, *_MODULES])]

require_own("scenes")
WhenImported("gymnasium", lambda: import_module("training.environments"))  # which registers ids such as "twin:tactip/EdgeFollow-v0"
