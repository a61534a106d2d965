"""How good it is: pictures against real frames, pins against labelled frames, and how far a sensor may degrade."""
