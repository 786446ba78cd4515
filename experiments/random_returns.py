"""The mean return of random actions on each task, with its standard error: normalized score 0.

python experiments/random_returns.py          # for RANDOM_RETURNS of report/scores.py: 7 minutes
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import jax
import numpy as np
from report.scores import RANDOM_RETURNS

from sacformer_jax.envs import VectorEnv, make_env

EPISODES = 1_024


def random_returns(task: str, episodes: int = EPISODES, seed: int = 0) -> np.ndarray:
    """Returns ``[episodes]`` of uniformly random actions on the native engine.

    One episode in each of that many environments, so that short ones do not count more.
    """
    env = VectorEnv(make_env(task, "native"), episodes)
    step = jax.jit(lambda state, key: env.step(state, env.random_action(key)))
    key, init_key = jax.random.split(jax.random.key(seed))
    state = env.init(init_key)
    total, running = np.zeros(episodes), np.ones(episodes, bool)
    while running.any():
        key, action_key = jax.random.split(key)
        state, result = step(state, action_key)
        total += np.where(running, result.reward, 0.0)
        running &= ~np.asarray(result.done)
    return total


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures and prints them."""
    parser = argparse.ArgumentParser(description="Returns of random actions.")
    parser.add_argument("--tasks", nargs="+", choices=list(RANDOM_RETURNS), metavar="TASK")
    parser.add_argument("--episodes", type=int, default=EPISODES)
    args = parser.parse_args(arguments)
    for task in args.tasks or RANDOM_RETURNS:
        returns = random_returns(task, args.episodes)
        error = returns.std(ddof=1) / np.sqrt(returns.size)
        print(f'    "{task}": {returns.mean():.1f},  # ± {error:.1f} (standard error)', flush=True)


if __name__ == "__main__":
    main()
