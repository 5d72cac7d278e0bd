"""For `make docs`: what is said of fields, where mkdocstrings does not look for it.

In docstrings fields are `name: what`, a line each, which Markdown would run together: they become a
list. Of the fields of a class their comments become the docstrings.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import griffe

_FIELD = re.compile(r"(\w+(?:, \w+)*): ")


class Fields(griffe.Extension):
    """Rewrites every docstring that is loaded."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.is_attribute and obj.docstring is None and obj.parent and obj.parent.is_class:
            if said := comment(obj):
                obj.docstring = griffe.Docstring(said, parent=obj)
        elif obj.docstring is not None:
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


def comment(obj: griffe.Object) -> str:
    """What stands behind a field, and in the lines before it."""
    if obj.lineno is None or not isinstance(obj.filepath, Path):
        return ""
    lines = obj.lines_collection[obj.filepath]
    found, at = [], obj.lineno - 2
    while at >= 0 and lines[at].strip().startswith("# "):
        found.insert(0, lines[at].strip()[2:])
        at -= 1
    _, mark, behind = lines[(obj.endlineno or obj.lineno) - 1].partition("  # ")
    return " ".join([*found, behind] if mark else found)
