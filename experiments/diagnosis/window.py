"""Whether learning is shown the same features as acting: they see another length of the past.

Letters: E episodes, T steps, N windows, W states of a window with its burn-in, R rows of steps that
are looked at together, L of each.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diagnosis.subject import Subject
from diagnosis.values import Episodes
from sacformer_jax.agents.sacformer import acting_pairs
from sacformer_jax.context import commanded_return_to_go
from sacformer_jax.normalizer import normalize
from sacformer_jax.policy_renderer import is_return_conditioned

_MOST_WINDOWS = 2_048


def window_numbers(subject: Subject, episodes: Episodes) -> dict[str, float]:
    """How far the features of a window's steps, and the mean actions, lie from those that acting
    has there: of the first step learnt from, of the last, and of the first in the window.

    Features: root mean square, over the standard deviation of acting's. Actions: mean absolute
    change, in half ranges of the bounds. Nothing of SAC, which sees no past, and where no episode
    holds a window that begins a window's length after its start.

    Args:
      subject: whose policy.
      episodes: the policy's own, ``[T, E]``; the first of each environment is looked at.
    """
    config = subject.config
    if config.agent != "sacformer":
        return {}
    burn_in, seen = config.context.burn_in, config.context.context_length
    length = burn_in + config.context.steps_to_learn  # W
    first = max(length, seen)
    found = []
    for e in range(episodes.done.shape[1]):
        ends = np.flatnonzero(episodes.done[:, e])
        num_steps = int(ends[0]) + 1 if ends.size else len(episodes.done)
        starts = np.arange(first, num_steps - length + 1)
        if starts.size:
            windows = starts[:, None] + np.arange(length)  # [N, W]
            ours = _looked_at(subject, seen, episodes, e, windows)
            found.append((*ours, *(x[windows] for x in _acting(subject, episodes, e, num_steps))))
    if not found:
        return {}
    of_all = [np.concatenate(parts) for parts in zip(*found, strict=True)]
    some = np.random.default_rng(0).permutation(len(of_all[0]))[:_MOST_WINDOWS]
    features, action, acting_features, acting_action = (x[some] for x in of_all)
    spread = max(acting_features[:, burn_in].var(axis=0).sum(), 1e-12)
    numbers = {}
    for name, place in (("first_learnt", burn_in), ("last_learnt", -1), ("first", 0)):
        change = (features - acting_features)[:, place]
        moved = np.abs(action - acting_action)[:, place]
        numbers[f"window/feature_change/{name}"] = float(
            np.sqrt((change**2).sum(axis=-1).mean() / spread)
        )
        numbers[f"window/action_change/{name}"] = float(moved.mean())
    return numbers


def _acting(
    subject: Subject, episodes: Episodes, env: int, num_steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Features ``[T, D]`` and mean actions ``[T, A]`` that acting has in an episode; of its first
    ``context_length - 1`` steps they mean nothing where it acts on a window.
    """
    config, steps = subject.config, np.arange(num_steps)
    if config.context.acting_context == "episode":
        pairs = acting_pairs(config, subject.tools.program.env.spec)
        features, action = _looked_at(subject, pairs, episodes, env, steps[None])
        return features[0], action[0]
    seen = config.context.context_length
    rows = np.maximum(steps[:, None] + np.arange(1 - seen, 1), 0)  # [T, K], each ends with a step
    features, action = _looked_at(subject, seen, episodes, env, rows)
    return features[:, -1], action[:, -1]


def _looked_at(
    subject: Subject, pairs: int, episodes: Episodes, env: int, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Features ``[R, L, D]`` and mean actions ``[R, L, A]`` of an environment's steps ``[R, L]``,
    each row by itself.
    """
    policy = subject.policy
    actor: Any = subject.tools.parts.actor
    actor = actor.clone(context_length=pairs)
    return_to_go = jnp.zeros(steps.shape)
    if is_return_conditioned(subject.config):
        so_far = np.cumsum(episodes.reward[:, env]) - episodes.reward[:, env]
        shown = commanded_return_to_go(
            jnp.asarray(so_far), policy.target_return, policy.return_scale
        )
        return_to_go = shown[steps]
    obs = jnp.asarray(episodes.obs[:, env])
    if subject.config.context.normalize_obs:
        obs = normalize(policy.normalizer, obs)

    @jax.jit
    def look(*inputs: Any) -> Any:
        output = actor.apply(policy.actor_params, *inputs)
        return output.features, jnp.tanh(output.gaussian.mean)

    action = jnp.asarray(episodes.action[:, env])[steps]
    time_step, real = jnp.asarray(steps), jnp.ones(steps.shape, bool)
    features, mean = look(obs[steps], action, return_to_go, time_step, real)
    return np.asarray(features), np.asarray(mean)
