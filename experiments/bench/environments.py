"""Part `env`: environment steps per second, frame skip included, under random actions.

Compared in turns, so that the noise of a shared machine hits all alike:

- the native engine inside a jitted scan, with resets;
- raw ``mujoco.rollout`` on as many threads, without observations, rewards or resets, from the
  states the native engine is in (so both meet the same contacts). Open loop (`raw_rollout`), the
  actions of ``RAW_STEPS`` steps are known when it is called, so the threads meet only at the end;
  no policy can act like that. Closed loop (`raw_rollout_stepwise`), each step is a call of its
  own, as for a policy that sees each state before it acts, and as the native engine steps;
- Gymnasium's vector environments, in a process of their own, since JAX's threads do not survive a
  fork;
- MJX;
- brax's own tasks.

Medians of ``REPETITIONS`` turns.

On CPU, MJX and brax take longer to compile than all the rest takes, so they are measured at 1 and
64 environments only, MJX on HalfCheetah and Hopper only. AsyncVectorEnv is one process for each
environment, so Gymnasium ends at 64.
"""

from __future__ import annotations

import contextlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import rollout

from bench.clock import Clock
from sacformer_jax.cores import usable_cores
from sacformer_jax.envs import TASKS, VectorEnv, make_env
from sacformer_jax.envs.mujoco_env import MujocoEnv
from sacformer_jax.envs.native import NativeEngine

SIZES = (1, 8, 64, 512)
GYM_SIZES = (1, 8, 64)
COSTLY_SIZES, MJX_TASKS = (1, 64), ("HalfCheetah", "Hopper")
"""What is measured on CPU of engines that compile for long."""
REPETITIONS = 3
SECONDS = 0.2
"""Shortest time of one measurement."""
RAW_STEPS = 10
"""Environment steps in one call of the open loop."""

Contender = Callable[[], float]
"""Measures once, in environment steps per second."""


def rate(run: Callable[[], Any], steps: int) -> float:
    """Steps per second of ``run``, which makes ``steps``, over at least ``SECONDS``."""
    count, start = 0, time.perf_counter()
    while (seconds := time.perf_counter() - start) < SECONDS or not count:
        run()
        count += steps
    return count / seconds


class Scan:
    """An environment of ours: ``length`` steps of all its copies in one jitted call."""

    def __init__(self, env: VectorEnv, length: int):
        def roll(state: Any, key: jax.Array) -> Any:
            # Drawn before, as for the others.
            actions = jax.vmap(env.random_action)(jax.random.split(key, length))
            return jax.lax.scan(lambda s, a: (env.step(s, a)[0], None), state, actions)[0]

        self.env, self._roll = env, jax.jit(roll, donate_argnums=0)
        self._steps, self._calls = length * env.num_envs, 0
        self.state = jax.jit(env.init)(jax.random.key(0))
        self._run()  # compiles

    def _run(self) -> None:
        self._calls += 1
        self.state = jax.block_until_ready(self._roll(self.state, jax.random.key(self._calls)))

    def __call__(self) -> float:
        return rate(self._run, self._steps)


class RawRollout:
    """``mujoco.rollout`` from the states that ``scan`` is in.

    Args:
      env: what ``scan`` steps.
      scan: the native engine's measurement.
      steps: environment steps in one call. Each call starts from those states, warm start
        included, since ``mujoco.rollout`` returns no warm start to go on with.
    """

    def __init__(self, env: MujocoEnv, scan: Scan, steps: int):
        assert isinstance(env.engine, NativeEngine)
        self.engine, self.scan, self.steps = env.engine, scan, steps
        self.frame_skip, self.num_envs = env.task.frame_skip, scan.env.num_envs
        model, threads = self.engine.model, usable_cores() if self.num_envs > 1 else 0
        self.num_state = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.data = [mujoco.MjData(model) for _ in range(max(1, threads))]
        self.models = [model] * self.num_envs
        self.rollout = rollout.Rollout(nthread=threads)
        self.rng = np.random.default_rng(0)

    def __call__(self) -> float:
        model, num, frames = self.engine.model, self.num_envs, self.steps * self.frame_skip
        physics, _ = self.engine.unpack_state(np.asarray(self.scan.state.env))
        start, warm = (
            np.ascontiguousarray(part) for part in np.split(physics, [self.num_state], axis=1)
        )
        low, high = model.actuator_ctrlrange.T
        actions = self.rng.uniform(low, high, (RAW_STEPS // self.steps, num, self.steps, model.nu))
        controls = np.repeat(actions, self.frame_skip, axis=2)
        arguments = {
            "initial_warmstart": warm,
            "state": np.empty((num, frames, self.num_state)),
            "sensordata": np.empty((num, frames, model.nsensordata)),
            "skip_checks": True,
        }

        def run() -> None:
            for control in controls:
                self.rollout.rollout(
                    self.models, self.data, start, control=control, nstep=frames, **arguments
                )

        run()
        return rate(run, num * RAW_STEPS)


_GYMNASIUM = """
import sys, time
import gymnasium
import numpy as np
id, mode, num_envs, seconds = sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4])
envs = gymnasium.make_vec(id, num_envs, vectorization_mode=mode)
envs.reset(seed=0)
actions = [envs.action_space.sample() for _ in range(64)]
for action in actions:
    envs.step(action)
print("ready", flush=True)
for line in sys.stdin:
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        envs.step(actions[count % len(actions)])
        count += 1
    print(count * num_envs / (time.perf_counter() - start), flush=True)
envs.close()
"""


@contextlib.contextmanager
def gymnasium_envs(env_id: str, mode: str, num_envs: int) -> Iterator[Contender]:
    """Gymnasium's vector environments, which reset by themselves; measured when called."""
    command = [sys.executable, "-c", _GYMNASIUM, env_id, mode, str(num_envs), str(SECONDS)]
    with (
        tempfile.TemporaryDirectory() as folder,  # where MuJoCo may write a log
        subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=folder,
        ) as process,
    ):
        assert process.stdin
        assert process.stdout
        stdin, stdout = process.stdin, process.stdout
        if stdout.readline() != "ready\n":
            raise RuntimeError(f"{env_id}: Gymnasium's {mode} environments did not start")

        def measure_once() -> float:
            stdin.write("again\n")
            stdin.flush()
            return float(stdout.readline())

        yield measure_once  # closing its input ends it


def contenders(task: str, num_envs: int, stack: contextlib.ExitStack) -> dict[str, Contender]:
    """Everything measured of one task at one size, by key."""
    on_cpu = jax.default_backend() == "cpu"
    env = make_env(task, "native")
    assert isinstance(env, MujocoEnv)
    scan = Scan(VectorEnv(env, num_envs), max(4, 1024 // num_envs))
    found: dict[str, Contender] = {
        f"native.{task}": scan,
        f"raw_rollout.{task}": RawRollout(env, scan, RAW_STEPS),
        f"raw_rollout_stepwise.{task}": RawRollout(env, scan, 1),
    }
    if num_envs in GYM_SIZES:
        for mode in ("async", "sync"):
            gym = gymnasium_envs(f"{task}-v5", mode, num_envs)
            found[f"gym_{mode}.{task}"] = stack.enter_context(gym)
    if not on_cpu or num_envs in COSTLY_SIZES:
        if not on_cpu or task in MJX_TASKS:
            length = max(2, 64 // num_envs)
            found[f"mjx.{task}"] = Scan(VectorEnv(make_env(task, "mjx"), num_envs), length)
        name = task.lower()
        spring = VectorEnv(make_env(f"brax:{name}"), num_envs)
        found[f"brax_spring.{name}"] = Scan(spring, max(4, 512 // num_envs))
    return found


def geometric_means(results: dict[str, float], num_envs: int = 64) -> dict[str, float]:
    """The native engine against the others, over the tasks."""
    return {
        f"env.native_over_{other.replace('raw_rollout', 'raw')}.{num_envs}.geomean": (
            statistics.geometric_mean(
                results[f"env.native.{task}.{num_envs}.steps_per_s"]
                / results[f"env.{other}.{task}.{num_envs}.steps_per_s"]
                for task in TASKS
            )
        )
        for other in ("raw_rollout", "raw_rollout_stepwise", "gym_async")
    }


def measure(clock: Clock) -> dict[str, float]:
    """All by flat keys ``env.ENGINE.TASK.SIZE.steps_per_s``, and ratios of the native engine."""
    del clock  # ratios are taken between neighbours in time
    results: dict[str, float] = {}
    # MuJoCo, where it is not ours, writes its log into the working directory.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for task in TASKS:
            for num_envs in SIZES:
                print(f"measuring {task}, {num_envs} environments …", file=sys.stderr, flush=True)
                results |= measure_in_turns(task, num_envs)
    return results | geometric_means(results)


def measure_in_turns(task: str, num_envs: int) -> dict[str, float]:
    """One task at one size."""
    with contextlib.ExitStack() as stack:
        found = contenders(task, num_envs, stack)
        turns = [{name: run() for name, run in found.items()} for _ in range(REPETITIONS)]
    return {
        f"env.{name}.{num_envs}.steps_per_s": statistics.median(turn[name] for turn in turns)
        for name in found
    }
