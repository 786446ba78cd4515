"""rejax on our task, through brax: its whole ``train`` compiled once, without evaluation.

What is not the same as here: it samples its replay without replacement and judges TD3's actor by
both critics. Its PPO clips every number of the gradient by itself, knows no time limit from the
task's end, and normalizes observations and rewards as they come. It has no DDPG, and its TD3 cannot
do with one critic.
"""

from __future__ import annotations

import time
from typing import Any

import flax.linen as nn
import jax
from brax.envs.wrappers.training import AutoResetWrapper, EpisodeWrapper
from rejax import PPO, SAC, TD3
from rejax.compat.brax2gymnax import Brax2GymnaxEnv

from bench.peer_programs.protocol import Session, Setting
from sacformer_jax.envs import make_env
from sacformer_jax.envs.brax_view import as_brax


class Task(Brax2GymnaxEnv):
    """Our task in brax's wrappers, in rejax's adapter.

    Brax's wrapper has reset the task where an episode ends; gymnax would make a reset at every
    step besides, which made the whole of it 7% slower.
    """

    def __init__(self, setting: Setting):
        env = EpisodeWrapper(
            as_brax(make_env(setting.env, "native")), setting.max_episode_steps, action_repeat=1
        )
        super().__init__(AutoResetWrapper(env))

    def step(self, key: Any, state: Any, action: Any, params: Any = None) -> Any:
        """One step, as ``gymnax`` defines it, without a reset of its own."""
        return self.step_env(key, state, action, params)


def make_sac(setting: Setting) -> Any:
    """Its SAC at the setting."""
    return SAC.create(
        **_common(setting),
        **_with_replay(setting),
        hidden_layer_sizes=setting.hidden_layers,
    )


def make_td3(setting: Setting) -> Any:
    """Its TD3 at the setting; the networks' sizes, which it fixes, are put in afterwards."""
    algorithm = TD3.create(
        **_common(setting),
        **_with_replay(setting),
        exploration_noise=setting.action_noise,
        policy_delay=setting.policy_delay,
        target_noise=setting.target_noise,
        target_noise_clip=setting.target_noise_clip,
    )
    sizes = {
        "hidden_layer_sizes": setting.hidden_layers,
        "activation": getattr(nn, setting.activation),
    }
    return algorithm.replace(
        actor=algorithm.actor.clone(**sizes), critic=algorithm.critic.clone(**sizes)
    )


def make_ppo(setting: Setting) -> Any:
    """Its PPO at the setting."""
    return PPO.create(
        **_common(setting),
        agent_kwargs={
            "hidden_layer_sizes": setting.hidden_layers,
            "activation": setting.activation,
        },
        num_steps=setting.rollout_steps,
        num_epochs=setting.epochs,
        num_minibatches=setting.minibatches,
        gae_lambda=setting.gae_lambda,
        clip_eps=setting.clip_range,
        vf_coef=setting.value_coefficient,
        ent_coef=0.0,
        max_grad_norm=setting.max_grad_norm,
        normalize_observations=True,
        normalize_rewards=True,
        reward_normalization_discount=setting.discount,
    )


def _common(setting: Setting) -> dict[str, Any]:
    """What all take; ``train`` runs for a stretch."""
    env = Task(setting)
    return {
        "env": env,
        "env_params": env.default_params,
        "num_envs": setting.num_envs,
        "learning_rate": setting.learning_rate,
        "gamma": setting.discount,
        "total_timesteps": setting.stretch_steps,
        "eval_freq": setting.stretch_steps,
        "skip_initial_evaluation": True,
    }


def _with_replay(setting: Setting) -> dict[str, Any]:
    return {
        "num_epochs": setting.updates_per_env_step * setting.num_envs,
        "batch_size": setting.batch_size,
        "buffer_size": setting.buffer_capacity,
        "fill_buffer": setting.learning_starts,
        "polyak": 1 - setting.tau,
    }


AGENTS = {"sac": make_sac, "td3": make_td3, "ppo": make_ppo}


def main() -> None:
    """Trains by stretches of one call of ``train``, which goes on where the last one stopped."""
    session = Session()
    setting = session.setting
    algorithm = AGENTS[setting.agent](setting).replace(eval_callback=lambda *_: ())
    state = jax.jit(algorithm.init_state)(jax.random.PRNGKey(setting.seed))
    # Donated, so that the replay is not copied.
    jitted = jax.jit(lambda state: algorithm.train(train_state=state)[0], donate_argnums=0)
    # Its statistics of rewards start as whole numbers, so a second call would compile again.
    after = jax.eval_shape(jitted, state)
    state = jax.tree.map(lambda leaf, later: leaf.astype(later.dtype), state, after)
    train = jitted.lower(state).compile()
    while int(state.global_step) < setting.learning_starts + setting.stretch_steps:
        state = jax.block_until_ready(train(state))
    networks = (state.actor_ts.params, state.critic_ts.params)
    session.ready("rejax", "jax", parameters=sum(leaf.size for leaf in jax.tree.leaves(networks)))
    while session.wanted():
        env_steps, updates = int(state.global_step), int(state.critic_ts.step)
        start = time.perf_counter()
        state = jax.block_until_ready(train(state))
        seconds = time.perf_counter() - start
        session.report(
            int(state.global_step) - env_steps, int(state.critic_ts.step) - updates, seconds
        )


if __name__ == "__main__":
    main()
