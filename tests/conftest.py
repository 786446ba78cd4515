"""Test set-up: cheap compilation, since tests compile much and compute little."""

import mmap
import os
import shutil
import tempfile
from pathlib import Path

import jaxlib
import pytest
from compiling import QUICK_LOOPS

os.environ.setdefault("JAX_PLATFORMS", "cpu")

# Tests neither read nor fill the user's compilation cache. They have one for the session, which
# pytest's workers and the processes that tests start inherit: many compile the same programs.
_FOLDER = "JAX_COMPILATION_CACHE_DIR"
_inherited = "PYTEST_XDIST_WORKER" in os.environ


def _known_to_xla(flag: str) -> bool:
    """Whether it has this flag: one that it does not know ends the process."""
    for library in Path(jaxlib.__file__).parent.glob("libjax_common.*"):
        with (
            library.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as code,
        ):
            if code.find(flag.encode()) >= 0:
                return True
    return False


if not _inherited:
    flags = ["--xla_backend_optimization_level=0", "--xla_llvm_disable_expensive_passes=true"]
    # Loops are compiled by LLVM alone instead of MLIR and LLVM, in less than half the time.
    if _known_to_xla("xla_cpu_use_fusion_emitters"):
        flags.append(QUICK_LOOPS)
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags])
    os.environ[_FOLDER] = tempfile.mkdtemp(prefix="sacformer-tests-")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"


def pytest_unconfigure(config: pytest.Config) -> None:
    """Removes the session's cache."""
    if not _inherited:
        shutil.rmtree(os.environ[_FOLDER], ignore_errors=True)
