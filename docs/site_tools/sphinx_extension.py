"""What Sphinx is given beside its own: pages made of the code, and math as MathML.

A line ``<!-- generated: NAME -->`` in a page stands for what :data:`GENERATED` makes of the code
when the site is built. Links to pages that lie elsewhere in the repository become links to the
pages of the site that show them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

from site_tools.generated import GENERATED, REPOSITORY, moved_links

_MARKER = re.compile(r"^<!-- generated: ([\w-]+)(?: ([\w./-]+))? -->$", re.MULTILINE)
_logger = logging.getLogger(__name__)


def expand(app: Sphinx, docname: str, source: list[str]) -> None:
    """Puts generated text in place of the markers, and site pages in place of repository files."""
    folder = Path(docname).parent

    def made(marker: re.Match[str]) -> str:
        name, argument = marker.groups()
        if name not in GENERATED:
            raise ExtensionError(f"{docname}: nothing generates {name!r}")
        return GENERATED[name](argument) if argument else GENERATED[name]()

    if docname.startswith("notebooks/"):
        return
    text = _MARKER.sub(made, source[0])
    source[0] = moved_links(text, REPOSITORY / "docs" / folder, REPOSITORY / "docs" / folder)


class AttributeDocs:
    """Keeps the string below an attribute as it is: Napoleon takes what stands before a colon in it
    for a type.
    """

    def __init__(self) -> None:
        self._kept: dict[str, list[str]] = {}

    def before(self, _app: Sphinx, what: str, name: str, *rest: Any) -> None:
        """Before Napoleon."""
        if what == "attribute":
            self._kept[name] = list(rest[-1])

    def after(self, _app: Sphinx, what: str, name: str, *rest: Any) -> None:
        """After it."""
        if what == "attribute":
            rest[-1][:] = self._kept.pop(name)


def _mathml(self: HTML5Translator, node: nodes.Element, block: bool) -> None:
    try:
        self.body.append(tex2mathml(node.astext(), as_block=block))
    except MathError as error:
        _logger.warning("math %r: %s", node.astext(), error, location=node)
    raise nodes.SkipNode


def visit_inline(self: HTML5Translator, node: nodes.math) -> None:
    """Math within a line."""
    _mathml(self, node, block=False)


def visit_block(self: HTML5Translator, node: nodes.math_block) -> None:
    """Math of its own."""
    _mathml(self, node, block=True)


def setup(app: Sphinx) -> dict[str, Any]:
    """Sphinx calls it."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    app.connect("source-read", expand)
    kept = AttributeDocs()
    app.connect("autodoc-process-docstring", kept.before, priority=100)
    app.connect("autodoc-process-docstring", kept.after, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
