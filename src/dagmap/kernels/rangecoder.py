"""The kernels of `codec.py`: columns of features through an adaptive binary range coder.

One walk over the columns serves both directions: each step hands the coder a value to write or
gets back the value read, so encoder and decoder cannot disagree about the model.
"""

from __future__ import annotations

import numpy as np

from ..model import LIMIT_MM, Int32s, Int64s, Uint8s
from .jit import leaf

MAX_SLOTS = 8  # parents of a feature, at most
_LIMIT = LIMIT_MM

# A model is one word: the chance in 2^-16 that the bit is 0, times 128, plus how often it was used.
# The nth use moves the chance by 1 / (n + 1.6) of the way.
FRESH = (1 << 15) << 7
_MOST_USES = 127
_RATES = np.array([65536 * 5 // (5 * n + 8) for n in range(_MOST_USES + 1)], np.int64)

# Where a parent is: there is none, in this bundle, before it, or it is one of the first parent's.
_NONE, _INSIDE, _OUTSIDE, _SHARED = 0, 1, 2, 3

# Kinds of numbers: distance to a parent inside, step to one outside, x, y, z, G, B - G, R - G.
# Each has a tree per context for bit lengths under 2^depth - 1, and one tree for what is longer.
_BACK, _AXIS, _CHANNEL = 0, 2, 5
_CONTEXTS = np.array([2, 1, 16, 16, 16, 12, 12, 12], np.int64)
_DEPTH = np.array([3, 4, 4, 4, 4, 3, 3, 3, 6, 2], np.int64)  # of trees, then of these two:
_RARE, _WHERE = 8, 9  # bit lengths that are longer; the place of a parent
_SIZES = (_CONTEXTS << _DEPTH[:_RARE]) + (1 << _DEPTH[_RARE])
# Where the models start: of each kind; [8] of places, [9] of which of the first parent's; [10] end.
_TREES = np.cumsum(np.concatenate([[0], _SIZES, [2 * 4 * 4, MAX_SLOTS]]))
MODELS = int(_TREES[10])
_BYTE_LENGTHS = np.array([value.bit_length() for value in range(256)], np.int64)

# Slots of the coder's state.
_LOW = 0  # encoding: low end of the interval; decoding: how far the code lies above it
_RANGE = 1
AT = 2  # the next byte of data; a decoder may ask for more than there are
DECODING = 3
FAILED = 4  # no valid columns, or no bytes that an encoder writes
_LENGTH = 5  # bit length of the number before: the context of the next
_PLACE = 6  # of the first parent of the feature before
_LAST = 7  # the last parent outside the bundle
STATE = 8


@leaf
def _renew(data: Uint8s, low: int, width: int, at: int, decoding: int) -> tuple[int, int, int]:
    """Move bytes until the range has 25 bits again. An encoder's low may hold a carry, bit 32."""
    while width < 1 << 24:
        width <<= 8
        if decoding:
            low = (low << 8) | (int(data[at]) if at < len(data) else 0)
        else:
            if low >> 32:
                before = at - 1
                while int(data[before]) == 255:
                    data[before] = 0
                    before -= 1
                data[before] = int(data[before]) + 1
            data[at] = (low >> 24) & 255
            low = (low & 0xFFFFFF) << 8
        at += 1
    return low, width, at


@leaf
def _tree(state: Int64s, models: Int32s, data: Uint8s, base: int, depth: int, value: int) -> int:
    """A number of `depth` bits, each by an adaptive model in the context of those before it."""
    low, width, at = int(state[_LOW]), int(state[_RANGE]), int(state[AT])
    decoding = int(state[DECODING])
    node = 1
    for shift in range(depth - 1, -1, -1):
        model = np.uint64(base + node)  # unsigned: saves numba the look at negative indices
        word = int(models[model])
        uses = word & _MOST_USES
        chance, rate = word >> 7, int(_RATES[np.uint64(uses)])
        bound = (width * chance) >> 16
        bit = (value >> shift) & 1
        if decoding:
            bit = 0 if low < bound else 1
        if bit == 0:
            width = bound
            chance += ((65536 - chance) * rate) >> 16
        else:
            width -= bound
            low += -bound if decoding else bound
            chance -= (chance * rate) >> 16
        models[model] = (chance << 7) | (uses + 1 if uses < _MOST_USES else uses)
        node = (node << 1) | bit
        if width < 1 << 24:
            low, width, at = _renew(data, low, width, at, decoding)
    state[_LOW], state[_RANGE], state[AT] = low, width, at
    return node - (1 << depth)


@leaf
def _plain(state: Int64s, data: Uint8s, count: int, value: int) -> int:
    """`count` bits without a model, the highest first, eight at a time."""
    low, width, at = int(state[_LOW]), int(state[_RANGE]), int(state[AT])
    decoding = int(state[DECODING])
    out = 0
    while count > 0:
        step = 8 if count > 8 else count
        count -= step
        width >>= step
        part = (value >> count) & ((1 << step) - 1)
        if decoding:
            part = low // width
            if part >> step:  # in the remainder of the division: no encoder goes there
                state[FAILED] = 1
                part = low = 0
            low -= part * width
        else:
            low += part * width
        out = (out << step) | part
        low, width, at = _renew(data, low, width, at, decoding)
    state[_LOW], state[_RANGE], state[AT] = low, width, at
    return out


@leaf
def _bit_length(value: int) -> int:
    length = 0
    while value >> 8:
        value >>= 8
        length += 8
    return length + int(_BYTE_LENGTHS[value])


@leaf
def _length(state: Int64s, models: Int32s, data: Uint8s, kind: int, length: int) -> int:
    """A bit length by the trees of its kind; it becomes the context of the next."""
    depth = int(_DEPTH[kind])
    most = (1 << depth) - 1
    context, last = int(state[_LENGTH]), int(_CONTEXTS[kind]) - 1
    tree = int(_TREES[kind]) + ((context if context < last else last) << depth)
    short = _tree(state, models, data, tree, depth, length if length < most else most)
    if short == most:
        rare = int(_TREES[kind + 1]) - (1 << int(_DEPTH[_RARE]))
        short += _tree(state, models, data, rare, int(_DEPTH[_RARE]), length - most)
        if short > 62:
            state[FAILED] = 1
            short = 0
    state[_LENGTH] = short
    return short


@leaf
def _number(state: Int64s, models: Int32s, data: Uint8s, kind: int, value: int) -> int:
    """A number: its bit length by models; its sign (a distance has none) and the rest plain."""
    magnitude = -value if value < 0 else value
    length = _length(state, models, data, kind, _bit_length(magnitude))
    if length == 0:
        return 0
    signed = 0 if kind == _BACK else 1
    lead = 1 << (length - 1)
    rest = (lead if value < 0 else 0) | (magnitude & (lead - 1))
    rest = _plain(state, data, length - 1 + signed, rest)
    magnitude = lead | (rest & (lead - 1))
    return -magnitude if rest & lead else magnitude


@leaf
def _shared(parents: Int64s, i: int, slot: int, base: int) -> int:
    """Which of the first parent's parents (i, slot) is, if that one is in this bundle; else -1."""
    first, parent = int(parents[i, 0]) - base, int(parents[i, slot])
    if slot > 0 and first >= 0 and parent >= 0:
        for which in range(parents.shape[1]):
            if int(parents[first, which]) == parent:
                return which
    return -1


@leaf
def _code_parent(
    state: Int64s, models: Int32s, data: Uint8s, parents: Int64s, i: int, slot: int, base: int
) -> None:
    """One parent of feature i; the slots before it are known."""
    number = base + i
    parent = int(parents[i, slot])
    if parent < -1 or parent >= number:
        state[FAILED] = 1
        parent = parents[i, slot] = -1
    which = _shared(parents, i, slot, base)
    place = _NONE if parent < 0 else _INSIDE if parent >= base else _OUTSIDE
    later = 1 if slot > 0 else 0
    tree = int(_TREES[8]) + (later * 4 + int(state[_PLACE])) * 4
    place = _SHARED if which >= 0 else place
    place = _tree(state, models, data, tree, int(_DEPTH[_WHERE]), place)
    state[_PLACE] = place
    state[_LENGTH] = later
    if place == _NONE:
        parent = -1
    elif place == _SHARED:
        slots, first = parents.shape[1], int(parents[i, 0]) - base
        which = _tree(state, models, data, int(_TREES[9]), _bit_length(slots - 1), which)
        known = slot > 0 and first >= 0 and which < slots
        parent = int(parents[first, which]) if known else -2
    else:
        last = int(state[_LAST])
        value = number - parent if place == _INSIDE else parent - last
        value = _number(state, models, data, place - 1, value)  # kinds 0 and 1
        parent = number - value if place == _INSIDE else last + value
        if parent < 0 or parent >= number or (parent >= base) != (place == _INSIDE):
            parent = -2
        elif place == _OUTSIDE:
            state[_LAST] = parent
    parents[i, slot] = parent
    if parent < -1 or (parent == -1) != (place == _NONE):
        state[FAILED] = 1
        parents[i, slot] = -1
    elif _shared(parents, i, slot, base) != (which if place == _SHARED else -1):
        state[FAILED] = 1  # an encoder would have said it otherwise


@leaf
def _code_parents(
    state: Int64s, models: Int32s, data: Uint8s, parents: Int64s, i: int, base: int
) -> None:
    """All parents of feature i; the place of the first is the context of the next feature's."""
    first = 0
    for slot in range(parents.shape[1]):
        _code_parent(state, models, data, parents, i, slot, base)
        if slot == 0:
            first = int(state[_PLACE])
    state[_PLACE] = first


@leaf
def _neighbour(row: Int64s, i: int, base: int, start: int) -> int:
    """The feature that i is predicted from, -1 for none."""
    for slot in range(len(row)):
        if int(row[slot]) >= base + start:
            return int(row[slot]) - base
    return i - 1 if i > start else -1


@leaf
def _code_position(
    state: Int64s, models: Int32s, data: Uint8s, position: Int32s, i: int, j: int
) -> None:
    """The position of feature i; leaves the largest bit length of its differences to j."""
    largest = 0
    state[_LENGTH] = 0
    for axis in range(3):
        guess = int(position[j, axis]) if j >= 0 else 0
        step = int(position[i, axis]) - guess
        step = _number(state, models, data, _AXIS + axis, step)
        if guess + step < -_LIMIT or guess + step > _LIMIT:
            state[FAILED] = 1
            step = -guess
        position[i, axis] = guess + step
        if int(state[_LENGTH]) > largest:
            largest = int(state[_LENGTH])
    state[_LENGTH] = largest


@leaf
def _code_color(state: Int64s, models: Int32s, data: Uint8s, color: Uint8s, i: int, j: int) -> None:
    """The colour of feature i: G, then B and R against G, each against the neighbour's, mod 256."""
    shift = 0  # of the true G against the neighbour's: B and R are expected to shift alike
    for channel in range(3):
        at = (channel + 1) % 3  # G, B, R
        guess = (int(color[j, at]) if j >= 0 else 0) + shift
        step = ((int(color[i, at]) - guess + 128) & 255) - 128
        step = _number(state, models, data, _CHANNEL + channel, step)
        if step < -128 or step > 127:
            state[FAILED] = 1
            step = 0
        color[i, at] = (guess + step) & 255
        if channel == 0:
            shift = step


@leaf
def _begin(state: Int64s, data: Uint8s) -> None:
    state[_RANGE] = 1 << 32
    if int(state[DECODING]):  # four bytes come in first, as four go out last
        for at in range(4):
            byte = int(data[at]) if at < len(data) else 0
            state[_LOW] = (int(state[_LOW]) << 8) | byte
        state[AT] = 4


@leaf
def _end(state: Int64s, data: Uint8s) -> None:
    low, width, at = int(state[_LOW]), int(state[_RANGE]), int(state[AT])
    decoding = int(state[DECODING])
    if decoding:
        if low != 0 or at != len(data):
            state[FAILED] = 1
        return
    for _ in range(4):  # each time the range shrinks by a byte, and one byte of low goes out
        low, width, at = _renew(data, low, width >> 8, at, decoding)
    state[AT] = at


@leaf
def walk(
    state: Int64s,
    models: Int32s,
    data: Uint8s,
    position: Int32s,
    parents: Int64s,
    color: Uint8s,
    starts: Int64s,
    colored: Uint8s,
    base: int,
) -> None:
    """All features in order, written or read; stops where it has failed."""
    _begin(state, data)
    state[_LAST] = base
    segment = 0
    for i in range(position.shape[0]):
        while i >= int(starts[segment + 1]):
            segment += 1
        _code_parents(state, models, data, parents, i, base)
        j = _neighbour(parents[i], i, base, int(starts[segment]))
        _code_position(state, models, data, position, i, j)
        if int(colored[segment]):
            _code_color(state, models, data, color, i, j)
        if int(state[FAILED]) or int(state[AT]) > len(data):
            break
    _end(state, data)
