"""Study of unseen objects: whether models that are trained on several objects estimate contacts with an unseen object."""

from training.studies.objects.plan import ObjectsPlan
from training.studies.objects.study import ObjectsResult, rows_in_range, run, table, verdicts

__all__ = ["ObjectsPlan", "ObjectsResult", "rows_in_range", "run", "table", "verdicts"]
