"""Whether an environment keeps our contract, told in the words of who wrote it."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.core import Env, EnvSpec, EnvStep
from sacformer_jax.envs.wrapping import are_places

_METHODS = ("reset", "step", "step_and_refill")


def check_env(env: Env, num_steps: int = 20, name: str | None = None) -> None:
    """Checks that an environment keeps the contract of :class:`~sacformer_jax.envs.core.Env`.

    Its facts and shapes are looked at without running anything; then it takes steps under random
    actions, compiled, and their values are looked at, too. Environments of one's own are checked
    when they are made, with ``num_steps=0``.

    Args:
      env: the environment.
      num_steps: how many steps to take; with 0 nothing is run.
      name: what it is called in messages; default: ``env.spec.name``.

    Raises:
      ConfigError: it does not keep it; the message says where, and what would be right.
    """
    _check_spec(env, name)
    check = _Check(env, env.spec.name if name is None else name)
    check.shapes()
    if num_steps > 0:
        check.values(num_steps)


def _check_spec(env: Env, name: str | None) -> None:
    spec = getattr(env, "spec", None)
    if not isinstance(spec, EnvSpec):
        raise ConfigError(
            f"env={name or type(env).__name__!r}: spec is of type {type(spec).__name__}: must be "
            "an EnvSpec"
        )
    for method in _METHODS:
        if not callable(getattr(env, method, None)):
            raise ConfigError(
                f"env={name or spec.name!r}: has no {method}; derive its class from JaxEnv, "
                "which has step_and_refill, and define reset and step"
            )


class _Check:
    """The checks of one environment, whose methods and spec are there.

    Args:
      env: the environment.
      name: what it is called.
    """

    def __init__(self, env: Env, name: str):
        self.env, self.spec, self.name = env, env.spec, name

    def require(self, holds: bool, message: str) -> None:
        if not holds:
            raise ConfigError(f"env={self.name!r}: {message}")

    # --- without running it ------------------------------------------------------------------

    def shapes(self) -> None:
        """Facts, shapes and types."""
        self._bounds()
        key = jax.eval_shape(lambda: jax.random.key(0))
        state, obs = self._pair("reset", jax.eval_shape(self.env.reset, key))
        self._array("reset: obs", obs, (self.spec.obs_size,), jnp.float32)
        action = jax.ShapeDtypeStruct((self.spec.action_size,), jnp.float32)
        after, step = self._pair("step", jax.eval_shape(self.env.step, state, action))
        self._step(step)
        self._same("the state after step", after, "that after reset", state)
        self._refill(state, obs, action, step)

    def _bounds(self) -> None:
        spec = self.spec
        for field in ("obs_size", "action_size", "max_episode_steps"):
            value = getattr(spec, field)
            self.require(
                isinstance(value, int) and value >= 1, f"spec.{field}={value!r}: must be 1 or more"
            )
        for field in ("action_low", "action_high"):
            bounds = getattr(spec, field)
            self.require(
                isinstance(bounds, tuple) and len(bounds) == spec.action_size,
                f"spec.{field}={bounds!r}: must be a tuple of {spec.action_size} floats",
            )
            self.require(
                all(math.isfinite(bound) for bound in bounds),
                f"spec.{field}={bounds!r}: must be finite, since actions are scaled to the bounds",
            )
        self.require(
            are_places(spec.velocities, spec.obs_size),
            f"spec.velocities={spec.velocities!r}: must be pairs (start, stop) in order, within "
            f"the {spec.obs_size} observations",
        )
        self.require(
            all(low < high for low, high in zip(spec.action_low, spec.action_high, strict=True)),
            f"spec.action_low={spec.action_low}: must be below spec.action_high={spec.action_high}",
        )

    def _pair(self, method: str, result: Any) -> tuple[Any, Any]:
        self.require(
            isinstance(result, tuple) and len(result) == 2,
            f"{method} gives {type(result).__name__}: must be a pair, the state and "
            f"{'obs' if method == 'reset' else 'an EnvStep'}",
        )
        return result

    def _step(self, step: Any) -> None:
        self.require(
            isinstance(step, EnvStep),
            f"step gives {type(step).__name__} beside the state: must be an EnvStep",
        )
        self._array("step: obs", step.obs, (self.spec.obs_size,), jnp.float32)
        self._array("step: reward", step.reward, (), jnp.float32)
        self._array("step: terminated", step.terminated, (), jnp.bool_)
        self._array("step: bad", step.bad, (), jnp.bool_)
        self._array("step: truncated", step.truncated, (), jnp.bool_)
        self.require(
            isinstance(step.reward_terms, dict),
            f"step: reward_terms is of type {type(step.reward_terms).__name__}: must be a dict",
        )
        for name, term in step.reward_terms.items():
            self._array(f"step: reward_terms[{name!r}]", term, (), jnp.float32)

    def _array(self, what: str, value: Any, shape: tuple[int, ...], dtype: Any) -> None:
        is_array = hasattr(value, "shape") and hasattr(value, "dtype")
        given = _described(value) if is_array else type(value).__name__
        wanted = f"{jnp.dtype(dtype).name}{list(shape)}"
        self.require(
            is_array and value.shape == shape and value.dtype == dtype,
            f"{what} is {given}: must be {wanted}",
        )

    def _same(self, what: str, tree: Any, other_what: str, other: Any) -> None:
        """Two PyTrees have the same structure, shapes and types, as a loop over steps needs."""
        leaves, others = (
            {jax.tree_util.keystr(path): _described(leaf) for path, leaf in flat}
            for flat in (jax.tree_util.tree_leaves_with_path(t) for t in (tree, other))
        )
        for path in dict.fromkeys([*leaves, *others]):
            given, wanted = leaves.get(path, "missing"), others.get(path, "missing")
            self.require(
                given == wanted,
                f"{what} differs from {other_what}: {path or 'it'} is {given}, there {wanted}; "
                "both must have the same structure, shapes and types",
            )
        structure: Any = jax.tree.structure(tree)
        wanted_structure: Any = jax.tree.structure(other)
        self.require(
            structure == wanted_structure,
            f"{what} differs from {other_what}: {structure}, there {wanted_structure}",
        )

    def _refill(self, state: Any, obs: Any, action: Any, step: EnvStep) -> None:
        keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 2))
        refilled = jax.eval_shape(
            lambda states, actions, refill, prepared, keys: self.env.step_and_refill(
                states, actions, refill, prepared, lambda: keys
            ),
            _of_two(state),
            _of_two(action),
            jax.ShapeDtypeStruct((2,), jnp.bool_),
            _of_two((state, obs)),
            keys,
        )
        wanted = _of_two(((state, step), (state, obs)))
        self._same("what step_and_refill gives", refilled, "reset and step of each", wanted)

    # --- with running it ---------------------------------------------------------------------

    def values(self, num_steps: int) -> None:
        """Steps under random actions: finite, and the same each time."""
        low, high = np.asarray(self.spec.action_low), np.asarray(self.spec.action_high)

        @jax.jit
        def run(key: jax.Array) -> tuple[jax.Array, EnvStep]:
            start, action_key = jax.random.split(key)
            state, obs = self.env.reset(start)
            shape = (num_steps, self.spec.action_size)
            actions = jax.random.uniform(action_key, shape, jnp.float32, low, high)
            return obs, jax.lax.scan(self.env.step, state, actions)[1]

        first = jax.device_get(run(jax.random.key(0)))
        again = jax.device_get(run(jax.random.key(0)))
        obs, steps = first
        self.require(bool(np.isfinite(obs).all()), "reset: obs is not finite")
        good = ~steps.bad
        self.require(
            bool(np.isfinite(steps.obs[good]).all()), "step: obs is not finite where bad is false"
        )
        self.require(
            bool(np.isfinite(steps.reward[good]).all()),
            "step: reward is not finite where bad is false",
        )
        for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
            self.require(
                np.array_equal(one, other, equal_nan=True),
                "the same key and actions give other values the second time: reset and step must "
                "be pure functions, with everything random from the key",
            )


def _of_two(tree: Any) -> Any:
    """Shapes with a leading axis of two environments."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((2, *leaf.shape), leaf.dtype), tree)


def _described(leaf: Any) -> str:
    return f"{leaf.dtype}{list(leaf.shape)}"
