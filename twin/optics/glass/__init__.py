"""The window and what stands behind it: rays through the flat glass to the camera."""
