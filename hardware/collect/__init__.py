"""Collection of labelled frames."""
