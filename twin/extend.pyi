"""What authors of new parts need: protocols and base classes of layouts, materials, arms, cameras, models, tasks, degradations, detectors. Made by docs/generators/stubs.py."""

from hardware.arms.arm import Arm as Arm
from hardware.arms.arm import ArmState as ArmState
from hardware.arms.arm import BaseArm as BaseArm
from hardware.arms.arm import FEEDBACK_AGE_S as FEEDBACK_AGE_S
from hardware.arms.mg400 import MG400 as MG400
from hardware.arms.mg400 import Mg400Ports as Mg400Ports
from hardware.cameras.reader import DevicePicture as DevicePicture
from hardware.cameras.reader import LiveSource as LiveSource
from hardware.cameras.reader import ReadFailed as ReadFailed
from hardware.cameras.reader import capture as capture
from hardware.cameras.source import FrameSource as FrameSource
from hardware.emulators.mg400 import Mg400Emulator as Mg400Emulator
from hardware.errors import Connection as Connection
from hardware.errors import DeviceError as DeviceError
from scenes.layouts.base import LatticeLayout as LatticeLayout
from scenes.layouts.base import Layout as Layout
from scenes.materials.base import MaterialLaw as MaterialLaw
from scenes.pins import PinsSpec as PinsSpec
from training.environments.tasks import Task as Task
from training.models import register as register
from training.models.part import Model as Model
from training.models.part import PinModel as PinModel
from training.models.part import refuse_sizes as refuse_sizes
from training.models.recipes import Recipe as Recipe
from twin.camera.projection import project as project
from twin.estimate import Estimate as Estimate
from twin.estimate import SensorModel as SensorModel
from twin.evaluation.degradation.condition import Condition as Condition
from twin.evaluation.degradation.condition import PictureView as PictureView
from twin.evaluation.degradation.condition import over_channels as over_channels
from twin.geometry.pins import rest_pins as rest_pins
from twin.mechanics import SkinSolver as SkinSolver
from twin.optics.preview import Preview as Preview
from twin.pins.detector import Detector as Detector
from twin.pins.detector_spec import DetectorSpec as DetectorSpec

register_model = register
