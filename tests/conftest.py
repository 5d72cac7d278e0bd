"""Fixtures that several test modules share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from robots import Nursery


@pytest.fixture(scope="session")
def nursery() -> Iterator[Nursery]:
    """Starts `dagmap` processes."""
    nursery = Nursery()
    yield nursery
    nursery.close()
