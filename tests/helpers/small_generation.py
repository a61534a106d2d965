"""A tiny simulated data set: gentle taps of the sensor with fewest pins on a coarse grid, pins alone."""

from pathlib import Path

from scenes import ExperimentSpec, RandomisationSpec, load_object, load_sensor
from training.generation import GenerationConfig

EXPERIMENT = """
description = "gentle taps"
object = "plane"
approach = "y"
zero_mm = 5.0
tap = [0, 5, 0, 0, 0, 0]
targets = ["pose_2", "pose_6"]
[pose]
pose_2 = [-4.4, -3.8]
pose_6 = [-8, 8]
[move]
move_1 = [-0.5, 0.5]
move_6 = [-2, 2]
"""
RANDOMISATION = {
    "name": "small",
    "description": "a little of everything",
    "executed_share": 0.6,
    "pin_noise_px": 0.1,
    "friction": {"low": 0.1, "high": 1.0, "free_share": 0.2},
    "sensor": {"skin.young_modulus_mpa": {"scale": (0.8, 1.25)}, "skin.thickness_mm": {"add": (-0.1, 0.1)}},
}
SENSOR, ACROSS = "mg400-127", 8


def small_config(tmp_path: Path, **changes) -> GenerationConfig:
    """The configuration that ``twin dataset`` makes of ``EXPERIMENT``."""
    from scenes import load_experiment

    file = tmp_path / "gentle.toml"
    file.write_text(EXPERIMENT)
    experiment: ExperimentSpec = load_experiment(file)
    parts = {
        "sensor": load_sensor(SENSOR),
        "object": load_object("plane"),
        "experiment": experiment,
        "randomisation": RandomisationSpec.model_validate(RANDOMISATION),
        "friction": 0.32,
        "images": "none",
        "across": ACROSS,
    }
    return GenerationConfig(**(parts | changes))


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, by its relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
