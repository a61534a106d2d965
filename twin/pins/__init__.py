"""Finds pins in frames, labels them, and builds their graphs.

`make_detector` gives the pipeline and other detectors with the same interface. `twin.pins.detectors.tune` finds their parameters from
frames. `twin.pins.check` examines the condition of a sensor.
"""

from twin.pins.detectors.detector import Detector, Found, make_detector
from twin.pins.detectors.detector_spec import METHODS, DetectorSpec, load_detector, shipped_detector, with_detector, write_detector
from twin.pins.graph import make_graph, node_features
from twin.pins.labelling.reference import PinView, Reference, make_reference, nominal_reference, view_of
from twin.pins.pipeline import Pipeline, measure_reference
