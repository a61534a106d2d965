"""The demo: the twin from specification to pin graph for shipped sensors, as pictures and one page."""
