"""Errors that a user can act on; the command line prints them as one line."""


class TwinError(Exception):
    """Base of every error raised on purpose: says what came, what was expected, what to do."""


class FrameError(TwinError):
    """A frame, video or recording can't be read, or does not fit the sensor."""


class ContactError(TwinError):
    """A contact can't be computed: start inside the object, out of reach, not converged."""


class MeshError(TwinError):
    """An object's mesh can't be used: not closed, wrong unit, empty."""


class RenderError(TwinError):
    """Nothing can be rendered on this machine as asked."""


class StoreError(TwinError):
    """A result can't be written, or what lies in a folder was made otherwise, or another run is at work there."""


class DatasetError(TwinError):
    """A data set can't be made, or not gone on with."""
