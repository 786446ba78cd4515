"""Stable-Baselines3 and its JAX sibling sbx, each in its own loop on Gymnasium's task.

The library is the second argument: ``sb3`` or ``sbx``.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import gymnasium
import torch

from bench.peer_programs.protocol import Session, Setting

LIBRARIES = {
    "sb3": ("stable-baselines3", "torch"),
    "sbx": ("sbx-rl", "jax", "stable-baselines3", "torch"),
}
AGENTS = {"sac": "SAC"}


def make_model(library: str, setting: Setting) -> Any:
    """The library's model at the setting; both take the same arguments."""
    if library == "sb3":
        import stable_baselines3 as algorithms
    else:
        import sbx as algorithms
    return getattr(algorithms, AGENTS[setting.agent])(
        "MlpPolicy",
        gymnasium.make(f"{setting.env}-v5", max_episode_steps=setting.max_episode_steps),
        learning_rate=setting.learning_rate,
        buffer_size=setting.buffer_capacity,
        learning_starts=setting.learning_starts,
        batch_size=setting.batch_size,
        tau=setting.tau,
        gamma=setting.discount,
        train_freq=1,
        gradient_steps=setting.updates_per_env_step,
        policy_kwargs={"net_arch": list(setting.hidden_layers)},
        seed=setting.seed,
        device="cpu",
    )


def parameters_of(library: str, model: Any) -> int:
    """Numbers in the actor and in the critics."""
    if library == "sb3":
        networks = (model.actor, model.critic)
        return sum(leaf.numel() for network in networks for leaf in network.parameters())
    import jax

    policy = model.policy
    leaves = jax.tree.leaves((policy.actor_state.params, policy.qf_state.params))
    return sum(leaf.size for leaf in leaves)


def main() -> None:
    """Trains by stretches of one call of ``learn``, which goes on where the last one stopped."""
    session, library = Session(), sys.argv[2]
    setting = session.setting
    torch.set_num_threads(setting.cores)
    model = make_model(library, setting)
    model.learn(setting.learning_starts + setting.stretch_steps)
    session.ready(*LIBRARIES[library], parameters=parameters_of(library, model))
    while session.wanted():
        env_steps, updates = model.num_timesteps, model._n_updates
        start = time.perf_counter()
        model.learn(setting.stretch_steps, reset_num_timesteps=False)
        seconds = time.perf_counter() - start
        session.report(model.num_timesteps - env_steps, model._n_updates - updates, seconds)


if __name__ == "__main__":
    main()
