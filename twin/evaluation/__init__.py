"""Evaluation of the twin: pictures compared with real frames, pins compared with labelled frames, and robustness to degradations."""
