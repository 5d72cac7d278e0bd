"""Inputs that a parser reads from a file or folder."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

_MEMORY = Path("/dev/shm")  # a disk would be the slowest part


def write(path: Path, data: bytes) -> None:
    """The file with these bytes; without any it is missing."""
    path.unlink(missing_ok=True)
    if data:
        path.write_bytes(data)


def workplace() -> Path:
    """A new folder, gone when the process ends; in memory where there is such a place."""
    path = Path(
        tempfile.mkdtemp(
            prefix="dagmap-fuzz-", dir=_MEMORY if os.access(_MEMORY, os.W_OK) else None
        )
    )
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    return path
