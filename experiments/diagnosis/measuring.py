"""All measures of all members of a run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from diagnosis.gradients import gradient_numbers, make_gradients, update_of
from diagnosis.history import Tokens, history_numbers, make_actor, return_tokens, token_numbers
from diagnosis.networks import attention_numbers, representation_numbers
from diagnosis.subject import Subject, draws, full_windows, subjects
from diagnosis.values import Judged, judged, make_judge, make_sampler, value_numbers
from diagnosis.window import window_numbers
from sacformer_jax.train import make_training_env


@dataclasses.dataclass(frozen=True)
class Amounts:
    """How much is measured.

    Attributes:
      batches: M, whose gradients are compared.
      episodes: E, of the policy's random actions, and of each evaluation.
      windows: full ones from the replay, for attention, ranks, dormant units and actions; 2,048 as
        in the source of the effective rank.
      seed: of all that is drawn.
    """

    batches: int = 32
    episodes: int = 8
    windows: int = 2_048
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """Of one member.

    Attributes:
      member: its name.
      steps: Q and the returns.
      tokens: return tokens.
    """

    member: str
    numbers: dict[str, float]
    steps: Judged
    tokens: Tokens


Say = Callable[[str], None]


def diagnose(run: Path, amounts: Amounts, say: Say = lambda line: None) -> list[Diagnosis]:
    """Measures every member of a run.

    Args:
      run: its folder.
      amounts: how much.
      say: is told what is under way.

    Raises:
      CheckpointError: there is no run, or no checkpoint that is good.
      ConfigError: its agent is another than sacformer and sac, or its checkpoints hold no replay.
      FloatingPointError: an update of the restored state is not finite.
    """
    found, measure = [], None
    for subject in subjects(run):
        say(f"{run}: {subject.member}")
        measure = measure or _measure_of(subject, amounts)
        found.append(measure(subject))
    return found


def _measure_of(first: Subject, amounts: Amounts) -> Callable[[Subject], Diagnosis]:
    """Measures a member of the run that ``first`` is of; what can be is compiled once."""
    tools, seed = first.tools, amounts.seed
    config = tools.program.config
    env = make_training_env(config, num_envs=amounts.episodes)
    gradients, actor = make_gradients(update_of(first)), make_actor(tools, env)
    sample = make_sampler(env, tools.parts)
    (one,) = draws(first, 1, seed)
    judge = make_judge(tools.parts, one.action.shape[1])

    def measure(subject: Subject) -> Diagnosis:
        windows = full_windows(subject, amounts.windows, seed)
        recording = actor.recorder.record(subject.policy, seed)
        episodes = jax.device_get(sample(subject.policy, jax.random.key(seed)))
        discount = float(subject.state.hyper.discount)
        steps = judged(subject.state.learner, episodes, judge, discount)
        tokens = return_tokens(subject, recording, amounts.batches, seed)
        numbers = {
            "env_steps": float(subject.state.counters.env_steps),
            "updates": float(subject.state.counters.updates),
            **_batch_numbers(subject, amounts),
            **gradient_numbers(subject, gradients, amounts.batches, seed),
            **value_numbers(subject, steps),
            **representation_numbers(subject, windows),
            **attention_numbers(subject, windows),
            **token_numbers(tokens),
            **history_numbers(subject, actor, recording, windows, seed),
            **window_numbers(subject, episodes),
        }
        return Diagnosis(subject.member, numbers, steps, tokens)

    return measure


def _batch_numbers(subject: Subject, amounts: Amounts) -> dict[str, float]:
    real = [int(window.mask.sum()) for window in draws(subject, amounts.batches, amounts.seed)]
    return {
        "batch/windows": float(subject.config.replay.batch_size),
        "batch/steps": float(np.mean(real)),
    }


def mean_numbers(members: list[Diagnosis]) -> dict[str, float]:
    """Mean over the members that have a number; NaN where none has."""
    names = dict.fromkeys(name for one in members for name in one.numbers)
    means = {}
    for name in names:
        there = [one.numbers.get(name, math.nan) for one in members]
        there = [value for value in there if not math.isnan(value)]
        means[name] = float(np.mean(there)) if there else math.nan
    return means
