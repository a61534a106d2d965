"""Devices as context managers: connected when entered, disconnected when left."""

from abc import ABC, abstractmethod
from typing import Self


class Connection(ABC):
    """Base of whatever has ``connect()`` and ``disconnect()``."""

    @abstractmethod
    def connect(self) -> None: ...

    @abstractmethod
    def disconnect(self) -> None: ...

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.disconnect()
