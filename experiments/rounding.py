"""One seed alone and among others: that what differs is rounding, and how it grows.

Three trainings of the same seed on Hopper at preset ``cpu``: by the program for one, as one of
three seeds of a population, and again alone with one parameter of the actor moved to the next
float32 after prefill. If being vmapped did more than round otherwise, the second would leave the
first sooner than the third does. Writes results/rounding.json and results/rounding.png.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sacformer_jax import Config, make_population, make_program, seed_members
from sacformer_jax.population import member_state
from sacformer_jax.types import TrainState

SEED, CHUNKS, CHUNK_ENV_STEPS = 1, 40, 64
RESULTS = Path(__file__).parent / "results"


def distance(one: TrainState, other: TrainState) -> dict[str, float]:
    """Largest differences of the networks' parameters and of the newest states stored."""
    parameters = [
        float(jnp.max(jnp.abs(a - b)))
        for name in ("actor_params", "critic_params")
        for a, b in zip(
            jax.tree.leaves(getattr(one.learner, name)),
            jax.tree.leaves(getattr(other.learner, name)),
            strict=True,
        )
    ]
    obs = jnp.max(jnp.abs(one.context.obs[:, -1] - other.context.obs[:, -1]))
    return {"parameters": max(parameters), "newest_obs": float(obs)}


def nudged(state: TrainState) -> TrainState:
    """The same with one number of the actor moved to the next float32."""
    leaves, structure = jax.tree.flatten(state.learner.actor_params)
    place = max(range(len(leaves)), key=lambda i: leaves[i].size)
    flat = np.array(leaves[place]).reshape(-1)
    flat[0] = np.nextafter(flat[0], np.float32(np.inf))
    leaves[place] = jnp.asarray(flat.reshape(leaves[place].shape))
    params = jax.tree.unflatten(structure, leaves)
    learner = dataclasses.replace(state.learner, actor_params=params)
    copy: TrainState = jax.tree.map(jnp.copy, dataclasses.replace(state, learner=learner))
    return copy


def main() -> None:
    """Trains and compares."""
    config = Config.from_preset("cpu", env="Hopper", chunk_env_steps=CHUNK_ENV_STEPS)
    population = make_population(config, seed_members([0, SEED, 2]))
    program = make_program(config)
    alone, _ = program.prefill(program.init(jax.random.key(SEED)))
    together, _ = population.prefill(population.init())
    other = nudged(alone)
    rows: list[dict[str, Any]] = []
    for _ in range(CHUNKS):
        alone, _ = program.train_chunk(alone)
        other, _ = program.train_chunk(other)
        together, _ = population.train_chunk(together)
        rows.append(
            {
                "updates": int(alone.counters.updates),
                "vmapped": distance(alone, member_state(population, together, 1)),
                "one_ulp": distance(alone, other),
            }
        )
        print(rows[-1], flush=True)
    (RESULTS / "rounding.json").write_text(json.dumps(rows, indent=1) + "\n")
    figure = Figure(figsize=(7, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    updates = [row["updates"] for row in rows]
    names = {
        "parameters": "largest difference of a parameter",
        "newest_obs": "of the newest states",
    }
    for axes, (what, title) in zip(figure.subplots(1, 2), names.items(), strict=True):
        for kind, label in (("vmapped", "among three seeds"), ("one_ulp", "one parameter + 1 ulp")):
            axes.semilogy(updates, [row[kind][what] or np.nan for row in rows], label=label)
        axes.set(xlabel="updates", title=title)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].legend(frameon=False)
    figure.suptitle("A seed beside itself, Hopper, preset cpu")
    figure.savefig(RESULTS / "rounding.png", dpi=110)


if __name__ == "__main__":
    main()
