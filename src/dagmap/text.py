"""What the name of a robot may hold: a rule on code points that no version of Python changes.

`str.isprintable` asks the Unicode tables of the Python that runs, so robots of different versions
would accept different transactions.
"""

from __future__ import annotations

import re

# Controls, separators of lines, marks that reorder what stands around them, the byte order mark,
# surrogates, and the last two code points of every plane with the 32 others that are no characters.
_REFUSED = (
    (0x0000, 0x001F),
    (0x007F, 0x009F),
    (0x061C, 0x061C),
    (0x200E, 0x200F),
    (0x2028, 0x2029),
    (0x202A, 0x202E),
    (0x2066, 0x2069),
    (0xD800, 0xDFFF),
    (0xFDD0, 0xFDEF),
    (0xFEFF, 0xFEFF),
    *((plane << 16 | 0xFFFE, plane << 16 | 0xFFFF) for plane in range(17)),
)
_FOUND = re.compile("[" + "".join(f"{chr(a)}-{chr(b)}" for a, b in _REFUSED) + "]")


def printable(text: str) -> bool:
    """Whether every character may stand in a name (docs/protocol.md, Names)."""
    return _FOUND.search(text) is None
