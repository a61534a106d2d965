"""The studio: a browser page on which the user moves an object against a sensor and sees skin, picture, graph, estimate and forces at once.

``contact`` holds the state behind the page and needs no browser: an object is moved against a sensor, and each move gives one answer.
``worker`` runs it in its own thread and always uses the newest wish. ``tracing`` path-traces in its own process. ``page`` shows the answers
with viser. The command line hands in everything that needs a model, a camera or an arm.
"""
