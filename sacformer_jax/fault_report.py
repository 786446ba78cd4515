"""What is known of a member that no longer learns."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np

from sacformer_jax.population import Population, member_counters
from sacformer_jax.processes import gathered, is_first
from sacformer_jax.types import TrainState


def report_fault(population: Population, index: int, state: TrainState, path: Path) -> str:
    """Writes down what is known of a member's fault, as JSON, and says it in a line.

    Every process has to call it; the first writes.

    Args:
      population: what is trained.
      index: the member's place.
      state: after the chunk.
      path: the file.
    """
    name = population.members[index].name
    learner, hyper, all_counters = gathered((state.learner, state.hyper, state.counters))
    counters = member_counters(all_counters, index)
    tensor = population.program.agent.checked[int(counters.first_fault)]
    bad = {
        jax.tree_util.keystr(place): int(np.sum(~np.isfinite(leaf[index])))
        for place, leaf in jax.tree_util.tree_flatten_with_path(learner)[0]
        if not np.all(np.isfinite(leaf[index]))
    }
    largest = {
        jax.tree_util.keystr(place): float(np.max(np.abs(leaf[index])))
        for place, leaf in jax.tree_util.tree_flatten_with_path(learner.critic_params)[0]
    }
    facts = {
        "member": name,
        "env_steps": int(counters.env_steps),
        "updates": int(counters.updates),
        "skipped_updates": int(counters.skipped_updates),
        "bad_physics": int(counters.bad_physics),
        "first_tensor_not_finite": tensor,
        "learner_values_not_finite": bad,
        "largest_critic_parameters": largest,
        "hyperparameters": {field: float(values[index]) for field, values in vars(hyper).items()},
    }
    if is_first():
        path.write_text(json.dumps(facts, indent=2) + "\n")
    return (
        f"{name}: {counters.skipped_updates} updates were not finite, {tensor} first; it "
        f"learns no more. Written to {path}"
    )
