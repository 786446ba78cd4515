"""Links and file names in the repository's Markdown, as a reader of the repository follows them.

The site is checked when it is built; this looks at the files as they lie there, README.md included.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

from markdown_it import MarkdownIt
from markdown_it.token import Token

_ROOTS = (".", "sacformer_jax", "docs", "experiments")
"""Where a file named in the text may lie."""
_NAMED = re.compile(r"^(?:[\w.-]+/)+[\w.-]+\.(?:py|md|json|csv|png|svg|sh|yml|toml|ipynb|cff)$")
_STANDS_FOR = re.compile(r"\b(?:RUN|STUDY|NAME)\b")
"""In a path that stands for many."""
_ANCHOR = re.compile(r"^\((?P<name>[\w-]+)\)=$", re.MULTILINE)


def text_of(path: Path) -> str:
    """The Markdown of a page, or of a notebook's cells."""
    if path.suffix == ".ipynb":
        cells = json.loads(path.read_text())["cells"]
        return "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    return path.read_text()


def _tokens(text: str) -> Iterator[Token]:
    """All tokens, those within lines, too."""
    for token in MarkdownIt("commonmark").enable("table").parse(text):
        yield token
        yield from token.children or ()


def slug(heading: str) -> str:
    """The anchor that GitHub (and MyST) makes of a heading."""
    kept = re.sub(r"[^\w\- ]", "", heading.strip().lower())
    return kept.replace(" ", "-")


def anchors(text: str) -> set[str]:
    """What may stand after ``#``: the headings, each second of a name numbered."""
    found: set[str] = set()
    counts: dict[str, int] = {}
    tokens = list(MarkdownIt("commonmark").enable("table").parse(text))
    for opening, inline in itertools.pairwise(tokens):
        if opening.type == "heading_open":
            words = "".join(t.content for t in inline.children or () if t.type != "html_inline")
            name = slug(words)
            count = counts.get(name, 0)
            counts[name] = count + 1
            found.add(f"{name}-{count}" if count else name)
    return found | set(_ANCHOR.findall(text))


def _shown(path: Path, root: Path) -> str:
    """The text of a page; of one that shows another file, that file's."""
    text = text_of(path)
    shown = re.search(r"<!-- generated: file ([\w./-]+) -->", text)
    return (root / shown[1]).read_text() if shown else text


def _is_there(text: str, root: Path) -> bool:
    """Whether what stands in a code span is no path of a file, or one that exists."""
    if not _NAMED.match(text) or _STANDS_FOR.search(text):
        return True
    return any((root / place / text).exists() for place in _ROOTS)


def problems(path: Path, root: Path) -> list[str]:
    """A line for each link, picture or file name in a page that leads nowhere.

    Args:
      path: the page.
      root: the repository.
    """
    found = []
    for token in _tokens(text_of(path)):
        if token.type == "code_inline" and not _is_there(token.content, root):
            found.append(f"`{token.content}`: no such file")
        target = token.attrGet("href") or token.attrGet("src")
        if not isinstance(target, str) or re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        place = (path.parent / unquote(file)).resolve() if file else path
        if not place.exists() or not place.is_relative_to(root):
            found.append(f"{target}: no such file")
        elif anchor and anchor not in anchors(_shown(place, root)):
            found.append(f"{target}: no such anchor")
    return [f"{path.relative_to(root)}: {problem}" for problem in found]
