"""What makes SACFormer better, and what does not: preset `cpu` with one thing changed at a time.

python experiments/improve.py --jobs 2
python experiments/improve.py --steps 100k --jobs 2    # what is near the top, as far as the arena

60,000 env steps, seeds 0 to 2 in one program, for SACFormer and for SAC, which gets what it can
have, too. Every variant is first trained on Hopper and Walker2d. The rule by which it is given up,
written down before anything was run: its normalized score, averaged over both tasks and all seeds,
is not above that of the agent as it is. What is left (`FURTHER`) goes on to HalfCheetah and Ant,
and what is ahead over all four is put together.

Hopper and Walker2d are learnt about where these runs end, so the variants that could be preset
`best` (`LONGER`) go on to the arena's 100,000 steps. The rule, written down before: SACFormer's
`best` stays `lambda-path` unless another's interquartile mean over the three tasks is ahead of its
own by 0.05 there; the same of SAC's `sac-lambda`, written down later, before `sac-lambda-larger`
was trained that far. (A copy of a run of 60,000 steps under runs/improve-100k, with what lies
beside it, is resumed.)
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

from study import Study, main_of_choices

from sacformer_jax import Config

TASKS = ("Hopper", "Walker2d")
FURTHER_TASKS = ("HalfCheetah", "Ant")
ENV_STEPS, SEEDS = {"60k": 60_000, "100k": 100_000}, 3
K = 6
"""Of preset `cpu`."""
# Every step is learnt from with all the past that acting shows; what the upper blocks have heard of
# is kept in acting, as training shows it.
WHOLE_PAST: dict[str, Any] = {
    "burn_in": K - 1,
    "acting_context": "episode",
    "acting_context_limit": K,
}
SACFORMER: dict[str, dict[str, Any]] = {
    "sacformer": {},
    "no-return": {"return_conditioning": "none"},
    "state-path": {"state_path_width": 256},
    "no-time": {"time_embedding": "none"},
    "rotary": {"time_embedding": "rotary"},
    "td-lambda": {"td_lambda": 0.5},
    "td-lambda-larger": {"td_lambda": 0.8},
    "critic-norm": {"critic_layer_norm": True},
    "critic-features": {"critic_features": True},
    "predicting": {"prediction_weight": 1.0},
    "predicting-features": {"critic_features": True, "prediction_weight": 1.0},
    "short-windows": {"context_length": 3, "batch_size": 64},
    "burn-in": WHOLE_PAST,
}
LAMBDA_PATH: dict[str, Any] = {"td_lambda": 0.5, "state_path_width": 256}
_LARGER_PATH: dict[str, Any] = {**LAMBDA_PATH, "td_lambda": 0.8}
_NO_TIME: dict[str, Any] = {"time_embedding": "none"}
_STATES: dict[str, Any] = {**_NO_TIME, "return_conditioning": "none"}
PREDICTED: dict[str, Any] = {"critic_features": True, "prediction_weight": 1.0}
# The transformer learns from predicting alone; actor and critics see what it makes of the past.
BELIEF: dict[str, Any] = {**PREDICTED, "transformer_loss": "prediction"}
# … with the actions before, one token a step; with 42 windows it is preset `best`.
JOINT_BELIEF: dict[str, Any] = {
    **LAMBDA_PATH, **BELIEF, **WHOLE_PAST,
    "tokens": "joint", "return_conditioning": "none", "time_embedding": "rotary",
}  # fmt: skip
# A transformer of one state is an MLP that foretells.
ONE_STATE: dict[str, Any] = {**BELIEF, **_STATES, "context_length": 1, "state_path_width": 256}
# 42 windows of 6 for 256 single steps.
_WINDOWS: dict[str, Any] = {"learnt_steps": K, "batch_size": 42}
TOGETHER: dict[str, dict[str, Any]] = {
    "lambda-norm": {"td_lambda": 0.5, "critic_layer_norm": True},
    "lambda-path": LAMBDA_PATH,
    "lambda-path-norm": {**LAMBDA_PATH, "critic_layer_norm": True},
    "lambda-no-time": {"td_lambda": 0.5, **_NO_TIME},
    "lambda-path-no-time": {**LAMBDA_PATH, **_NO_TIME},
    "lambda-path-states": {**LAMBDA_PATH, **_STATES},
    # What else SAC has otherwise: wide heads at first, and as many steps to learn from.
    "lambda-path-as-sac": {**LAMBDA_PATH, **_STATES, "head_init_scale": 1.0, "batch_size": 42},
    "larger-path": _LARGER_PATH,
    "larger-path-no-time": {**_LARGER_PATH, **_NO_TIME},
    "lambda-path-predicting": {**LAMBDA_PATH, **PREDICTED},
    "lambda-belief": {**LAMBDA_PATH, **BELIEF},
    "lambda-belief-states": {**LAMBDA_PATH, **BELIEF, **_STATES},
    # As many steps to learn from as SAC, which is much where states do not tell all.
    "lambda-path-42": {**LAMBDA_PATH, "batch_size": 42},
    "lambda-belief-joint-42": {**JOINT_BELIEF, "batch_size": 42},
    "lambda-belief-joint-42-ahead": {**JOINT_BELIEF, "batch_size": 42, "prediction_steps": 3},
    # Whether it needs the past.
    "lambda-belief-one-state": {**ONE_STATE, **_WINDOWS, "td_lambda": 0.5},
}  # fmt: skip
SAC: dict[str, dict[str, Any]] = {
    "sac": {},
    "sac-critic-norm": {"critic_layer_norm": True},
    "sac-slower-critic": {"critic_learning_rate": 3e-4},
    "sac-faster-actor": {"actor_learning_rate": 1e-3},
    # The same returns along windows, without a transformer.
    "sac-lambda": {**_WINDOWS, "td_lambda": 0.5},
    "sac-lambda-larger": {**_WINDOWS, "td_lambda": 0.8},
    "sac-lambda-larger-small-heads": {**_WINDOWS, "td_lambda": 0.8, "head_init_scale": 0.01},
    "sac-lambda-norm": {**_WINDOWS, "td_lambda": 0.5, "critic_layer_norm": True},
}
FURTHER = (
    "sacformer", "lambda-path", "larger-path-no-time", "lambda-belief-states", "lambda-path-42",
    "lambda-belief-joint-42", "lambda-belief-joint-42-ahead", "sac", "sac-lambda",
    "sac-lambda-larger",
)  # fmt: skip
"""Variants that are trained on all four tasks."""
LONGER = (
    "lambda-path", "lambda-path-42", "lambda-belief-joint-42", "lambda-belief-joint-42-ahead",
    "lambda-belief-one-state", "sac-lambda", "sac-lambda-larger",
)  # fmt: skip
"""Variants that go on to 100,000 steps."""


def study(steps: str = "60k") -> Study:
    """All its runs of so many steps."""
    changed = SACFORMER | TOGETHER
    variants = {name: {"agent": "sacformer", **changes} for name, changes in changed.items()}
    variants |= {name: {"agent": "sac", **changes} for name, changes in SAC.items()}
    longer = steps != "60k"
    tasks = (*TASKS, "HalfCheetah") if longer else (*TASKS, *FURTHER_TASKS)
    on_all_tasks = LONGER if longer else FURTHER
    configs = {
        f"{task}-{variant}": Config.from_preset(
            "cpu", env=task, seeds=SEEDS, total_env_steps=ENV_STEPS[steps], **changes
        )
        for (variant, changes), task in itertools.product(variants.items(), tasks)
        if variant in on_all_tasks or (task in TASKS and not longer)
    }
    return Study(f"improve-{steps}" if longer else "improve", configs, __file__)


if __name__ == "__main__":
    sys.exit(main_of_choices(study, "steps", tuple(ENV_STEPS), "env steps of a run"))
