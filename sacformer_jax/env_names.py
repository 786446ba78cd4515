"""Environments of one's own by name: ``"module:attribute"``, or registered in this process.

Here a name is only looked up. What kinds of objects are environments is
:mod:`sacformer_jax.envs.own`'s to know.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
import os
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

from sacformer_jax.values import ConfigError

RESERVED_PREFIXES = ("brax", "playground", "gym")
"""``brax:NAME`` and the like are suites, never modules."""

_REGISTERED: dict[str, Any] = {}


def register(name: str, env: Any, replace: bool = False) -> None:
    """Makes ``env`` known as ``name`` in this process; see ``sacformer_jax.register_env``.

    Raises:
      ConfigError: the name has a colon, or is registered already and ``replace`` is false.
    """
    if not name or ":" in name:
        raise ConfigError(
            f"register_env: name={name!r}: must be a word without a colon; names with one are "
            "suites (brax:NAME) or places in modules (my_tasks:reach)"
        )
    if name in _REGISTERED and not replace:
        raise ConfigError(
            f"register_env: name={name!r}: is registered already; choose another, or replace=True"
        )
    _REGISTERED[name] = env
    find.cache_clear()


def registered() -> list[str]:
    """The names registered in this process."""
    return list(_REGISTERED)


def is_own(name: str) -> bool:
    """Whether the name is registered, or a place in a module."""
    prefix, colon, _ = name.partition(":")
    return name in _REGISTERED or (bool(colon) and prefix not in RESERVED_PREFIXES)


@functools.cache
def find(name: str) -> Any:
    """What an own name stands for; what makes environments is called, once in a process.

    Raises:
      ConfigError: there is no such module or attribute, or it needs arguments.
    """
    found = _REGISTERED[name] if name in _REGISTERED else _imported(name)
    return called(name, found) if is_factory(found) else found


def own_limit(name: str) -> int | None:
    """The time limit of an own environment, in its steps, where it says one."""
    env = find(name)
    if hasattr(env, "mjx_model") and hasattr(env, "_config"):
        return playground_limit(env._config)
    limit = getattr(env, "max_episode_steps", None) or getattr(
        getattr(env, "spec", None), "max_episode_steps", None
    )
    return limit if isinstance(limit, int) else None


def playground_limit(config: Any) -> int:
    """Of a Playground environment's configuration, in steps of ours: ``action_repeat`` of its own;
    1,000 of those where it says nothing.
    """
    return -(-int(config.get("episode_length", 1_000)) // int(config.get("action_repeat", 1)))


def is_factory(found: Any) -> bool:
    """Whether it makes environments: a class, or a function."""
    return isinstance(found, type) or (callable(found) and not hasattr(found, "reset"))


def called(name: str, factory: Callable[[], Any]) -> Any:
    """What the factory makes.

    Raises:
      ConfigError: it cannot be called without arguments.
    """
    try:
        signature = inspect.signature(factory)
    except ValueError:  # what is built in may not tell
        return factory()
    try:
        signature.bind()
    except TypeError as error:
        raise ConfigError(
            f"env={name!r}: cannot be called without arguments ({error}); name a function that "
            "needs none"
        ) from error
    return factory()


def _imported(name: str) -> Any:
    module_name, _, attribute = name.partition(":")
    if module_name.endswith(".py"):
        right = f"{module_name.removesuffix('.py').replace('/', '.')}:{attribute}"
        raise ConfigError(f"env={name!r}: name the module, not its file: {right}")
    parts = [*module_name.split("."), *attribute.split(".")]
    if not all(part.isidentifier() for part in parts):
        raise ConfigError(
            f"env={name!r}: must be MODULE:ATTRIBUTE, both as in Python's import, such as "
            "my_tasks:reach for reach in my_tasks.py"
        )
    module = _module(name, module_name)
    found: Any = module
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise ConfigError(f"env={name!r}: {_missing(module, found, part)}")
        found = getattr(found, part)
    return found


def _module(name: str, module_name: str) -> ModuleType:
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.insert(0, here)  # as `python -m` does
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if module_name != missing and not module_name.startswith(f"{missing}."):
            raise ConfigError(
                f"env={name!r}: module {module_name!r} imports {missing!r}, which is not installed"
            ) from error
        raise ConfigError(
            f"env={name!r}: there is no module {missing!r}, neither in {here!r} nor installed; run "
            "this in the folder where it is, put that on PYTHONPATH, or install it"
        ) from error


def _missing(module: ModuleType, holder: Any, part: str) -> str:
    public = [
        known
        for known, value in vars(holder).items()
        if not known.startswith("_")
        and not isinstance(value, ModuleType)
        # What the module has imported from elsewhere is not meant.
        and not (callable(value) and getattr(value, "__module__", None) != module.__name__)
    ]
    close = difflib.get_close_matches(part, public, n=3)
    if close:
        hint = f"did you mean {' or '.join(map(repr, close))}?"
    else:
        hint = f"it has {', '.join(public[:20]) or 'nothing public'}"
    where = f"module {module.__name__!r} ({module.__file__})"
    return f"{where if holder is module else f'what it names in {where}'} has no {part!r}; {hint}"
