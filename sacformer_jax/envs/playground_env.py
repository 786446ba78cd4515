"""Tasks of MuJoCo Playground (extra ``playground``) under our contract.

Playground's own wrapper starts every episode of an environment from the first state it had; here
resets are those of the contract, random each time.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import subprocess
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

from sacformer_jax.config import ConfigError
from sacformer_jax.env_names import playground_limit
from sacformer_jax.envs.core import EnvSpec, EnvStep, JaxEnv
from sacformer_jax.presets import UNKNOWN_TARGET, Layer


def _playground() -> ModuleType:
    """The package.

    Raises:
      ConfigError: it is not installed.
    """
    try:
        with contextlib.redirect_stdout(None):  # warp prints where it is
            return importlib.import_module("mujoco_playground")
    except ImportError as error:
        raise ConfigError(
            f"env='playground:…': needs MuJoCo Playground ({error}): "
            'pip install "sacformer-jax[playground]"'
        ) from error


def playground_names() -> list[str]:
    """Names of Playground's tasks, those registered by the user among them.

    Raises:
      ConfigError: Playground is not installed.
    """
    package = _playground()
    suites = (package.dm_control_suite, package.locomotion, package.manipulation)
    return sorted(name for suite in suites for name in suite.ALL_ENVS)


def task_layers(name: str) -> tuple[Layer, ...]:
    """Settings that Playground knows better than our defaults.

    Raises:
      ConfigError: Playground is not installed or has no such task.
    """
    limit = playground_limit(_default_config(name))
    layers = [Layer("the task's own episode length", {"max_episode_steps": limit})]
    if name in _playground().dm_control_suite.ALL_ENVS:
        # Rewards are at most 1 there, whatever the task.
        values = {"target_return": float(limit), "return_scale": limit / 10}
        layers.append(Layer("the highest return there is, and a tenth of it", values))
    else:
        layers.append(UNKNOWN_TARGET)
    return tuple(layers)


class PlaygroundEnv(JaxEnv):
    """A Playground environment. Its ``done`` is a termination; the time limit is ours.

    The parts of the reward are those of its metrics whose names begin with ``reward``. Where its
    configuration has an ``action_repeat``, a step of ours is as many of its own.

    Args:
      env: Playground's name, e.g. ``"CheetahRun"``; or an ``mjx_env.MjxEnv`` of one's own.
      mjx_impl: implementation of MJX: ``"jax"``; one's own has chosen.
      name: what one's own is called.

    Raises:
      ConfigError: Playground or the task's robot is not there, there is no such task, its
        observations are not one vector, or ``mjx_impl`` is another one.
    """

    def __init__(self, env: str | Any, mjx_impl: str = "jax", name: str | None = None):
        if isinstance(env, str):
            config, name = _default_config(env), f"playground:{env}"
            _check_impl(mjx_impl)
            overrides = {"impl": mjx_impl} if "impl" in config else {}
            self._env = _load(env, overrides)
        else:
            config, name = env._config, name or type(env).__name__
            self._env = env
        self._action_repeat = int(config.get("action_repeat", 1))
        size = int(self._env.action_size)
        state = jax.eval_shape(self._env.reset, jax.random.key(0))
        self.spec = EnvSpec(
            name=name,
            obs_size=_checked_obs_size(name, state.obs),
            action_size=size,
            action_low=(-1.0,) * size,  # as Playground's own training bounds them
            action_high=(1.0,) * size,
            max_episode_steps=playground_limit(config),
            engine="mjx",
            engine_reason="as Playground has it; impl jax",
        )

    @property
    def playground(self) -> Any:
        """The environment itself."""
        return self._env

    @property
    def dt(self) -> float:
        """Seconds of a step."""
        return float(self._env.dt) * self._action_repeat

    def reset(self, key: jax.Array) -> tuple[Any, jax.Array]:
        state = self._env.reset(key)
        return state, state.obs

    def step(self, state: Any, action: jax.Array) -> tuple[Any, EnvStep]:
        def once(state: Any, _: None) -> tuple[Any, EnvStep]:
            state = self._env.step(state, action)
            qpos, qvel = state.data.qpos, state.data.qvel
            terms = {k: v for k, v in state.metrics.items() if k.startswith("reward")}
            return state, EnvStep(
                obs=state.obs,
                reward=state.reward,
                terminated=state.done > 0.5,
                # Their done says this, too, but it is not an end of the task.
                bad=~(jnp.isfinite(qpos).all() & jnp.isfinite(qvel).all()),
                reward_terms=terms,
            )

        state, steps = jax.lax.scan(once, state, length=self._action_repeat)
        step = EnvStep(
            obs=steps.obs[-1],
            reward=steps.reward.sum(),
            terminated=steps.terminated.any(),
            bad=steps.bad.any(),
            reward_terms={name: term.sum() for name, term in steps.reward_terms.items()},
        )
        return state, step


def _default_config(name: str) -> Any:
    names = playground_names()
    if name not in names:
        close = difflib.get_close_matches(name, names, n=5)
        what = f"close ones are {', '.join(close)}" if close else f"there are {', '.join(names)}"
        raise ConfigError(f"env='playground:{name}': no such task; {what}")
    return _playground().registry.get_default_config(name)


def is_playground(env: Any) -> bool:
    """Whether it is an ``mjx_env.MjxEnv``; Playground is not imported to find out."""
    return any(
        base.__module__.startswith("mujoco_playground.") and base.__name__ == "MjxEnv"
        for base in type(env).__mro__
    )


def _load(name: str, overrides: dict[str, str]) -> Any:
    package = _playground()
    try:
        with contextlib.redirect_stdout(None):
            return package.registry.load(name, config_overrides=overrides)
    except (OSError, subprocess.SubprocessError) as error:
        if name in package.dm_control_suite.ALL_ENVS:
            raise
        from mujoco_playground._src import mjx_env

        raise ConfigError(
            f"env='playground:{name}': its robot is of mujoco_menagerie, which Playground clones "
            f"at first use, and that failed: {error}; without a network, put a checkout of "
            f"https://github.com/google-deepmind/mujoco_menagerie at {mjx_env.MENAGERIE_PATH} "
            f"(commit {mjx_env.MENAGERIE_COMMIT_SHA}), or take a task of the DM control suite"
        ) from error


def _checked_obs_size(name: str, obs: Any) -> int:
    if isinstance(obs, Mapping):
        shapes = ", ".join(f"{key} {tuple(value.shape)}" for key, value in obs.items())
        raise ConfigError(
            f"env={name!r}: observations are a dictionary ({shapes}); what can be taken "
            "is one vector"
        )
    if len(obs.shape) != 1:
        raise ConfigError(
            f"env={name!r}: observations have shape {obs.shape}; what can be taken is one vector"
        )
    return int(obs.shape[0])


def _check_impl(mjx_impl: str) -> None:
    if mjx_impl == "warp":
        raise ConfigError(
            "mjx_impl='warp': states of warp hold the contacts of all environments together, which "
            "cannot be reset one by one; playground:NAME runs with mjx_impl=jax"
        )
