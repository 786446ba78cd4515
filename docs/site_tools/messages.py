"""The messages in the source, to compare with those that the troubleshooting page quotes."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

GAP = "…"
"""In a quoted message, for what differs."""


def _parts(node: ast.expr) -> str | None:
    """A string with a gap for each value in it; None if it is no string."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(
            GAP if isinstance(value, ast.FormattedValue) else str(_parts(value))
            for value in node.values
        )
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = _parts(node.left), _parts(node.right)
        if left is None and right is None:
            return None
        return (left or GAP) + (right or GAP)
    return None


def in_source(folder: Path) -> Iterator[str]:
    """Every string in the modules of a package, with gaps."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.expr) and (text := _parts(node)):
                yield text


def says(source: str, quoted: str) -> bool:
    """Whether a message of the source can read as quoted: its gaps filled with anything."""
    pattern = ".*".join(re.escape(part) for part in re.split(f"{GAP}+", source))
    return re.fullmatch(pattern, quoted, re.DOTALL) is not None


def quoted(page: str) -> list[str]:
    """The messages in the ``text`` blocks of a page that are of one line."""
    blocks = re.findall(r"^```text\n([^\n]+)\n```$", page, re.MULTILINE)
    return [block.removeprefix("error: ") for block in blocks]
