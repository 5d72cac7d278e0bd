"""For `make docs`: fields in docstrings, `name: what` a line, which Markdown would run together.

Such lines become a list; what is indented below one belongs to it.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

_FIELD = re.compile(r"(\w+(?:, \w+)*): ")


class Fields(griffe.Extension):
    """Rewrites every docstring that is loaded."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = listed(obj.docstring.value)


def listed(text: str) -> str:
    """The same text with its fields as a Markdown list."""
    out: list[str] = []
    inside = False
    for line in text.splitlines():
        field = _FIELD.match(line)
        if field:
            out += [] if inside else [""]
            line = f"- `{field[1]}`: {line[field.end() :]}"
        elif inside and line and not line.startswith(" "):
            out.append("")
        inside = bool(field) or (inside and line.startswith(" "))
        out.append(line)
    return "\n".join(out)
