"""Study of the twin's value for real frames: models trained in the twin, with a few labelled frames in addition, and without the twin."""

from training.studies.sim_to_real.steps import SimToRealPlan
from training.studies.sim_to_real.study import SimToRealResult, run

__all__ = ["SimToRealPlan", "SimToRealResult", "run"]
