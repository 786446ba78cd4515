"""Run by test_mesh.py in a process with 8 CPU devices: what it finds, as JSON.

python mesh_program.py MESH …, each one of members, data, both, update
"""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as Spec
from trees import largest_difference, unequal

from sacformer_jax import Config, Devices, agents, make_population, seed_members
from sacformer_jax.parallel import DATA_AXIS, DataAxis
from sacformer_jax.train import hyperparameters

SETTINGS = {
    "env": "Hopper", "num_envs": 4, "max_episode_steps": 60, "prefill_env_steps": 480,
    "chunk_env_steps": 40, "total_env_steps": 2_000, "eval_episodes": 2, "actor_width": 8,
    "actor_layers": 1, "critic_width": 8, "batch_size": 8, "buffer_capacity": 2_000,
    "updates_per_env_step": 0.5, "normalize_obs": True, "tune_alpha": True,
}  # fmt: skip
SACFORMER = {
    "actor_heads": 1, "actor_dropout": 0.0, "return_conditioning": "commanded",
    "target_return": "auto", "context_length": 3,
}  # fmt: skip
MESHES = {
    "members": Devices(members=4), "data": Devices(data=4), "both": Devices(members=4, data=2),
}  # fmt: skip
COLLECTIVES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter")


def collectives(compiled: Any) -> dict[str, int]:
    """How many of each a program contains."""
    text = compiled.as_text()
    found = {name: len(re.findall(rf" {name}(?:-start)?\(", text)) for name in COLLECTIVES}
    return {name: number for name, number in found.items() if number}


def trained(devices: Devices) -> dict[str, Any]:
    """The states of four seeds of SAC after prefill and after two chunks, on these devices."""
    config = Config.from_preset("cpu", agent="sac", **SETTINGS, seeds=4)
    population = make_population(config, seed_members(config.all_seeds), devices)
    state, _ = population.prefill(population.init())
    prefilled = jax.tree.map(jnp.copy, state)
    program = population.train_chunk.lower(state).compile()
    for _ in range(2):
        state, metrics = program(state)
    devices_used = {
        device.id for leaf in jax.tree.leaves(state) for device in leaf.sharding.device_set
    }
    return {
        "prefilled": jax.device_get(_plain(prefilled)),
        "trained": jax.device_get(_plain(state)),
        "metrics": jax.device_get(metrics),
        "collectives": collectives(program),
        "num_devices": len(devices_used),
        "evaluation": jax.device_get(population.evaluate(_policy(state), np.int32(560))),
    }


def _policy(state: Any) -> Any:
    from sacformer_jax import policy_of

    return policy_of(state)


def _plain(tree: Any) -> Any:
    return jax.tree.map(
        lambda x: (
            jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        ),
        tree,
    )


def _with_variances(learner: Any) -> Any:
    """The statistics' sums of squares, in the thousands, as the variances that are learnt with."""
    normalizer = learner.normalizer
    variance = normalizer.m2 / np.maximum(normalizer.count, 1)[:, None]  # [S, O]
    return dataclasses.replace(learner, normalizer=dataclasses.replace(normalizer, m2=variance))


def compared(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    learners = [_with_variances(which["trained"].learner) for which in (one, other)]
    return {
        "prefilled": unequal(one["prefilled"], other["prefilled"]),
        "learner": largest_difference(*learners),
        "trained": unequal(one["trained"], other["trained"]),
        "evaluation": largest_difference(one["evaluation"], other["evaluation"]),
        "collectives": other["collectives"],
        "num_devices": other["num_devices"],
    }


def update_of_the_same_batch(agent_name: str) -> float:
    """Largest difference of the new learner: the batch on 4 devices, and on one."""
    own = SACFORMER if agent_name == "sacformer" else {}
    config = Config.from_preset("cpu", agent=agent_name, **SETTINGS, **own)
    population = make_population(config, seed_members([0]))
    program, key = population.program, jax.random.key(3)
    state, _ = population.prefill(population.init())
    state = jax.tree.map(lambda s, x: x[0] if len(s) else x, population.specs, state)
    hyper = hyperparameters(config, program.env.spec.action_size)
    sample = jax.jit(program.buffer.sample, static_argnums=2)
    window = sample(state.buffer, key, 32, hyper.rtg_discount)
    expected, metrics = jax.jit(program.agent.update)(state.learner, hyper, window, key)

    split_agent = agents.make(config, program.env.spec, DataAxis(4))
    mesh = jax.make_mesh(
        (4,), (DATA_AXIS,), axis_types=(jax.sharding.AxisType.Auto,), devices=jax.devices()[:4]
    )
    update = jax.jit(
        jax.shard_map(
            split_agent.update,
            mesh=mesh,
            in_specs=(Spec(), Spec(), Spec(DATA_AXIS), Spec()),
            out_specs=(Spec(), Spec()),
            check_vma=False,
        )
    )
    compiled = update.lower(state.learner, hyper, window, key).compile()
    ours, our_metrics = compiled(state.learner, hyper, window, key)
    assert collectives(compiled) == {"all-reduce": 3}, collectives(compiled)
    for name, value in metrics.items():
        np.testing.assert_allclose(our_metrics[name], value, rtol=1e-4, atol=1e-6, err_msg=name)
    moved = largest_difference(expected, state.learner)
    assert moved > 1e-4
    return largest_difference(ours, expected)


def main() -> None:
    assert jax.device_count() == 8
    one = trained(Devices())
    found: dict[str, Any] = {
        mesh: compared(one, trained(MESHES[mesh])) for mesh in sys.argv[1:] if mesh in MESHES
    }
    if "update" in sys.argv[1:]:
        found["update"] = {name: update_of_the_same_batch(name) for name in ("sacformer", "sac")}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
