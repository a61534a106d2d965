"""What training on several objects is worth on an object that was never touched."""

from training.studies.objects.plan import Plan
from training.studies.objects.study import Result, rows_in_range, run, table, verdicts

__all__ = ["Plan", "Result", "rows_in_range", "run", "table", "verdicts"]
