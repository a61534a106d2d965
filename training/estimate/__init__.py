"""Estimators: pose, interval, domain, pins at rest."""
