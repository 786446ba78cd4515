"""Programs compiled with the loops that users get, where a test asks for the same bits.

Under what `conftest.py` sets, a sum may be made in another order in a program for several members
than in the program for one.
"""

from __future__ import annotations

import os
from typing import Any

QUICK_LOOPS = "--xla_cpu_use_fusion_emitters=false"


def with_users_loops(program: Any, *arguments: Any) -> Any:
    """``program``, something jitted, compiled for such arguments."""
    quick = QUICK_LOOPS in os.environ.get("XLA_FLAGS", "")
    options = {"xla_cpu_use_fusion_emitters": True} if quick else None
    return program.lower(*arguments).compile(compiler_options=options)


def users_flags() -> str:
    """``XLA_FLAGS`` of a process that compiles so."""
    return os.environ.get("XLA_FLAGS", "").replace(QUICK_LOOPS, "")
