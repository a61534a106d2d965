"""From frames to labelled pins and their graphs."""

from twin.preprocess.forms import raw_to_recording, recording_to_raw
from twin.preprocess.graph import features, make_graph
from twin.preprocess.pipeline import Pipeline, measure_reference
from twin.preprocess.reference import Reference, make_reference, nominal_reference
from twin.preprocess.touch import require_untouched

__all__ = [
    "Pipeline",
    "Reference",
    "features",
    "make_graph",
    "make_reference",
    "measure_reference",
    "nominal_reference",
    "raw_to_recording",
    "recording_to_raw",
    "require_untouched",
]
