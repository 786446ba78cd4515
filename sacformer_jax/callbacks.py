"""Callbacks: your code between the chunks of a run, with its metrics and its policy.

Subclass :class:`Callback`, override what you need and give it to :func:`~sacformer_jax.train` or
:func:`~sacformer_jax.resume`. They run on the host, between jitted calls, and change nothing of
what is computed. Of several processes (which must all be given the same callbacks) only those of
the first are called.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np

from sacformer_jax import agents
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.logging import Record
from sacformer_jax.members import Member
from sacformer_jax.policy import Policy, member_index
from sacformer_jax.population import Population
from sacformer_jax.processes import gathered, is_first
from sacformer_jax.results import RunResult
from sacformer_jax.train import policy_of
from sacformer_jax.types import PolicyState, TrainState


@dataclasses.dataclass(frozen=True)
class RunStart:
    """What ``on_start`` is told.

    Attributes:
      path: the run's folder.
      config: the configuration.
      spec: facts of the environment.
      members: what is trained side by side.
      env_steps: done already, prefill included.
      resumed: whether it goes on from a checkpoint.
      sources: where each value of the configuration comes from.
    """

    path: Path
    config: Config
    spec: EnvSpec
    members: tuple[Member, ...]
    env_steps: int
    resumed: bool
    sources: dict[str, str]


@dataclasses.dataclass(frozen=True)
class Event:
    """What ``on_chunk`` and ``on_eval`` are told.

    Attributes:
      path: the run's folder.
      env_steps: environment steps done, by each member.
      records: by the member's name, the line just written to its ``metrics.jsonl``: of kind
        ``"train"`` in ``on_chunk`` and ``"eval"`` in ``on_eval`` (see
        :mod:`sacformer_jax.logging`).
      timings: in ``on_chunk`` the line written to ``timings.jsonl``; empty in ``on_eval``.
    """

    path: Path
    env_steps: int
    records: dict[str, Record]
    timings: Record
    _policy: Callable[[str | int | None], Policy]

    @property
    def members(self) -> tuple[str, ...]:
        """Names of the members."""
        return tuple(self.records)

    @property
    def record(self) -> Record:
        """The record of the only member.

        Raises:
          ConfigError: there are several; take yours from ``records``.
        """
        if len(self.records) > 1:
            raise ConfigError(f"event.record: of {', '.join(self.records)}, take event.records[…]")
        return next(iter(self.records.values()))

    def mean(self, name: str) -> float:
        """A metric's mean over the members.

        Raises:
          ConfigError: these records have no such metric, or one of them has null.
        """
        values = [record.get(name) for record in self.records.values()]
        known = [value for value in values if isinstance(value, int | float)]
        if len(known) < len(values):
            raise ConfigError(f"name={name!r}: no number; there are {', '.join(self._numbers())}")
        return sum(known) / len(known)

    def _numbers(self) -> list[str]:
        record = next(iter(self.records.values()))
        return [name for name, value in record.items() if isinstance(value, int | float)]

    def policy(self, member: str | int | None = None) -> Policy:
        """The policy as it is now, copied to the host; ask for it before the callback returns.

        Args:
          member: of several, which: its seed, or its name.

        Raises:
          ConfigError: the run has no such member, or several and none was named.
          RuntimeError: the callback has returned.
        """
        return self._policy(member)


class Callback:
    """Does nothing; override what you need.

    ``on_chunk`` and ``on_eval`` stop the run by returning False: it is saved and can be resumed.
    An error raised in a callback ends the run, too, after it was saved.
    """

    def on_start(self, run: RunStart) -> None:
        """Before the first chunk, of a new run or a resumed one."""

    def on_chunk(self, event: Event) -> bool | None:
        """After each chunk of ``chunk_env_steps``."""

    def on_eval(self, event: Event) -> bool | None:
        """After each evaluation, the one before the first chunk included."""

    def on_end(self, result: RunResult | None) -> None:
        """At the end, however it came; None where it was an error."""


class StopAtReturn(Callback):
    """Stops when the mean evaluation return (over the members, too) reaches a threshold.

    Args:
      threshold: the return.
    """

    def __init__(self, threshold: float):
        self.threshold = threshold

    def on_eval(self, event: Event) -> bool | None:
        return event.mean("return_mean") < self.threshold


class StopWithoutProgress(Callback):
    """Stops when the mean evaluation return has not grown over a number of evaluations.

    Args:
      evaluations: how many in a row may pass without a new best one, at least 1.
      min_progress: by how much a new best one must exceed the last.

    Raises:
      ConfigError: ``evaluations`` is below 1 or ``min_progress`` is negative.
    """

    def __init__(self, evaluations: int, min_progress: float = 0.0):
        if evaluations < 1:
            raise ConfigError(f"evaluations={evaluations}: must be at least 1")
        if min_progress < 0:
            raise ConfigError(f"min_progress={min_progress}: must be at least 0")
        self.evaluations, self.min_progress = evaluations, min_progress
        self.best, self.since = -float("inf"), 0

    def on_eval(self, event: Event) -> bool | None:
        value = event.mean("return_mean")
        if value > self.best + self.min_progress:
            self.best, self.since = value, 0
        else:
            self.since += 1
        return self.since < self.evaluations


class Callbacks:
    """All callbacks of a run, as its loop sees them.

    Attributes:
      stop: whether one asked to stop, or failed.

    Args:
      callbacks: in the order in which they are called.
      population: what is trained.
      path: the run's folder.
    """

    def __init__(self, callbacks: Sequence[Callback], population: Population, path: Path):
        self._callbacks, self._population, self._path = tuple(callbacks), population, path
        self._error: Exception | None = None
        self.stop = False
        self._made: dict[int, Policy] = {}

    def start(self, env_steps: int, resumed: bool, sources: dict[str, str]) -> None:
        """Calls ``on_start``."""
        population = self._population
        run = RunStart(
            path=self._path,
            config=population.config,
            spec=population.program.env.spec,
            members=population.members,
            env_steps=env_steps,
            resumed=resumed,
            sources=sources,
        )
        self._call(lambda callback: callback.on_start(run))

    def chunk(self, state: TrainState, records: dict[str, Record], timings: Record) -> None:
        """Calls ``on_chunk``; of several processes all have to come here."""
        self._event(state, records, timings, lambda callback: callback.on_chunk)

    def evaluation(self, state: TrainState, records: dict[str, Record]) -> None:
        """Calls ``on_eval``; of several processes all have to come here."""
        self._event(state, records, {}, lambda callback: callback.on_eval)

    def end(self, result: RunResult | None) -> None:
        """Calls ``on_end``, of every one though others fail.

        Raises:
          Exception: what one of them raised.
        """
        self._call(lambda callback: callback.on_end(result))
        self.raise_error()

    def raise_error(self) -> None:
        """Raises what a callback raised, once."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _event(
        self,
        state: TrainState,
        records: dict[str, Record],
        timings: Record,
        method: Callable[[Callback], Callable[[Event], bool | None]],
    ) -> None:
        if not self._callbacks:
            return
        policies = functools.cache(lambda: gathered(policy_of(state)))
        if jax.process_count() > 1:
            policies()  # which all processes have to ask for
        if not is_first():
            return
        over = False

        def policy(member: str | int | None) -> Policy:
            if over:
                raise RuntimeError("event.policy: ask for it before the callback returns")
            return self._made_policy(member, policies())

        event = Event(self._path, int(state.counters.env_steps), records, timings, policy)
        self._call(lambda callback: method(callback)(event))
        over = True

    def _made_policy(self, member: str | int | None, states: PolicyState) -> Policy:
        population = self._population
        index = member_index(population.members, member)
        state = jax.tree.map(lambda leaf: leaf[index], states)
        if index not in self._made:
            config = population.members[index].config(population.config)
            spec = population.program.env.spec
            self._made[index] = Policy(config, spec, agents.make(config, spec), state)
        # A copy shares what is compiled.
        policy = copy.copy(self._made[index])
        policy.state = state
        return policy

    def _call(self, call: Callable[[Callback], bool | None]) -> None:
        if not is_first():
            return
        for callback in self._callbacks:
            try:
                answer = call(callback)
                # NumPy's and JAX's False, too, which comparing with a mean of theirs gives.
                if isinstance(answer, bool | np.bool_ | jax.Array) and not answer:
                    self.stop = True
            except Exception as error:
                # Kept until the run has been saved.
                self._error = self._error or error
                self.stop = True
