"""Ways to find pins, ours and others', behind one call; and their parameters found from frames."""

from twin.detectors.detector import Detector, Found, make_detector
from twin.detectors.spec import METHODS, DetectorSpec, load_detector, shipped_detector, write_detector
from twin.detectors.tune import Tuned, tune

__all__ = [
    "METHODS",
    "Detector",
    "DetectorSpec",
    "Found",
    "Tuned",
    "load_detector",
    "make_detector",
    "shipped_detector",
    "tune",
    "write_detector",
]
