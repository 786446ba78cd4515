"""Checking the type of a setting's value, and the error that says what is wrong."""

from __future__ import annotations

import difflib
import math
import types as python_types
import typing
from typing import Any, Literal


class ConfigError(ValueError):
    """A setting that cannot work; the message names field, value and what would be right."""


def unknown(what: str, name: str, known: Any) -> str:
    """What to say of a name that does not exist."""
    close = difflib.get_close_matches(name, list(known), n=1)
    hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
    return f"{what} {name!r} does not exist; {hint}"


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or its type where it has none."""
    return (str(error) or type(error).__name__).splitlines()[0]


def _alternatives(union: Any) -> tuple[tuple[Any, ...], Any]:
    """The words (or None) and the one number type that a union allows."""
    words: list[Any] = []
    for member in typing.get_args(union):
        if typing.get_origin(member) is Literal:
            words += typing.get_args(member)
        elif member is type(None):
            words.append(None)
        else:
            kind = member
    return tuple(words), kind


def coerced(name: str, value: Any, kind: Any) -> Any:
    """``value`` as the field's type, where nothing is lost by it."""
    if kind == int | tuple[int, ...]:
        if isinstance(value, list | tuple):
            return tuple(coerced(name, each, int) for each in value)
        kind = int
    if isinstance(kind, python_types.UnionType) or typing.get_origin(kind) is typing.Union:
        words, kind = _alternatives(kind)
        if value is None or isinstance(value, str):
            if value in words:
                return value
            other = "".join(f", or {word!r}" for word in words)
            raise ConfigError(f"{name}={value!r}: must be of type {kind.__name__}{other}")
    if typing.get_origin(kind) is Literal:
        choices = typing.get_args(kind)
        if value not in choices:
            raise ConfigError(f"{name}={value!r}: must be one of {', '.join(map(str, choices))}")
        return value
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) < 2**1000 else math.inf
    if kind is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ConfigError(f"{name}={value!r}: must be of type {kind.__name__}")
    if kind is float and not math.isfinite(value):
        raise ConfigError(f"{name}={value!r}: must be a finite number")
    return value
