"""From blobs to named pins: the layout at rest, matching, and layouts that frames show."""
