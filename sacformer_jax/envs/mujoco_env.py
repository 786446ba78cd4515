"""A task on a physics engine, as an environment of the contract."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.core import EnvSpec, EnvStep, where_tree
from sacformer_jax.envs.physics import EngineChoice, PhysicsOutput, ResetNoise, make_engine
from sacformer_jax.envs.tasks import (
    TASKS,
    Coordinates,
    Derived,
    RewardTerms,
    Task,
    positions_and_velocities,
)
from sacformer_jax.parallel import any_of_all


class MujocoEnv:
    """A task on a physics engine.

    Args:
      task: your own, or the name of one of :data:`~sacformer_jax.envs.tasks.TASKS`.
      choice: the physics engine; default: by device.

    Raises:
      KeyError: no such task.
      ConfigError: this machine or this task cannot have the engine, or the task cannot be run.
    """

    def __init__(self, task: Task | str, choice: EngineChoice | None = None):
        self.task = task = TASKS[task] if isinstance(task, str) else task
        choice, reason = (choice or EngineChoice()).resolved()
        self.engine = make_engine(task, choice)
        obs = jax.eval_shape(self.reset, jax.random.key(0))[1]
        if len(getattr(obs, "shape", ())) != 1 or obs.dtype != jnp.float32:
            raise ConfigError(
                f"task {task.name!r}: observe gives {obs}: must be a vector [O] of float32"
            )
        velocities = task.velocities
        if not velocities and task.observe is positions_and_velocities:
            velocities = ((self.engine.nq, self.engine.nq + self.engine.nv),)
        self.spec = EnvSpec(
            name=task.name,
            obs_size=obs.shape[0],
            action_size=self.engine.action_low.shape[0],
            action_low=tuple(self.engine.action_low.tolist()),
            action_high=tuple(self.engine.action_high.tolist()),
            max_episode_steps=task.max_episode_steps,
            engine=choice.engine,
            engine_reason=reason,
            gymnasium_id=task.gymnasium_id,
            velocities=velocities,
        )

    def reset(self, key: jax.Array) -> tuple[Any, jax.Array]:
        physics = self.engine.reset(self._start(key))
        return physics.state, self._read(self.task.observe, physics.quantities)

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
            lambda: jax.vmap(self._start)(keys()),
            lambda: ResetNoise(qpos=jnp.zeros((num, nq)), qvel=jnp.zeros((num, nv))),
        )
        stepped, fresh = self.engine.step_and_reset(states, actions, refill, noise)
        fresh_obs = jax.vmap(self.task.observe)(fresh.quantities)
        steps = jax.vmap(self._env_step)(stepped, actions)
        return (stepped.state, steps), where_tree(refill, (fresh.state, fresh_obs), prepared)

    def _start(self, key: jax.Array) -> ResetNoise:
        """Where an episode starts, as what is added to where the model does."""
        if self.task.reset is None:
            return self.reset_noise(key)
        initial = Coordinates(qpos=self.engine.init_qpos, qvel=jnp.zeros(self.engine.nv))
        start = self.task.reset(key, initial)
        for name in ("qpos", "qvel"):
            expected, given = getattr(initial, name).shape, jnp.shape(getattr(start, name))
            if given != expected:
                raise ConfigError(
                    f"task {self.task.name!r}: reset gives {name} of shape {given}: must be "
                    f"{expected}"
                )
        return ResetNoise(
            qpos=jnp.asarray(start.qpos, jnp.float32) - initial.qpos,
            qvel=jnp.asarray(start.qvel, jnp.float32),
        )

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
        terms = self._as_scalars(self._read(self.task.reward_terms, quantities, action, x_velocity))
        return EnvStep(
            obs=self._read(self.task.observe, quantities),
            reward=jnp.stack(list(terms.values())).sum(),
            terminated=jnp.asarray(self._read(self.task.terminated, quantities)),
            bad=physics.bad,
            reward_terms=terms,
        )

    def _read(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Calls a function of the task's."""
        try:
            return function(*arguments)
        except KeyError as error:
            if error.args[0] not in get_args(Derived):
                raise
            raise ConfigError(
                f"task {self.task.name!r}: derived={self.task.derived}: has no {error}, which "
                "its functions read; name it there"
            ) from error

    def _as_scalars(self, terms: RewardTerms) -> RewardTerms:
        if not isinstance(terms, dict) or not terms:
            raise ConfigError(
                f"task {self.task.name!r}: reward_terms must give a dict of one or more scalars, "
                'such as {"reward_forward": x_velocity}'
            )
        terms = {name: jnp.asarray(term, jnp.float32) for name, term in terms.items()}
        for name, term in terms.items():
            if term.shape != ():
                raise ConfigError(
                    f"task {self.task.name!r}: reward_terms gives {name!r} of shape {term.shape}: "
                    "must be a scalar"
                )
        return terms
