"""What is looked at: a member of a run, its replay included, and batches of that.

Letters: B windows, W steps of a window, K pairs of a context.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax import Config, ConfigError, make_population
from sacformer_jax.agents import sac, sacformer
from sacformer_jax.agents.sac_policy import SACParts, training_return_to_go
from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.parallel import UNDIVIDED
from sacformer_jax.population import Population, member_state
from sacformer_jax.train import Program, policy_of
from sacformer_jax.types import Context, PolicyState, TrainState, Window

_PARTS = {"sacformer": sacformer.make_parts, "sac": sac.make_parts}
_MOST_DRAWS = 1_000


@dataclasses.dataclass(frozen=True)
class Tools:
    """What all members of a run have in common; compiled once.

    Attributes:
      program: the training functions of one member.
      parts: what its agent is bound to.
      sample: ``(state, key) -> Window``, a batch as an update draws it.
      training_tokens: ``(window, state) -> [B, W]``, what the return tokens show in training.
    """

    program: Program
    parts: SACParts
    sample: Callable[[TrainState, jax.Array], Window]
    training_tokens: Callable[[Window, TrainState], jax.Array]


@dataclasses.dataclass(frozen=True)
class Subject:
    """A member of a run as its newest checkpoint has it.

    Attributes:
      member: its name.
      tools: of its run.
      state: everything.
    """

    member: str
    tools: Tools
    state: TrainState

    @property
    def config(self) -> Config:
        return self.tools.program.config

    @property
    def policy(self) -> PolicyState:
        return policy_of(self.state)


def make_tools(program: Program) -> Tools:
    """Binds the training functions of SACFormer or SAC to what looks at them."""
    config = program.config
    parts = _PARTS[config.agent](config, program.env.spec, UNDIVIDED)

    @jax.jit
    def sample(state: TrainState, key: jax.Array) -> Window:
        assert state.buffer is not None
        batch_size, discount = config.replay.batch_size, state.hyper.rtg_discount
        return program.buffer.sample(state.buffer, key, batch_size, discount)

    @jax.jit
    def training_tokens(window: Window, state: TrainState) -> jax.Array:
        tokens = training_return_to_go(parts, window, state.hyper)
        return tokens[:, : window.action.shape[1]]

    return Tools(program, parts, sample, training_tokens)


def subjects(path: Path) -> Iterator[Subject]:
    """The members of a run.

    Raises:
      CheckpointError: there is no run, or no checkpoint that is good.
      ConfigError: its agent is another than sacformer and sac, or its checkpoints hold no replay.
    """
    folder = RunFolder(path).opened()
    run = folder.read_config()
    if run.config.agent not in _PARTS:
        raise ConfigError(
            f"agent={run.config.agent}: must be {' or '.join(_PARTS)} to be diagnosed, as the "
            f"agent of run {str(path)!r}"
        )
    if not run.config.run.checkpoint_replay:
        raise ConfigError(
            "checkpoint_replay=False: must be True, so that the checkpoints of run "
            f"{str(path)!r} hold the replay that is looked at"
        )
    population: Population = make_population(run.config, run.members)
    restored = folder.restore(
        population.abstract(), population.block_axes, population.shardings, move_aside=False
    )
    tools = make_tools(population.program)
    for place, member in enumerate(run.members):
        yield Subject(member.name, tools, member_state(population, restored.state, place))


def full_windows(subject: Subject, num: int, seed: int) -> Window:
    """So many replayed windows, or one more batch's worth, with a real step in each place.

    Raises:
      ConfigError: hardly any window of the replay is full.
    """
    found: list[Window] = []
    count = 0
    for draw in range(_MOST_DRAWS):
        window = jax.device_get(subject.tools.sample(subject.state, _key(seed, draw)))
        full = np.all(window.state_mask[:, : window.action.shape[1]], axis=1)
        full &= window.mask[:, -1] & (window.weight > 0)
        found.append(jax.tree.map(lambda leaf, full=full: leaf[full], window))
        count += int(full.sum())
        if count >= num:
            return jax.tree.map(lambda *leaves: np.concatenate(leaves), *found)
    raise ConfigError(
        f"context_length={subject.config.context.context_length}: must be shorter, or episodes "
        f"longer; the replay gave {count} windows without a gap in {_MOST_DRAWS} batches"
    )


def _key(seed: int, draw: int) -> jax.Array:
    return jax.random.fold_in(jax.random.key(seed), draw)


def on_windows_of(parts: SACParts) -> SACParts:
    """The same parts, acting on windows computed anew, whatever acting sees."""
    return dataclasses.replace(parts, acting_actor=parts.actor)


def contexts_of(window: Window, num_pairs: int) -> Context:
    """The contexts ``[B, K]`` that acting would have at the last steps of windows."""
    steps = window.action.shape[1]
    pairs = slice(steps - num_pairs, steps)
    return Context(
        obs=jnp.asarray(window.obs[:, pairs]),
        action=jnp.asarray(window.action[:, pairs]).at[:, -1].set(0.0),
        return_so_far=jnp.asarray(window.return_so_far[:, pairs]),
        time_step=jnp.asarray(window.time_step[:, pairs]),
        mask=jnp.asarray(window.state_mask[:, pairs]),
        cache={},
    )


def draws(subject: Subject, num: int, seed: int) -> Iterator[Window]:
    """``num`` batches as updates draw them, on the host."""
    for draw in range(num):
        window: Any = subject.tools.sample(subject.state, _key(seed, draw))
        yield jax.device_get(window)
