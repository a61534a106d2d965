"""What the twin is worth on real frames: trained in it, with a few labelled frames beside it, and without it."""

from training.studies.sim_to_real.study import Plan, Result, run

__all__ = ["Plan", "Result", "run"]
