"""SACFormer: Soft Actor-Critic with a Decision-Transformer actor, end to end in JAX.

For runs: :class:`Config`, :func:`train`, :func:`resume`, :func:`evaluate`, :func:`load_policy`,
:func:`export_policy`, :func:`collect`, :func:`extract`, :func:`render`, :func:`report`; with
:class:`Member` and :class:`Devices` of many members on many devices, and :class:`Callback` for your
own code between chunks.
For environments of your own: :class:`Task`, :class:`MujocoEnv`, :class:`JaxEnv`,
:func:`check_env`, :func:`register_env`; with wrappers: :func:`wrapped`, and in Gymnasium
:func:`gymnasium_env`; for ``brax.training`` on ours: :func:`as_brax`.
For your own loops: :func:`make_env`, :class:`VectorEnv`, :func:`make_program` (``init``,
``prefill``, ``train_chunk``), :func:`make_evaluator`, :func:`policy_of`.
"""

from sacformer_jax.api import collect, evaluate
from sacformer_jax.callbacks import Callback, Event, RunStart, StopAtReturn, StopWithoutProgress
from sacformer_jax.checkpoint import CheckpointError
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.envs import (
    Coordinates,
    Env,
    EnvSpec,
    EnvStep,
    JaxEnv,
    MujocoEnv,
    Quantities,
    Task,
    VectorEnv,
    as_brax,
    check_env,
    make_env,
    register_env,
    wrapped,
)
from sacformer_jax.evaluate import make_evaluator
from sacformer_jax.export import export_policy
from sacformer_jax.extraction import extract
from sacformer_jax.gymnasium_eval import gymnasium_env
from sacformer_jax.loop import DivergedError
from sacformer_jax.members import Member, seed_members
from sacformer_jax.policy import Policy, load_policy
from sacformer_jax.population import Devices, Population, make_population
from sacformer_jax.render import VideoEvery, render
from sacformer_jax.report import report
from sacformer_jax.results import RunResult
from sacformer_jax.runner import resume, train
from sacformer_jax.train import Program, make_program, policy_of
from sacformer_jax.version import __version__

__all__ = [
    "Callback",
    "CheckpointError",
    "Config",
    "ConfigError",
    "Coordinates",
    "Devices",
    "DivergedError",
    "Env",
    "EnvSpec",
    "EnvStep",
    "Event",
    "JaxEnv",
    "Member",
    "MujocoEnv",
    "Policy",
    "Population",
    "Program",
    "Quantities",
    "RunResult",
    "RunStart",
    "StopAtReturn",
    "StopWithoutProgress",
    "Task",
    "VectorEnv",
    "VideoEvery",
    "__version__",
    "as_brax",
    "check_env",
    "collect",
    "evaluate",
    "export_policy",
    "extract",
    "gymnasium_env",
    "load_policy",
    "make_env",
    "make_evaluator",
    "make_population",
    "make_program",
    "policy_of",
    "register_env",
    "render",
    "report",
    "resume",
    "seed_members",
    "train",
    "wrapped",
]
