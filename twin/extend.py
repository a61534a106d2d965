"""What authors of new parts need: protocols and base classes of layouts, materials, arms, cameras, models, tasks, degradations, detectors.

arms          Arm ArmState BaseArm FEEDBACK_AGE_S MG400 Mg400Ports Mg400Emulator
cameras       FrameSource LiveSource DevicePicture ReadFailed capture World
devices       DeviceError Connection
models        Estimate SensorModel Model PinModel Recipe register_model refuse_sizes
tasks         Task Start StepOutcome WorldState standing_on
degradations  Condition PictureView over_channels
detectors     Detector DetectorSpec
sensors       PinsSpec Layout LatticeLayout MaterialLaw
mechanics     SkinSolver
optics        Preview project rest_pins
contracts     ArmContract CameraContract LayoutContract MaterialContract ConditionContract ModelContract TaskContract

The pages below `docs/how-to` show how to add each of them. Each name is imported when it is first used.
"""

from typing import Any

from twin.lazy import offered_name

_PLACES = {
    "Arm": "hardware.arms.arm",
    "ArmContract": "twin.contracts",
    "ArmState": "hardware.arms.arm",
    "BaseArm": "hardware.arms.arm",
    "CameraContract": "twin.contracts",
    "Condition": "twin.evaluation.degradation.condition",
    "ConditionContract": "twin.contracts",
    "Connection": "hardware.errors",
    "Detector": "twin.pins.detectors.detector",
    "DetectorSpec": "twin.pins.detectors.detector_spec",
    "DeviceError": "hardware.errors",
    "DevicePicture": "hardware.cameras.reader",
    "Estimate": "twin.estimate",
    "FEEDBACK_AGE_S": "hardware.arms.arm",
    "FrameSource": "hardware.cameras.source",
    "LatticeLayout": "scenes.layouts.base",
    "Layout": "scenes.layouts.base",
    "LayoutContract": "twin.contracts",
    "LiveSource": "hardware.cameras.reader",
    "MG400": "hardware.arms.mg400",
    "MaterialContract": "twin.contracts",
    "MaterialLaw": "scenes.materials.base",
    "Mg400Emulator": "hardware.emulators.mg400",
    "Mg400Ports": "hardware.arms.mg400",
    "Model": "training.models.part",
    "ModelContract": "twin.contracts",
    "PictureView": "twin.evaluation.degradation.condition",
    "PinModel": "training.models.part",
    "PinsSpec": "scenes.pins",
    "Preview": "twin.optics.preview",
    "ReadFailed": "hardware.cameras.reader",
    "Recipe": "training.models.part",
    "SensorModel": "twin.estimate",
    "SkinSolver": "twin.mechanics",
    "Start": "training.environments.tasks",
    "StepOutcome": "training.environments.tasks",
    "Task": "training.environments.tasks",
    "TaskContract": "twin.contracts",
    "World": "hardware.cameras.twin",
    "WorldState": "training.environments.tasks",
    "capture": "hardware.cameras.reader",
    "over_channels": "twin.evaluation.degradation.condition",
    "project": "twin.camera.projection",
    "refuse_sizes": "training.models.part",
    "register_model": "training.models:register",
    "rest_pins": "twin.geometry.pins",
    "standing_on": "training.environments.world",
}
"""By public name: its module, and its name there if that is another."""
__all__ = sorted(_PLACES)


def __getattr__(name: str) -> Any:
    return offered_name(_PLACES, "twin.extend", name)
