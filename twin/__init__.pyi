"""Digital twin of the TacTip, a soft tactile sensor with a camera inside. Made by docs/generators/stubs.py."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from hardware.arms.open_arm import open_arm as open_arm
from hardware.cameras.source import open_camera as open_camera
from hardware.collect.collect import Collected as Collected
from hardware.collect.record import RecordedFrames as RecordedFrames
from hardware.live.examining import Examination as Examination
from hardware.safety.decide import load_limits as load_limits
from hardware.safety.safe_arm import SafeArm as SafeArm
from hardware.servo.following import Followed as Followed
from hardware.servo.grip import Gripped as Gripped
from scenes import ExperimentSpec as ExperimentSpec
from scenes import ObjectSpec as ObjectSpec
from scenes import SensorSpec as SensorSpec
from scenes import ServoSpec as ServoSpec
from scenes import load_experiment as load_experiment
from scenes import load_object as load_object
from scenes import load_sensor as load_sensor
from training.environments import register_all as register_all
from training.environments.baselines import BaselinesVecEnv as BaselinesVecEnv
from training.environments.demonstrations import Demonstrations as Demonstrations
from training.environments.learn import Learnt as Learnt
from training.estimate.estimator import load_with_history as load_with_history
from training.generation.run import Simulated as Simulated
from training.mujoco.model import attach_sensor as attach_sensor
from training.mujoco.model import load_scene as load_scene
from training.mujoco.model import write_urdf as write_urdf
from training.mujoco.scene import TactileScene as TactileScene
from training.studies.degradation import DegradationResult as DegradationResult
from training.studies.evaluation import Evaluation as Evaluation
from training.studies.evaluation import Predictions as Predictions
from training.studies.label_audit import LabelAudit as LabelAudit
from training.studies.realism import Realism as Realism
from training.studies.train import TrainedRun as TrainedRun
from training.studies.validation import Validation as Validation
from twin.calibration.contact.calibrate import ContactCalibration as ContactCalibration
from twin.calibration.contact.forces import ForceComparison as ForceComparison
from twin.calibration.go_on import WholeSensor as WholeSensor
from twin.calibration.optics import OpticsCalibration as OpticsCalibration
from twin.mechanics.path import ContactPose as ContactPose
from twin.pins.batch import Preprocessed as Preprocessed
from twin.pins.detectors.tune_files import TunedOnFrames as TunedOnFrames
from twin.pins.graph import node_features as node_features
from twin.pins.pipeline import Pipeline as Pipeline
from twin.progress import Progress as Progress
from twin.simulator import Simulator as Simulator
from twin.types import Form as Form
from twin.types import Frame as Frame
from twin.types import Observation as Observation
from twin import errors as errors
from twin import extend as extend

load_model = load_with_history
register_environments = register_all

__version__: str

def require_own(*names: str) -> None: ...

def audit(
    data: Path | str,
    *,
    sensor: str | Path | SensorSpec,
    out: Path | str,
    form: Form | str | None = ...,
    table: Path | str | None = ...,
    no_contact: Path | str | None = ...,
    pipeline: Path | str | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> LabelAudit: ...

def calibrate_contact(
    *,
    sensor: str | Path | SensorSpec,
    frames: Path | str,
    out: Path | str,
    num_labelled: int = ...,
    seed: int = ...,
    experiment: str | Path | ExperimentSpec = ...,
    obj: str | Path | ObjectSpec | None = ...,
    hold: str | Sequence[str] | None = ...,
    workers: int = ...,
    elements: int = ...,
    form: Form | str | None = ...,
    table: Path | str | None = ...,
    no_contact: Path | str | None = ...,
    pipeline: Path | str | None = ...,
    column: str | Sequence[str] | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> ContactCalibration | ForceComparison: ...

def calibrate_optics(
    *,
    sensor: str | Path | SensorSpec,
    frames: Path | str,
    out: Path | str,
    no_contact: Path | str | None = ...,
    max_frames: int = ...,
    pipeline: Path | str | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> OpticsCalibration: ...

def new_sensor(
    frames: Path | str | None = ...,
    *,
    out: Path | str,
    camera: str | Path = ...,
    label_table: Path | str | None = ...,
    experiment: str | Path | ExperimentSpec | None = ...,
    contacts: int = ...,
    optics: bool = ...,
    workers: int = ...,
    elements: int = ...,
    layout: str | None = ...,
    radius_mm: float | None = ...,
    no_contact: Path | str | None = ...,
    table: Path | str | None = ...,
    form: Form | str | None = ...,
    max_frames: int = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> WholeSensor: ...

def realism(
    path: Path | str,
    *,
    sensor: str | Path | SensorSpec,
    out: Path | str,
    pose_aligned: bool = ...,
    max_frames: int | None = ...,
    fitted: int = ...,
    without: str | Sequence[str] | None = ...,
    residual: bool = ...,
    quality: Literal['rasterised', 'preview', 'standard', 'high'] = ...,
    two_sample: bool = ...,
    thorough: bool = ...,
    table: Path | str | None = ...,
    pipeline: Path | str | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Realism: ...

def record(
    *,
    camera: str | Path,
    out: Path | str,
    count: int = ...,
    port: int = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> RecordedFrames: ...

def robustness(
    *,
    sensor: str | Path | SensorSpec,
    out: Path | str,
    pipeline: str | Sequence[str] | None = ...,
    model: Path | str | Sequence[Path | str] | None = ...,
    conditions: Path | str | None = ...,
    frames: Path | str | None = ...,
    max_frames: int = ...,
    rendered: bool = ...,
    jobs: int = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> DegradationResult: ...

def validate(
    *,
    sensor: str | Path | SensorSpec,
    frames: Path | str,
    out: Path | str,
    experiment: str | Path | ExperimentSpec = ...,
    obj: str | Path | ObjectSpec | None = ...,
    max_frames: int | None = ...,
    friction_frames: int = ...,
    seed: int = ...,
    elements: int = ...,
    form: Form | str | None = ...,
    table: Path | str | None = ...,
    no_contact: Path | str | None = ...,
    pipeline: Path | str | None = ...,
    column: str | Sequence[str] | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Validation | ForceComparison: ...

def check(
    source: str | Path,
    *,
    sensor: str | Path | SensorSpec,
    form: Form | str | None = ...,
    pipeline: Path | str | None = ...,
    max_frames: int = ...,
    no_contact: Path | str | None = ...,
    push: str | Sequence[str] | None = ...,
    twist: Path | str | None = ...,
    out: Path | str | None = ...,
    page: Path | str | None = ...,
    model: Path | str | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Examination: ...

def preprocess(
    path: Path | str,
    *,
    sensor: str | Path | SensorSpec,
    out: Path | str,
    form: Form | str | None = ...,
    overlay: bool = ...,
    table: Path | str | None = ...,
    no_contact: Path | str | None = ...,
    pipeline: Path | str | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Preprocessed: ...

def tune(
    *,
    sensor: str | Path | SensorSpec,
    frames: Path | str,
    out: Path | str | None = ...,
    method: Literal['twin', 'legacy', 'adaptive', 'fixed', 'simple', 'log', 'dog', 'doh'] = ...,
    form: Form | str | None = ...,
    max_frames: int = ...,
    table: Path | str | None = ...,
    no_contact: Path | str | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> TunedOnFrames: ...

def demonstrate(
    *,
    task: str,
    sensor: str | Path | SensorSpec,
    out: Path | str,
    episodes: int = ...,
    randomise: str | None = ...,
    surrogate: Path | str | None = ...,
    objects: str | Sequence[str] | None = ...,
    video: bool = ...,
    seed: int = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Demonstrations: ...

def evaluate(
    run: Path | str,
    *,
    data: Path | str | Sequence[Path | str],
    out: Path | str,
    rows: str = ...,
    label_kind: str = ...,
    robustness: bool = ...,
    table: Path | str | None = ...,
    no_contact: Path | str | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Evaluation: ...

def learn(
    *,
    task: str,
    sensor: str | Path | SensorSpec,
    out: Path | str,
    observation: str = ...,
    randomise: str | None = ...,
    surrogate: Path | str | None = ...,
    objects: str | Sequence[str] | None = ...,
    friction_history: bool = ...,
    state_estimator: bool = ...,
    minutes: float = ...,
    environments: int = ...,
    fem: int = ...,
    seed: int = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Learnt: ...

def make_dataset(
    *,
    experiment: str | Path | ExperimentSpec,
    sensor: str | Path | SensorSpec,
    count: int,
    out: Path | str,
    wide: bool = ...,
    obj: str | Path | ObjectSpec | None = ...,
    images: Literal['raw', 'gray', 'processed', 'none'] = ...,
    states: Literal['all', 'end'] = ...,
    randomise: str | None = ...,
    seed: int | None = ...,
    workers: int = ...,
    scheduler: str = ...,
    quality: Literal['rasterised', 'preview', 'standard', 'high'] | None = ...,
    residual: bool = ...,
    elements: int = ...,
    also: str | Sequence[str] | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Simulated: ...

def predict(
    run: Path | str,
    frame: Path | str,
    *,
    maps: Path | str | None = ...,
    sequence: bool = ...,
    table: Path | str | None = ...,
    no_contact: Path | str | None = ...,
    force: bool = ...,
) -> Predictions: ...

def train(
    *,
    model: str,
    sensor: str | Path | SensorSpec,
    data: Path | str | Sequence[Path | str],
    out: Path | str,
    target: str | Sequence[str] = ...,
    label_kind: str = ...,
    seed: int = ...,
    split: int = ...,
    epochs: int | None = ...,
    batch: int | None = ...,
    members: int | None = ...,
    kernel: bool | None = ...,
    max_minutes: float | None = ...,
    threads: int | None = ...,
    device: str = ...,
    form: Form | str | None = ...,
    table: Path | str | None = ...,
    no_contact: Path | str | None = ...,
    pipeline: Path | str | None = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> TrainedRun: ...

def collect(
    *,
    camera: str | Path,
    arm: str,
    sensor: str | Path | SensorSpec,
    out: Path | str,
    experiment: str | Path | ExperimentSpec = ...,
    count: int = ...,
    obj: str | Path | ObjectSpec | None = ...,
    servo: str | Path | ServoSpec = ...,
    form: Form | str | None = ...,
    safety: str | None = ...,
    seed: int | None = ...,
    design: str = ...,
    plain_light: bool = ...,
    also: str | Sequence[str] | None = ...,
    ros2: str | None = ...,
    dry_run: bool = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Collected: ...

def grasp(
    policy: str,
    *,
    out: Path | str,
    sensor: str | Path | SensorSpec = ...,
    gripper: str = ...,
    left: str = ...,
    right: str = ...,
    arm: str = ...,
    object_mm: float = ...,
    safety: str | None = ...,
    also: str | Sequence[str] | None = ...,
    ros2: str | None = ...,
    dry_run: bool = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Gripped: ...

def run_policy(
    policy: Path | str,
    *,
    obj: str | Path | ObjectSpec,
    out: Path | str,
    camera: str | Path = ...,
    arm: str = ...,
    servo: str | Path | ServoSpec = ...,
    steps: int | None = ...,
    safety: str | None = ...,
    record: bool = ...,
    seed: int = ...,
    known_place: bool = ...,
    plain_light: bool = ...,
    also: str | Sequence[str] | None = ...,
    ros2: str | None = ...,
    dry_run: bool = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Followed: ...

def servo(
    *,
    obj: str | Path | ObjectSpec,
    out: Path | str,
    model: Path | str = ...,
    camera: str | Path = ...,
    arm: str = ...,
    servo: str | Path | ServoSpec = ...,
    steps: int | None = ...,
    stream: bool = ...,
    rate: float = ...,
    safety: str | None = ...,
    record: bool = ...,
    seed: int = ...,
    known_place: bool = ...,
    plain_light: bool = ...,
    at_rest: str = ...,
    also: str | Sequence[str] | None = ...,
    ros2: str | None = ...,
    dry_run: bool = ...,
    force: bool = ...,
    progress: Progress | bool | None = ...,
) -> Followed: ...
