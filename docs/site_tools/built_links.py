"""Looks at the links inside a built site: every file and every anchor must be there.

python -m site_tools.built_links docs/_build/html
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """The anchors of a page, and what it refers to.

    Attributes:
      anchors: what may stand after ``#``.
      references: targets of ``href`` and ``src``.
    """

    def __init__(self, text: str):
        super().__init__()
        self.anchors: set[str] = set()
        self.references: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Of one element."""
        for name, value in attrs:
            if value is None:
                continue
            if name == "id" or (tag == "a" and name == "name"):
                self.anchors.add(value)
            elif name in ("href", "src") and not (tag == "link" and "canonical" in value):
                self.references.add(value)


def broken(site: Path) -> list[str]:
    """A line for each reference inside the site that leads nowhere."""
    site = site.resolve()
    pages = {path: Page(path.read_text()) for path in sorted(site.rglob("*.html"))}
    problems = []
    for path, page in pages.items():
        for reference in sorted(page.references):
            parts = urlsplit(reference)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            where = f"{path.relative_to(site)}: {reference}"
            if not target.is_relative_to(site) or not target.exists():
                problems.append(f"{where}: no such file")
            elif (
                parts.fragment
                and target in pages
                and unquote(parts.fragment) not in {"", *pages[target].anchors}
            ):
                problems.append(f"{where}: no such anchor")
    return problems


def main(arguments: list[str]) -> int:
    """The command; returns the exit code."""
    (site,) = arguments
    problems = broken(Path(site))
    print("\n".join(problems) or f"{site}: every internal link leads somewhere")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
