"""A camera that plays the pictures of a folder."""

import twin


def open_example(folder: str, sensor, form):
    """The camera of ``example:FOLDER``."""
    return twin.open_camera(folder, sensor, form)
