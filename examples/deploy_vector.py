"""A trained policy over a vector environment: python examples/deploy_vector.py runs/my-run"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np

from sacformer_jax import Policy, load_policy
from sacformer_jax.gymnasium_eval import gymnasium_env


def play(
    policy: Policy, envs: gymnasium.vector.VectorEnv, episodes: int, seed: int = 0
) -> list[list[float]]:
    """The returns of some episodes of each environment."""
    returns: list[list[float]] = [[] for _ in range(envs.num_envs)]
    totals = np.zeros(envs.num_envs)
    done, start = np.zeros(envs.num_envs, bool), np.ones(envs.num_envs, bool)
    obs, _ = envs.reset(seed=seed)
    state, reward = None, None
    while min(len(each) for each in returns) < episodes:
        action, state = policy.predict(obs, state, episode_start=start, reward=reward)
        # In Gymnasium's default mode, NEXT_STEP, an environment that is done gives its last
        # observation; the next step ignores the action and gives the first of the new episode.
        # In mode SAME_STEP it is there at once: set `start = done` after the step instead.
        start = done
        obs, reward, terminated, truncated, _ = envs.step(action)
        totals += reward
        done = terminated | truncated
        for env in np.flatnonzero(done):
            returns[env].append(float(totals[env]))
            totals[env] = 0.0
    return [each[:episodes] for each in returns]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", help="folder of the run")
    parser.add_argument("--num-envs", type=int, default=4)
    parser.add_argument("--episodes", type=int, default=2, help="of each environment")
    args = parser.parse_args()
    trained = load_policy(args.run)
    makers = [lambda: gymnasium_env(trained)] * args.num_envs
    vector_env = gymnasium.vector.SyncVectorEnv(makers)
    for number, values in enumerate(play(trained, vector_env, args.episodes)):
        print(f"environment {number}: returns {', '.join(f'{value:.1f}' for value in values)}")
