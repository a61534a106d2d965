"""Live frames: watching, recording, checking."""
