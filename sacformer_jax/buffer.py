"""The trajectory replay: fixed-shape rings on the device, sampled as windows.

Each observation is stored once: the successor of a step is the next ring entry. A window is drawn
by a uniformly random stored step (the anchor) and a uniformly random place for it among the K
slots, so windows overhang both ends of an episode. A window with ``n`` steps in it can then be
drawn through ``n`` anchors; its weight 1/n makes the expected weight of all stored steps equal.
With a burn-in, steps before those K come with them, to be looked at but not learnt from (R2D2,
Kapturowski et al. 2019); the anchor is never one of them.

Scattered windows, as the authors' program draws them, are K different steps of one finished
episode, in order; episodes are drawn uniformly, so steps of short ones more often.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from sacformer_jax import episodes
from sacformer_jax.config import ConfigError, shortest_column
from sacformer_jax.context import all_discounted_suffix_sums, discounted_suffix_sums
from sacformer_jax.types import BufferState, States, Transition, Window

Drawn = TypeVar("Drawn")


@dataclasses.dataclass(frozen=True)
class TrajectoryBuffer:
    """Static facts of the replay; its functions are pure.

    Attributes:
      num_envs: N columns.
      length: T, ring length of each column in steps.
      obs_size: O.
      action_size: A.
      context_length: K, steps of a window that are learnt from.
      max_episode_steps: longest episode.
      hindsight: whether windows carry hindsight return-to-go; then only steps of finished
        episodes are drawn.
      scattered: whether windows are scattered instead of contiguous.
      burn_in: steps of a contiguous window before the K that are learnt from.

    Raises:
      ConfigError: a column is shorter than :func:`shortest_column`.
    """

    num_envs: int
    length: int
    obs_size: int
    action_size: int
    context_length: int
    max_episode_steps: int
    hindsight: bool = False
    scattered: bool = False
    burn_in: int = 0

    @property
    def window_length(self) -> int:
        """Steps of a window, those of the burn-in included."""
        return self.burn_in + self.context_length

    def __post_init__(self) -> None:
        needed = shortest_column(self.max_episode_steps, self.window_length, self.scattered)
        if self.length < needed:
            raise ConfigError(
                f"buffer_capacity={self.length * self.num_envs} over num_envs={self.num_envs} "
                f"gives {self.length} steps each: must be at least {needed} each, so "
                f"buffer_capacity >= {needed * self.num_envs}"
            )

    def init(self) -> BufferState:
        """An empty replay."""
        shape = (self.num_envs, self.length)
        return BufferState(
            steps=Transition(
                obs=jnp.zeros((*shape, self.obs_size)),
                action=jnp.zeros((*shape, self.action_size)),
                reward=jnp.zeros(shape),
                terminated=jnp.zeros(shape, bool),
                truncated=jnp.zeros(shape, bool),
                bad=jnp.zeros(shape, bool),
                time_step=jnp.zeros(shape, jnp.int32),
                return_so_far=jnp.zeros(shape),
            ),
            head=jnp.zeros((), jnp.int32),
            size=jnp.zeros((), jnp.int32),
            running=jnp.zeros(self.num_envs, jnp.int32),
            episodes=episodes.init(self.num_envs, self.length, self.context_length)
            if self.scattered
            else None,
        )

    def add(self, state: BufferState, step: Transition) -> BufferState:
        """Writes one step of all N environments over the oldest one."""

        def write(ring: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(ring, new[:, None], state.head, axis=1)

        ended = step.terminated | step.truncated
        table = state.episodes
        if table is not None:
            table = episodes.record(table, step, state.head, self.length, self.context_length)
        return BufferState(
            steps=jax.tree.map(write, state.steps, step),
            head=(state.head + 1) % self.length,
            size=jnp.minimum(state.size + 1, self.length),
            running=jnp.where(ended, 0, jnp.minimum(state.running + 1, self.length)),
            episodes=table,
        )

    def eligible(self, state: BufferState) -> jax.Array:
        """int32 ``[N]``: how many of each column's oldest steps contiguous windows are drawn at."""
        if self.hindsight:
            return state.size - jnp.minimum(state.running, state.size)
        return jnp.full(self.num_envs, state.size)

    def num_drawable(self, state: BufferState) -> jax.Array:
        """int32: how many steps (of scattered windows: episodes) windows are drawn at."""
        if state.episodes is not None:
            return jnp.sum(state.episodes.count)
        return jnp.sum(self.eligible(state))

    def can_sample(self, state: BufferState) -> jax.Array:
        """bool: whether there is anything to draw."""
        return self.num_drawable(state) > 0

    def sample(
        self, state: BufferState, key: jax.Array, batch_size: int, rtg_discount: jax.Array
    ) -> Window:
        """Draws B windows; ``can_sample`` must hold (scattered ones have no real step otherwise).

        Args:
          state: the replay.
          key: typed PRNG key.
          batch_size: B.
          rtg_discount: scalar discount of hindsight return-to-go (unused without hindsight).
        """
        anchor_key, slot_key = jax.random.split(key)
        table = state.episodes
        if table is not None:
            entry = episodes.draw_entries(table.count, anchor_key, batch_size)
            episode = _in_turns(lambda which: episodes.look_up(table, *which), entry)
            places = episodes.distinct_sorted(slot_key, episode.length, self.context_length)

            def scattered(which: tuple[episodes.Drawn, jax.Array]) -> Window:
                return self.scattered_window(state, *which, rtg_discount)

            return _in_turns(scattered, (episode, places))
        column, anchor = episodes.draw_entries(self.eligible(state), anchor_key, batch_size)
        slot = jax.random.randint(slot_key, (batch_size,), self.burn_in, self.window_length)

        def contiguous(which: tuple[jax.Array, jax.Array, jax.Array]) -> Window:
            return self.window(state, *which, rtg_discount)

        return _in_turns(contiguous, (column, anchor, slot))

    def window(
        self,
        state: BufferState,
        column: jax.Array,
        anchor: jax.Array,
        slot: jax.Array,
        rtg_discount: jax.Array,
    ) -> Window:
        """The windows with the ``anchor``-th oldest step of ``column`` at ``slot`` (``[B]``)."""
        steps, k = state.steps, self.window_length
        rows = column[:, None]

        def places(num: int) -> tuple[jax.Array, jax.Array, jax.Array]:
            """Ring positions of ``num`` slots, whether in the ring, distance to the anchor."""
            distance = jnp.arange(num) - slot[:, None]  # [B, num]
            age_rank = anchor[:, None] + distance
            inside = (age_rank >= 0) & (age_rank < state.size)
            return (state.head - state.size + age_rank) % self.length, inside, distance

        position, inside, distance = places(k + 1)
        time_step = steps.time_step[rows, position]
        anchor_time = jnp.take_along_axis(time_step, slot[:, None], axis=1)
        # d steps after the anchor and past a reset, the time step is below d: equality is proof.
        same_episode = inside & (time_step == anchor_time + distance)
        step_position = position[:, :k]
        real_step = same_episode[:, :k]
        good = real_step & ~steps.bad[rows, step_position]
        learnt = jnp.arange(k) >= self.burn_in
        mask = good & learnt
        terminated = steps.terminated[rows, step_position]
        if self.hindsight:
            position_on, inside_on, distance_on = places(k + self.max_episode_steps)
            ahead = steps.time_step[rows, position_on] == anchor_time + distance_on
            rewards = jnp.where(inside_on & ahead, steps.reward[rows, position_on], 0.0)
            return_to_go = discounted_suffix_sums(rewards, k + 1, rtg_discount)
        else:
            return_to_go = jnp.zeros(position.shape)
        return Window(
            obs=jnp.where(same_episode[..., None], steps.obs[rows, position], 0.0),
            action=jnp.where(good[..., None], steps.action[rows, step_position], 0.0),
            reward=jnp.where(mask, steps.reward[rows, step_position], 0.0),
            discount=1.0 - terminated.astype(jnp.float32),
            return_so_far=jnp.where(same_episode, steps.return_so_far[rows, position], 0.0),
            return_to_go=jnp.where(same_episode, return_to_go, 0.0),
            time_step=jnp.where(same_episode, time_step, 0),
            state_mask=same_episode,
            mask=mask,
            bootstrap_mask=mask & (terminated | same_episode[:, 1:]),
            weight=1.0 / jnp.sum(real_step & learnt, axis=1),
        )

    def scattered_window(
        self,
        state: BufferState,
        drawn: episodes.Drawn,
        time_step: jax.Array,
        rtg_discount: jax.Array,
    ) -> Window:
        """The windows of the steps ``time_step [B, K]`` of the episodes drawn."""
        steps = state.steps
        rows, start = drawn.column[:, None], drawn.start[:, None]
        position = (start + time_step) % self.length  # [B, K]
        next_position = (position + 1) % self.length
        mask = jnp.broadcast_to(drawn.exists[:, None], position.shape)
        terminated = steps.terminated[rows, position]
        # A truncated episode's last state was not stored.
        known = mask & ~terminated & ~steps.truncated[rows, position]
        obs, reward = steps.obs[rows, position], steps.reward[rows, position]
        return_so_far = steps.return_so_far[rows, position]
        if self.hindsight:
            ahead = jnp.arange(self.max_episode_steps)
            rewards = steps.reward[rows, (start + ahead) % self.length]
            rewards = jnp.where(ahead < drawn.length[:, None], rewards, 0.0)
            sums = all_discounted_suffix_sums(rewards, rtg_discount)
            sums = jnp.pad(sums, ((0, 0), (0, 1)))  # nothing after the last step
            return_to_go = jnp.take_along_axis(sums, time_step, axis=1)
            next_return_to_go = jnp.take_along_axis(sums, time_step + 1, axis=1)
        else:
            return_to_go = next_return_to_go = jnp.zeros(position.shape)
        return Window(
            obs=obs,
            action=steps.action[rows, position],
            reward=reward,
            discount=1.0 - terminated.astype(jnp.float32),
            return_so_far=return_so_far,
            return_to_go=return_to_go,
            time_step=time_step,
            state_mask=mask,
            mask=mask,
            bootstrap_mask=mask & (terminated | known),
            weight=drawn.exists.astype(jnp.float32),
            following=States(
                obs=jnp.where(known[..., None], steps.obs[rows, next_position], 0.0),
                return_so_far=return_so_far + reward,
                return_to_go=next_return_to_go,
                time_step=time_step + 1,
                mask=known,
            ),
        )


def weighted_by_share(window: Window, num_drawable: jax.Array) -> Window:
    """One shard's windows, weighted so that the steps of all shards weigh the same again.

    Each shard draws as many windows, so where fewer steps are held each is drawn more often.

    Args:
      window: drawn from this shard's replay.
      num_drawable: how many steps it holds, :meth:`TrajectoryBuffer.num_drawable`.
    """
    weight = jnp.where(num_drawable > 0, window.weight * num_drawable, 0.0)
    return dataclasses.replace(window, weight=weight)


def _in_turns(read: Callable[[Any], Drawn], which: Any) -> Drawn:
    """``read(which)`` in a loop of two turns (or a few more) over the leading axis of ``which``.

    A loop's body is a computation of its own. Otherwise XLA fuses the writing of the newest step
    into the reading of the batch, which then needs the ring before and after the step: it copies
    all of it at every step (jaxlib 0.10.2, CPU).
    """
    batch_size = jax.tree.leaves(which)[0].shape[0]
    turns = next((n for n in range(2, batch_size) if batch_size % n == 0), batch_size)
    drawn = jax.lax.map(
        read, jax.tree.map(lambda x: x.reshape(turns, -1, *x.shape[1:]), which)
    )  # [turns, B / turns, ...]
    return jax.tree.map(lambda x: x.reshape(batch_size, *x.shape[2:]), drawn)
