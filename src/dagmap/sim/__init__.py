"""Fleets in one process: seed in, timeline out."""

from __future__ import annotations
