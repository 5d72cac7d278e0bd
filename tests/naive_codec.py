"""The slow, obvious twin of `kernels/codec.py`: one big number, models in a dictionary, no kernels.

It follows the format's description (the docstring of the kernel module), not its code.
"""

from __future__ import annotations

from collections.abc import Sequence

Row = Sequence[int]
DEPTH = {"back": 3, "step": 4, "axis": 4, "channel": 3}
LAST_CONTEXT = {"back": 1, "step": 0, "axis": 15, "channel": 11}
NONE, INSIDE, OUTSIDE, SHARED = range(4)


class Wrong(Exception):
    """No encoder writes these bytes."""


class Models:
    """Chance of a zero in 2^-16 and count of uses, by (kind, context, bits before)."""

    def __init__(self) -> None:
        self.known: dict[object, tuple[int, int]] = {}

    def chance(self, key: object) -> int:
        return self.known.get(key, (1 << 15, 0))[0]

    def learn(self, key: object, bit: int) -> None:
        chance, uses = self.known.get(key, (1 << 15, 0))
        rate = 65536 * 5 // (5 * uses + 8)
        moved = chance - (chance * rate >> 16) if bit else chance + ((65536 - chance) * rate >> 16)
        self.known[key] = (moved, min(uses + 1, 127))


class Writer:
    def __init__(self) -> None:
        self.models, self.low, self.width, self.moved = Models(), 0, 1 << 32, 0

    def _renew(self) -> None:
        while self.width < 1 << 24:
            self.low, self.width, self.moved = self.low << 8, self.width << 8, self.moved + 1

    def bit(self, key: object, bit: int) -> int:
        bound = self.width * self.models.chance(key) >> 16
        self.low, self.width = (self.low + bound, self.width - bound) if bit else (self.low, bound)
        self.models.learn(key, bit)
        self._renew()
        return bit

    def plain(self, count: int, value: int) -> int:
        bits = f"{value:0{count}b}" if count else ""
        for at in range(0, count, 8):
            part = bits[at : at + 8]
            self.width >>= len(part)
            self.low += int(part, 2) * self.width
            self._renew()
        return value

    def end(self) -> bytes:
        return self.low.to_bytes(4 + self.moved, "big")


class Reader:
    def __init__(self, data: bytes) -> None:
        self.models, self.data, self.width, self.code, self.at = Models(), data, 1 << 32, 0, 0
        for _ in range(4):
            self._byte()

    def _byte(self) -> None:
        if self.at >= len(self.data):
            raise Wrong
        self.code = self.code * 256 + self.data[self.at]
        self.at += 1

    def _renew(self) -> None:
        while self.width < 1 << 24:
            self.width <<= 8
            self._byte()

    def bit(self, key: object, bit: int) -> int:
        bound = self.width * self.models.chance(key) >> 16
        bit = int(self.code >= bound)
        self.code, self.width = (
            (self.code - bound, self.width - bound) if bit else (self.code, bound)
        )
        self.models.learn(key, bit)
        self._renew()
        return bit

    def plain(self, count: int, value: int) -> int:
        value = 0
        while count:
            step = min(count, 8)
            count -= step
            self.width >>= step
            part = self.code // self.width
            if part >= 1 << step:
                raise Wrong
            self.code -= part * self.width
            value = value << step | part
            self._renew()
        return value

    def end(self) -> None:
        if self.code or self.at != len(self.data):
            raise Wrong


Coder = Writer | Reader


def tree(coder: Coder, key: tuple[object, ...], depth: int, value: int) -> int:
    bits = ""
    for digit in f"{value:0{depth}b}" if depth else "":
        bits += str(coder.bit((key, bits), int(digit)))
    return int(bits, 2) if bits else 0


def number(
    coder: Coder, kind: tuple[object, ...], context: int, signed: bool, value: int
) -> tuple[int, int]:
    """The number and the bit length of its magnitude."""
    name = str(kind[0])
    most = 2 ** DEPTH[name] - 1
    length = abs(value).bit_length()
    context = min(context, LAST_CONTEXT[name])
    short = tree(coder, (*kind, context), DEPTH[name], min(length, most))
    length = short
    if short == most:
        length += tree(coder, (*kind, "rare"), 6, max(abs(value).bit_length() - most, 0))
    if length > 62:
        raise Wrong
    if length == 0:
        return 0, 0
    rest = abs(value) % 2 ** (length - 1) + (2 ** (length - 1) if value < 0 else 0)
    rest = coder.plain(length - 1 + signed, rest)
    magnitude = 2 ** (length - 1) + rest % 2 ** (length - 1)
    return (-magnitude if rest >= 2 ** (length - 1) else magnitude), length


def one_parent(
    coder: Coder,
    parents: list[list[int]],
    i: int,
    slot: int,
    base: int,
    before: int,
    memory: dict[str, int],
) -> int:
    """Write or fill in one parent; returns where it is."""
    parent, first = parents[i][slot], parents[i][0]
    uncles = parents[first - base] if slot > 0 and first >= base else []
    if parent == -1:
        place = NONE
    elif parent in uncles:
        place = SHARED
    else:
        place = INSIDE if parent >= base else OUTSIDE
    place = tree(coder, ("place", slot > 0, before), 2, place)
    if place == NONE:
        parent = -1
    elif place == INSIDE:
        parent = base + i - number(coder, ("back",), slot > 0, False, base + i - parent)[0]
    elif place == OUTSIDE:
        last = memory["outside"]
        parent = memory["outside"] = last + number(coder, ("step",), 0, True, parent - last)[0]
    else:
        which = uncles.index(parent) if parent in uncles else 0
        which = tree(coder, ("which",), (len(parents[i]) - 1).bit_length(), which)
        if which >= len(uncles) or uncles[which] == -1 or uncles.index(uncles[which]) != which:
            raise Wrong
        parent = uncles[which]
    low, high = {INSIDE: (base, base + i - 1), OUTSIDE: (0, base - 1)}.get(place, (-1, base + i))
    if not low <= parent <= high or (place in (INSIDE, OUTSIDE) and parent in uncles):
        raise Wrong
    parents[i][slot] = parent
    return place


def walk(
    coder: Coder,
    position: list[list[int]],
    parents: list[list[int]],
    color: list[list[int]],
    base: int,
    starts: Row,
    colored: Row,
) -> None:
    """Write the columns, or fill them in."""
    memory = {"place": NONE, "outside": base}
    for i in range(len(position)):
        segment = max(s for s in range(len(colored)) if starts[s] <= i < starts[s + 1])
        start, places = starts[segment], [memory["place"]]
        for slot in range(len(parents[i])):
            places.append(one_parent(coder, parents, i, slot, base, places[-1], memory))
        memory["place"] = places[1] if parents[i] else NONE
        near = [parent - base for parent in parents[i] if parent >= base + start]
        j = near[0] if near else i - 1 if i > start else None
        lengths = [0]
        for axis in range(3):
            guess = 0 if j is None else position[j][axis]
            step = position[i][axis] - guess
            step, length = number(coder, ("axis", axis), lengths[-1], True, step)
            if abs(guess + step) > 2**29:
                raise Wrong
            position[i][axis] = guess + step
            lengths.append(length)
        if colored[segment]:
            _color(coder, color[i], [0, 0, 0] if j is None else color[j], max(lengths))


def _color(coder: Coder, own: list[int], other: list[int], context: int) -> None:
    shift = 0
    for channel, at in enumerate((1, 2, 0)):
        step = (own[at] - other[at] - shift + 128) % 256 - 128
        step, context = number(coder, ("channel", channel), context, True, step)
        if not -128 <= step <= 127:
            raise Wrong
        own[at] = (other[at] + shift + step) % 256
        shift = step if channel == 0 else shift


def encode(
    position: list[list[int]],
    parents: list[list[int]],
    base: int,
    starts: Row,
    color: list[list[int]],
    colored: Row,
) -> bytes:
    if not position:
        return b""
    coder = Writer()
    copies = ([list(row) for row in rows] for rows in (position, parents, color))
    walk(coder, *copies, base, starts, colored)
    return coder.end()


def decode(
    data: bytes, n: int, slots: int, base: int, starts: Row, colored: Row
) -> tuple[list[list[int]], list[list[int]], list[list[int]]] | None:
    """The columns, or None where `ok` is to be False."""
    position = [[0] * 3 for _ in range(n)]
    parents = [[-1] * slots for _ in range(n)]
    color = [[0] * 3 for _ in range(n)]
    try:
        if n == 0:
            return None if data else (position, parents, color)
        coder = Reader(data)
        walk(coder, position, parents, color, base, starts, colored)
        coder.end()
    except Wrong:
        return None
    return position, parents, color


def morton(points: list[list[int]]) -> list[int]:
    """Indices in Z order, by strings of bits."""

    def key(i: int) -> tuple[list[int], str]:
        shifted = [value + 2**19 for value in points[i]]
        bits = [f"{value % 2**20:020b}" for value in shifted]
        return [value // 2**20 for value in shifted], "".join(map("".join, zip(*bits, strict=True)))

    return sorted(range(len(points)), key=key)
