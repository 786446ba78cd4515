"""JAX's persistent compilation cache, in the user's cache folder."""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path

import jax
import platformdirs


def folder() -> Path:
    """Where compiled programs are kept: one folder for each kind of processor.

    Programs are compiled for the very processor, and JAX does not look whether what it finds was.
    """
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else [platform.processor()]
    # All cores of a machine are alike; their speeds and numbers are not.
    kind = sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))})
    digest = hashlib.sha256("\n".join(kind or lines).encode()).hexdigest()[:12]
    name = f"{platform.machine()}-{digest}"
    return platformdirs.user_cache_path("sacformer-jax") / "compiled" / name


def enable() -> Path | None:
    """Turns the cache on, unless the user has said something of it himself; where it is.

    JAX's own settings come first: ``JAX_COMPILATION_CACHE_DIR=FOLDER`` for another folder,
    ``JAX_ENABLE_COMPILATION_CACHE=false`` for none. A folder that cannot be written is no reason to
    stop: then there is no cache.
    """
    settings = jax.config.values
    if not settings["jax_enable_compilation_cache"]:
        return None
    if settings["jax_compilation_cache_dir"] is not None:
        return Path(settings["jax_compilation_cache_dir"])
    path = folder()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(path, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    # Many small programs are compiled at the start of a run, too.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    return path
