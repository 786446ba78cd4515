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
      env: brax's name, e.g. ``"halfcheetah"``; or an environment itself, bare of wrappers. Its
        attribute ``max_episode_steps``, where it has one, is the time limit; otherwise 1000.
      backend: physics backend of an environment given by name.
      name: what an environment that is given itself is called; default: its class.

    Raises:
      ConfigError: no such environment or backend, or one that resets itself, or whose observation
        is no vector.
    """

    def __init__(self, env: str | brax_envs.Env, backend: str = "spring", name: str | None = None):
        if isinstance(env, str):
            self._env, name = self._by_name(env, backend), f"brax:{env}"
            engine_reason = "as asked for"
        else:
            self._env, name = env, name or type(env).__name__
            engine_reason = "the environment's own"
            _check_bare(env, name)
        obs = jax.eval_shape(self._env.reset, jax.random.key(0)).obs
        if len(getattr(obs, "shape", ())) != 1:
            kind = f"an array of shape {obs.shape}" if hasattr(obs, "shape") else type(obs).__name__
            raise ConfigError(f"env={name!r}: its observation is {kind}: must be one vector [O]")
        # Brax's policies act in the unit box; where the actuators' range is another, brax scales.
        unit = (1.0,) * int(self._env.action_size)
        self.spec = EnvSpec(
            name=name,
            obs_size=obs.shape[0],
            action_size=len(unit),
            action_low=tuple(-bound for bound in unit),
            action_high=unit,
            max_episode_steps=getattr(self._env, "max_episode_steps", 1000),
            engine=f"brax {self._env.backend}",
            engine_reason=engine_reason,
        )

    @staticmethod
    def _by_name(name: str, backend: str) -> brax_envs.Env:
        if name not in brax_names():
            known = ", ".join(f"brax:{known}" for known in brax_names())
            raise ConfigError(f"env='brax:{name}': no such environment; there are {known}")
        if backend not in BACKENDS:
            raise ConfigError(f"brax_backend={backend!r}: must be one of {', '.join(BACKENDS)}")
        return brax_envs.get_environment(name, backend=backend)

    @property
    def brax(self) -> brax_envs.Env:
        """The environment itself."""
        return self._env

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


def _check_bare(env: brax_envs.Env, name: str) -> None:
    inner: Any = env
    while isinstance(inner, brax_envs.Wrapper):
        if type(inner).__module__.startswith("brax.envs.wrappers"):
            raise ConfigError(
                f"env={name!r}: is wrapped in brax's {type(inner).__name__}: give the bare "
                "environment; many at once, the time limit and resets are added here"
            )
        inner = inner.env
