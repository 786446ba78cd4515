"""Where a state does not tell all: how SACFormer is to see the past, beside SAC that sees it too.

python experiments/memory.py --jobs 2                 # velocities left out of the observation
python experiments/memory.py --arena delay --jobs 2   # actions come into effect two steps late

Preset `cpu`, 60,000 env steps, seeds 0 to 2 in one program. SAC sees the last K observations with
the actions between them; SACFormer the same history, as K pairs with its own actions among them.
Return-to-go tells of the reward and so of the velocity: none of these has it, but one. Both agents
have variants with the λ-returns along windows which improve.py shows to help both, SACFormer beside
them with relative positions, as the embedding of the time step was seen to be noise.
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

from improve import JOINT_BELIEF, ONE_STATE, PREDICTED, SAC, WHOLE_PAST, K
from study import Study, main_of_choices

from sacformer_jax import Config

TASKS = ("Hopper", "Walker2d", "HalfCheetah")
ENV_STEPS, SEEDS = 60_000, 3
ARENAS: dict[str, dict[str, Any]] = {
    "hidden": {"hide_velocities": True},
    "delay": {"action_delay": 2},
}
_SEQUENCE: dict[str, Any] = {"tokens": "gsa", "return_conditioning": "none"}
_LAMBDA_SEQUENCE: dict[str, Any] = {
    **_SEQUENCE, **WHOLE_PAST, "td_lambda": 0.5, "time_embedding": "rotary",
}  # fmt: skip
_BELIEF_SEQUENCE: dict[str, Any] = {**JOINT_BELIEF, "tokens": "gsa"}
_JOINT: dict[str, Any] = {**JOINT_BELIEF, "prediction_steps": "effect"}
_LAMBDA_SAC: dict[str, Any] = {"agent": "sac", **SAC["sac-lambda"]}
VARIANTS: dict[str, dict[str, Any]] = {
    "sac": {"agent": "sac", "stack_obs": K},
    "sac-lambda": {**_LAMBDA_SAC, "stack_obs": K},
    "sac-lambda-pairs": {**_LAMBDA_SAC, "stack_obs": 2},
    "sac-one-state": {"agent": "sac"},
    # Critics that see no more than the current state.
    "blind-critic": _SEQUENCE,
    "critic-features": {**_SEQUENCE, "critic_features": True},
    "predicting-features": {**_SEQUENCE, **PREDICTED},
    "critic-history": {**_SEQUENCE, **WHOLE_PAST, "critic_history": K},
    "lambda-history": {**_LAMBDA_SEQUENCE, "critic_history": K},
    "lambda-predicting": {**_LAMBDA_SEQUENCE, **PREDICTED},
    "lambda-predicting-path": {**_LAMBDA_SEQUENCE, **PREDICTED, "state_path_width": 256},
    "belief": _BELIEF_SEQUENCE,
    # Of a delayed action what it will meet is foretold, too.
    "belief-effect": {**_BELIEF_SEQUENCE, "prediction_steps": "effect"},
    # A third of the tokens, at two thirds of the cost of an update.
    "belief-joint": _JOINT,
    # As many steps as SAC on windows learns from.
    "belief-joint-42": {**_JOINT, "batch_size": 42},
    # Whether prediction needs the transformer: an MLP that has the past stacked.
    "belief-one-step-targets": {**_BELIEF_SEQUENCE, "td_lambda": 0.0},
    "belief-stacked": {**ONE_STATE, "batch_size": 256, "stack_obs": K},
    "belief-stacked-lambda": {**ONE_STATE, "learnt_steps": K, "td_lambda": 0.5, "stack_obs": K},
    "with-return": {"tokens": "gsa", **PREDICTED},
}  # fmt: skip


def study(arena: str) -> Study:
    """All its runs."""
    configs = {
        f"{task}-{variant}": Config.from_preset(
            "cpu", env=task, seeds=SEEDS, total_env_steps=ENV_STEPS, **ARENAS[arena], **changes
        )
        for (variant, changes), task in itertools.product(VARIANTS.items(), TASKS)
    }
    return Study(f"memory-{arena}", configs, __file__)


if __name__ == "__main__":
    sys.exit(main_of_choices(study, "arena", tuple(ARENAS), "what is kept from the agent"))
