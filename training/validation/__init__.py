"""How far the twin's pins are from those of labelled real frames."""

from training.validation.compare import Comparison, compare, table_of
from training.validation.model import ContactModel, MeasuredFrames, measure_frames

__all__ = ["Comparison", "ContactModel", "MeasuredFrames", "compare", "measure_frames", "table_of"]
