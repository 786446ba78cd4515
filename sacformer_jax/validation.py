"""What a configuration must satisfy, each refusal with its reason."""

from __future__ import annotations

import numpy as np

from sacformer_jax.config import (
    MLP_AGENTS,
    Config,
    ConfigError,
    ContextConfig,
    TaskConfig,
    shortest_column,
)

_AT_LEAST_ONE = (
    "num_envs", "max_episode_steps", "total_env_steps", "eval_every", "eval_episodes",
    "checkpoint_every", "chunk_env_steps", "buffer_capacity", "batch_size", "context_length",
    "actor_layers", "actor_width", "actor_heads", "actor_mlp_ratio", "critic_layers",
    "critic_width", "critic_heads", "critic_history", "policy_delay", "rollout_steps", "epochs",
    "minibatches", "stack_obs",
)  # fmt: skip
_POSITIVE = (
    "updates_per_env_step", "return_scale", "head_init_scale", "actor_learning_rate",
    "critic_learning_rate", "alpha", "alpha_learning_rate", "tau", "action_noise_clip",
    "clip_range", "max_grad_norm", "target_noise_clip",
)  # fmt: skip
_AT_MOST_ONE = ("tau", "discount", "rtg_discount", "gae_lambda", "td_lambda")


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ConfigError(message)


def check(config: Config) -> None:
    """Raises ConfigError naming the first field that cannot work, its value and the remedy."""
    values = config.flat()
    for name in _AT_LEAST_ONE:
        _require(values[name] >= 1, f"{name}={values[name]}: must be at least 1")
    for name in _POSITIVE:
        _require(
            bool(np.float32(values[name]) > 0), f"{name}={values[name]}: must be greater than 0"
        )
    for name, value in values.items():
        if isinstance(value, float):
            _require(
                abs(value) <= float(np.finfo(np.float32).max),
                f"{name}={value}: is beyond the range of float32",
            )
    for name in _AT_MOST_ONE:
        _require(values[name] <= 1, f"{name}={values[name]}: must be at most 1")
    for name in (
        "discount", "rtg_discount", "prefill_env_steps", "seed", "action_noise",
        "max_skipped_updates", "gae_lambda", "target_noise", "entropy_coefficient",
        "value_coefficient", "pretrain_updates", "video_every", "burn_in", "state_path_width",
        "td_lambda", "prediction_weight", "action_delay",
    ):  # fmt: skip
        _require(values[name] >= 0, f"{name}={values[name]}: must not be negative")
    _check_wrappers(config)
    _check_seeds(config)
    _check_actor(config)
    _check_policy(config)
    _check_window(config)
    _check_past(config)
    _check_target_return(config)
    _check_acting(config)
    _check_critic(config)
    _check_offline(config)
    if config.agent == "ppo":
        _check_ppo(config)
    else:
        _check_steps(config)


def _check_wrappers(config: Config) -> None:
    task = config.task
    for name in ("action_delay", "stack_obs"):
        value = getattr(task, name)
        _require(
            value < task.max_episode_steps or value == getattr(TaskConfig, name),
            f"{name}={value}: must be below max_episode_steps={task.max_episode_steps}",
        )


def _check_seeds(config: Config) -> None:
    _require(config.seed < 2**32, f"seed={config.seed}: must be below 2**32")
    seeds = config.seeds
    if isinstance(seeds, int):
        _require(seeds >= 1, f"seeds={seeds}: must be at least 1")
    else:
        _require(len(seeds) >= 2, f"seeds={seeds}: name two or more, or give how many")
        _require(len(set(seeds)) == len(seeds), f"seeds={seeds}: each must differ from the others")
    for seed in config.all_seeds:
        _require(0 <= seed < 2**32, f"seeds={seeds}: {seed} must be at least 0 and below 2**32")


def _check_actor(config: Config) -> None:
    actor, context = config.actor, config.context
    _require(
        0 <= actor.actor_dropout < 1,
        f"actor_dropout={actor.actor_dropout}: must be at least 0 and below 1",
    )
    _require(
        not actor.acting_dropout or (config.agent not in MLP_AGENTS and actor.actor_dropout > 0),
        "acting_dropout=True: there is no dropout to leave on; use acting_dropout=False, or "
        "agent=sacformer with actor_dropout above 0",
    )
    if config.agent in MLP_AGENTS:
        _require(
            actor.state_path_width == 0,
            f"state_path_width={actor.state_path_width}: agent={config.agent} has no transformer "
            "to go around; use state_path_width=0, or agent=sacformer",
        )
        weight = config.learning.prediction_weight
        _require(
            weight == 0,
            f"prediction_weight={weight}: agent={config.agent} predicts nothing; use "
            "prediction_weight=0, or agent=sacformer",
        )
        _require(
            actor.transformer_loss == "policy",
            f"transformer_loss={actor.transformer_loss!r}: agent={config.agent} has no "
            "transformer; use transformer_loss=policy, or agent=sacformer",
        )
        _require(
            not config.critic.critic_features,
            f"critic_features=True: agent={config.agent} has no transformer whose features critics "
            "could see; use critic_features=False, or agent=sacformer",
        )
        _require(
            context.context_length == 1,
            f"context_length={context.context_length}: agent={config.agent} sees one state; "
            "use context_length=1, or agent=sacformer",
        )
        _require(
            context.return_conditioning == "none",
            f"return_conditioning={context.return_conditioning!r}: agent={config.agent} sees no "
            "return; use return_conditioning=none, or agent=sacformer",
        )
        _require(
            context.tokens == "gs",
            f"tokens={context.tokens!r}: agent={config.agent} sees no actions; use tokens=gs, "
            "or agent=sacformer",
        )
    else:
        for name, value in (
            ("prediction_weight", config.learning.prediction_weight),
            ("state_path_width", actor.state_path_width),
        ):
            _require(
                actor.transformer_loss == "policy" or value > 0,
                f"transformer_loss={actor.transformer_loss!r}: needs a prediction to learn from "
                f"and an MLP that sees the features, and {name}={value}; use {name} above 0, or "
                "transformer_loss=policy",
            )
        _require(
            actor.actor_width % actor.actor_heads == 0,
            f"actor_heads={actor.actor_heads}: must divide actor_width={actor.actor_width}",
        )
        head_width = actor.actor_width // actor.actor_heads
        _require(
            actor.time_embedding != "rotary" or head_width % 2 == 0,
            f"time_embedding={actor.time_embedding!r}: turns pairs of numbers, and "
            f"actor_width={actor.actor_width} over actor_heads={actor.actor_heads} is odd; use an "
            "even width of heads, or another time_embedding",
        )
        if context.tokens != "gs":
            why = "there is no action before the state"
            _check_past_in_training(context, "tokens", context.tokens, why, "gs")


def _check_policy(config: Config) -> None:
    _require(
        config.policy.policy == "gaussian" or not config.learning.tune_alpha,
        "tune_alpha=True: policy=deterministic has no entropy to tune it by; use "
        "tune_alpha=False, or policy=gaussian",
    )
    _require(
        config.agent not in ("td3", "ddpg") or not config.learning.tune_alpha,
        f"tune_alpha=True: agent={config.agent} has no entropy to tune it by; use "
        "tune_alpha=False, or agent=sacformer or sac",
    )


def _check_past_in_training(
    context: ContextConfig, name: str, value: str, why: str, off: str
) -> None:
    """Refuses a setting that makes nothing of windows of a single step."""
    _require(
        context.context_length > 1,
        f"{name}={value!r}: with context_length=1 {why}; use {name}={off}, or context_length of 2 "
        "or more",
    )
    _require(
        context.window_length > 1,
        f"{name}={value!r}: with learnt_steps=1 and burn_in=0 {why}; use {name}={off}, or more of "
        "either",
    )


def _check_past(config: Config) -> None:
    """What looks along a window needs one whose steps follow each other, and enough of them."""
    context, critic, td_lambda = config.context, config.critic, config.learning.td_lambda
    _require(
        context.learnt_steps is None or context.learnt_steps >= 1,
        f"learnt_steps={context.learnt_steps}: must be at least 1, or None for context_length",
    )
    asked = {
        ("burn_in", 0): context.burn_in,
        ("critic_history", 1): critic.critic_history,
        ("td_lambda", 0): td_lambda,
        ("learnt_steps", None): context.learnt_steps,
    }
    for (name, off), value in asked.items():
        along = name in ("td_lambda", "learnt_steps")
        agents = ("sacformer", "sac") if along else ("sacformer",)
        _require(
            value == off or config.agent in agents,
            f"{name}={value}: agent={config.agent} learns from single steps; use {name}={off}, or "
            f"agent={' or '.join(agents)}",
        )
        _require(
            value == off or context.window == "contiguous",
            f"{name}={value}: steps of window=scattered do not follow each other; use "
            f"{name}={off}, or window=contiguous",
        )
    _require(
        td_lambda == 0 or context.steps_to_learn > 1,
        f"td_lambda={td_lambda}: a window of a single step has nothing after it; use td_lambda=0, "
        "or learnt_steps of 2 or more",
    )
    _check_prediction_steps(config)
    _require(
        critic.critic_history == 1 or critic.critic == "mlp",
        f"critic_history={critic.critic_history}: is for critic=mlp; a transformer sees the whole "
        "window; use critic_history=1",
    )
    _require(
        not critic.critic_features or (critic.critic == "mlp" and critic.critic_history == 1),
        f"critic_features=True: with critic={critic.critic} and "
        f"critic_history={critic.critic_history} critics see the past by themselves; use "
        "critic_features=False, or critic=mlp and critic_history=1",
    )
    _require(
        critic.critic_history <= context.window_length + 1,
        f"critic_history={critic.critic_history}: a window has {context.window_length + 1} states "
        f"(burn_in={context.burn_in}, {context.steps_to_learn} to learn from and one after them); "
        "use as many or fewer",
    )


def _check_prediction_steps(config: Config) -> None:
    steps, in_a_row = config.learning.prediction_steps, config.context.steps_in_a_row
    _require(
        steps == 1 or config.learning.prediction_weight > 0,
        f"prediction_steps={steps}: nothing is predicted; use prediction_steps=1, or "
        "prediction_weight above 0",
    )
    _require(
        steps == "effect" or 1 <= steps <= in_a_row,
        f"prediction_steps={steps}: must be from 1 to {in_a_row}, the steps of a window that are "
        f"learnt from and follow each other (learnt_steps={config.context.steps_to_learn}, "
        f"window={config.context.window}), or 'effect'",
    )


def _check_window(config: Config) -> None:
    context = config.context
    scale, decrement = context.hindsight_scale, context.next_rtg_decrement
    for name, value in (("hindsight_scale", scale), ("next_rtg_decrement", decrement)):
        _require(
            value is None or context.return_conditioning == "hindsight",
            f"{name}={value}: is for return_conditioning=hindsight, not "
            f"{context.return_conditioning}; use {name}=None, or hindsight",
        )
    _require(
        scale is None or bool(np.float32(scale) > 0),
        f"hindsight_scale={scale}: must be greater than 0",
    )
    if context.window == "contiguous":
        _require(
            decrement is None,
            f"next_rtg_decrement={decrement}: window=contiguous shows what followed; use "
            "next_rtg_decrement=None, or window=scattered",
        )
        return
    reasons = {
        f"agent={config.agent} sees one state; use window=contiguous, or agent=sacformer": (
            config.agent not in MLP_AGENTS
        ),
        f"with tokens={context.tokens} an action must stand before the state it led to; use "
        "tokens=gs": context.tokens == "gs",
        "critic=transformer needs the steps before the one it judges; use critic=mlp": (
            config.critic.critic == "mlp"
        ),
        f"context_length={context.context_length} different steps cannot be drawn from episodes "
        f"of at most max_episode_steps={config.task.max_episode_steps}; use a smaller K": (
            context.context_length <= config.task.max_episode_steps
        ),
    }
    for reason, holds in reasons.items():
        _require(holds, f"window={context.window!r}: {reason}")


def _check_ppo(config: Config) -> None:
    ppo, run = config.ppo, config.run
    batch = ppo.rollout_steps * config.task.num_envs
    _require(
        batch % ppo.minibatches == 0 and batch > ppo.minibatches,
        f"minibatches={ppo.minibatches}: must divide rollout_steps={ppo.rollout_steps} times "
        f"num_envs={config.task.num_envs}, and leave two steps or more in each",
    )
    _require(
        run.prefill_env_steps == 0,
        f"prefill_env_steps={run.prefill_env_steps}: agent=ppo learns from its own steps alone; "
        "use prefill_env_steps=0",
    )
    _require(
        run.checkpoint_replay,
        "checkpoint_replay=False: agent=ppo keeps no replay that could be left out; use True",
    )
    _require(
        run.total_env_steps < 2**31,
        f"total_env_steps={run.total_env_steps}: must be below 2**31, the counters' range",
    )
    _require(
        not config.learning.tune_alpha, "tune_alpha=True: agent=ppo has no temperature; use False"
    )
    _require(
        config.policy.policy == "gaussian",
        f"policy={config.policy.policy!r}: agent=ppo needs probabilities; use policy=gaussian",
    )
    _require(
        config.critic.critic_init == "lecun",
        f"critic_init={config.critic.critic_init!r}: agent=ppo initializes orthogonally; use "
        "critic_init=lecun, the default",
    )


def _check_target_return(config: Config) -> None:
    context = config.context
    _require(
        context.target_return != "auto" or context.return_conditioning != "none",
        "target_return='auto': return_conditioning=none looks at no return; use hindsight or "
        "commanded",
    )


def _check_acting(config: Config) -> None:
    context, limit = config.context, config.context.acting_context_limit
    _require(limit is None or limit >= 1, f"acting_context_limit={limit}: must be at least 1")
    if context.acting_context == "window":
        _require(
            limit is None,
            f"acting_context_limit={limit}: acting_context=window shows context_length="
            f"{context.context_length} states; use acting_context_limit=None, or "
            "acting_context=episode",
        )
        return
    _require(
        config.agent not in MLP_AGENTS,
        f"acting_context={context.acting_context!r}: agent={config.agent} sees one state; use "
        "acting_context=window, or agent=sacformer",
    )
    why = "training never shows what came before"
    _check_past_in_training(context, "acting_context", context.acting_context, why, "window")
    _require(
        limit is None or limit >= context.context_length,
        f"acting_context_limit={limit}: is below "
        f"context_length={context.context_length}, what training shows; use "
        f"{context.context_length} or more",
    )


def _check_critic(config: Config) -> None:
    critic = config.critic
    if critic.critic == "mlp":
        return
    _require(
        config.agent not in MLP_AGENTS,
        f"critic={critic.critic!r}: agent={config.agent} sees one step; use critic=mlp, or "
        "agent=sacformer",
    )
    _check_past_in_training(config.context, "critic", critic.critic, "it sees one step", "mlp")
    _require(
        critic.critic_width % critic.critic_heads == 0,
        f"critic_heads={critic.critic_heads}: must divide critic_width={critic.critic_width}",
    )
    _require(
        critic.critic_init == "lecun",
        f"critic_init={critic.critic_init!r}: is for critic=mlp; a transformer has its own; use "
        "critic_init=lecun",
    )
    _require(
        not critic.critic_layer_norm,
        "critic_layer_norm=True: is for critic=mlp; a transformer has its own",
    )


def _check_offline(config: Config) -> None:
    offline = config.offline
    if not offline.dataset:
        _require(
            offline.pretrain_updates == 0,
            f"pretrain_updates={offline.pretrain_updates}: there is nothing to learn from; give a "
            "dataset, or use pretrain_updates=0",
        )
        return
    _require(
        config.agent != "ppo",
        f"dataset={offline.dataset!r}: agent=ppo learns from its own steps alone; use another "
        "agent, or dataset=''",
    )
    _require(
        offline.pretrain_updates == 0 or config.agent in ("sacformer", "sac"),
        f"pretrain_updates={offline.pretrain_updates}: agent={config.agent} can only begin with "
        "the dataset in its replay; use pretrain_updates=0, or agent=sacformer or sac",
    )
    _require(
        offline.pretrain_updates == 0 or config.run.prefill_env_steps == 0,
        f"prefill_env_steps={config.run.prefill_env_steps}: pretrain_updates would imitate these "
        "random actions with those of the dataset, which fills the replay by itself; use "
        "prefill_env_steps=0",
    )
    _require(
        config.run.checkpoint_replay,
        f"dataset={offline.dataset!r}: is in the replay, which checkpoint_replay=False does not "
        "save; use checkpoint_replay=True",
    )
    for name in ("hide_velocities", "action_delay", "stack_obs"):
        value, plain = getattr(config.task, name), getattr(TaskConfig, name)
        _require(
            value == plain,
            f"dataset={offline.dataset!r}: its steps are the environment's own, not those under "
            f"{name}={value}; use {name}={plain}, or dataset=''",
        )


def _check_steps(config: Config) -> None:
    task, run, replay = config.task, config.run, config.replay
    _require(
        run.total_env_steps > run.prefill_env_steps,
        f"total_env_steps={run.total_env_steps}: must be above "
        f"prefill_env_steps={run.prefill_env_steps}, or nothing is learnt",
    )
    _require(
        run.total_env_steps < 2**31,
        f"total_env_steps={run.total_env_steps}: must be below 2**31, the counters' range",
    )
    steps, updates = config.steps_and_updates
    _require(
        steps <= 1000 and updates >= 1,
        f"updates_per_env_step={replay.updates_per_env_step}: with num_envs={task.num_envs} an "
        f"iteration would have {steps} steps and {updates} updates; use a simpler fraction",
    )
    _require(
        abs(updates / (steps * task.num_envs) / replay.updates_per_env_step - 1) < 1e-3,
        f"updates_per_env_step={replay.updates_per_env_step}: is not a fraction with a "
        "denominator up to 1000; the smallest is 0.001",
    )
    learning_steps = run.total_env_steps - run.prefill_env_steps
    _require(
        learning_steps * replay.updates_per_env_step < 2**31,
        f"updates_per_env_step={replay.updates_per_env_step}: makes over 2**31 updates in "
        f"total_env_steps={run.total_env_steps}, beyond the counters' range",
    )
    needed = 0 if config.offline.dataset else 1
    whole_episodes = (
        config.context.return_conditioning == "hindsight" or config.context.window == "scattered"
    )
    if needed and whole_episodes:
        # Only finished episodes are replayed.
        needed = task.max_episode_steps
    _require(
        config.prefill_vector_steps >= needed,
        f"prefill_env_steps={run.prefill_env_steps}: must be at least {needed * task.num_envs} "
        f"({needed} for each of num_envs={task.num_envs}), so that there is something to sample",
    )
    scattered = config.context.window == "scattered"
    least = task.num_envs * shortest_column(
        task.max_episode_steps, config.context.window_length, scattered
    )
    what = "two of the longest episodes" if scattered else "the longest episode and a window"
    _require(
        replay.buffer_capacity >= least,
        f"buffer_capacity={replay.buffer_capacity}: must be at least {least}, so that each of "
        f"num_envs={task.num_envs} holds {what}",
    )
