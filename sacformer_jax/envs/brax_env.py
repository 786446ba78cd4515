"""Any environment of ``brax.envs``, on any of its backends, under our contract."""

from __future__ import annotations

import contextlib
from typing import Any, get_args

import jax
import jax.numpy as jnp

from sacformer_jax.config import BraxBackend, ConfigError
from sacformer_jax.envs.core import EnvSpec, EnvStep, JaxEnv

with contextlib.redirect_stdout(None):  # brax prints which extras it could do without
    from brax import envs as brax_envs

BACKENDS = get_args(BraxBackend)


def brax_names() -> list[str]:
    """Names of the environments brax has registered."""
    return sorted(brax_envs._envs)


class BraxEnv(JaxEnv):
    """A brax environment. Brax's ``done`` is a termination; the time limit is ours.

    Args:
      name: brax's name, e.g. ``"halfcheetah"``.
      backend: physics backend.

    Raises:
      ConfigError: no such environment or backend.
    """

    def __init__(self, name: str, backend: str = "spring"):
        if name not in brax_names():
            known = ", ".join(f"brax:{known}" for known in brax_names())
            raise ConfigError(f"env='brax:{name}': no such environment; there are {known}")
        if backend not in BACKENDS:
            raise ConfigError(f"brax_backend={backend!r}: must be one of {', '.join(BACKENDS)}")
        self._env = brax_envs.get_environment(name, backend=backend)
        # Brax's policies act in the unit box; where the actuators' range is another, brax scales.
        unit = (1.0,) * self._env.action_size
        self.spec = EnvSpec(
            name=f"brax:{name}",
            obs_size=jax.eval_shape(self._env.reset, jax.random.key(0)).obs.shape[-1],
            action_size=int(self._env.action_size),
            action_low=tuple(-bound for bound in unit),
            action_high=unit,
            max_episode_steps=1000,
            engine=f"brax {backend}",
            engine_reason="as asked for",
        )

    def reset(self, key: jax.Array) -> tuple[Any, jax.Array]:
        state = self._env.reset(key)
        return state, state.obs

    def step(self, state: Any, action: jax.Array) -> tuple[Any, EnvStep]:
        state = self._env.step(state, action)
        step = EnvStep(
            obs=state.obs,
            reward=state.reward,
            terminated=state.done > 0.5,
            bad=jnp.zeros((), bool),  # non-finite values are caught by the vector env
            reward_terms={k: v for k, v in state.metrics.items() if k.startswith("reward_")},
        )
        return state, step
