"""Test set-up: cheap compilation, since tests compile much and compute little."""

import os
import shutil
import tempfile

import pytest

os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "")
    + " --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)
os.environ.setdefault("JAX_PLATFORMS", "cpu")

# Tests neither read nor fill the user's compilation cache. They have one for the session, which
# pytest's workers and the processes that tests start inherit: many compile the same programs.
_FOLDER = "JAX_COMPILATION_CACHE_DIR"
_inherited = "PYTEST_XDIST_WORKER" in os.environ
if not _inherited:
    os.environ[_FOLDER] = tempfile.mkdtemp(prefix="sacformer-tests-")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"


def pytest_unconfigure(config: pytest.Config) -> None:
    """Removes the session's cache."""
    if not _inherited:
        shutil.rmtree(os.environ[_FOLDER], ignore_errors=True)
