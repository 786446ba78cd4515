"""Run folders whose policy has learnt nothing: made without compiling any training."""

from __future__ import annotations

import json
from pathlib import Path

import jax

from sacformer_jax import Config, agents, make_env, wrapped
from sacformer_jax.checkpoint import BestSoFar, RunFolder, save_best
from sacformer_jax.members import Member
from sacformer_jax.runner import sources_of
from sacformer_jax.train import hyperparameters, policy_state

STEPS = 12
SMALL = {
    "env": "Hopper", "max_episode_steps": STEPS, "num_envs": 2, "batch_size": 4,
    "buffer_capacity": 400, "context_length": 3, "actor_layers": 2, "actor_width": 8,
    "actor_heads": 2, "critic_width": 8, "normalize_obs": False, "target_return": 40.0,
    "return_scale": 10.0, "head_init_scale": 1.0, "return_conditioning": "commanded",
}  # fmt: skip


def untrained_config(**fields: object) -> Config:
    """A small configuration, by default of SACFormer in Hopper."""
    if fields.get("agent", "sacformer") != "sacformer":
        mlp = {"context_length": 1, "actor_heads": 1, "return_conditioning": "none"}
        fields = {**mlp, **fields}
    return Config.from_preset("cpu", **{**SMALL, **fields})


def untrained_run(path: Path, seeds: int = 1, **fields: object) -> Path:
    """A run of so many members with a best policy, and metrics made up."""
    config = untrained_config(seeds=seeds, **fields)
    task = config.task
    env = make_env(task.env, task.engine, task.brax_backend)
    spec = wrapped(env, task.hide_velocities, task.action_delay, task.stack_obs).spec
    members = tuple(Member(f"seed-{seed}", seed) for seed in range(seeds))
    folder = RunFolder(path)
    folder.create(config, sources_of(config), spec, members)
    for member in members:
        agent = agents.make(config, spec)
        learner = jax.jit(agent.init)(jax.random.key(member.seed))
        policy = policy_state(learner, hyperparameters(config, spec.action_size))
        save_best(folder, member.name, policy, BestSoFar(100, 1.0))
        lines = [json.dumps(record) for record in made_up_records(member.seed)]
        folder.metrics_path(member.name).write_text("\n".join(lines) + "\n")
    return path


def made_up_records(shift: float = 0.0, ppo: bool = False) -> list[dict[str, object]]:
    """Lines of ``metrics.jsonl`` as training writes them."""
    records: list[dict[str, object]] = []
    for chunk in range(1, 6):
        own = {"q_mean": 2.0 * chunk, "alpha": 0.2}
        if ppo:
            own = {
                "approx_kl": 0.01, "clip_fraction": 0.1, "explained_variance": 0.5,
                "learning_rate": 3e-4,
            }  # fmt: skip
        records.append(
            {
                "kind": "train", "env_steps": 100 * chunk, "updates": 100 * chunk,
                "episodes": chunk % 2, "episode_return_mean": 10.0 * chunk if chunk % 2 else None,
                "episode_length_mean": 12.0 if chunk % 2 else None, "bad_physics": 0,
                "skipped_updates": chunk, "critic_loss": 1.0 / chunk, "actor_loss": -chunk,
                "entropy": 3.0 - chunk, "actor_grad_norm": 1.0, "critic_grad_norm": 10.0**chunk,
                **own,
            }
        )  # fmt: skip
        if chunk % 2:
            records.append(
                {
                    "kind": "eval", "env_steps": 100 * chunk, "updates": 100 * chunk,
                    "episodes": 2, "return_mean": 9.0 * chunk + shift, "return_std": 1.0,
                    "return_min": 8.0, "return_max": 10.0, "length_mean": 12.0,
                    "bad_physics": 0,
                }
            )  # fmt: skip
    return records
