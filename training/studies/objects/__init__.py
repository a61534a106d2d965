"""Study of unseen objects: whether models that are trained on several objects estimate contacts with an object that they never touched."""

from training.studies.objects.plan import Plan
from training.studies.objects.study import Result, rows_in_range, run, table, verdicts

__all__ = ["Plan", "Result", "rows_in_range", "run", "table", "verdicts"]
