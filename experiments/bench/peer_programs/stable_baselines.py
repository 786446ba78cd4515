"""Stable-Baselines3 and its JAX sibling sbx, each in its own loop on Gymnasium's task.

The library is the second argument: ``sb3`` or ``sbx``. What is not the same as here: sbx moves
TD3's target networks at every update, judges its actor by the smaller critic, and does not clip how
far PPO's value moves. PPO's environments are stepped one after the other (``DummyVecEnv``), their
observations and rewards normalized by ``VecNormalize``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecNormalize

from bench.peer_programs.protocol import Session, Setting

LIBRARIES = {
    "sb3": ("stable-baselines3", "torch"),
    "sbx": ("sbx-rl", "jax", "stable-baselines3", "torch"),
}


def with_replay(setting: Setting) -> tuple[Any, dict[str, Any]]:
    """The environment, and the arguments of SAC; TD3 and DDPG have more."""
    return gymnasium.make(f"{setting.env}-v5", max_episode_steps=setting.max_episode_steps), {
        "buffer_size": setting.buffer_capacity,
        "learning_starts": setting.learning_starts,
        "batch_size": setting.batch_size,
        "tau": setting.tau,
        "train_freq": 1,
        "gradient_steps": setting.updates_per_env_step,
    }


def deterministic(setting: Setting) -> tuple[Any, dict[str, Any]]:
    """The same of DDPG."""
    env, arguments = with_replay(setting)
    zeros = np.zeros(env.action_space.shape)
    noise = NormalActionNoise(zeros, zeros + setting.action_noise)
    return env, {**arguments, "action_noise": noise}


def delayed(setting: Setting) -> tuple[Any, dict[str, Any]]:
    """The same of TD3."""
    env, arguments = deterministic(setting)
    return env, {
        **arguments,
        "policy_delay": setting.policy_delay,
        "target_policy_noise": setting.target_noise,
        "target_noise_clip": setting.target_noise_clip,
    }


def on_policy(setting: Setting) -> tuple[Any, dict[str, Any]]:
    """The same of PPO."""
    env = make_vec_env(
        f"{setting.env}-v5",
        setting.num_envs,
        env_kwargs={"max_episode_steps": setting.max_episode_steps},
    )
    return VecNormalize(env, gamma=setting.discount), {
        "n_steps": setting.rollout_steps,
        "batch_size": setting.minibatch_size,
        "n_epochs": setting.epochs,
        "gae_lambda": setting.gae_lambda,
        "clip_range": setting.clip_range,
        "clip_range_vf": setting.clip_range,
        "ent_coef": 0.0,
        "vf_coef": setting.value_coefficient,
        "max_grad_norm": setting.max_grad_norm,
    }


AGENTS: dict[str, tuple[str, Callable[[Setting], tuple[Any, dict[str, Any]]]]] = {
    "sac": ("SAC", with_replay),
    "td3": ("TD3", delayed),
    "ddpg": ("DDPG", deterministic),
    "ppo": ("PPO", on_policy),
}
"""The name in both libraries, and what it is made with."""


def make_model(library: str, setting: Setting) -> Any:
    """The library's model at the setting; both take the same arguments."""
    if library == "sb3":
        import stable_baselines3 as algorithms

        activation: Any = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[setting.activation]
    else:
        import jax
        import sbx as algorithms

        activation = {"relu": jax.nn.relu, "tanh": jax.numpy.tanh}[setting.activation]
    name, arguments_at = AGENTS[setting.agent]
    env, arguments = arguments_at(setting)
    if library == "sbx" and setting.agent in ("td3", "ddpg"):
        arguments["qf_learning_rate"] = setting.learning_rate
    return getattr(algorithms, name)(
        "MlpPolicy",
        env,
        learning_rate=setting.learning_rate,
        gamma=setting.discount,
        policy_kwargs={"net_arch": list(setting.hidden_layers), "activation_fn": activation},
        seed=setting.seed,
        device="cpu",
        **arguments,
    )


def parameters_of(library: str, model: Any) -> int:
    """Numbers in the actor and in the critics."""
    policy = model.policy
    if library == "sb3":
        networks = (policy.actor, policy.critic) if hasattr(policy, "actor") else (policy,)
        return sum(leaf.numel() for network in networks for leaf in network.parameters())
    import jax

    critic = policy.vf_state if hasattr(policy, "vf_state") else policy.qf_state
    leaves = jax.tree.leaves((policy.actor_state.params, critic.params))
    return sum(leaf.size for leaf in leaves)


def updates_of(library: str, model: Any) -> int:
    """Gradient updates so far; what both count for PPO are the epochs."""
    if not hasattr(model, "rollout_buffer"):
        return int(model._n_updates)
    if library == "sbx":
        return int(model.policy.actor_state.step)
    moments = model.policy.optimizer.state.values()
    return max((int(of_leaf["step"]) for of_leaf in moments), default=0)


def main() -> None:
    """Trains by stretches of one call of ``learn``, which goes on where the last one stopped."""
    session, library = Session(), sys.argv[2]
    setting = session.setting
    # A second thread makes SAC and TD3 faster and PPO, whose layers are narrow, 5% slower.
    torch.set_num_threads(1 if setting.agent == "ppo" else setting.cores)
    model = make_model(library, setting)
    model.learn(setting.learning_starts + setting.stretch_steps)
    session.ready(*LIBRARIES[library], parameters=parameters_of(library, model))
    while session.wanted():
        env_steps, updates = model.num_timesteps, updates_of(library, model)
        start = time.perf_counter()
        model.learn(setting.stretch_steps, reset_num_timesteps=False)
        seconds = time.perf_counter() - start
        session.report(
            model.num_timesteps - env_steps, updates_of(library, model) - updates, seconds
        )


if __name__ == "__main__":
    main()
