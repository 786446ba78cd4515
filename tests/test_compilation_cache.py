"""The compilation cache: where it is, whose word counts, and that a second start finds all."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from describing import described

from sacformer_jax import compilation_cache

TINY = {
    "agent": "sac", "env": "Hopper", "num-envs": 2, "max-episode-steps": 50,
    "prefill-env-steps": 200, "chunk-env-steps": 100, "total-env-steps": 400, "eval-every": 200,
    "eval-episodes": 2, "actor-width": 8, "actor-layers": 1, "critic-width": 8, "batch-size": 4,
    "buffer-capacity": 2000,
}  # fmt: skip


@pytest.fixture
def settings(monkeypatch, tmp_path):
    """JAX's settings as in a fresh process, restored afterwards."""
    names = {
        "jax_enable_compilation_cache": True,
        "jax_compilation_cache_dir": None,
        "jax_persistent_cache_min_compile_time_secs": 1.0,
    }
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    monkeypatch.setattr(
        compilation_cache.platformdirs, "user_cache_path", lambda name: tmp_path / "caches" / name
    )
    for name, value in names.items():
        jax.config.update(name, value)
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)


def test_it_lies_in_the_users_cache_folder(settings):
    path = compilation_cache.enable()
    assert path == compilation_cache.folder()
    assert path.parent == settings / "caches" / "sacformer-jax" / "compiled"
    assert path.is_dir()
    assert jax.config.jax_compilation_cache_dir == str(path)


def test_the_users_own_folder_comes_first(settings):
    jax.config.update("jax_compilation_cache_dir", str(settings / "mine"))
    assert compilation_cache.enable() == settings / "mine"
    assert not (settings / "caches").exists()


def test_none_where_the_user_wants_none(settings):
    jax.config.update("jax_enable_compilation_cache", False)
    assert compilation_cache.enable() is None
    assert not (settings / "caches").exists()


def test_none_where_it_cannot_be_written(settings):
    (settings / "caches").write_text("a file where the folder would be")
    assert compilation_cache.enable() is None
    assert jax.config.jax_compilation_cache_dir is None


def test_other_processors_have_other_folders(settings, monkeypatch):
    info = "model name : {}\nflags : avx2 {}\ncpu MHz : {}\n"
    found = {}
    for name, texts in {
        "this": info.format("A", "fma", 2000), "at another speed": info.format("A", "fma", 3000),
        "another": info.format("A", "fma avx512f", 2000),
    }.items():  # fmt: skip
        monkeypatch.setattr(Path, "read_text", lambda self, texts=texts: texts)
        found[name] = compilation_cache.folder()
    assert found["this"] == found["at another speed"] != found["another"]


def test_a_second_run_compiles_nothing_anew_and_is_the_same(tmp_path):
    """Native engine and all: host calls are known by name. Nor does resuming."""
    cache, digests, files = tmp_path / "cache", [], []
    environment = {
        **os.environ,
        "JAX_ENABLE_COMPILATION_CACHE": "true",
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    for name in ("first", "second"):
        run = str(tmp_path / name)

        def sacformer(*args):
            command = [sys.executable, "-m", "sacformer_jax.cli", *args]
            subprocess.run(command, env=environment, capture_output=True, check=True)

        sacformer("train", *(f"--{k}={v}" for k, v in TINY.items()), f"--run-dir={run}")
        files.append(sorted(path.name for path in cache.iterdir() if path.name.endswith("-cache")))
        digests.append(described(Path(run))["digest"])
    sacformer("resume", run, "--total-env-steps", "500")
    files.append(sorted(path.name for path in cache.iterdir() if path.name.endswith("-cache")))
    assert any(name.startswith("jit_train_chunk") for name in files[0])
    assert any(name.startswith("jit_evaluate") for name in files[0])
    first, second, resumed = (
        {name for name in names if name.startswith(("jit_train", "jit_prefill", "jit_evaluate"))}
        for names in files
    )
    assert first == second == resumed
    assert digests[0] == digests[1]
