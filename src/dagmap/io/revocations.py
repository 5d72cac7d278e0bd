"""Revocations that a person gives to a running robot: files in a folder, each read once."""

from __future__ import annotations

from pathlib import Path

from ..transaction import MAX_SIZE


class Revocations:
    """The folder `revocations` beside a robot's keys: for files of `dagmap keys revoke`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: set[tuple[str, int, int]] = set()  # name, size, time: half a copy is read again

    def new(self) -> list[bytes]:
        """What has come since the last call. What cannot be read now is tried again."""
        found = []
        for path in self._files():
            try:
                about = path.stat()
                version = path.name, about.st_size, about.st_mtime_ns
                if version in self._read or about.st_size > MAX_SIZE:
                    continue
                found.append(path.read_bytes())
            except OSError:
                continue
            self._read.add(version)
        return found

    def _files(self) -> list[Path]:
        try:
            return sorted(self._folder.glob("*.tx"))
        except OSError:  # such as too many open files: the agent has to go on
            return []
