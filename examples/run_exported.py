"""An exported policy, run without this package: JAX, flatbuffers and NumPy are enough.

Made by ``sacformer export runs/my-run --to policy.zip``. As a program it runs an episode in the
policy's Gymnasium task: ``python examples/run_exported.py policy.zip``.
"""

import json
import sys
import zipfile
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def load(path: str, num_envs: int = 1) -> tuple[Callable[..., Any], dict[str, Any], dict[str, Any]]:
    """``action, state = step(obs, state, episode_start, reward)``; a first state; the manifest."""
    with zipfile.ZipFile(path) as archive:
        manifest = json.loads(archive.read("manifest.json"))
        if (manifest["format"], manifest["format_version"]) != ("sacformer-policy", 1):
            made = f"{manifest['format']} {manifest['format_version']}"
            raise ValueError(f"{path}: of format {made}, but this loader reads sacformer-policy 1")
        program = jax.export.deserialize(bytearray(archive.read("policy.jax_export")))
    state = {}  # all zero: no step yet
    for name, leaf in manifest["state"].items():
        shape = [num_envs if size == "N" else size for size in leaf["shape"]]
        state[name] = jnp.zeros(shape, leaf["dtype"])
    return jax.jit(program.call), state, manifest


if __name__ == "__main__":
    import gymnasium

    step, state, manifest = load(sys.argv[1])
    if wrappers := manifest.get("wrappers"):
        raise SystemExit(f"it needs an environment wrapped as in its training: {wrappers}")
    env = gymnasium.make(manifest["gymnasium_id"])
    obs, _ = env.reset(seed=0)
    reward, total, start, done = 0.0, 0.0, True, False
    while not done:
        # Rows of one environment.
        action, state = step(
            np.array([obs], np.float32), state, np.array([start]), np.array([reward], np.float32)
        )
        obs, step_reward, terminated, truncated, _ = env.step(np.asarray(action[0]))
        reward, start, done = float(step_reward), False, terminated or truncated
        total += reward
    print(f"return {total:.1f}")
