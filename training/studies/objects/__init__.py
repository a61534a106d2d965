"""Study of unseen objects: whether models that are trained on several objects estimate contacts with an unseen object."""

from training.studies.objects.study import ObjectsPlan, ObjectsResult, rows_in_range, run, table, verdicts

__all__ = ["ObjectsPlan", "ObjectsResult", "rows_in_range", "run", "table", "verdicts"]
