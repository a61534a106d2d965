"""Devices as context managers: connected on the way in, let go of on the way out."""


class Connection:
    """Mixin for whatever has ``connect()`` and ``disconnect()``."""

    def __enter__(self):
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.disconnect()
