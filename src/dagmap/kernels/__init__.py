"""Arrays in, arrays out: the only home of numba. Every kernel has an obvious twin in tests/naive."""

from __future__ import annotations
