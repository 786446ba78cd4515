"""Members trained side by side as one program: vmapped, and split over a mesh of devices.

The state of a population is a :class:`~sacformer_jax.types.TrainState` whose leaves lead with the
members, ``[S, ...]``, and, of what belongs to environments, with the environments after them,
``[S, N, ...]``. What all members have in common, because they advance in step, has no such axis:
the number of environment steps, the head of the replay's rings and how full they are. So a
condition on it stays a condition, and writing into the rings stays one slice.

Over several devices the mesh has two axes: members, without any communication, and data
(:class:`~sacformer_jax.parallel.DataAxis`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec

from sacformer_jax.config import Config, ConfigError
from sacformer_jax.envs import Env, VectorEnv
from sacformer_jax.evaluate import Evaluation, make_evaluator
from sacformer_jax.members import Member
from sacformer_jax.parallel import DATA_AXIS, MEMBER_AXIS, DataAxis
from sacformer_jax.train import Metrics, Program, hyperparameters, make_program, make_training_env
from sacformer_jax.types import BufferState, Counters, Hyperparameters, PolicyState, TrainState

_COMMON, _MEMBER, _MEMBER_AND_DATA = Spec(), Spec(MEMBER_AXIS), Spec(MEMBER_AXIS, DATA_AXIS)
_EVALUATION_STREAM = 2**31
"""Folded into the seed's key: beyond the small numbers by which training splits it."""


@dataclasses.dataclass(frozen=True)
class Devices:
    """How a population lies on devices.

    Attributes:
      members: devices over which the members are split.
      data: devices over which environments, replay and batch of each member are split.
    """

    members: int = 1
    data: int = 1

    @classmethod
    def for_members(cls, num_members: int, data: int = 1, available: int | None = None) -> Devices:
        """``data`` devices for each of as many groups of members as there are devices for.

        Args:
          num_members: of the population.
          data: devices of each group.
          available: how many devices there are; default: JAX's.
        """
        available = jax.device_count() if available is None else available
        groups = max(1, available // max(1, data))
        return cls(max(n for n in range(1, groups + 1) if num_members % n == 0), data)

    def checked(self, config: Config, num_members: int) -> Devices:
        """Itself, if the sizes can be split so and there are so many devices.

        Raises:
          ConfigError: otherwise.
        """
        batch, batch_size = "batch_size", config.replay.batch_size
        if config.agent == "ppo":
            batch = "num_envs * rollout_steps / minibatches"
            batch_size = config.task.num_envs * config.ppo.rollout_steps // config.ppo.minibatches
        for name, size, what, split in (
            ("seed_devices", self.members, "members", num_members),
            ("data_devices", self.data, "num_envs", config.task.num_envs),
            ("data_devices", self.data, batch, batch_size),
        ):
            if size < 1 or split % size:
                raise ConfigError(f"{name}={size}: must be at least 1 and divide {what}={split}")
        used, available = self.members * self.data, jax.device_count()
        if used > available:
            raise ConfigError(
                f"seed_devices={self.members} times data_devices={self.data}: there are "
                f"{available} devices"
            )
        if jax.process_count() > 1 and used != available:
            raise ConfigError(
                f"seed_devices={self.members} times data_devices={self.data}: with several "
                f"processes all {available} devices must be used"
            )
        return self

    def mesh(self) -> Mesh | None:
        """The mesh, or None for the one device."""
        num = self.members * self.data
        if num == 1:
            return None
        return jax.make_mesh(
            (self.members, self.data),
            (MEMBER_AXIS, DATA_AXIS),
            axis_types=(AxisType.Auto, AxisType.Auto),
            devices=jax.devices()[:num],
        )


ONE_DEVICE = Devices()


@dataclasses.dataclass(frozen=True)
class Population:
    """A configuration and its members, bound to functions of the whole population.

    Attributes:
      program: the functions of one member (over several data devices: of a shard of it).
      members: S of them.
      devices: how they lie on devices.
      specs: of every leaf of the state, which mesh axes its leading axes are split over.
      shardings: the same as shardings.
      init: ``() -> TrainState``.
      prefill: ``TrainState -> (TrainState, metrics [S])``; the argument is donated.
      refill: what checkpoints hold (:meth:`stored`) -> ``(TrainState, metrics [S])``.
      train_chunk: ``TrainState -> (TrainState, metrics [S])``; the argument is donated.
      pretrain_chunk: ``TrainState -> (TrainState, metrics [S])``; the argument is donated. None
        where the configuration asks for none.
      evaluate: ``(policies [S, ...], env_steps) -> Evaluation [S, E]``, by the members' seeds.
      num_drawable: ``BufferState -> [S]``, see
        :meth:`~sacformer_jax.buffer.TrajectoryBuffer.num_drawable`; None without a replay.
    """

    program: Program
    members: tuple[Member, ...]
    devices: Devices
    specs: TrainState
    shardings: TrainState
    init: Callable[[], TrainState]
    prefill: jax.stages.Wrapped
    refill: jax.stages.Wrapped
    train_chunk: jax.stages.Wrapped
    pretrain_chunk: jax.stages.Wrapped | None
    evaluate: Callable[[PolicyState, Any], Evaluation]
    num_drawable: jax.stages.Wrapped | None

    @property
    def config(self) -> Config:
        return self.program.config

    @property
    def block_axes(self) -> TrainState:
        """Of every leaf, how many of its leading axes may be split over devices."""
        return jax.tree.map(len, self.specs)

    def abstract(self) -> TrainState:
        """Shapes of the state."""
        return jax.eval_shape(self.init)

    def stored(self, state: TrainState) -> TrainState:
        """What checkpoints hold of a state, or of a tree like it; None where they do not."""
        if self.config.run.checkpoint_replay:
            return state
        return without_replay(state)


def stacked_hyperparameters(
    config: Config, members: Sequence[Member], action_size: int
) -> Hyperparameters:
    """The members' numeric settings, leaves float32 ``[S]`` (NumPy)."""
    each = [hyperparameters(member.config(config), action_size) for member in members]
    return jax.tree.map(lambda *leaves: np.array(leaves, np.float32), *each)


def make_population(
    config: Config,
    members: Sequence[Member],
    devices: Devices = ONE_DEVICE,
    env: Env | None = None,
) -> Population:
    """Binds a valid configuration and its members to functions of them all.

    Args:
      config: see :meth:`~sacformer_jax.config.Config.validated`.
      members: at least one.
      devices: how they lie on devices.
      env: use this environment instead of the one ``config.task`` names.

    Raises:
      ConfigError: a setting cannot work, of the configuration, a member or the devices.
    """
    _check_members(config, members)
    devices = devices.checked(config, len(members))
    data, task = DataAxis(devices.data), config.task
    if env is None:
        vector_env = make_training_env(config, data=data)
    else:
        vector_env = VectorEnv(env, task.num_envs, task.max_episode_steps, data)
    program = make_program(config, vector_env, data)
    evaluator = make_evaluator(
        VectorEnv(vector_env.env, config.run.eval_episodes, task.max_episode_steps),
        # Every data device acts for all.
        make_program(config, VectorEnv(vector_env.env, 1, task.max_episode_steps)).agent
        if data.size > 1
        else program.agent,
        config.context.context_length,
    )
    seeds = np.array([member.seed for member in members], np.uint32)
    hyper = stacked_hyperparameters(config, members, vector_env.spec.action_size)

    def init(seed: jax.Array, hyper: Hyperparameters) -> TrainState:
        state: TrainState = program.init(jax.random.key(seed), hyper)
        return state

    def evaluate(policy: PolicyState, seed: jax.Array, env_steps: jax.Array) -> Evaluation:
        key = jax.random.fold_in(jax.random.key(seed), _EVALUATION_STREAM)
        return evaluator(policy, jax.random.fold_in(key, env_steps))

    def num_drawable(buffer: BufferState) -> jax.Array:
        return data.count(program.buffer.num_drawable(buffer))

    specs = _specs(init, hyper, data)
    split = _Splitter(devices, devices.mesh(), len(members))
    chunk_specs = (specs, _MEMBER)
    init_all = split(init, (_MEMBER, _MEMBER), specs)
    evaluate_all = split(evaluate, (_MEMBER, _MEMBER, _COMMON), _MEMBER)
    return Population(
        program=program,
        members=tuple(members),
        devices=devices,
        specs=specs,
        shardings=jax.tree.map(split.sharding, specs),
        init=lambda: init_all(seeds, hyper),
        prefill=split(program.prefill, (specs,), chunk_specs, donate=True),
        refill=split(program.refill, (without_replay(specs),), chunk_specs),
        train_chunk=split(program.train_chunk, (specs,), chunk_specs, donate=True),
        pretrain_chunk=None
        if program.pretrain_chunk is None
        else split(program.pretrain_chunk, (specs,), chunk_specs, donate=True),
        evaluate=lambda policy, env_steps: evaluate_all(policy, seeds, env_steps),
        num_drawable=None
        if program.replay is None
        else split(num_drawable, (specs.buffer,), _MEMBER),
    )


def _check_members(config: Config, members: Sequence[Member]) -> None:
    if not members:
        raise ConfigError("members=[]: there must be at least one")
    numbers = [field.name for field in dataclasses.fields(Hyperparameters)]
    names: set[str] = set()
    for member in members:
        if member.name in names:
            raise ConfigError(f"members: two members are called {member.name!r}")
        names.add(member.name)
        for name in member.values:
            if name not in numbers:
                raise ConfigError(
                    f"values of member {member.name!r}: {name!r} is not a setting in which members "
                    f"can differ; those are {', '.join(numbers)}"
                )
        if "target_return" in member.values:
            run, own = config.context.target_return, member.values["target_return"]
            if "auto" in (run, own):
                raise ConfigError(
                    f"values of member {member.name!r}: target_return={own!r} in a run with "
                    f"target_return={run!r}: members may differ in it where all are numbers"
                )
        member.config(config).validated()


def _specs(init: Callable[..., TrainState], hyper: Hyperparameters, data: DataAxis) -> TrainState:
    """Which mesh axes the leading axes of each leaf of the state are split over."""
    one = jax.tree.map(lambda leaf: leaf[0], hyper)
    # Only the structure is looked at.
    state = jax.eval_shape(
        lambda: jax.vmap(init, in_axes=(None, None), axis_name=DATA_AXIS, axis_size=data.size)(
            np.uint32(0), one
        )
    )

    def all_of(tree: Any, spec: Spec) -> Any:
        return jax.tree.map(lambda _: spec, tree)

    specs: Any = all_of(state, _MEMBER_AND_DATA)
    buffer = specs.buffer
    if buffer is not None:
        buffer = dataclasses.replace(buffer, head=_COMMON, size=_COMMON)
    whole: TrainState = dataclasses.replace(
        specs,
        learner=all_of(state.learner, _MEMBER),
        hyper=all_of(state.hyper, _MEMBER),
        env=dataclasses.replace(specs.env, key=_MEMBER),
        buffer=buffer,
        counters=dataclasses.replace(all_of(state.counters, _MEMBER), env_steps=_COMMON),
        key=_MEMBER,
    )
    return whole


@dataclasses.dataclass(frozen=True)
class _Splitter:
    """Makes a function of one member one of all, and splits it over the mesh."""

    devices: Devices
    mesh: Mesh | None
    num_members: int

    def __call__(
        self, function: Callable[..., Any], in_specs: Any, out_specs: Any, donate: bool = False
    ) -> jax.stages.Wrapped:
        batched = _batched(function, self.num_members // self.devices.members, in_specs, out_specs)
        if self.mesh is not None:
            # What is common to the devices of an axis comes out of reductions or of the same
            # computation; jax cannot tell (host calls), so it is not asked to check.
            batched = jax.shard_map(
                batched, mesh=self.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
            )

        def program(*arguments: Any) -> Any:
            return batched(*arguments)

        # What profiles and the compilation cache call it.
        program.__name__ = function.__name__
        return jax.jit(program, donate_argnums=(0,) if donate else ())

    def sharding(self, spec: Spec) -> jax.sharding.Sharding:
        if self.mesh is None:
            return jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        return NamedSharding(self.mesh, spec)


def _batched(
    function: Callable[..., Any], num_members: int, in_specs: Any, out_specs: Any
) -> Callable[..., Any]:
    """A function of one member as one of ``num_members``, whose leaves lead with them."""

    def is_batched(spec: Spec) -> bool:
        return len(spec) > 0

    if num_members > 1:
        in_axes, out_axes = (
            jax.tree.map(lambda spec: 0 if is_batched(spec) else None, specs)
            for specs in (in_specs, out_specs)
        )
        return jax.vmap(function, in_axes=in_axes, out_axes=out_axes)

    def without(spec: Spec, tree: Any) -> Any:
        return jax.tree.map(lambda x: x[0], tree) if is_batched(spec) else tree

    def with_axis(spec: Spec, tree: Any) -> Any:
        return jax.tree.map(lambda x: jnp.asarray(x)[None], tree) if is_batched(spec) else tree

    def alone(*arguments: Any) -> Any:
        # A batch of one would be slower than none.
        result = function(*jax.tree.map(without, in_specs, arguments))
        return jax.tree.map(with_axis, out_specs, result)

    return alone


def without_replay(state: TrainState) -> TrainState:
    """A state, or a tree like it, without replay, environments and contexts."""
    nothing: Any = None
    return dataclasses.replace(state, env=nothing, context=nothing, buffer=nothing)


def member_metrics(metrics: Metrics, index: int) -> Metrics:
    """One member's, of metrics on the host."""
    return {name: values[index] for name, values in metrics.items()}


def member_counters(counters: Counters, index: int) -> Counters:
    """One member's counters, of counters on the host."""
    return jax.tree.map(lambda value: value if np.ndim(value) == 0 else value[index], counters)


def member_state(population: Population, state: TrainState, index: int) -> TrainState:
    """The train state of one member, as its own :class:`~sacformer_jax.train.Program` has it."""
    return jax.tree.map(
        lambda spec, leaf: leaf[index] if len(spec) else leaf, population.specs, state
    )
