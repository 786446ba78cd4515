"""What the policy does with what it sees beside the newest state: return-to-go, time, history.

Letters: B windows, K pairs of a context, A action size.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diagnosis.numbers import percentiles, share_outside
from diagnosis.subject import Subject, Tools, contexts_of, draws, on_windows_of
from sacformer_jax.agents import sac_policy
from sacformer_jax.agents.core import Agent
from sacformer_jax.agents.sac_policy import SACParts, acting_outlook
from sacformer_jax.context import commanded_return_to_go
from sacformer_jax.envs import VectorEnv
from sacformer_jax.evaluate import make_evaluator
from sacformer_jax.policy_renderer import is_return_conditioned
from sacformer_jax.recording import Recorder, Recording
from sacformer_jax.types import Acted, Context, Params, PolicyState, Window

AS_IT_IS = "as_it_is"


@dataclasses.dataclass(frozen=True)
class Change:
    """Something that acting is deprived of, or told otherwise.

    Attributes:
      newest_only: earlier pairs are not seen.
      policy: ``PolicyState -> PolicyState``.
    """

    newest_only: bool = False
    policy: Callable[[PolicyState], PolicyState] = lambda policy: policy


def changes_of(tools: Tools) -> dict[str, Change]:
    """What can be changed for an agent; only :data:`AS_IT_IS` where it sees one state alone."""
    config = tools.program.config
    changes = {AS_IT_IS: Change()}
    if config.agent != "sacformer":
        return changes
    if config.context.context_length > 1 or config.context.acting_context == "episode":
        changes["newest_pair"] = Change(newest_only=True)
    changes["time_step_0"] = Change(policy=_without_time)
    if is_return_conditioned(config):
        changes["target_halved"] = Change(policy=lambda policy: _with_target(policy, 0.5))
        changes["target_doubled"] = Change(policy=lambda policy: _with_target(policy, 2.0))
    return changes


def _with_target(policy: PolicyState, factor: float) -> PolicyState:
    return dataclasses.replace(policy, target_return=factor * policy.target_return)


def _without_time(policy: PolicyState) -> PolicyState:
    """The embedding of time step 0 in all places: what each step gives if told that it is the
    first. Where keys and values lie in a cache, which the time step tells too, stays.
    """

    def of_first(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        names = [entry.key for entry in path]
        return jnp.broadcast_to(leaf[:1], leaf.shape) if "embed_time" in names else leaf

    params: Params = jax.tree_util.tree_map_with_path(of_first, policy.actor_params)
    return dataclasses.replace(policy, actor_params=params)


def acting_agent(agent: Agent, parts: SACParts, newest_only: bool) -> Agent:
    """The agent itself, or one that sees the newest pair alone: computed anew on windows, whose
    other pairs do not exist, since what a cache holds cannot be hidden.
    """
    if not newest_only:
        return agent
    on_windows = on_windows_of(parts)

    def act(policy: PolicyState, context: Context, key: jax.Array, explore: bool) -> Acted:
        acted = sac_policy.act(on_windows, policy, _newest(context), key, explore)
        return dataclasses.replace(acted, context=context)

    return dataclasses.replace(
        agent, act=act, init_cache=lambda num: sac_policy.init_cache(on_windows, num)
    )


def _newest(context: Context) -> Context:
    last = jnp.arange(context.mask.shape[1]) == context.mask.shape[1] - 1
    return dataclasses.replace(context, mask=context.mask & last)


@dataclasses.dataclass(frozen=True)
class Actor:
    """Functions by which a run's policies act under each change; compiled once.

    Attributes:
      changes: by name.
      recorder: of evaluations as they are.
      evaluators: by whether only the newest pair is seen: ``(policy, key) -> Evaluation``.
      means: the same: ``(policy, contexts [B, K]) -> [B, A]``, mean actions on replayed windows, in
        half ranges of the bounds.
    """

    changes: dict[str, Change]
    recorder: Recorder
    evaluators: dict[bool, Callable[..., Any]]
    means: dict[bool, Callable[[PolicyState, Context], jax.Array]]


def make_actor(tools: Tools, env: VectorEnv) -> Actor:
    """Binds a run's agent to the environments that it is evaluated in."""
    agent, parts = tools.program.agent, tools.parts
    length, on_windows = parts.context_length, on_windows_of(tools.parts)

    def means(newest_only: bool) -> Callable[[PolicyState, Context], jax.Array]:
        @jax.jit
        def mean(policy: PolicyState, context: Context) -> jax.Array:
            context = _newest(context) if newest_only else context
            return jnp.tanh(
                acting_outlook(on_windows, policy, context, jax.random.key(0)).gaussian.mean
            )

        return mean

    return Actor(
        changes=changes_of(tools),
        recorder=Recorder(env, agent, length, lambda episodes: episodes.running),
        evaluators={
            newest: make_evaluator(env, acting_agent(agent, parts, newest), length)
            for newest in (False, True)
        },
        means={newest: means(newest) for newest in (False, True)},
    )


def history_numbers(
    subject: Subject, actor: Actor, recording: Recording, windows: Window, seed: int
) -> dict[str, float]:
    """Evaluation return under each change, from the same resets, and how far mean actions on
    replayed states move: the mean absolute change, in half ranges of the action bounds.

    Args:
      subject: whose policy.
      actor: of its run.
      recording: its evaluation as it is, by the same seed.
      windows: full ones.
      seed: of the evaluation.
    """
    contexts = contexts_of(windows, subject.config.context.context_length)
    usual = np.asarray(actor.means[False](subject.policy, contexts))
    numbers = {f"history/return/{AS_IT_IS}": float(recording.returns.mean())}
    for name, change in actor.changes.items():
        if name == AS_IT_IS:
            continue
        policy = change.policy(subject.policy)
        result = actor.evaluators[change.newest_only](policy, jax.random.key(seed))
        action = np.asarray(actor.means[change.newest_only](policy, contexts))
        numbers[f"history/return/{name}"] = float(np.mean(result.returns))
        numbers[f"history/action_change/{name}"] = float(np.abs(action - usual).mean())
    return numbers


@dataclasses.dataclass(frozen=True)
class Tokens:
    """Return tokens as the network sees them, scaled: empty where it sees none.

    Attributes:
      training: ``[N]``, of the steps in batches.
      acting: ``[M]``, of the steps of an evaluation.
    """

    training: np.ndarray
    acting: np.ndarray


def return_tokens(subject: Subject, recording: Recording, num_batches: int, seed: int) -> Tokens:
    """Of so many batches, and of an evaluation."""
    if not is_return_conditioned(subject.config):
        return Tokens(np.zeros(0), np.zeros(0))
    training = []
    for window in draws(subject, num_batches, seed):
        shown = np.asarray(subject.tools.training_tokens(window, subject.state))
        training.append(shown[window.mask])
    steps = np.arange(len(recording.return_so_far) - 1)
    acted = steps[:, None] < recording.lengths  # [T, E]
    policy = subject.policy
    commanded = commanded_return_to_go(
        jnp.asarray(recording.return_so_far[:-1]), policy.target_return, policy.return_scale
    )
    return Tokens(np.concatenate(training), np.asarray(commanded)[acted])


def token_numbers(tokens: Tokens) -> dict[str, float]:
    """Percentiles, and the share of acting that training hardly ever shows."""
    if not tokens.acting.size:
        return {}
    numbers = {}
    for where, values in (("training", tokens.training), ("acting", tokens.acting)):
        for name, value in percentiles(values).items():
            numbers[f"return_tokens/{where}/{name}"] = value
    outside = share_outside(tokens.acting, tokens.training)
    return {**numbers, "return_tokens/acting/outside": outside}
