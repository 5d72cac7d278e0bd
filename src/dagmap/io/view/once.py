"""What need not be drawn again."""

from __future__ import annotations

from typing import Any

import numpy as np


class Once:
    """Does something again only where what it depends on has changed."""

    def __init__(self) -> None:
        self._key: tuple[Any, ...] | None = None

    def changed(self, *key: Any) -> bool:
        same = self._key is not None and len(key) == len(self._key)
        if same and all(a is b or _equal(a, b) for a, b in zip(key, self._key or (), strict=True)):
            return False
        self._key = key
        return True


def _equal(a: Any, b: Any) -> bool:
    return bool(np.array_equal(a, b)) if isinstance(a, np.ndarray) else bool(a == b)
