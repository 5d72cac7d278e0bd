"""What is closed at the end of a `with` block."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TypeVar

C = TypeVar("C", bound="Closing")


class Closing(ABC):
    """Base of what holds a file, a socket or a thread until `close`."""

    @abstractmethod
    def close(self) -> None:
        """Let go of it."""

    def __enter__(self: C) -> C:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()
