"""Recorded frames from disk: a picture, a folder, a video, or a recording with its table and metadata.

It reads the folder formats of the sensor's users: ``frames_bw/`` with ``init_0.png``, ``images/``, and ``sensor_images/`` or
``processed_images/``, each with ``targets.csv`` and JSON metadata. Irregularities are listed; everything that can be read is read.
"""

from twin.frames.folders import distinct_stems, natural_key
from twin.frames.images import read_image
from twin.frames.recording import Recording, evenly_read, frames_at, open_recording, spread_indices
