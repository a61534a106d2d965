"""Every figure that a document states: measured by a job, kept in ``figures.json`` with what made it, printed into tables from there."""
