"""Runs: training, files, evaluation, packed copies."""
