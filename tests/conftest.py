"""Test set-up: cheap compilation, since tests compile much and compute little."""

import os

os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "")
    + " --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Tests neither read nor fill the user's compilation cache.
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
