"""Bytes as trees of fields, so that a mutation changes one field and the rest stays in order.

A grammar is a function that reads a node from the front of a `Reader`. Where the bytes do not fit,
what is left becomes one raw field: every input has a tree, and `dump` of it is the input again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from random import Random

from dagmap import wire
from dagmap.wire import Reader, Refusal

Flip = Callable[[bytes], bytes]  # changes bytes somehow: libFuzzer's own mutation, or `flip` below
Special = Callable[[bytes, Random], bytes]  # changes the bytes of a labelled node with insight

EDGES = (0, 1, 2, 127, 128, 255, 4096, 4097, 1 << 16, (1 << 16) + 1, (1 << 31) - 1, 1 << 31)
EDGES += ((1 << 32) - 1, 1 << 32, (1 << 40) - 1, 1 << 40, 1 << 41, (1 << 48) - 1, 1 << 48)
EDGES += ((1 << 62) - 1, 1 << 62, (1 << 63) - 1, 1 << 63, 1 << 70)


@dataclass
class Leaf:
    """A field: `number` or `signed` (LEB128), or `raw` bytes."""

    kind: str
    value: int | bytes

    def dump(self) -> bytes:
        if isinstance(self.value, bytes):
            return self.value
        return wire.number(self.value) if self.kind == "number" else wire.signed(self.value)


@dataclass
class Branch:
    """Fields in a row: a plain `list`, or with the `count` of them or their `size` before it."""

    kind: str
    items: list[Node] = field(default_factory=list)
    label: str = ""

    def dump(self) -> bytes:
        body = b"".join(item.dump() for item in self.items)
        if self.kind == "size":
            return wire.number(len(body)) + body
        return wire.number(len(self.items)) + body if self.kind == "count" else body


Node = Leaf | Branch
Grammar = Callable[[Reader, list[Node]], Node]  # the second: the nodes before it in its record


def tree(data: bytes, grammar: Grammar) -> Branch:
    """The tree of any bytes."""
    reader = Reader(data)
    root = Branch("list", [])
    _take(reader, grammar, root)
    if reader.left:
        root.items.append(rest(reader, []))
    return root


def number(reader: Reader, _: list[Node]) -> Node:
    return Leaf("number", reader.number())


def signed(reader: Reader, _: list[Node]) -> Node:
    return Leaf("signed", reader.signed())


def rest(reader: Reader, _: list[Node]) -> Node:
    return Leaf("raw", reader.take(reader.left))


def raw(size: int) -> Grammar:
    return lambda reader, _: Leaf("raw", reader.take(size))


def record(*fields: Grammar, label: str = "") -> Grammar:
    """One field after the other."""

    def read(reader: Reader, _: list[Node]) -> Node:
        out = Branch("list", [], label)
        for grammar in fields:
            if not _take(reader, grammar, out):
                break
        return out

    return read


def many(item: Grammar) -> Grammar:
    """Items up to the end."""

    def read(reader: Reader, _: list[Node]) -> Node:
        out = Branch("list")
        while reader.left and _take(reader, item, out):
            pass
        return out

    return read


def counted(item: Grammar) -> Grammar:
    """Their number, then the items."""

    def read(reader: Reader, _: list[Node]) -> Node:
        count, out = reader.number(reader.left), Branch("count")
        while len(out.items) < count:
            out.items.append(item(reader, out.items))
        return out

    return read


def sized(item: Grammar) -> Grammar:
    """The size in bytes, then what fills it."""

    def read(reader: Reader, _: list[Node]) -> Node:
        return Branch("size", tree(reader.take(reader.number(reader.left)), item).items)

    return read


def when(test: Callable[[list[Node]], bool], item: Grammar) -> Grammar:
    """The item where the fields before it say that it is there."""
    return lambda reader, before: item(reader, before) if test(before) else Branch("list")


def by_kind(grammars: dict[int, Grammar], other: Grammar = rest, at: int = -1) -> Grammar:
    """The grammar that a field before chooses: a number or a raw byte, `at` in its record."""

    def read(reader: Reader, before: list[Node]) -> Node:
        node = before[at]
        value = node.value if isinstance(node, Leaf) else -1
        kind = value if isinstance(value, int) else int.from_bytes(value, "little")
        return grammars.get(kind, other)(reader, before)

    return read


def _take(reader: Reader, grammar: Grammar, out: Branch) -> bool:
    """Append what the grammar reads; where it cannot, all that is left, raw."""
    start = reader.at
    try:
        out.items.append(grammar(reader, out.items))
    except Refusal:
        reader.at = start
        out.items.append(rest(reader, []))
        return False
    return True


def places(root: Branch) -> Iterator[tuple[Branch, int]]:
    """Every node but the root, as (parent, index)."""
    for i, item in enumerate(root.items):
        yield root, i
        if isinstance(item, Branch):
            yield from places(item)


def labelled(root: Branch, label: str) -> list[Branch]:
    """The records of a label, in order."""
    nodes = (parent.items[i] for parent, i in places(root))
    return [node for node in nodes if isinstance(node, Branch) and node.label == label]


def mutate(
    root: Branch, rng: Random, flip: Flip, special: dict[str, Special] | None = None
) -> None:
    """Change one to three nodes in place; `special` changes records by their label."""
    for label, change in (special or {}).items():
        for node in labelled(root, label):
            if rng.random() < 0.3:
                node.items = [Leaf("raw", change(node.dump(), rng))]
    for _ in range(rng.choice((0, 1, 1, 2, 3) if special else (1, 1, 1, 2, 3))):
        found = list(places(root))
        if not found:
            return
        parent, i = rng.choice(found)
        node = parent.items[i]
        if isinstance(node, Leaf):
            _change_leaf(node, rng, flip, found)
        elif node.kind != "list" and rng.random() < 0.2:
            lie = Leaf("number", _other(len(node.items), rng))
            parent.items[i] = Branch("list", [lie, *node.items])
        if rng.random() < 0.3:
            _shuffle(parent, i, rng, found)


def _change_leaf(leaf: Leaf, rng: Random, flip: Flip, found: list[tuple[Branch, int]]) -> None:
    if isinstance(leaf.value, int):
        leaf.value = _other(leaf.value, rng)
    elif rng.random() < 0.4:  # an id or key from elsewhere in the tree
        alike = [parent.items[i] for parent, i in found]
        values = [n.value for n in alike if isinstance(n, Leaf) and isinstance(n.value, bytes)]
        leaf.value = rng.choice([v for v in values if len(v) == len(leaf.value)] or [b""])
    else:
        leaf.value = flip(leaf.value)


def _other(value: int, rng: Random) -> int:
    near = (value + 1, value - 1, value * 2, value ^ 1, rng.randrange(16))
    return abs(rng.choice(near if rng.random() < 0.5 else EDGES))


def _shuffle(parent: Branch, i: int, rng: Random, found: list[tuple[Branch, int]]) -> None:
    """Repeat, drop, swap or graft an item."""
    items, way = parent.items, rng.randrange(4)
    if way == 0 and len(items) < 64:
        items.insert(i, items[i])
    elif way == 1:
        del items[i]
    elif way == 2:
        j = rng.randrange(len(items))
        items[i], items[j] = items[j], items[i]
    else:
        other, j = rng.choice(found)
        if j < len(other.items):
            items[i] = tree(other.items[j].dump(), rest)  # a copy, so that no tree holds itself


def flipper(rng: Random) -> Flip:
    """Changes of bytes as libFuzzer makes them, for runs without it."""

    def flip(data: bytes) -> bytes:
        out = bytearray(data)
        for _ in range(rng.choice((1, 1, 2, 4))):
            _change_bytes(out, rng)
        return bytes(out)

    return flip


def _change_bytes(out: bytearray, rng: Random) -> None:
    at, way = rng.randrange(len(out) + 1), rng.randrange(6)
    if way == 0 or not out:
        out[at:at] = rng.randbytes(rng.choice((1, 1, 2, 8)))
    elif way == 1:
        del out[at : at + rng.choice((1, 1, 2, 8, 64))]
    elif way == 2:
        out[at : at + 4] = rng.choice((b"\0", b"\xff", b"\x80", b"\x7f")) * len(out[at : at + 4])
    elif way == 3:
        end = at + rng.randrange(1, 33)
        out[at:at] = out[at:end]
    else:
        out[at % len(out)] ^= 1 << rng.randrange(8)
