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

_OFFERED = {
    "hardware.arms.arm": ("Arm", "ArmState", "BaseArm", "FEEDBACK_AGE_S"),
    "hardware.arms.mg400": ("MG400", "Mg400Ports"),
    "hardware.cameras.reader": ("DevicePicture", "LiveSource", "ReadFailed", "capture"),
    "hardware.cameras.source": ("FrameSource",),
    "hardware.cameras.twin": ("World",),
    "hardware.emulators.mg400": ("Mg400Emulator",),
    "hardware.errors": ("Connection", "DeviceError"),
    "scenes.layouts.base": ("LatticeLayout", "Layout"),
    "scenes.materials.base": ("MaterialLaw",),
    "scenes.pins": ("PinsSpec",),
    "training.environments.tasks": ("Start", "StepOutcome", "Task", "WorldState"),
    "training.environments.world": ("standing_on",),
    "training.models.part": ("Model", "PinModel", "Recipe", "refuse_sizes"),
    "twin.camera.projection": ("project",),
    "twin.contracts": (
        "ArmContract",
        "CameraContract",
        "ConditionContract",
        "LayoutContract",
        "MaterialContract",
        "ModelContract",
        "TaskContract",
    ),
    "twin.estimate": ("Estimate", "SensorModel"),
    "twin.evaluation.degradation.condition": ("Condition", "PictureView", "over_channels"),
    "twin.geometry.pins": ("rest_pins",),
    "twin.mechanics": ("SkinSolver",),
    "twin.optics.preview": ("Preview",),
    "twin.pins.detectors.detector": ("Detector",),
    "twin.pins.detectors.detector_spec": ("DetectorSpec",),
}
"""By module: the names that are taken from it."""
_RENAMED = {"register_model": "training.models:register"}
"""By public name: its module, and its other name there."""
_PLACES = {name: place for place, names in _OFFERED.items() for name in names} | _RENAMED
__all__ = sorted(_PLACES)


def __getattr__(name: str) -> Any:
    return offered_name(_PLACES, "twin.extend", name)
