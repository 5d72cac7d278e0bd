"""Arrays in, arrays out: the only home of numba. Each kernel has a twin in tests/naive.py."""

from __future__ import annotations
