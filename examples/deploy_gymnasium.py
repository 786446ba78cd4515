"""A trained policy in a Gymnasium loop: python examples/deploy_gymnasium.py runs/my-run"""

from __future__ import annotations

import argparse

import gymnasium

from sacformer_jax import Policy, load_policy
from sacformer_jax.gymnasium_eval import gymnasium_env


def play(policy: Policy, env: gymnasium.Env, episodes: int, seed: int = 0) -> list[float]:
    """The returns of some episodes."""
    returns = []
    for episode in range(episodes):
        obs, _ = env.reset(seed=seed if episode == 0 else None)
        state, reward, total, done = None, 0.0, 0.0, False  # state=None: a new episode begins
        while not done:
            action, state = policy.predict(obs, state, reward=reward)
            obs, step_reward, terminated, truncated, _ = env.step(action)
            reward = float(step_reward)
            total += reward
            done = terminated or truncated
        returns.append(total)
    return returns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", help="folder of the run")
    parser.add_argument("--episodes", type=int, default=3)
    args = parser.parse_args()
    trained = load_policy(args.run)
    for value in play(trained, gymnasium_env(trained), args.episodes):
        print(f"return {value:.1f}")
