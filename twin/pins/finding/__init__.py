"""From a picture to blobs: thresholds, spots, caps."""
