"""Text of the site that is made of the code: configuration, command line, files shown as pages."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import inspect
import io
import itertools
import os
import re
import textwrap
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

from sacformer_jax import cli, config, presets

REPOSITORY = Path(__file__).resolve().parents[2]

SHOWN_ELSEWHERE = {
    "README.md": "docs/index.md",
    "CHANGELOG.md": "docs/changelog.md",
    "CONTRIBUTING.md": "docs/contributing.md",
    "experiments/README.md": "docs/reproducing.md",
}
"""Files of the repository that are pages of the site, and which."""

_LINK = re.compile(r"(!?\[[^\]]*\]\()([^)\s#]+)(#[^)\s]*)?(\))")


def moved_links(text: str, origin: Path, place: Path) -> str:
    """Markdown whose relative links, written for the folder ``origin``, hold in ``place``."""

    def moved(link: re.Match[str]) -> str:
        start, target, anchor, end = link.groups(default="")
        if "://" in target or target.startswith(("mailto:", "<")):
            return link.group()
        file = (origin / target).resolve()
        if not file.is_relative_to(REPOSITORY):
            return link.group()
        inside = file.relative_to(REPOSITORY).as_posix()
        file = REPOSITORY / SHOWN_ELSEWHERE.get(inside, inside)
        if file.suffix == ".md" and not file.is_relative_to(REPOSITORY / "docs"):
            start += "path:"  # to be downloaded, as other files are
        return f"{start}{os.path.relpath(file, place)}{anchor}{end}"

    return _LINK.sub(moved, text)


def repository_file(path: str) -> str:
    """A Markdown file of the repository, as a page of the site."""
    file = REPOSITORY / path
    return moved_links(file.read_text(), file.parent, REPOSITORY / "docs")


def field_docs(section: type) -> dict[str, str]:
    """The string below each field of a dataclass."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(section)))
    (body,) = (node.body for node in tree.body if isinstance(node, ast.ClassDef))
    docs = {}
    for field, below in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
            assert isinstance(field.target, ast.Name)
            docs[field.target.id] = ast.literal_eval(below.value)
    return docs


def type_name(kind: Any) -> str:
    """A type as a user reads it: ``float``, ``"mlp" or "transformer"``."""
    if kind is type(None):
        return "None"
    if typing.get_origin(kind) is typing.Literal:
        return " or ".join(f"`{value}`" for value in typing.get_args(kind))
    if typing.get_origin(kind) is tuple:
        return f"{type_name(typing.get_args(kind)[0])}, several"
    if arguments := typing.get_args(kind):
        return " or ".join(type_name(argument) for argument in arguments)
    return str(kind.__name__)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def configuration() -> str:
    """A table of each section of the configuration, then what each preset sets and why."""
    hints = typing.get_type_hints(config.Config)
    sections: dict[str, Any] = {
        name: kind for name, kind in hints.items() if dataclasses.is_dataclass(kind)
    }
    lines = ["## The top", "", f"{inspect.getdoc(config.Config)}", "", *_table(config.Config)]
    for name, kind in sections.items():
        lines += ["", f"## {name}", "", f"{inspect.getdoc(kind)} (`config.{name}` in Python.)", ""]
        lines += _table(kind)
    for name in presets.PRESETS:
        lines += ["", f"## Preset {name}", "", *_layers(name)]
    return "\n".join(lines)


def _table(section: type) -> list[str]:
    docs, hints = field_docs(section), typing.get_type_hints(section)
    rows = ["| field, flag | type | default | in presets | |", "| --- | --- | --- | --- | --- |"]
    for field in dataclasses.fields(section):
        if dataclasses.is_dataclass(hints[field.name]):
            continue
        cells = (
            f"`{field.name}`<br>`--{field.name.replace('_', '-')}`",
            type_name(hints[field.name]),
            f"`{field.default!r}`",
            "<br>".join(_set_by_presets(field.name)),
            docs[field.name],
        )
        rows.append(f"| {' | '.join(_cell(cell) for cell in cells)} |")
    return rows


def _set_by_presets(field: str) -> list[str]:
    """The values that layers of presets give a field, each with a link to the layer."""
    return [
        f"`{layer.values[field]!r}` [{_name(preset, layer)}](#layer-{preset}-{number})"
        for preset, layers in presets.PRESETS.items()
        for number, layer in enumerate(layers, 1)
        if field in layer.values
    ]


def _name(preset: str, layer: presets.Layer) -> str:
    return " ".join([preset, *filter(None, (layer.agent, layer.env))])


def _layers(preset: str) -> list[str]:
    """What each layer of a preset sets, for whom, and its source."""
    lines = []
    for number, layer in enumerate(presets.PRESETS[preset], 1):
        conditions = (("agent", layer.agent), ("env", layer.env))
        fits = [f"`{key}={value}`" for key, value in conditions if value is not None]
        values = ", ".join(f"`{key}={value!r}`" for key, value in layer.values.items())
        lines += [f"(layer-{preset}-{number})=", f"**{' and '.join(fits) or 'All'}**: {values}."]
        lines += ["", f"*{_cell(layer.source)}*", ""]
    return lines


def commands() -> dict[str, str]:
    """Each command and what it does, as ``sacformer --help`` lists them."""
    return dict(re.findall(r"^  (\w+) +(.+)$", cli._USAGE, re.MULTILINE))


def help_text(arguments: list[str]) -> str:
    """What ``sacformer ARGUMENTS --help`` prints, without colours, 96 columns wide."""
    printed = io.StringIO()
    environment = {"COLUMNS": "96", "NO_COLOR": "1", "TERM": "dumb"}
    with (
        mock.patch.dict(os.environ, environment),
        contextlib.redirect_stdout(printed),
        contextlib.suppress(SystemExit),
    ):
        cli.main([*arguments, "--help"])
    lines = re.sub(r"\x1b\[[0-9;]*m", "", printed.getvalue()).splitlines()
    return "\n".join(line.rstrip() for line in lines)


def command_line() -> str:
    """A section for each command with its help."""
    lines = ["## sacformer", "", "```text", help_text([]), "```"]
    for name, what in commands().items():
        lines += ["", f"## sacformer {name}", "", f"{what[0].upper()}{what[1:]}.", ""]
        lines += ["```text", help_text([name]), "```"]
    return "\n".join(lines)


GENERATED: dict[str, Callable[..., str]] = {
    "configuration": configuration,
    "command-line": command_line,
    "file": repository_file,
}
"""What a marker in a page may ask for."""
