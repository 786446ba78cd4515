"""Checkpoints of other processes: more devices, two of them, full disks, kills."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from checkpoints import (  # noqa: F401 (fixtures are used by their names)
    checkpoint_names,
    metadata_file,
    program_fixture,
    reseal,
)

from sacformer_jax.checkpoint import CheckpointWriter
from sacformer_jax.digests import digest
from sacformer_jax.members import seed_members
from sacformer_jax.train import Program

_PRELUDE = """
import faulthandler; faulthandler.dump_traceback_later(50)
import os, resource, shutil, sys
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
from sacformer_jax import CheckpointError, Config
from sacformer_jax.checkpoint import *
from sacformer_jax.digests import digest

def tree(seed, size=24):
    rng = np.random.default_rng(seed)
    return {
        "big": rng.integers(0, 2**31, (2, 4, size), np.int32),
        "params": {"w": rng.normal(size=(2, 3)).astype(np.float32)},
        "half": np.asarray(rng.normal(size=(2, 8)), jnp.bfloat16),
        "mask": rng.random((2, 4)) < 0.5,
        "steps": np.int32(seed),
        "key": jax.random.split(jax.random.key(seed), 2),
    }

axes = {"big": 2, "params": {"w": 1}, "half": 1, "mask": 2, "steps": 0, "key": 1}
shapes = lambda size=24: jax.tree.map(
    lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree(0, size)
)

def mesh_shardings():
    count = jax.device_count()
    mesh = jax.make_mesh((2, count // 2), ("seed", "data"), axis_types=(AxisType.Auto,) * 2)
    specs = [P(), P("seed"), P("seed", "data")]
    return jax.tree.map(lambda n: NamedSharding(mesh, specs[n]), axes)

def spread(values):
    def put(x, sharding):
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            data = np.asarray(jax.random.key_data(x))
            make = lambda: jax.random.wrap_key_data(jnp.asarray(data))
            return jax.jit(make, out_shardings=sharding)()
        return jax.make_array_from_callback(np.shape(x), sharding, lambda index: x[index])
    return jax.tree.map(put, values, mesh_shardings())

def progress(step):
    return Progress(step, (None, None), (0, 0))

folder = RunFolder(sys.argv[1])
config = Config.from_preset("cpu", env="Hopper", seeds=2)
"""


@pytest.fixture
def tools(tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the programs below have at hand, for this process."""
    path = tmp_path / "run"
    monkeypatch.setattr(sys, "argv", ["test", str(path)])
    exec(_PRELUDE, space := {"__name__": "prelude"})
    space["folder"].create(space["config"], {}, program.env.spec, seed_members([0, 1]))
    return space


def _start(code: str, path: Path, *arguments: str, devices: int = 1) -> subprocess.Popen[str]:
    flags = f" --xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + flags}
    return subprocess.Popen(
        [sys.executable, "-c", _PRELUDE + code, str(path), *arguments],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def _finished(process: subprocess.Popen[str]) -> str:
    """All it printed."""
    try:
        output, _ = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        output, _ = process.communicate()
    assert process.returncode == 0, output
    return output


_ON_EIGHT = """
assert jax.device_count() == 8
restored = folder.restore(shapes(), axes, mesh_shardings())
assert restored.progress == progress(1)
assert len(restored.state["big"].sharding.device_set) == 8
assert digest(restored.state, axes) == digest(tree(1), axes)
whole = folder.restore(shapes()).state
assert len(whole["big"].sharding.device_set) == 1
assert digest(whole, axes) == digest(tree(1), axes)
with CheckpointWriter(folder, config, axes) as writer:
    state = spread(tree(2))
    writer.save(state, {"w": state["params"]["w"]}, progress(2))
"""


def test_saved_on_one_device_restored_on_eight_and_back(tools: dict[str, Any]) -> None:
    folder, tree, axes = tools["folder"], tools["tree"], tools["axes"]
    state = jax.tree.map(jnp.asarray, tree(1))
    with CheckpointWriter(folder, tools["config"], axes) as writer:
        writer.save(state, {"w": state["params"]["w"]}, tools["progress"](1))
    _finished(_start(_ON_EIGHT, folder.path, devices=8))
    restored = folder.restore(tools["shapes"](), axes)
    assert restored.progress == tools["progress"](2)
    assert digest(restored.state, axes) == digest(tree(2), axes)


_ONE_OF_TWO = """
index = int(sys.argv[2])
jax.distributed.initialize(f"localhost:{sys.argv[3]}", 2, index)
assert jax.device_count() == 4 and jax.local_device_count() == 2
shardings = mesh_shardings()
restored = folder.restore(shapes(), axes, shardings)
assert [line.count("is damaged") for line in restored.moved_aside] == [1], restored.moved_aside
assert digest(restored.state, axes) == sys.argv[4]
assert restored.progress == progress(1)
with CheckpointWriter(folder, config, axes) as writer:
    for step in (2, 3):
        if index == 0:  # only one of them
            save_best(folder, "seed-1", {"w": np.float32(step)}, BestSoFar(step, 1.0))
        state = spread(tree(step))
        writer.save(state, {"w": state["params"]["w"]}, progress(step))
        assert digest(state, axes) == sys.argv[3 + step]
    save_best(folder, "seed-1", {"w": np.float32(index)}, BestSoFar(5, 1.0))
    state = spread(tree(3))
    writer.save(state, {"w": state["params"]["w"]}, progress(4))
    writer._manager.wait_until_finished()
    if index == 0:  # it alone looks whether all is there
        shutil.rmtree(folder.checkpoints_path / "4")
    try:
        writer.wait()
    except CheckpointError as error:
        print(error)
    writer.save(state, {"w": state["params"]["w"]}, progress(4))
"""


def test_two_processes(tools: dict[str, Any]) -> None:
    """Each sees half of every array; one of them finds the checkpoint damaged."""
    folder, tree, axes = tools["folder"], tools["tree"], tools["axes"]
    with CheckpointWriter(folder, tools["config"], axes) as writer:
        for step in (1, 2):
            state = jax.tree.map(jnp.asarray, tree(step))
            writer.save(state, {"w": state["params"]["w"]}, tools["progress"](step))
    newest = folder.path / "checkpoints" / "2"
    reseal(newest, lambda metadata: metadata["items"]["state"]["['mask']"].update(digest="0" * 64))
    digests = [digest(tree(step), axes) for step in (1, 2, 3)]
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    both = [_start(_ONE_OF_TWO, folder.path, str(i), port, *digests, devices=2) for i in range(2)]
    try:
        for process, reason in zip(both, ("lacks it", "another process"), strict=True):
            (line,) = [line for line in _finished(process).splitlines() if "checkpoint" in line]
            assert "checkpoints/4 could not be saved" in line
            assert reason in line
    finally:
        for process in both:
            process.kill()
            process.wait()
    restored = folder.restore(tools["shapes"](), axes)
    assert restored.progress == tools["progress"](4)
    assert restored.moved_aside == ()
    assert digest(restored.state, axes) == digests[2]
    assert folder.steps() == [3, 4]
    best = json.loads(metadata_file(folder.path / "seed-1" / "best" / "5").read_text())
    assert best["items"]["policy"]["['w']"]["shape"] == []


_LIMITED = """
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
size = 500_000
state = jax.tree.map(jnp.asarray, tree(2, size))
writer = CheckpointWriter(folder, config, axes)
try:
    with writer:
        writer.save(state, {"w": state["params"]["w"]}, progress(2))
except CheckpointError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
assert [path.name for path in folder.checkpoints_path.iterdir()] == ["1"]
with writer:
    writer.save(state, {"w": state["params"]["w"]}, progress(2))
assert digest(folder.restore(shapes(size), axes).state, axes) == digest(state, axes)
"""


def test_a_file_that_may_not_grow(tools: dict[str, Any]) -> None:
    """A real error of the system while the arrays are written."""
    state = jax.tree.map(jnp.asarray, tools["tree"](1))
    with CheckpointWriter(tools["folder"], tools["config"], tools["axes"]) as writer:
        writer.save(state, {"w": state["params"]["w"]}, tools["progress"](1))
    output = _finished(_start(_LIMITED, tools["folder"].path))
    assert output.count("\n") == 1
    assert "checkpoints/2 could not be saved" in output
    assert "File too large" in output


_MANY_FAIL = """
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
rng = np.random.default_rng(0)
state = {f"leaf {i}": jnp.asarray(rng.random((50, 20 + i // 40 * 2000))) for i in range(50)}
with CheckpointWriter(folder, config) as writer:
    for step in range(1, 6):
        writer.save(state, {"w": state["leaf 0"]}, progress(step))
        writer.wait()
        for file in folder.checkpoints_path.glob(f"{step}/state/**/d/*"):
            if step > 1:
                os.truncate(file, file.stat().st_size // 2)
assert folder.steps() == [4, 5]
try:
    folder.restore(jax.eval_shape(lambda: state))
except CheckpointError as error:
    print(error)
for step in range(6, 10):
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
    try:
        with writer:
            writer.save(state, {"w": state["leaf 0"]}, progress(step))
    except CheckpointError as error:
        print(error)
assert sys.unraisablehook is sys.__unraisablehook__
"""


def test_of_many_arrays_that_fail_one_line_is_printed(tools: dict[str, Any]) -> None:
    """Orbax abandons those that are still under way, and they complain."""
    lines = _finished(_start(_MANY_FAIL, tools["folder"].path)).splitlines()
    assert len(lines) == 5
    assert "no checkpoint left that is good" in lines[0]
    for step, line in enumerate(lines[1:], start=6):
        assert f"checkpoints/{step} could not be saved (File too large)" in line


_SMALL_DISK = """
size = 500_000
state = jax.tree.map(jnp.asarray, tree(1, 1000))
with CheckpointWriter(folder, config, axes) as writer:
    writer.save(state, {"w": state["params"]["w"]}, progress(1))
large = jax.tree.map(jnp.asarray, tree(2, size))
writer = CheckpointWriter(folder, config, axes)
try:
    with writer:
        writer.save(large, {"w": large["params"]["w"]}, progress(2))
except CheckpointError as error:
    print(error)
assert digest(folder.restore(shapes(1000), axes).state, axes) == digest(state, axes)
with writer:
    writer.save(state, {"w": state["params"]["w"]}, progress(3))
assert folder.restore(shapes(1000), axes).progress == progress(3)
"""


def test_a_disk_that_is_full(tools: dict[str, Any], tmp_path: Path) -> None:
    mount = tmp_path / "small"
    mount.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(mount)]
    try:
        mounted = subprocess.run(command, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("no small disk can be mounted here")
    try:
        shutil.copytree(tools["folder"].path, mount / "run")
        output = _finished(_start(_SMALL_DISK, mount / "run"))
    finally:
        subprocess.run(["umount", str(mount)], check=True)
    assert "checkpoints/2 could not be saved" in output
    assert "No space left on device" in output


_KILLED = """
size = 6_000_000
for step in (1, 2):
    state = jax.tree.map(jnp.asarray, tree(step, size))
    writer = CheckpointWriter(folder, config, axes)
    writer.save(state, {"w": state["params"]["w"]}, progress(step))
    if step == 1:
        writer.wait()
print("saving", flush=True)
writer.wait()
print("saved", flush=True)
"""


def test_killed_in_a_save(tools: dict[str, Any]) -> None:
    folder, size = tools["folder"], 6_000_000
    process = _start(_KILLED, folder.path)
    assert process.stdout is not None
    assert process.stdout.readline() == "saving\n"
    time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    assert process.communicate(timeout=60)[0] == ""
    assert any("tmp" in name for name in checkpoint_names(folder))  # it was in the middle of it
    assert folder.steps() == [1]
    restored = folder.restore(tools["shapes"](size), tools["axes"])
    assert restored.progress == tools["progress"](1)
    assert restored.moved_aside == ()
    state = jax.tree.map(jnp.asarray, tools["tree"](2))
    with CheckpointWriter(folder, tools["config"], tools["axes"]) as writer:
        writer.save(state, {"w": state["params"]["w"]}, tools["progress"](2))
    assert checkpoint_names(folder) == ["1", "2"]
    restored = folder.restore(tools["shapes"](), tools["axes"])
    assert digest(restored.state, tools["axes"]) == digest(state, tools["axes"])
