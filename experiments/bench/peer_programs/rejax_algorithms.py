"""rejax on our task, through brax: its whole ``train`` compiled once, without evaluation."""

from __future__ import annotations

import time
from typing import Any

import jax
from brax.envs.wrappers.training import AutoResetWrapper, EpisodeWrapper
from rejax import SAC
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
    """Its SAC at the setting; ``train`` runs for a stretch."""
    env = Task(setting)
    algorithm = SAC.create(
        env=env,
        env_params=env.default_params,
        hidden_layer_sizes=setting.hidden_layers,
        num_envs=setting.num_envs,
        num_epochs=setting.updates_per_env_step * setting.num_envs,
        batch_size=setting.batch_size,
        buffer_size=setting.buffer_capacity,
        fill_buffer=setting.learning_starts,
        learning_rate=setting.learning_rate,
        gamma=setting.discount,
        polyak=1 - setting.tau,
        total_timesteps=setting.stretch_steps,
        eval_freq=setting.stretch_steps,
        skip_initial_evaluation=True,
    )
    return algorithm.replace(eval_callback=lambda *_: ())


AGENTS = {"sac": make_sac}


def main() -> None:
    """Trains by stretches of one call of ``train``, which goes on where the last one stopped."""
    session = Session()
    setting = session.setting
    algorithm = AGENTS[setting.agent](setting)
    state = jax.jit(algorithm.init_state)(jax.random.PRNGKey(setting.seed))
    # Donated, so that the replay is not copied.
    jitted = jax.jit(lambda state: algorithm.train(train_state=state)[0], donate_argnums=0)
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
