"""Id-encoded episodes for the replay's tests, and what an oracle in plain Python remembers."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax.buffer import TrajectoryBuffer
from sacformer_jax.types import BufferState, Transition

GAMMA = 0.9
NUM_ENVS = 3
MAX_EPISODE = 7


@dataclasses.dataclass
class Step:
    """One remembered step of the oracle's columns."""

    number: int
    episode: int
    time_step: int
    reward: float
    return_so_far: float
    terminated: bool
    truncated: bool
    bad: bool


def simulate(seed: int, num_steps: int) -> list[list[Step]]:
    """Random episodes for each column; the last one usually unfinished."""
    rng = np.random.default_rng(seed)
    columns = []
    for column in range(NUM_ENVS):
        steps: list[Step] = []
        episode, time_step, so_far = 0, 0, 0.0
        length = int(rng.integers(1, MAX_EPISODE + 1))
        for i in range(num_steps):
            ended = time_step == length - 1
            terminated = bool(ended and length < MAX_EPISODE and rng.random() < 0.6)
            truncated = bool(ended and not terminated)
            bad = bool(truncated and length < MAX_EPISODE and rng.random() < 0.7)
            reward = 0.0 if bad else float(np.float32(rng.normal()))
            steps.append(
                Step(
                    number=1 + i + 1000 * column,
                    episode=episode,
                    time_step=time_step,
                    reward=reward,
                    return_so_far=so_far,
                    terminated=terminated,
                    truncated=truncated,
                    bad=bad,
                )
            )
            so_far, time_step = so_far + reward, time_step + 1
            if ended:
                episode, time_step, so_far = episode + 1, 0, 0.0
                length = int(rng.integers(1, MAX_EPISODE + 1))
        columns.append(steps)
    return columns


def transitions(columns: list[list[Step]]) -> Transition:
    """The steps as arrays ``[time, N, ...]``; the observation is ``(number, -number)``."""
    by_time = list(zip(*columns, strict=True))

    def field(name: str, dtype: type) -> jax.Array:
        return jnp.asarray([[getattr(s, name) for s in row] for row in by_time], dtype)

    number = field("number", float)
    return Transition(
        obs=jnp.stack([number, -number], axis=-1),
        action=number[..., None] + 0.5,
        reward=field("reward", float),
        terminated=field("terminated", bool),
        truncated=field("truncated", bool),
        bad=field("bad", bool),
        time_step=field("time_step", int),
        return_so_far=field("return_so_far", float),
    )


def make_buffer(
    context_length: int,
    hindsight: bool,
    length: int = 25,
    scattered: bool = False,
    burn_in: int = 0,
) -> TrajectoryBuffer:
    return TrajectoryBuffer(
        num_envs=NUM_ENVS,
        length=length,
        obs_size=2,
        action_size=1,
        context_length=context_length,
        max_episode_steps=MAX_EPISODE,
        hindsight=hindsight,
        scattered=scattered,
        burn_in=burn_in,
    )


def filled(buffer: TrajectoryBuffer, columns: list[list[Step]]) -> BufferState:
    def add(state: BufferState, step: Transition) -> tuple[BufferState, None]:
        return buffer.add(state, step), None

    return jax.jit(lambda s, x: jax.lax.scan(add, s, x)[0])(buffer.init(), transitions(columns))


def stored(columns: list[list[Step]], length: int) -> list[list[Step]]:
    return [steps[-length:] for steps in columns]


def oracle_return_to_go(steps: list[Step], index: int) -> float:
    rewards = []
    for step in steps[index:]:
        if step.episode != steps[index].episode:
            break
        rewards.append(step.reward)
    total = 0.0
    for reward in reversed(rewards):
        total = reward + GAMMA * total
    return total
