"""A task on a physics engine: the five Gymnasium tasks as environments of the contract."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax.envs.core import EnvSpec, EnvStep, where_tree
from sacformer_jax.envs.physics import EngineChoice, PhysicsOutput, ResetNoise, make_engine
from sacformer_jax.envs.tasks import TASKS
from sacformer_jax.parallel import any_of_all


class MujocoEnv:
    """One of :data:`~sacformer_jax.envs.tasks.TASKS` on a physics engine.

    Args:
      name: the task's name, e.g. ``"HalfCheetah"``.
      choice: the physics engine.

    Raises:
      KeyError: no such task.
      ConfigError: this machine or this task cannot have the engine.
    """

    def __init__(self, name: str, choice: EngineChoice):
        self.task = task = TASKS[name]
        choice, reason = choice.resolved()
        self.engine = make_engine(task, choice)
        obs_size = jax.eval_shape(self.reset, jax.random.key(0))[1].shape[0]
        self.spec = EnvSpec(
            name=name,
            obs_size=obs_size,
            action_size=self.engine.action_low.shape[0],
            action_low=tuple(self.engine.action_low.tolist()),
            action_high=tuple(self.engine.action_high.tolist()),
            max_episode_steps=task.max_episode_steps,
            engine=choice.engine,
            engine_reason=reason,
            gymnasium_id=task.gymnasium_id,
        )

    def reset(self, key: jax.Array) -> tuple[Any, jax.Array]:
        physics = self.engine.reset(self.reset_noise(key))
        return physics.state, self.task.observe(physics.quantities)

    def step(self, state: Any, action: jax.Array) -> tuple[Any, EnvStep]:
        physics = self.engine.step(state, action)
        return physics.state, self._env_step(physics, action)

    def step_and_refill(
        self,
        states: Any,
        actions: jax.Array,
        refill: jax.Array,
        prepared: tuple[Any, jax.Array],
        keys: Callable[[], jax.Array],
    ) -> tuple[tuple[Any, EnvStep], tuple[Any, jax.Array]]:
        num, nq, nv = len(refill), self.engine.nq, self.engine.nv
        noise = jax.lax.cond(
            any_of_all(refill),
            lambda: jax.vmap(self.reset_noise)(keys()),
            lambda: ResetNoise(qpos=jnp.zeros((num, nq)), qvel=jnp.zeros((num, nv))),
        )
        stepped, fresh = self.engine.step_and_reset(states, actions, refill, noise)
        fresh_obs = jax.vmap(self.task.observe)(fresh.quantities)
        steps = jax.vmap(self._env_step)(stepped, actions)
        return (stepped.state, steps), where_tree(refill, (fresh.state, fresh_obs), prepared)

    def reset_noise(self, key: jax.Array) -> ResetNoise:
        """The random part of a reset, drawn as the Gymnasium task draws it."""
        task, nq = self.task, self.engine.nq
        # One draw for both, made normal by the inverse of its distribution function where the
        # task wants that: on CPU each draw costs more than its numbers.
        above_minus_one = np.nextafter(np.float32(-1.0), np.float32(0.0))
        draws = jax.random.uniform(
            key, (nq + self.engine.nv,), jnp.float32, above_minus_one, maxval=1.0
        )
        qpos, qvel = draws[:nq], draws[nq:]
        if task.qvel_noise_normal:
            qvel = np.sqrt(2.0, dtype=np.float32) * jax.lax.erf_inv(qvel)
        return ResetNoise(qpos=task.qpos_noise * qpos, qvel=task.qvel_noise * qvel)

    def _env_step(self, physics: PhysicsOutput, action: jax.Array) -> EnvStep:
        quantities = physics.quantities
        x_velocity = quantities.displacement[0] / self.engine.dt
        terms = self.task.reward_terms(quantities, action, x_velocity)
        return EnvStep(
            obs=self.task.observe(quantities),
            reward=jnp.stack(list(terms.values())).sum(),
            terminated=self.task.terminated(quantities),
            bad=physics.bad,
            reward_terms=terms,
        )
