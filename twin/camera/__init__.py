"""The camera: where points of space appear in its picture, and from light to the levels of a frame."""
