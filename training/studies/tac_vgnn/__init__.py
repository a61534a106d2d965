"""The Tac-VGNN paper's comparison on a recording: graphs, models, training efficiency, and the Voronoi areas of contacts."""

from training.studies.tac_vgnn.study import TacVgnnPlan, TacVgnnResult, run

__all__ = ["TacVgnnPlan", "TacVgnnResult", "run"]
