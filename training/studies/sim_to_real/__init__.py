"""Study of the twin's value for real frames: models trained in the twin, with a few labelled frames in addition, and without the twin."""

from training.studies.sim_to_real.plan import Plan
from training.studies.sim_to_real.study import Result, run

__all__ = ["Plan", "Result", "run"]
