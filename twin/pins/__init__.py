"""Finds pins in frames, labels them, and builds their graphs.

`make_detector` gives the pipeline and other detectors with the same interface; `tune` finds their parameters from frames. `examine` checks
the condition of a sensor from a few of its frames.
"""

from twin.pins.check import Finding, Grade, examine
from twin.pins.detectors.detector import Detector, Found, make_detector
from twin.pins.detectors.detector_spec import METHODS, DetectorSpec, load_detector, shipped_detector, with_detector, write_detector
from twin.pins.detectors.tune import Tuned, tune
from twin.pins.graph import make_graph, node_features
from twin.pins.labelling.reference import Reference, make_reference, nominal_reference
from twin.pins.labelling.view import PinView, view_of
from twin.pins.pipeline import Pipeline, measure_reference
