"""Comparison of the twin's pins with those of labelled real frames."""

from twin.evaluation.labelled.compare import Comparison, compare, table_of
from twin.evaluation.labelled.model import ContactModel, MeasuredFrames, measure_frames
