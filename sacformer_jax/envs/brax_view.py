"""The other direction: our tasks as ``brax.envs.Env``, for ``brax.training`` and its peers."""

from __future__ import annotations

import contextlib

import jax
import jax.numpy as jnp

from sacformer_jax.envs.core import Env

with contextlib.redirect_stdout(None):  # brax prints which extras it could do without
    from brax import envs as brax_envs


class BraxView(brax_envs.Env):
    """An environment of ours as brax sees it: one environment, no time limit, no reset of its own.

    Brax's wrappers (``brax.envs.training.wrap``) add vectorization, episodes and resets; give them
    ``episode_length=env.spec.max_episode_steps``. Brax's agents act in the unit box, so actions are
    scaled from there to the task's bounds. Brax knows one kind of ``done`` besides its own time
    limit, so what an environment truncates by itself ends like a termination. So does a step of bad
    physics; it has reward 0 and the observation before it, and is counted in
    ``metrics["bad_physics"]``.

    Args:
      env: one of ours, e.g. ``make_env("HalfCheetah", "native")``.

    Example:
      >>> env = as_brax(make_env("HalfCheetah"))
      >>> state = jax.jit(env.reset)(jax.random.PRNGKey(0))
      >>> state = jax.jit(env.step)(state, jnp.zeros(env.action_size))
    """

    def __init__(self, env: Env):
        self.env = env

    def reset(self, rng: jax.Array) -> brax_envs.State:
        """A fresh episode; ``rng`` is a key, typed or not."""
        env_state, obs = self.env.reset(rng)
        zero = jnp.zeros(())
        terms = jax.eval_shape(
            self.env.step, env_state, self.to_bounds(jnp.zeros(self.action_size))
        )
        metrics = dict.fromkeys((*terms[1].reward_terms, "bad_physics"), zero)
        return brax_envs.State(
            pipeline_state=env_state, obs=obs, reward=zero, done=zero, metrics=metrics
        )

    def step(self, state: brax_envs.State, action: jax.Array) -> brax_envs.State:
        """One step under ``action [A]`` in the unit box."""
        env_state, step = self.env.step(state.pipeline_state, self.to_bounds(action))
        bad = step.broke_down
        terms = {name: jnp.where(bad, 0.0, value) for name, value in step.reward_terms.items()}
        return state.replace(
            pipeline_state=env_state,
            obs=jnp.where(bad, state.obs, step.obs),
            reward=jnp.where(bad, 0.0, step.reward),
            done=(step.terminated | step.truncated | bad).astype(jnp.float32),
            metrics={**state.metrics, **terms, "bad_physics": bad.astype(jnp.float32)},
        )

    @property
    def observation_size(self) -> int:
        return self.env.spec.obs_size

    @property
    def action_size(self) -> int:
        return self.env.spec.action_size

    @property
    def backend(self) -> str:
        """The physics engine."""
        return self.env.spec.engine

    def to_bounds(self, action: jax.Array) -> jax.Array:
        """An action of the unit box, as brax's policies give them, in the task's bounds."""
        low, high = jnp.array(self.env.spec.action_low), jnp.array(self.env.spec.action_high)
        return (low + high) / 2 + (high - low) / 2 * action


def as_brax(env: Env) -> BraxView:
    """The environment as a ``brax.envs.Env``; see :class:`BraxView`."""
    return BraxView(env)
