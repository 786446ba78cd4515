"""Q against what it stands for: the discounted return, with entropy, of the policy's own episodes.

Letters: E episodes, T steps, W steps of a window, K pairs of a context.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from diagnosis.numbers import num_known, soft_returns, value_bias
from diagnosis.subject import Subject
from sacformer_jax import context as contexts
from sacformer_jax.agents.sac_policy import SACParts, acting_outlook, init_cache
from sacformer_jax.critics import CriticInputs
from sacformer_jax.envs import VectorEnv
from sacformer_jax.types import Acted, LearnerState, PolicyState


@flax.struct.dataclass
class Episodes:
    """Steps of E environments under a policy's random actions; ``[T, E]`` leads.

    Attributes:
      obs: ``[T, E, O]`` raw observations acted on.
      action: ``[T, E, A]``.
      log_prob: ``[T, E]``, of the actions.
      reward: ``[T, E]``.
      terminated: bool ``[T, E]``.
      done: bool ``[T, E]``: the first episode of each environment ends at the first one.
      bad: bool ``[T, E]`` bad physics.
      features: ``[T, E, F]`` of the actor's, that critics are to see beside the observation.
    """

    obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    reward: jax.Array
    terminated: jax.Array
    done: jax.Array
    bad: jax.Array
    features: jax.Array


def make_sampler(env: VectorEnv, parts: SACParts) -> Callable[[PolicyState, jax.Array], Episodes]:
    """``sample(policy, key) -> Episodes`` as long as the longest one may be; jitted."""

    @jax.jit
    def sample(policy: PolicyState, key: jax.Array) -> Episodes:
        env_key, acting_key = jax.random.split(key)
        env_state = env.init(env_key)
        cache = init_cache(parts, env.num_envs)
        context = contexts.start(env_state.obs, parts.context_length, parts.action_size, cache)

        def step(carry: Any, key: jax.Array) -> tuple[Any, Episodes]:
            env_state, context = carry
            key, noise_key = jax.random.split(key)
            outlook = acting_outlook(parts, policy, context, key)
            gaussian = outlook.gaussian
            action, log_prob = parts.distribution.sample_and_log_prob(
                jax.random.normal(noise_key, gaussian.mean.shape), gaussian.mean, gaussian.log_std
            )
            next_state, taken = env.step(env_state, action)
            acted = Acted(action, outlook.context)
            context = contexts.advance(acted, taken.next_obs, taken.reward, taken.done)
            features = jnp.zeros((env.num_envs, 0))
            if parts.num_critic_features:
                assert outlook.features is not None
                features = outlook.features
            seen = Episodes(
                env_state.obs, action, log_prob, taken.reward, taken.terminated, taken.done,
                taken.bad, features,
            )  # fmt: skip
            return (next_state, context), seen

        keys = jax.random.split(acting_key, env.max_episode_steps)
        episodes: Episodes = jax.lax.scan(step, (env_state, context), keys)[1]
        return episodes

    return sample


def alpha_of(learner: LearnerState) -> float:
    """The entropy temperature."""
    assert learner.log_alpha is not None
    return float(jnp.exp(learner.log_alpha))


@dataclasses.dataclass(frozen=True)
class Judged:
    """Steps whose return is known.

    Attributes:
      q: ``[N]``, the smaller of the critics.
      returns: ``[N]``, see :func:`~diagnosis.numbers.soft_returns`.
      entropy: the policy's over all steps, in nats.
    """

    q: np.ndarray
    returns: np.ndarray
    entropy: float


Judge = Callable[[LearnerState, Any, Any, Any], Any]


def make_judge(parts: SACParts, window_length: int) -> Judge:
    """``judge(learner, obs [T, O], features [T, F], action [T, A]) -> [T]``: the smallest Q of each
    step of an episode, seen as the last one of a window; jitted.
    """

    @jax.jit
    def judge(
        learner: LearnerState, obs: jax.Array, features: jax.Array, action: jax.Array
    ) -> jax.Array:
        length = obs.shape[0]
        # [T, W]: the steps of the window that ends at each; before the episode there is nothing.
        place = jnp.arange(length)[:, None] + jnp.arange(1 - window_length, 1)
        real = place >= 0
        place = jnp.maximum(place, 0)
        obs = jnp.where(real[..., None], obs[place], 0.0)  # [T, W, O]
        action = jnp.where(real[..., None], action[place], 0.0)
        obs = parts.normalized(learner.normalizer, obs)
        obs = jnp.concatenate([obs, features[place]], axis=-1)
        time_step = jnp.where(real, place, 0)
        inputs = CriticInputs(
            obs=obs,
            next_obs=jnp.zeros_like(obs),  # nobody who judges steps looks at it
            action=action,
            time_step=jnp.concatenate([time_step, time_step[:, -1:] + 1], axis=1),
            state_mask=jnp.pad(real, ((0, 0), (0, 1)), constant_values=True),
        )
        q = parts.critics.now(learner.critic_params, inputs, action)  # [C, T, W]
        return jnp.min(q, axis=0)[:, -1]

    return judge


def judged(
    learner: LearnerState,
    episodes: Episodes,
    judge: Judge,
    discount: float,
) -> Judged:
    """Q and return of the steps of first episodes; those that bad physics ended are left out.

    Args:
      learner: its critics are asked.
      episodes: of its policy, on the host.
      judge: see :func:`make_judge`.
      discount: γ.
    """
    q, returns, entropies = [], [], []
    alpha = alpha_of(learner)
    for place in range(episodes.done.shape[1]):
        column = jax.tree.map(lambda leaf, i=place: leaf[:, i], episodes)
        length = int(np.argmax(column.done)) + 1
        if np.any(column.bad[:length]):
            continue
        # All steps, so that one program does for episodes of every length.
        values = np.asarray(judge(learner, column.obs, column.features, column.action))
        known = num_known(length, bool(column.terminated[length - 1]), discount)
        soft = soft_returns(column.reward[:length], column.log_prob[:length], discount, alpha)
        q.append(values[:known])
        returns.append(soft[:known])
        entropies.append(-column.log_prob[:length])
    if not q:
        return Judged(np.zeros(0), np.zeros(0), float("nan"))
    return Judged(
        np.concatenate(q), np.concatenate(returns), float(np.concatenate(entropies).mean())
    )


def value_numbers(subject: Subject, steps: Judged) -> dict[str, float]:
    """The bias of Q, and the policy's entropy where it acts beside what it is to be."""
    learner, hyper = subject.state.learner, subject.state.hyper
    return {
        **{f"q_bias/{name}": value for name, value in value_bias(steps.q, steps.returns).items()},
        "q_bias/steps": float(len(steps.q)),
        "entropy/acting": steps.entropy,
        "entropy/target": float(hyper.target_entropy),
        "alpha": alpha_of(learner),
    }
