"""The Tac-VGNN paper's comparison on a recording: graphs, models, training efficiency, and the Voronoi areas of contacts."""

from training.studies.tac_vgnn.study import Plan, Result, run

__all__ = ["Plan", "Result", "run"]
