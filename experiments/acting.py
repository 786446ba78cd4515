"""What acting costs: on the window, on the whole episode through the cache, and computed anew.

Milliseconds a step of the actor alone, at the paper's size on HalfCheetah (17 observations, 6
actions): stretches of 100 steps at the beginning, middle and end of an episode of 1,000, the median
of five repetitions of each. Writes results/acting.json.

python experiments/acting.py
"""

from __future__ import annotations

import json
import statistics
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from bench.clock import Clock

from sacformer_jax import Config, agents
from sacformer_jax import context as contexts
from sacformer_jax.envs import make_env
from sacformer_jax.networks import TransformerActor, max_time_step
from sacformer_jax.train import hyperparameters, policy_state
from sacformer_jax.transformer import TransformerConfig
from sacformer_jax.types import Context

EPISODE, STRETCH = 1_000, 100
NUM_ENVS = (1, 8, 64)
RESULTS = Path(__file__).parent / "results" / "acting.json"


def acting(clock: Clock, num_envs: int, acting_context: str) -> dict[str, float]:
    """Cost of a step in the first, middle and last hundred of an episode."""
    config = Config.from_preset("paper", env="HalfCheetah", acting_context=acting_context)
    spec = make_env("HalfCheetah", "native").spec
    agent = agents.make(config, spec)
    policy = policy_state(agent.init(jax.random.key(0)), hyperparameters(config, spec.action_size))
    obs, reward = jnp.ones((num_envs, spec.obs_size)), jnp.ones(num_envs)
    never = jnp.zeros(num_envs, bool)

    def step(context: Context, _: None) -> tuple[Context, None]:
        acted = agent.act(policy, context, jax.random.key(0), explore=False)
        return contexts.advance(acted, obs, reward, never), None

    stretch = jax.jit(lambda context: jax.lax.scan(step, context, length=STRETCH)[0])
    cache = agent.init_cache(num_envs)
    context = contexts.start(obs, config.context.context_length, spec.action_size, cache)
    costs = {}
    for first in range(0, EPISODE, STRETCH):
        if first in (0, EPISODE // 2, EPISODE - STRETCH):
            run = partial(stretch, context)
            costs[f"from_step_{first}"] = clock.milliseconds(run, STRETCH, repetitions=5)
        context = stretch(context)
    return costs


def computed_anew(clock: Clock, num_envs: int) -> float:
    """Cost of one pass over all 1,000 steps, which acting without a cache takes at the end."""
    spec = make_env("HalfCheetah", "native").spec
    actor = TransformerActor(
        TransformerConfig(3, 128, 1, 4, 0.0, "relu"),
        spec.action_size,
        EPISODE,
        max_time_step(spec),
        1.0,
    )
    inputs = (
        jnp.ones((num_envs, EPISODE, spec.obs_size)),
        jnp.ones((num_envs, EPISODE, spec.action_size)),
        jnp.ones((num_envs, EPISODE)),
        jnp.broadcast_to(jnp.arange(EPISODE), (num_envs, EPISODE)),
        jnp.ones((num_envs, EPISODE), bool),
    )
    params = jax.jit(actor.init)(jax.random.key(0), *inputs)
    # The keys and values, which could be the past of later steps, are not asked for.
    apply: Any = jax.jit(lambda *args: actor.apply(*args).gaussian)  # type: ignore[union-attr]
    return clock.milliseconds(partial(apply, params, *inputs), repetitions=3)


def main() -> None:
    """Measures, prints a Markdown table, writes the JSON."""
    clock, results = Clock(), {}
    print("| environments | window of 6 | episode: first 100 | middle | last 100 | anew at 1,000 |")
    print("| --- | --- | --- | --- | --- | --- |")
    for num_envs in NUM_ENVS:
        window, episode = (acting(clock, num_envs, kind) for kind in ("window", "episode"))
        anew = computed_anew(clock, num_envs) if num_envs <= 8 else None
        results[str(num_envs)] = {"window": window, "episode": episode, "anew": anew}
        cells = [statistics.median(window.values()), *episode.values()]
        shown = [f"{cell:.2f} ms" for cell in cells] + ["–" if anew is None else f"{anew:.0f} ms"]
        print(f"| {num_envs} | {' | '.join(shown)} |")
    RESULTS.write_text(
        json.dumps({"jax": jax.__version__, "milliseconds": results}, indent=2) + "\n"
    )


if __name__ == "__main__":
    main()
