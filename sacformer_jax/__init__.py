"""SACFormer: Soft Actor-Critic with a Decision-Transformer actor, end to end in JAX.

For runs: :class:`Config`, :func:`train`, :func:`resume`, :func:`evaluate`, :func:`load_policy`.
For your own loops: :func:`make_env`, :class:`VectorEnv`, :func:`make_program` (``init``,
``prefill``, ``train_chunk``), :func:`make_evaluator`, :func:`policy_of`.
"""

from sacformer_jax.api import evaluate
from sacformer_jax.checkpoint import CheckpointError
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.envs import VectorEnv, make_env
from sacformer_jax.evaluate import make_evaluator
from sacformer_jax.policy import Policy, load_policy
from sacformer_jax.runner import RunResult, resume, train
from sacformer_jax.train import Program, make_program, policy_of
from sacformer_jax.version import __version__

__all__ = [
    "CheckpointError",
    "Config",
    "ConfigError",
    "Policy",
    "Program",
    "RunResult",
    "VectorEnv",
    "__version__",
    "evaluate",
    "load_policy",
    "make_env",
    "make_evaluator",
    "make_program",
    "policy_of",
    "resume",
    "train",
]
