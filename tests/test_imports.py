"""The shape of the package: imports follow the flow of data, and the pure part stays pure."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import sacformer_jax

ROOT = Path(sacformer_jax.__file__).parent
PACKAGE = "sacformer_jax"

# Each module may import only from earlier lines, and from its own line where that is a folder or
# the settings. A new module needs a place here.
ARROW: tuple[tuple[str, ...], ...] = (
    ("version", "cores", "values", "parallel"),
    ("env_names",),
    ("config", "validation", "presets"),
    ("members",),
    ("envs",),
    ("types",),
    ("layers", "distributions"),
    ("context", "transformer", "normalizer", "cache", "episodes"),
    ("advantages",),
    ("networks",),
    ("critics",),
    ("buffer",),
    ("rollout",),
    ("agents",),
    ("replay_learning", "on_policy"),
    ("iteration",),
    ("train",),
    ("evaluate", "attention"),
    ("recording",),
    ("population",),
    ("offline",),
    # Here the outside world begins.
    ("logging", "processes", "digests", "memory"),
    ("stored",),
    ("restoring", "lock"),
    ("run_folder",),
    ("saved_policies",),
    ("checkpoint",),
    ("plots", "diagnostics", "datasets", "console", "compilation_cache", "launch"),
    ("policy", "collecting", "results", "signals", "fault_report"),
    ("callbacks", "video", "model_renderer"),
    ("gym_frames",),
    ("frames",),
    ("policy_renderer",),
    ("tracking", "render"),
    ("pictures",),
    ("acting_step", "gymnasium_eval", "loop", "reward_in_obs"),
    ("onnx_export",),
    ("export", "extraction", "runner", "report"),
    ("api",),
    ("commands", "picture_commands"),
    ("cli",),
    ("__init__",),
)
TOGETHER = ("config", "validation", "presets", "envs", "agents", "report")
NUM_PURE = [line[0] for line in ARROW].index("logging")
RANK = {name: rank for rank, line in enumerate(ARROW) for name in line}
PURE = tuple(name for line in ARROW[:NUM_PURE] for name in line)

# Apart from the arrow: an agent sees windows, never where they come from.
NEVER = {
    "agents": {"buffer", "rollout", "train", "evaluate"},
    "evaluate": {"buffer", "rollout", "train"},
    "layers": set(RANK),
    "transformer": set(RANK) - {"layers"},
    "distributions": set(RANK),
    "envs.tasks": set(RANK),
}

OUTSIDE = {
    "absl", "argparse", "asyncio", "atexit", "concurrent", "datetime", "glob", "gymnasium",
    "importlib", "io", "json", "logging", "matplotlib", "multiprocessing", "orbax", "os",
    "pathlib", "pickle", "random", "rich", "shutil", "signal", "socket", "subprocess", "sys",
    "tempfile", "tensorboardX", "threading", "time", "tyro", "urllib", "warnings",
}  # fmt: skip
ALLOWED = {
    "cores": {"os"},  # which cores there are
    "envs.gym_host": {"gymnasium", "threading", "warnings"},  # the environments are Gymnasium's
    "envs.gym_live": {"gymnasium"},
    "envs.gym_registry": {"gymnasium", "importlib"},
    "envs.gym_wrappers": {"gymnasium"},
    "env_names": {"importlib", "os", "sys"},  # finds the user's module
    "envs.native_host": {"threading", "concurrent"},  # the host's side of the callback
    "envs.physics": {"pathlib", "importlib"},  # finds the model files
    "envs.playground_env": {"importlib", "subprocess"},  # an extra, which runs git
    "envs.tasks": {"pathlib"},  # names one
    "envs.mjx_engine": {"threading"},  # MJX's table of collisions is the process's
}
DIRTY_CALLS = {"print", "open", "input", "breakpoint", "exec", "eval"}
DIRTY_METHODS = {"open", "read_text", "write_text", "read_bytes", "write_bytes", "mkdir", "unlink"}


def _modules() -> dict[str, ast.Module]:
    """Syntax trees by name inside the package: ``"envs.core"``, ``"envs"`` for its ``__init__``."""
    trees = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)
        trees[name] = ast.parse(path.read_text(), str(path))
    return trees


def _imports(tree: ast.Module) -> set[str]:
    """Dotted names of everything imported, inside functions too."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert node.module is not None
            if node.module == PACKAGE:
                found.update(f"{PACKAGE}.{alias.name}" for alias in node.names)
            else:
                found.add(node.module)
    return found


def _own(tree: ast.Module) -> set[str]:
    """Top-level modules of the package that are imported."""
    return {name.split(".")[1] for name in _imports(tree) if name.startswith(f"{PACKAGE}.")}


def _dirty_calls(tree: ast.Module) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            if isinstance(node.func, ast.Name) and node.func.id in DIRTY_CALLS:
                found.add(node.func.id)
            if isinstance(node.func, ast.Attribute) and node.func.attr in DIRTY_METHODS:
                found.add(node.func.attr)
        if isinstance(node, ast.Global):
            found.add("global")
        # NumPy's own generators are global state; jax.debug prints and calls back.
        if isinstance(node, ast.Attribute) and ast.unparse(node) in ("np.random", "jax.debug"):
            found.add(ast.unparse(node))
    return found


MODULES = _modules()
PURE_MODULES = {name: tree for name, tree in MODULES.items() if name.split(".")[0] in PURE}


def test_every_module_has_a_place() -> None:
    assert {name.split(".")[0] for name in MODULES} == set(RANK)


@pytest.mark.parametrize("name", MODULES)
def test_imports_follow_the_arrow(name: str) -> None:
    top = name.split(".")[0]
    for imported in _own(MODULES[name]):
        if imported not in RANK:  # a function of the package itself, as in `from sacformer_jax`
            pytest.fail(f"{name} imports {imported} from the package's front")
        if RANK[imported] == RANK[top] and top in TOGETHER:
            continue
        assert RANK[imported] < RANK[top], f"{name} imports {imported}, which comes later"


@pytest.mark.parametrize("name", NEVER)
def test_imports_that_are_never_made(name: str) -> None:
    trees = [tree for module, tree in MODULES.items() if f"{module}.".startswith(f"{name}.")]
    assert trees
    for tree in trees:
        assert not _own(tree) & NEVER[name]


@pytest.mark.parametrize("name", PURE_MODULES)
def test_pure_modules_do_not_touch_the_outside(name: str) -> None:
    imported = {dotted.split(".")[0] for dotted in _imports(PURE_MODULES[name])}
    assert imported & OUTSIDE <= ALLOWED.get(name, set())
    assert not _dirty_calls(PURE_MODULES[name])


def test_allowances_are_still_needed() -> None:
    for name, allowed in ALLOWED.items():
        imported = {dotted.split(".")[0] for dotted in _imports(MODULES[name])}
        assert allowed <= imported, name


def test_the_pure_part_is_what_design_says() -> None:
    assert set(PURE) >= {
        "envs", "types", "context", "transformer", "networks", "distributions", "normalizer",
        "buffer", "rollout", "agents", "train", "evaluate", "config", "validation", "presets",
    }  # fmt: skip
    assert not set(PURE) & {
        "runner", "checkpoint", "logging", "console", "plots", "cli", "api", "policy",
        "gymnasium_eval",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("source", "imports", "calls"),
    [
        ("import os.path", {"os.path"}, set()),
        ("def f():\n    from sacformer_jax.runner import train", {f"{PACKAGE}.runner"}, set()),
        ("from sacformer_jax import checkpoint as c", {f"{PACKAGE}.checkpoint"}, set()),
        ("def f():\n    print(1)", set(), {"print"}),
        ("p.write_text('x')", set(), {"write_text"}),
        ("jax.debug.print('x')", set(), {"jax.debug"}),
        ("def f():\n    global x\n    x = np.random.rand()", set(), {"global", "np.random"}),
    ],
)
def test_the_walker_sees(source: str, imports: set[str], calls: set[str]) -> None:
    tree = ast.parse(source)
    assert _imports(tree) == imports
    assert _dirty_calls(tree) == calls
