"""``brax.training``'s PPO on a task of ours, as brax sees it through ``as_brax``.

The physics is our engine, inside brax's own program; the trained policy is then run in Gymnasium's
environment of the same name, which knows neither. Writes results/brax_ppo.json.

python experiments/brax_ppo.py --env HalfCheetah --steps 500000
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from benchmark import machine
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo

from sacformer_jax import as_brax, make_env
from sacformer_jax.envs.brax_view import BraxView
from sacformer_jax.envs.models import loading_quietly

RESULTS = Path(__file__).parent / "results" / "brax_ppo.json"
REPORTED = ("eval/episode_", "eval/avg_episode_length", "training/total_loss", "training/sps")
"""How the names of the metrics begin that are kept."""
BATCH, MINIBATCHES = 16, 16


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is run.

    Attributes:
      env: one of our tasks.
      steps: environment steps, rounded up by brax to whole rounds.
      num_envs: environments side by side; must divide 256, the pieces of a round.
      unroll_steps: of a piece.
      evaluations: brax's own, the one before the first step included.
      seed: of everything random.
      width: of the two hidden layers of policy and value.
      episodes: of the evaluation in Gymnasium.
      max_episode_steps: time limit.
    """

    env: str = "HalfCheetah"
    steps: int = 500_000
    num_envs: int = 16
    unroll_steps: int = 16
    evaluations: int = 11
    seed: int = 0
    width: int = 64
    episodes: int = 10
    max_episode_steps: int = 1000


def give_back_device_put_replicated() -> None:
    """Brax 0.14.2's agents call ``jax.device_put_replicated``, which JAX 0.10.0 has removed.

    Nothing is done where JAX has it. What replaces it is what JAX's changelog recommends.
    """
    if hasattr(jax, "device_put_replicated"):
        return

    def device_put_replicated(tree: Any, devices: Sequence[jax.Device]) -> Any:
        # The axis has the name of brax's own in jax.pmap, or their arrays do not go together.
        mesh = jax.sharding.Mesh(np.array(devices), ("i",))
        sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("i"))

        def put(leaf: Any) -> jax.Array:
            return jax.device_put(jnp.stack([jnp.asarray(leaf)] * len(devices)), sharding)

        return jax.tree.map(put, tree)

    vars(jax)["device_put_replicated"] = device_put_replicated


@dataclasses.dataclass(frozen=True)
class Trained:
    """What brax's PPO gives.

    Attributes:
      policy: ``obs [O] -> action [A]`` in the unit box, its mean.
      evaluations: brax's reports, by environment steps.
    """

    policy: Callable[[jax.Array], jax.Array]
    evaluations: dict[int, dict[str, float]]


def train(setting: Setting) -> Trained:
    """Trains brax's PPO on the task, on one device."""
    give_back_device_put_replicated()
    evaluations: dict[int, dict[str, float]] = {}

    def progress(env_steps: int, metrics: dict[str, Any]) -> None:
        evaluations[env_steps] = {name: float(value) for name, value in metrics.items()}
        reward = metrics["eval/episode_reward"]
        print(f"{env_steps:>9,} env steps  return {reward:8.1f}", file=sys.stderr)

    layers = (setting.width, setting.width)
    make_policy, params, _ = ppo.train(
        environment=as_brax(make_env(setting.env, "native")),
        num_timesteps=setting.steps,
        max_devices_per_host=1,
        num_envs=setting.num_envs,
        num_evals=setting.evaluations,
        num_eval_envs=setting.episodes,
        deterministic_eval=True,
        episode_length=setting.max_episode_steps,
        seed=setting.seed,
        learning_rate=3e-4,
        entropy_cost=1e-3,
        discounting=0.99,
        normalize_observations=True,
        unroll_length=setting.unroll_steps,
        batch_size=BATCH,
        num_minibatches=MINIBATCHES,
        num_updates_per_batch=8,
        max_grad_norm=0.5,
        clipping_epsilon=0.2,
        network_factory=functools.partial(
            ppo_networks.make_ppo_networks,
            policy_hidden_layer_sizes=layers,
            value_hidden_layer_sizes=layers,
        ),
        progress_fn=progress,
    )
    act = jax.jit(make_policy(params, deterministic=True))
    return Trained(lambda obs: act(obs, jax.random.key(0))[0], evaluations)


def in_gymnasium(setting: Setting, trained: Trained) -> list[float]:
    """Returns of the policy's episodes in Gymnasium's environment."""
    view: BraxView = as_brax(make_env(setting.env, "native"))
    returns = []
    with loading_quietly(), contextlib.closing(gymnasium.make(f"{setting.env}-v5")) as env:
        for episode in range(setting.episodes):
            obs, _ = env.reset(seed=setting.seed + episode)
            total, done = 0.0, False
            while not done:
                action = view.to_bounds(trained.policy(jnp.asarray(obs, jnp.float32)))
                obs, reward, terminated, truncated, _ = env.step(np.asarray(action))
                total, done = total + float(reward), terminated or truncated
            returns.append(total)
    return returns


def main(arguments: Sequence[str] | None = None) -> None:
    """Trains, evaluates in Gymnasium, writes and prints the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    for field in dataclasses.fields(Setting):
        flag = f"--{field.name.replace('_', '-')}"
        parser.add_argument(flag, type=type(field.default), default=field.default)
    parser.add_argument("--json", type=Path, default=RESULTS, help="where the result goes")
    given = vars(parser.parse_args(arguments))
    path = given.pop("json")
    machine_facts = machine()
    setting, start = Setting(**given), time.perf_counter()
    trained = train(setting)
    seconds = time.perf_counter() - start
    returns = in_gymnasium(setting, trained)
    result = {
        "command": "python experiments/brax_ppo.py "
        + " ".join(f"--{name.replace('_', '-')} {value}" for name, value in given.items()),
        "setting": dataclasses.asdict(setting),
        "machine": machine_facts,
        "training_seconds": seconds,
        "evaluations": {
            str(steps): {
                name: value for name, value in metrics.items() if name.startswith(REPORTED)
            }
            for steps, metrics in trained.evaluations.items()
        },
        "gymnasium_returns": returns,
        "gymnasium_return_mean": float(np.mean(returns)),
    }
    path.write_text(json.dumps(result, indent=2) + "\n")
    print(f"{setting.env}-v5 in Gymnasium: {np.mean(returns):.1f} ± {np.std(returns):.1f}")


if __name__ == "__main__":
    main()
