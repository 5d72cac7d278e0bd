"""Bytes of the wire: bounded reading and plain writing, shared by transactions and messages.

Whole numbers are LEB128 of at most 63 bits in their shortest form; signed ones are zigzag first.
"""

from __future__ import annotations

import numpy as np

from .model import AuthorId, Int64s, Reason

_LONGEST = 8  # bytes of a number that is read together with others: 56 bits


class Refusal(Exception):
    """Foreign bytes that are refused. Never leaves the package: it becomes a `Rejected` event."""

    def __init__(self, reason: Reason, detail: str = "", fault: AuthorId | None = None) -> None:
        super().__init__(f"{reason.value}: {detail}" if detail else reason.value)
        self.reason, self.detail, self.fault = reason, detail, fault


class Reader:
    """Reads from the front of `data`; raises Refusal instead of running over its end."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def take(self, count: int) -> bytes:
        if count > self.left:
            raise Refusal(Reason.TRUNCATED, f"{count} bytes wanted, {self.left} left")
        self.at += count
        return self.data[self.at - count : self.at]

    def number(self, limit: int = (1 << 63) - 1) -> int:
        value = shift = 0
        while True:
            byte = self.take(1)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
            shift += 7
            if shift > 56:
                raise Refusal(Reason.MALFORMED, "number longer than 63 bits")
        if byte == 0 and shift:
            raise Refusal(Reason.MALFORMED, "number not in its shortest form")
        if value > limit:
            raise Refusal(Reason.MALFORMED, f"number {value} above {limit}")
        return value

    def numbers(self, count: int, limit: int) -> Int64s:
        """The next `count` numbers (count,), as `number` reads them."""
        data = np.frombuffer(self.data[self.at : self.at + _LONGEST * count], np.uint8)
        ends = np.flatnonzero(data < 0x80)[:count]
        sizes = np.diff(ends, prepend=-1)
        short = len(ends) == count > 0 and int(sizes.max()) <= _LONGEST
        if not short or (data[ends[sizes > 1]] == 0).any():  # to be refused, as a rule
            return np.array([self.number(limit) for _ in range(count)], np.int64)
        starts = ends - sizes + 1
        used = data[: int(ends[-1]) + 1].astype(np.int64)
        shift = 7 * (np.arange(len(used)) - starts.repeat(sizes))
        values = np.add.reduceat((used & 0x7F) << shift, starts)
        if int(values.max()) > limit:
            raise Refusal(Reason.MALFORMED, f"number {int(values.max())} above {limit}")
        self.at += len(used)
        return np.asarray(values, np.int64)

    def signed(self) -> int:
        value = self.number()
        return (value >> 1) ^ -(value & 1)

    def end(self) -> None:
        if self.left:
            raise Refusal(Reason.MALFORMED, f"{self.left} bytes too many")


def number(value: int) -> bytes:
    """A whole number from 0 to 2^63 - 1 as LEB128."""
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def numbers(values: Int64s) -> bytes:
    """Many of them, one after the other."""
    sizes = np.ones(len(values), np.int64)
    for shift in range(7, 63, 7):
        sizes += values >> shift > 0
    starts = np.cumsum(sizes) - sizes
    place = np.arange(int(sizes.sum())) - starts.repeat(sizes)
    more = place < sizes.repeat(sizes) - 1
    return bytes((values.repeat(sizes) >> 7 * place & 0x7F | 0x80 * more).astype(np.uint8))


def signed(value: int) -> bytes:
    """A whole number of either sign as zigzag LEB128."""
    return number((value << 1) if value >= 0 else ((-value << 1) - 1))
