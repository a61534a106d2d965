"""Sources of frames behind one protocol: cameras, streams, recordings, sessions, the twin."""
