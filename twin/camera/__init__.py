"""The camera: projection of points in space to its picture, and conversion of light to the gray levels of a frame."""
