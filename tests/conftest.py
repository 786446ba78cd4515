"""Test set-up: cheap compilation, since tests compile much and compute little."""

import gc
import mmap
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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
    # Nothing is gained by splitting programs that compile so fast among threads.
    if _known_to_xla("xla_cpu_parallel_codegen_split_count"):
        flags.append("--xla_cpu_parallel_codegen_split_count=1")
    # Loops are compiled by LLVM alone instead of MLIR and LLVM, in less than half the time.
    if _known_to_xla("xla_cpu_use_fusion_emitters"):
        flags.append(QUICK_LOOPS)
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags])
    os.environ[_FOLDER] = tempfile.mkdtemp(prefix="sacformer-tests-")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"


_LONGEST = (
    "test_population", "test_devices", "test_kills", "test_ppo", "test_mesh", "test_offline",
    "test_td3", "test_extraction", "test_cli", "test_runs", "test_train", "test_acting",
    "test_compilation_cache", "test_diagnostics", "test_mjx", "test_sac_update",
)  # fmt: skip
"""Modules that take longest; first, so that no worker waits for another at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keeps the order, but for modules that take longest."""
    places = {name: place for place, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Leaves what is there by now out of every later collection, of which some tests make many.

    And has JAX make its devices: a command called as a function would choose how many otherwise.
    """
    import jax  # only now: JAX reads what is set above

    jax.devices()
    gc.collect()
    gc.freeze()


_LOOK_AT_PICTURES = {
    "test_runs", "test_render", "test_diagnostics", "test_cli", "test_sweep", "test_study",
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _pictures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Elsewhere runs in this process end without their pictures, whose drawing takes longer."""
    from sacformer_jax import runner  # only now: JAX reads what is set above

    with pytest.MonkeyPatch.context() as patched:
        if request.path.stem not in _LOOK_AT_PICTURES:
            patched.setattr(runner, "draw_records", _not_drawn)
        yield


def _not_drawn(records: Any, to: Path) -> list[Path]:
    assert set(records.records) == {member.name for member in records.run.members}
    assert to.is_dir()
    return []


def pytest_unconfigure(config: pytest.Config) -> None:
    """Removes the session's cache."""
    if not _inherited:
        shutil.rmtree(os.environ[_FOLDER], ignore_errors=True)
