"""A policy's acting step as a plain function of arrays, and what an exported file says of it."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from sacformer_jax.policy import Policy
from sacformer_jax.version import __version__

FORMAT, FORMAT_VERSION = "sacformer-policy", 1
Size = Any
"""Of an axis: a number, or one of ``jax.export``'s symbols."""


@dataclasses.dataclass(frozen=True)
class Leaf:
    """An array of a state.

    Attributes:
      name: its place, e.g. ``"context.obs"``.
      shape: without the axis of environments, where it has one.
      dtype: of NumPy, or bfloat16.
      per_env: whether its first axis is that of the environments.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    per_env: bool

    def sized(self, num_envs: Size) -> tuple[Size, ...]:
        """The whole shape."""
        return (num_envs, *self.shape) if self.per_env else self.shape


class ActingStep:
    """The acting step as a function of arrays, with as small a state as it needs.

    Attributes:
      policy: whose.
      leaves: the arrays of the state that an action, now or later, depends on: for a policy that
        looks at one observation none at all.
    """

    def __init__(self, policy: Policy, deterministic: bool):
        self.policy, self._deterministic = policy, deterministic
        shaped = jax.eval_shape(lambda: policy.initial_state(1))
        paths, self._treedef = jax.tree_util.tree_flatten_with_path(shaped)
        self._all = self.leaves = tuple(_leaf(path, array) for path, array in paths)
        self.leaves = self._needed()

    @property
    def random(self) -> bool:
        """Whether it draws random numbers."""
        return any(not leaf.per_env for leaf in self.leaves)

    def shapes(self, num_envs: Size) -> list[jax.ShapeDtypeStruct]:
        """Of what :meth:`flat` takes."""
        shaped = jax.ShapeDtypeStruct
        return [
            shaped((num_envs, self.policy.spec.obs_size), jnp.float32),
            shaped((num_envs,), jnp.bool_),
            shaped((num_envs,), jnp.float32),
            *(shaped(leaf.sized(num_envs), leaf.dtype) for leaf in self.leaves),
        ]

    def flat(
        self, obs: jax.Array, episode_start: jax.Array, reward: jax.Array, *state: jax.Array
    ) -> tuple[jax.Array, ...]:
        """``obs [N, O]``, ``episode_start [N]``, ``reward [N]``, leaves -> ``action [N, A]``,
        leaves.
        """
        given = {leaf.name: array for leaf, array in zip(self.leaves, state, strict=True)}
        # What no action depends on may be anything.
        whole = [
            given[leaf.name] if leaf.name in given
            else jnp.zeros(leaf.sized(obs.shape[0]), leaf.dtype)
            for leaf in self._all
        ]  # fmt: skip
        acting_state = jax.tree.unflatten(self._treedef, whole)
        policy = self.policy
        after = policy.act(
            policy.state, acting_state, obs, episode_start, reward, self._deterministic
        )
        by_leaf = zip(self._all, jax.tree.leaves(after), strict=True)
        return after.last.action, *(x for leaf, x in by_leaf if leaf.name in given)

    def call(
        self,
        obs: jax.Array,
        state: dict[str, jax.Array],
        episode_start: jax.Array,
        reward: jax.Array,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The same with the state as a dictionary: ``action, state``."""
        names = [leaf.name for leaf in self.leaves]
        action, *after = self.flat(obs, episode_start, reward, *(state[name] for name in names))
        return action, dict(zip(names, after, strict=True))

    def _needed(self) -> tuple[Leaf, ...]:
        """The leaves that the action depends on, at once or by way of other leaves."""
        jaxpr = jax.make_jaxpr(self.flat)(*self.shapes(1)).jaxpr
        needed = [False] * len(self._all)
        while True:
            _, used = partial_eval.dce_jaxpr(jaxpr, [True, *needed])
            if used[3:] == needed:
                return tuple(itertools.compress(self._all, needed))
            needed = [old or new for old, new in zip(needed, used[3:], strict=True)]


def _leaf(path: tuple[Any, ...], array: jax.ShapeDtypeStruct) -> Leaf:
    name = jax.tree_util.keystr(path, simple=True, separator=".").removeprefix("last.")
    per_env = name != "key"
    return Leaf(name, array.shape[1:] if per_env else array.shape, array.dtype, per_env)


def manifest(step: ActingStep, num_envs: int | None, deterministic: bool) -> dict[str, Any]:
    """What an exported file says of itself, as plain values.

    ``"N"`` in a shape is the number of environments, of whoever calls it.
    """
    policy, n = step.policy, "N" if num_envs is None else num_envs

    def array(shape: Sequence[Size], dtype: Any) -> dict[str, Any]:
        return {"shape": list(shape), "dtype": jnp.dtype(dtype).name}

    spec = policy.spec
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "made_with": {"sacformer_jax": __version__, "jax": jax.__version__},
        "agent": policy.config.agent,
        "env": spec.name,
        "gymnasium_id": spec.gymnasium_id,
        "wrappers": dataclasses.asdict(spec.wrapping) if spec.wrapping.words() else None,
        "deterministic": deterministic,
        "uses_reward": policy.uses_reward,
        "action_low": list(spec.action_low),
        "action_high": list(spec.action_high),
        "call": "action, state = call(obs, state, episode_start, reward)",
        "inputs": {
            "obs": array((n, spec.obs_size), jnp.float32),
            "episode_start": array((n,), jnp.bool_),
            "reward": array((n,), jnp.float32),
        },
        "outputs": {"action": array((n, spec.action_size), jnp.float32)},
        "state": {leaf.name: array(leaf.sized(n), leaf.dtype) for leaf in step.leaves},
        "initial_state": "zeros",
        "config": policy.config.to_dict(),
    }
