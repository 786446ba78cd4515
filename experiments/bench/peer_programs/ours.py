"""sacformer-jax itself, by compiled chunks."""

from __future__ import annotations

import time

import jax

from bench.peer_programs.protocol import Session, Setting
from sacformer_jax import Config, make_program


def config(setting: Setting) -> Config:
    """Preset `paper`, whose values for SAC must be those of the setting."""
    made = Config.from_preset(
        "paper",
        agent=setting.agent,
        env=setting.env,
        engine="native",
        seed=setting.seed,
        prefill_env_steps=setting.learning_starts,
        chunk_env_steps=setting.stretch_steps,
    )
    expected = {
        "num_envs": setting.num_envs,
        "updates_per_env_step": setting.updates_per_env_step,
        "batch_size": setting.batch_size,
        "buffer_capacity": setting.buffer_capacity,
        "max_episode_steps": setting.max_episode_steps,
        "actor_learning_rate": setting.learning_rate,
        "critic_learning_rate": setting.learning_rate,
        "discount": setting.discount,
        "tau": setting.tau,
        "tune_alpha": True,
        "normalize_obs": False,
    }
    values = made.flat()
    assert {name: values[name] for name in expected} == expected
    for network in ("actor", "critic"):
        width, layers = values[f"{network}_width"], values[f"{network}_layers"]
        assert (width,) * layers == setting.hidden_layers
    return made


def main() -> None:
    """Trains by stretches of one chunk."""
    session = Session()
    program = make_program(config(session.setting))
    state = program.init(jax.random.key(session.setting.seed))
    state, _ = program.prefill(state)
    state, _ = jax.block_until_ready(program.train_chunk(state))
    networks = (state.learner.actor_params, state.learner.critic_params)
    session.ready(
        "sacformer-jax", "jax", parameters=sum(leaf.size for leaf in jax.tree.leaves(networks))
    )
    while session.wanted():
        env_steps, updates = int(state.counters.env_steps), int(state.counters.updates)
        start = time.perf_counter()
        state, _ = jax.block_until_ready(program.train_chunk(state))
        seconds = time.perf_counter() - start
        session.report(
            int(state.counters.env_steps) - env_steps,
            int(state.counters.updates) - updates,
            seconds,
        )


if __name__ == "__main__":
    main()
