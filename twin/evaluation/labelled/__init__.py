"""Comparison of the twin's pins with those of labelled real frames."""

from twin.evaluation.labelled.model import Comparison, ContactModel, MeasuredFrames, compare, measure_frames, table_of
