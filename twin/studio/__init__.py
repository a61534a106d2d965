"""The studio: a page in a browser on which one moves the contact and sees skin, picture, graph, estimate and forces at once.

``contact`` is the state behind the page, free of any browser: an object is moved against a sensor, and each move has one answer.
``worker`` runs it in a thread of its own and always takes the newest wish. ``tracing`` path-traces in a process of its own. ``page``
shows the answers with viser. What needs a model, a camera or an arm is handed in by the command line.
"""
