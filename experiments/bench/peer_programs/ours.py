"""sacformer-jax itself, by compiled chunks."""

from __future__ import annotations

import time
from typing import Any

import jax

from bench.peer_programs.protocol import Conversation, Session, Setting
from sacformer_jax import Config, Population, Program, make_program
from sacformer_jax.launch import choose_xla_threads
from sacformer_jax.types import TrainState


def config(setting: Setting) -> Config:
    """Preset `paper`, whose values for the agent must be those of the setting."""
    of_rollout = {"num_envs": setting.num_envs, "rollout_steps": setting.rollout_steps}
    made = Config.from_preset(
        "paper",
        agent=setting.agent,
        env=setting.env,
        engine="native",
        seed=setting.seed,
        prefill_env_steps=setting.learning_starts,
        chunk_env_steps=setting.stretch_steps,
        **(of_rollout if setting.agent == "ppo" else {}),
    )
    values, expected = made.flat(), _expected(setting)
    assert {name: values[name] for name in expected} == expected
    for network in ("actor", "critic"):
        width, layers = values[f"{network}_width"], values[f"{network}_layers"]
        assert (width,) * layers == setting.hidden_layers
    return made


def _expected(setting: Setting) -> dict[str, Any]:
    """What the setting says, by our names."""
    same_names = ["num_envs", "max_episode_steps", "discount"]
    expected: dict[str, Any] = {
        "actor_learning_rate": setting.learning_rate,
        "critic_learning_rate": setting.learning_rate,
        "actor_activation": setting.activation,
        "critic_activation": setting.activation,
        "normalize_obs": setting.agent == "ppo",
        "tune_alpha": setting.agent == "sac",
    }
    if setting.agent == "ppo":
        same_names += ["rollout_steps", "epochs", "minibatches", "gae_lambda", "clip_range"]
        same_names += ["value_coefficient", "max_grad_norm"]
        expected |= {"entropy_coefficient": 0.0, "clip_value_loss": True, "normalize_reward": True}
    else:
        same_names += ["updates_per_env_step", "batch_size", "buffer_capacity", "tau"]
    if setting.agent in ("td3", "ddpg"):
        same_names += ["action_noise"]
    if setting.agent == "td3":
        same_names += ["policy_delay", "target_noise", "target_noise_clip"]
    return expected | {name: getattr(setting, name) for name in same_names}


def train_by_chunks(
    conversation: Conversation, program: Program | Population, state: TrainState
) -> None:
    """Prefills, trains a chunk, says that it is ready; then a chunk for every stretch.

    Args:
      conversation: with who wants the stretches.
      program: of one member or of several, whose env steps and updates are those of each.
      state: as ``program.init`` makes it.
    """
    state, _ = program.prefill(state)
    state, _ = jax.block_until_ready(program.train_chunk(state))
    networks = (state.learner.actor_params, state.learner.critic_params)
    conversation.ready(
        "sacformer-jax", "jax", parameters=sum(leaf.size for leaf in jax.tree.leaves(networks))
    )
    while conversation.wanted():
        env_steps, updates = _counts(state)
        start = time.perf_counter()
        state, _ = jax.block_until_ready(program.train_chunk(state))
        seconds = time.perf_counter() - start
        env_steps_now, updates_now = _counts(state)
        conversation.report(env_steps_now - env_steps, updates_now - updates, seconds)


def _counts(state: TrainState) -> tuple[int, int]:
    counters = state.counters
    return int(counters.env_steps), int(counters.updates.max())  # [], [] or [S], the same for all


def main() -> None:
    """Trains what the setting says."""
    session = Session()
    configured = config(session.setting)
    choose_xla_threads(configured)  # as the command line does
    program = make_program(configured)
    train_by_chunks(session, program, program.init(jax.random.key(session.setting.seed)))


if __name__ == "__main__":
    main()
