"""The physics engines: agreement with Gymnasium's MuJoCo, solver iterations, speed, compile time.

python experiments/engines.py                    # all five tasks: about ten minutes on 2 cores
python experiments/engines.py --tasks Hopper

Errors are of single environment steps, from states along trajectories of random actions, against C
MuJoCo with Gymnasium's own settings, which engine native equals to the bit.
Results are kept in results/engines.json, task by task.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sacformer_jax.envs import TASKS, VectorEnv, make_env, mjx_engine
from sacformer_jax.envs.mjx_engine import MjxEngine, SolverIterations
from sacformer_jax.envs.mujoco_env import MujocoEnv
from sacformer_jax.envs.native import NativeEngine
from sacformer_jax.envs.native_host import STATE_SPEC
from sacformer_jax.envs.physics import EngineChoice

RESULTS = Path(__file__).parent / "results" / "engines.json"
# Contacts come late in some tasks (Hopper falls for ten steps), so samples are spread.
NUM_ENVS, NUM_STEPS, KEPT_EVERY = 64, 60, 10
ITERATIONS = ((1, 4), (2, 4), (4, 8), (8, 8))
Sample = tuple[Any, np.ndarray]


def native_env(task: str) -> tuple[MujocoEnv, NativeEngine]:
    """The task on C MuJoCo, and its engine."""
    env = MujocoEnv(task, EngineChoice("native"))
    assert isinstance(env.engine, NativeEngine)
    return env, env.engine


def sample_steps(env: MujocoEnv, num_envs: int, num_steps: int, kept_every: int) -> Sample:
    """States (words of the native engine) and actions along random trajectories."""
    vector = VectorEnv(env, num_envs)

    def step(state: Any, key: jax.Array) -> Any:
        action = vector.random_action(key)
        return vector.step(state, action)[0], (state.env, action)

    key = jax.random.key(1)
    roll = jax.jit(lambda state: jax.lax.scan(step, state, jax.random.split(key, num_steps))[1])
    stretch = jax.device_get(roll(vector.init(key)))
    words, actions = (values[kept_every - 1 :: kept_every] for values in stretch)
    return words.reshape(-1, words.shape[-1]), actions.reshape(-1, actions.shape[-1])


def after(env: MujocoEnv, states: Any, actions: np.ndarray) -> tuple[Any, dict[str, float]]:
    """``(qvel, reward)`` after one step from each state, with seconds to compile and to run."""

    def step(state: Any, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        physics = env.engine.step(state, action)
        return physics.quantities.qvel, env._env_step(physics, action).reward

    start = time.perf_counter()
    compiled = jax.jit(jax.vmap(step)).lower(states, actions).compile()
    compile_s = time.perf_counter() - start
    jax.block_until_ready(compiled(states, actions))
    start = time.perf_counter()
    result = jax.device_get(compiled(states, actions))
    return result, {
        "compile_s": round(compile_s, 1),
        "steps_per_s": round(len(actions) / (time.perf_counter() - start)),
    }


def mjx_states(engine: MjxEngine, native: NativeEngine, words: np.ndarray) -> tuple[Any, float]:
    """The same states for MJX, and the share of them in contact."""
    model, values, touching = native.model, [], 0
    data = mujoco.MjData(model)
    for physics, measured in zip(*native.unpack_state(words), strict=True):
        mujoco.mj_setState(model, data, physics, STATE_SPEC)
        values.append((data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy(), measured))
        mujoco.mj_forward(model, data)
        touching += data.ncon > 0
    columns = (jnp.asarray(np.stack(column), jnp.float32) for column in zip(*values, strict=True))
    return jax.vmap(engine.state)(*columns), touching / len(words)


def errors(actual: Any, expected: Any) -> dict[str, float]:
    """Median, 99 % quantile and maximum of the largest |Δqvel| and of |Δreward| of each step."""
    found = {}
    for name, a, b in zip(("qvel", "reward"), actual, expected, strict=True):
        difference = np.abs(a - b).reshape(len(a), -1).max(axis=1)
        found[f"{name}_median"] = float(np.median(difference))
        found[f"{name}_99"] = float(np.quantile(difference, 0.99))
        found[f"{name}_max"] = float(difference.max())
    return found


def rollout_speed(env: MujocoEnv) -> float:
    """Environment steps per second of NUM_ENVS environments with resets, inside one scan."""
    vector = VectorEnv(env, NUM_ENVS)

    def step(state: Any, key: jax.Array) -> Any:
        return vector.step(state, vector.random_action(key))[0], None

    roll = jax.jit(lambda state, keys: jax.lax.scan(step, state, keys)[0])
    steps = 16
    keys = jax.random.split(jax.random.key(0), steps)
    state = jax.block_until_ready(roll(vector.init(jax.random.key(0)), keys))
    start = time.perf_counter()
    jax.block_until_ready(roll(state, keys))
    return round(NUM_ENVS * steps / (time.perf_counter() - start))


def measure(task: str) -> dict[str, Any]:
    """Everything about one task."""
    env, native = native_env(task)
    words, actions = sample_steps(env, NUM_ENVS, NUM_STEPS, KEPT_EVERY)
    expected, timing = after(env, jnp.asarray(words), actions)
    results: dict[str, Any] = {
        "native": {**timing, "rollout_steps_per_s": rollout_speed(env)},
    }
    native.model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    newton, _ = after(env, jnp.asarray(words), actions)
    results["C MuJoCo, Newton"] = errors(newton, expected)

    twin = make_env(task, "mjx")
    assert isinstance(twin, MujocoEnv)
    assert isinstance(twin.engine, MjxEngine)
    # A state says nothing of the solver's settings.
    states, results["share in contact"] = mjx_states(twin.engine, native, words)

    def add(name: str, **settings: Any) -> None:
        twin.engine = MjxEngine(TASKS[task], **settings)
        actual, timing = after(twin, states, actions)
        results[name] = {**timing, **errors(actual, expected)}
        results[name]["qvel_max_to_newton"] = errors(actual, newton)["qvel_max"]
        print(task, name, json.dumps(results[name]), flush=True)

    add("mjx parity")
    results["mjx parity"]["rollout_steps_per_s"] = rollout_speed(twin)
    for iterations in ITERATIONS:
        add("mjx {} x {}".format(*iterations), iterations=SolverIterations(*iterations))
    ours = mjx_engine._plane_capsule
    mjx_engine._plane_capsule = mjx_engine.collision_driver._COLLISION_FUNC[
        mjx_engine._PLANE_CAPSULE
    ]
    add("mjx parity, its own tangents")
    mjx_engine._plane_capsule = ours
    return results


def summary(results: dict[str, Any]) -> str:
    """The results as a Markdown table."""
    lines = [
        "| task | engine | compile, s | steps/s | qvel: median, 99 %, max | reward: 99 %, max |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for task, settings in results.items():
        for name, values in settings.items():
            if not isinstance(values, dict):
                continue
            cells = [
                ", ".join(f"{values[key]:.0e}" for key in keys) if keys[0] in values else "–"
                for keys in (("qvel_median", "qvel_99", "qvel_max"), ("reward_99", "reward_max"))
            ]
            speed = [f"{values[k]:,}" if k in values else "–" for k in ("compile_s", "steps_per_s")]
            lines.append(f"| {task} | {name} | {' | '.join(speed + cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Measures the tasks asked for and keeps what was measured of the others."""
    parser = argparse.ArgumentParser(description="Agreement and speed of the physics engines.")
    parser.add_argument("--tasks", nargs="*", choices=list(TASKS), default=list(TASKS))
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for task in parser.parse_args().tasks:
        results[task] = measure(task)
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(summary(results))


if __name__ == "__main__":
    main()
