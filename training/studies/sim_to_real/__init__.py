"""Study of the twin's value for real frames: models trained in the twin, with a few labelled frames in addition, and without the twin."""

from training.studies.sim_to_real.study import Plan, Result, run

__all__ = ["Plan", "Result", "run"]
