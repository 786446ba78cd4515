"""The typed configuration: frozen sections, validation with reasons, JSON round trip.

Every field name is unique over all sections, so a field can be given by its bare name, in Python
(``Config.from_preset("cpu", env="Hopper")``) and on the command line (``--env Hopper``).
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Mapping
from fractions import Fraction
from typing import Any, Literal

from sacformer_jax.values import ConfigError, coerced, unknown

AgentName = Literal["sacformer", "sac", "td3", "ddpg", "ppo"]
MLP_AGENTS = ("sac", "td3", "ddpg", "ppo")
"""Agents that see one state."""
PresetName = Literal["cpu", "best", "memory", "paper", "authors"]
Conditioning = Literal["hindsight", "commanded", "none"]
EngineName = Literal["auto", "native", "mjx"]
MjxPreset = Literal["parity", "fast"]
MjxImpl = Literal["jax", "warp"]
BraxBackend = Literal["spring", "positional", "generalized", "mjx"]
Tokens = Literal["gs", "gsa", "joint"]
ComputeDtype = Literal["float32", "bfloat16"]
ActingContext = Literal["window", "episode"]
WindowKind = Literal["contiguous", "scattered"]
PolicyKind = Literal["gaussian", "deterministic"]
KernelInit = Literal["lecun", "xavier"]
CriticName = Literal["mlp", "transformer"]
TimeEmbedding = Literal["absolute", "rotary", "none"]
TransformerLoss = Literal["policy", "prediction"]
Activation = Literal["relu", "gelu", "tanh", "silu"]


_PRETRAIN_CHUNK = 250


@dataclasses.dataclass(frozen=True)
class TaskConfig:
    """What is learnt."""

    env: str = "HalfCheetah"
    """Task: HalfCheetah, Hopper, Walker2d, Ant, Humanoid, brax:NAME, playground:NAME, gym:ID, or
    your own MODULE:NAME."""
    engine: EngineName = "auto"
    """Physics engine of MuJoCo tasks: C MuJoCo (native), MuJoCo in JAX (mjx), or by device."""
    mjx_preset: MjxPreset = "parity"
    """Solver of engine mjx: as in Gymnasium's models (parity), or few iterations (fast)."""
    mjx_impl: MjxImpl = "jax"
    """Implementation of engine mjx; warp needs an NVIDIA GPU and the package warp-lang."""
    brax_backend: BraxBackend = "spring"
    """Physics backend of brax:NAME tasks."""
    num_envs: int = 1
    """Environments stepped side by side."""
    max_episode_steps: int = 1000
    """Time limit of an episode, in environment steps (truncation, not termination); by default of
    gym:ID, playground:NAME and your own tasks theirs."""
    hide_velocities: bool = False
    """Leave the velocities out of the observation."""
    action_delay: int = 0
    """Steps between choosing an action and its effect; the first actions of an episode are 0."""
    stack_obs: int = 1
    """Observations seen as one, with the actions between them."""


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """How long, and what is kept."""

    total_env_steps: int = 1_000_000
    """Environment steps of the whole run, prefill included; rounded up to whole chunks."""
    prefill_env_steps: int = 10_000
    """Environment steps under uniformly random actions before the first update."""
    eval_every: int = 2_000
    """Environment steps between evaluations."""
    eval_episodes: int = 4
    """Episodes of each evaluation, under the mean action."""
    video_every: int = 0
    """Environment steps between videos (made at evaluations, of the first seed); 0: none."""
    checkpoint_every: int = 20_000
    """Environment steps between checkpoints."""
    checkpoint_replay: bool = True
    """Checkpoints hold the replay and the running episodes; else resuming collects them anew."""
    chunk_env_steps: int = 1_000
    """Environment steps of one jitted call; evaluations and checkpoints fall between calls."""
    max_skipped_updates: int = 100
    """Updates skipped because a tensor was not finite, above which training stops."""
    run_dir: str = ""
    """Folder of the run; empty: a new one under runs/."""


@dataclasses.dataclass(frozen=True)
class ReplayConfig:
    """Trajectory replay and how often it is learnt from."""

    buffer_capacity: int = 1_000_000
    """Environment steps the replay holds, over all environments."""
    batch_size: int = 128
    """Windows in a batch; each has up to learnt_steps steps to learn from."""
    updates_per_env_step: float = 1.0
    """Gradient updates per environment step (UTD), over all environments."""


@dataclasses.dataclass(frozen=True)
class OfflineConfig:
    """What is learnt from before going online."""

    dataset: str = ""
    """Minari dataset, by id, folder or .hdf5 file, that the replay starts with; empty: none."""
    pretrain_updates: int = 0
    """Updates on it before the first step, the actor imitating it (sacformer, sac)."""


@dataclasses.dataclass(frozen=True)
class ContextConfig:
    """What the actor sees."""

    context_length: int = 6
    """K: (return-to-go, state) pairs the actor sees, in training and in acting on the window."""
    learnt_steps: int | None = None
    """Steps of a window that are learnt from; None: K (sacformer, sac)."""
    burn_in: int = 0
    """Steps before those of a window that are looked at but not learnt from, so that learning sees
    more of the past; as much as acting with actor_layers times (K - 1)."""
    acting_context: ActingContext = "window"
    """In acting it sees the last K pairs, computed anew, or the episode so far, through a cache."""
    acting_context_limit: int | None = None
    """Newest pairs seen at most with acting_context=episode; None: all."""
    window: WindowKind = "contiguous"
    """Steps of a window: contiguous, or drawn from one finished episode and sorted."""
    return_conditioning: Conditioning = "hindsight"
    """Return-to-go in training: obtained afterwards, commanded (Eq. 1 as in acting), or none."""
    target_return: float | Literal["auto"] = 5_000.0
    """G_1 in acting and in commanded conditioning; auto: the best training return so far, or 0."""
    return_scale: float = 1_000.0
    """Every return-to-go is divided by this."""
    hindsight_scale: float | None = None
    """Divides hindsight return-to-go instead of return_scale; None: the same."""
    next_rtg_decrement: float | None = None
    """Scattered windows: hindsight return-to-go at t+1 is that of t less this; None: its own."""
    rtg_discount: float = 0.99
    """Discount of hindsight return-to-go; 1 for none."""
    tokens: Tokens = "gs"
    """Tokens of a step: return-to-go and state (gs), the action taken there too (gsa), or a single
    one for the return-to-go, the state and the action before it (joint)."""
    normalize_obs: bool = False
    """Normalize observations by their running mean and variance."""

    @property
    def steps_to_learn(self) -> int:
        """Steps of a window that are learnt from."""
        return self.context_length if self.learnt_steps is None else self.learnt_steps

    @property
    def steps_in_a_row(self) -> int:
        """Steps that are learnt from and known to follow each other."""
        return self.steps_to_learn if self.window == "contiguous" else 1

    @property
    def window_length(self) -> int:
        """Steps of a window that is drawn from the replay."""
        return self.burn_in + self.steps_to_learn


@dataclasses.dataclass(frozen=True)
class ActorConfig:
    """The actor network."""

    actor_layers: int = 3
    """Transformer blocks (sacformer) or hidden layers (the other agents)."""
    actor_width: int = 128
    """Width of tokens (sacformer) or hidden layers (the other agents)."""
    actor_heads: int = 1
    """Attention heads (sacformer)."""
    actor_mlp_ratio: int = 4
    """Hidden width of a block's MLP over actor_width (sacformer)."""
    actor_dropout: float = 0.1
    """Dropout rate in updates (sacformer), taken to the nearest of 1/256, 2/256, …"""
    acting_dropout: bool = False
    """Leave dropout on in acting and in evaluation (sacformer)."""
    actor_activation: Activation = "relu"
    """Activation function."""
    time_embedding: TimeEmbedding = "absolute"
    """How tokens tell their time step: by an embedding of it, by how queries and keys are turned,
    so that only its difference counts, or not at all (sacformer)."""
    state_path_width: int = 0
    """Width of an MLP of two layers from the newest state to the heads, around the transformer,
    whose part starts at zero; with transformer_loss=prediction it sees the transformer's features
    beside the state; 0: none (sacformer)."""
    transformer_loss: TransformerLoss = "policy"
    """What the transformer learns from: the actor's loss, that of its prediction in it; or the
    prediction alone, its features then given to the MLP of state_path_width (sacformer)."""
    head_init_scale: float = 1.0
    """Gain of the heads' initialization: Xavier-uniform, of ppo's mean orthogonal."""


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """What the actor's heads stand for."""

    policy: PolicyKind = "gaussian"
    """Gaussian with entropy, or deterministic with noise in acting, in targets and in the loss."""
    action_noise: float = 0.1
    """Standard deviation of the noise of policy=deterministic, over half the action range."""
    action_noise_clip: float = 0.25
    """Largest noise of policy=deterministic, over half the action range."""


@dataclasses.dataclass(frozen=True)
class CriticConfig:
    """The twin critics."""

    critic: CriticName = "mlp"
    """Sees the state and the action alone (mlp), or the window before them too (transformer)."""
    critic_layers: int = 2
    """Hidden layers (mlp) or transformer blocks (transformer)."""
    critic_width: int = 256
    """Width of hidden layers (mlp) or tokens (transformer)."""
    critic_history: int = 1
    """States that a critic sees, the newest included, with the actions between them (mlp)."""
    critic_features: bool = False
    """Critics see the transformer's features of the past, too, as given (mlp)."""
    critic_heads: int = 1
    """Attention heads (transformer)."""
    critic_activation: Activation = "relu"
    """Activation function."""
    critic_layer_norm: bool = False
    """LayerNorm before each activation (mlp)."""
    critic_init: KernelInit = "lecun"
    """Initialization of the layers (mlp): LeCun-uniform or Xavier-uniform, biases zero."""


@dataclasses.dataclass(frozen=True)
class PrecisionConfig:
    """Precision of all networks."""

    compute_dtype: ComputeDtype = "float32"
    """Matrix products inside actor and critics; embeddings, heads and the rest are float32."""


@dataclasses.dataclass(frozen=True)
class LearningConfig:
    """Step sizes, discount, soft updates, temperature."""

    actor_learning_rate: float = 3e-4
    """Adam step size of the actor."""
    critic_learning_rate: float = 3e-4
    """Adam step size of the critics."""
    discount: float = 0.99
    """Discount factor γ."""
    prediction_weight: float = 0.0
    """Weight of foretelling the next observation and the reward, whose errors count as a share of
    their variance; 0: nothing is foretold (sacformer)."""
    prediction_steps: int | Literal["effect"] = 1
    """Steps that are foretold; effect: up to the one in which the action comes into effect
    (1 + action_delay), as far as a window shows them."""
    td_lambda: float = 0.0
    """λ of the critics' targets along a window: 0 for one step, towards 1 for all that follow."""
    tau: float = 0.005
    """Soft-update coefficient of the target critics."""
    alpha: float = 0.2
    """Entropy temperature: fixed, or the first value where it is tuned."""
    tune_alpha: bool = False
    """Tune the temperature to the target entropy."""
    alpha_learning_rate: float = 3e-4
    """Adam step size of log alpha."""
    target_entropy: float | None = None
    """What tuning aims at, in nats; None: minus the number of action dimensions."""


@dataclasses.dataclass(frozen=True)
class Td3Config:
    """What TD3 has beside DDPG (agent=td3)."""

    policy_delay: int = 2
    """Updates of the critics to one of the actor and of the targets."""
    target_noise: float = 0.2
    """Standard deviation of the noise on target actions, over half the action range."""
    target_noise_clip: float = 0.5
    """Largest absolute value of that noise, over half the action range."""


@dataclasses.dataclass(frozen=True)
class PpoConfig:
    """Proximal policy optimization (agent=ppo)."""

    rollout_steps: int = 2048
    """Steps of each environment between two rounds of learning."""
    epochs: int = 10
    """Passes over them in a round."""
    minibatches: int = 32
    """Parts of a pass, an update each."""
    gae_lambda: float = 0.95
    """λ of generalized advantage estimation."""
    clip_range: float = 0.2
    """How far the probability ratio may move from 1."""
    clip_value_loss: bool = True
    """Clip how far a value moves, too."""
    entropy_coefficient: float = 0.0
    """Weight of the entropy bonus."""
    value_coefficient: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 0.5
    """Norm that gradients are scaled down to."""
    anneal_learning_rate: bool = True
    """Let the learning rate fall to 0 linearly over the run."""
    normalize_advantages: bool = True
    """Mean 0 and standard deviation 1 in each part of a pass."""
    normalize_reward: bool = True
    """Divide rewards by the running standard deviation of discounted returns."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Everything that decides a run."""

    agent: AgentName = "sacformer"
    """Algorithm."""
    preset: PresetName = "paper"
    """Where the values not given come from; `sacformer describe` prints them all."""
    seed: int = 0
    """Seed of everything random; of several seeds the first."""
    seeds: int | tuple[int, ...] = 1
    """Seeds trained side by side in one program: how many, from `seed` on, or which."""
    task: TaskConfig = dataclasses.field(default_factory=TaskConfig)
    run: RunConfig = dataclasses.field(default_factory=RunConfig)
    replay: ReplayConfig = dataclasses.field(default_factory=ReplayConfig)
    offline: OfflineConfig = dataclasses.field(default_factory=OfflineConfig)
    context: ContextConfig = dataclasses.field(default_factory=ContextConfig)
    actor: ActorConfig = dataclasses.field(default_factory=ActorConfig)
    policy: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    critic: CriticConfig = dataclasses.field(default_factory=CriticConfig)
    precision: PrecisionConfig = dataclasses.field(default_factory=PrecisionConfig)
    learning: LearningConfig = dataclasses.field(default_factory=LearningConfig)
    td3: Td3Config = dataclasses.field(default_factory=Td3Config)
    ppo: PpoConfig = dataclasses.field(default_factory=PpoConfig)

    @classmethod
    def from_preset(cls, preset: str = "cpu", **fields: Any) -> Config:
        """The preset's values for the agent and environment asked for, with ``fields`` on top.

        Args:
          preset: one of :data:`~sacformer_jax.presets.PRESETS`.
          **fields: any field by its bare name, e.g. ``env="Hopper", num_envs=4``.

        Raises:
          ConfigError: an unknown name or a value that cannot work.
        """
        from sacformer_jax.presets import resolve

        return resolve(preset, fields).config.validated()

    def replace(self, **fields: Any) -> Config:
        """A copy with fields given by their bare names.

        Raises:
          ConfigError: an unknown name or a value of the wrong type.
        """
        places = field_places()
        changes: dict[str, dict[str, Any]] = {}
        for name, value in fields.items():
            if name not in places:
                raise ConfigError(unknown("field", name, places))
            section, kind = places[name]
            changes.setdefault(section, {})[name] = coerced(name, value, kind)
        config = dataclasses.replace(self, **changes.pop("", {}))
        for section, values in changes.items():
            changed = dataclasses.replace(getattr(config, section), **values)
            config = dataclasses.replace(config, **{section: changed})
        return config

    def flat(self) -> dict[str, Any]:
        """All fields by their bare names, in the order of the sections."""
        return {
            name: getattr(getattr(self, section) if section else self, name)
            for name, (section, _) in field_places().items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values, ready for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Config:
        """Inverse of :meth:`to_dict`.

        Raises:
          ConfigError: unknown fields or values of the wrong type.
        """
        sections = {section for section, _ in field_places().values()} - {""}
        fields: dict[str, Any] = {}
        for name, value in values.items():
            fields.update(value if name in sections and isinstance(value, dict) else {name: value})
        return cls().replace(**fields)

    @property
    def all_seeds(self) -> tuple[int, ...]:
        """The seeds that are trained."""
        if isinstance(self.seeds, tuple):
            return self.seeds
        return tuple(range(self.seed, self.seed + self.seeds))

    @property
    def steps_and_updates(self) -> tuple[int, int]:
        """Vector steps and gradient updates of one training iteration (their ratio is UTD)."""
        if self.agent == "ppo":
            return self.ppo.rollout_steps, self.ppo.epochs * self.ppo.minibatches
        ratio = Fraction(self.replay.updates_per_env_step).limit_denominator(1000)
        ratio *= self.task.num_envs
        return ratio.denominator, ratio.numerator

    @property
    def iterations_per_chunk(self) -> int:
        """Training iterations of one jitted call."""
        steps, _ = self.steps_and_updates
        return max(1, self.run.chunk_env_steps // (steps * self.task.num_envs))

    @property
    def env_steps_per_chunk(self) -> int:
        """Environment steps of one jitted call."""
        return self.iterations_per_chunk * self.steps_and_updates[0] * self.task.num_envs

    @property
    def updates_per_pretrain_chunk(self) -> int:
        """Updates of one jitted call of pretraining; their number is rounded up to whole calls."""
        return min(self.offline.pretrain_updates, _PRETRAIN_CHUNK)

    @property
    def prefill_vector_steps(self) -> int:
        """Steps of all environments under random actions (rounded up)."""
        return -(-self.run.prefill_env_steps // self.task.num_envs)

    @property
    def env_steps_of_prefill(self) -> int:
        """Environment steps that these are."""
        return self.prefill_vector_steps * self.task.num_envs

    def validated(self) -> Config:
        """Itself, if it can work.

        Raises:
          ConfigError: with the field, its value and what would be right.
        """
        from sacformer_jax.validation import check

        check(self)
        return self


@functools.cache
def field_places() -> Mapping[str, tuple[str, Any]]:
    """Each field's section ("" at the top) and type, by bare name."""
    places: dict[str, tuple[str, Any]] = {}
    for name, kind in typing.get_type_hints(Config).items():
        if dataclasses.is_dataclass(kind):
            for inner, inner_kind in typing.get_type_hints(kind).items():
                assert inner not in places, f"field {inner} is in two sections"
                places[inner] = (name, inner_kind)
        else:
            places[name] = ("", kind)
    return types.MappingProxyType(places)


def shortest_column(max_episode_steps: int, window_length: int, scattered: bool) -> int:
    """Steps that each environment's column must hold: the longest episode and a window.

    For scattered windows two of the longest episodes, so that one is whole at any time.
    """
    return max_episode_steps + (max_episode_steps if scattered else window_length)
