"""From frames to labelled pins and their graphs."""

from twin.preprocess.graph import features, make_graph
from twin.preprocess.pipeline import Pipeline, measure_reference
from twin.preprocess.pressed import require_untouched
from twin.preprocess.reference import Reference, make_reference, nominal_reference

__all__ = [
    "Pipeline",
    "Reference",
    "features",
    "make_graph",
    "make_reference",
    "measure_reference",
    "nominal_reference",
    "require_untouched",
]
