"""The configuration: round trips, presets, documentation of fields, refusal of bad input."""

from __future__ import annotations

import ast
import inspect
import json
import math
from pathlib import Path
from typing import Any, get_args

import pytest

from sacformer_jax import Config, ConfigError, config, make_program, train
from sacformer_jax.presets import PRESETS, resolve
from sacformer_jax.runner import sources_of

ENVS = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid", "brax:ant")
AGENTS = get_args(config.AgentName)
TINY = {
    "env": "Hopper", "num_envs": 2, "max_episode_steps": 50, "prefill_env_steps": 200,
    "chunk_env_steps": 100, "total_env_steps": 600, "eval_every": 200, "eval_episodes": 2,
    "checkpoint_every": 200, "actor_width": 8, "actor_heads": 1, "actor_layers": 1,
    "critic_width": 8, "batch_size": 4, "buffer_capacity": 2000, "updates_per_env_step": 1.0,
    "context_length": 6, "return_conditioning": "commanded",
}  # fmt: skip


# --- fields and round trips --------------------------------------------------------------------


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("env", ENVS)
def test_every_preset_is_valid_and_survives_json(preset: str, agent: str, env: str) -> None:
    made = Config.from_preset(preset, agent=agent, env=env)
    assert (made.preset, made.agent, made.task.env) == (preset, agent, env)
    again = Config.from_dict(json.loads(json.dumps(made.to_dict())))
    assert again == made
    assert again.validated() is again


def test_json_keeps_values_that_are_not_defaults() -> None:
    given = {
        "target_entropy": -1.5, "updates_per_env_step": 1 / 3, "normalize_obs": True, "seed": 7,
        "run_dir": "runs/ä b", "actor_activation": "gelu", "total_env_steps": 123_456,
    }  # fmt: skip
    made = Config.from_preset("cpu", **given)
    again = Config.from_dict(json.loads(json.dumps(made.to_dict())))
    assert again == made
    assert {name: again.flat()[name] for name in given} == given


def test_from_dict_refuses_unknown_and_mistyped_fields() -> None:
    values = Config().to_dict()
    values["task"]["num_envz"] = 3
    with pytest.raises(ConfigError, match="num_envz"):
        Config.from_dict(values)
    values = Config().to_dict()
    values["learning"]["tau"] = "small"
    with pytest.raises(ConfigError, match=r"tau='small'"):
        Config.from_dict(values)


def test_field_names_are_unique_over_sections() -> None:
    names: list[str] = []
    for name, value in Config().to_dict().items():
        names.extend(value if isinstance(value, dict) else [name])
    assert len(names) == len(set(names))
    assert set(names) == set(config.field_places())
    assert list(Config().flat()) == list(config.field_places())


def test_every_field_has_a_docstring() -> None:
    tree = ast.parse(inspect.getsource(config))
    sections = {type(getattr(Config(), s)).__name__ for s, _ in config.field_places().values() if s}
    documented: set[str] = set()
    for node in tree.body:
        if not isinstance(node, ast.ClassDef) or node.name not in {"Config", *sections}:
            continue
        for field, text in zip(node.body, [*node.body[1:], None], strict=True):
            if not isinstance(field, ast.AnnAssign) or not isinstance(text, ast.Expr):
                continue
            assert isinstance(field.target, ast.Name)
            assert isinstance(text.value, ast.Constant)
            assert len(str(text.value.value).strip()) > 3, field.target.id
            documented.add(field.target.id)
    assert documented == set(config.field_places())


def test_replace_takes_bare_names_and_leaves_the_original() -> None:
    original = Config()
    changed = original.replace(env="Ant", tau=0.01, seed=3)
    assert (changed.task.env, changed.learning.tau, changed.seed) == ("Ant", 0.01, 3)
    assert original == Config()
    differing = {n for n, v in changed.flat().items() if v != original.flat()[n]}
    assert differing == {"env", "tau", "seed"}


def test_numbers_are_taken_where_nothing_is_lost() -> None:
    made = Config().replace(discount=1, num_envs=4.0, total_env_steps=1e6, target_entropy=-3)
    assert made.learning.discount == 1.0
    assert isinstance(made.learning.discount, float)
    assert isinstance(made.task.num_envs, int)
    assert made.run.total_env_steps == 1_000_000
    assert made.learning.target_entropy == -3.0
    assert made.replace(target_entropy=None).learning.target_entropy is None


# --- presets -----------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("agent", AGENTS)
def test_sources_name_every_field(preset: str, agent: str) -> None:
    resolved = resolve(preset, {"agent": agent, "env": "Humanoid", "tau": 0.01}, "from me")
    assert set(resolved.sources) == set(resolved.config.flat())
    assert all(source.strip() for source in resolved.sources.values())
    given = {name for name, source in resolved.sources.items() if source == "from me"}
    assert given == {"agent", "env", "tau"}
    assert resolved.config.learning.tau == 0.01


def test_a_preset_value_names_its_layer_as_source() -> None:
    for preset, layers in PRESETS.items():
        for layer in layers:
            asked = {"agent": layer.agent or "sacformer", "env": layer.env or "Hopper"}
            resolved = resolve(preset, asked)
            # A later layer may set a field again; the last one's value and source must show.
            for name in layer.values:
                last = [
                    other
                    for other in layers
                    if name in other.values
                    and other.agent in (None, asked["agent"])
                    and other.env in (None, asked["env"])
                ][-1]
                assert resolved.sources[name] == last.source, (preset, name)
                assert resolved.config.flat()[name] == last.values[name], (preset, name)


def test_preset_paper_holds_the_papers_values() -> None:
    flat = Config.from_preset("paper", env="HalfCheetah").flat()
    paper = {
        "agent": "sacformer", "num_envs": 1, "max_episode_steps": 1000, "actor_layers": 3,
        "actor_width": 128, "actor_dropout": 0.1, "actor_heads": 1, "actor_mlp_ratio": 4,
        "actor_activation": "relu", "critic_layers": 2, "critic_width": 256,
        "actor_learning_rate": 3e-4, "critic_learning_rate": 3e-4, "discount": 0.99, "tau": 0.005,
        "batch_size": 128, "context_length": 6, "updates_per_env_step": 1.0,
        "prefill_env_steps": 10_000, "eval_every": 2_000, "eval_episodes": 4,
        "total_env_steps": 1_000_000, "buffer_capacity": 1_000_000, "alpha": 0.2,
        "tune_alpha": False, "return_conditioning": "hindsight", "rtg_discount": 0.99,
    }  # fmt: skip
    assert {name: flat[name] for name in paper} == paper


def test_preset_paper_on_humanoid() -> None:
    made = Config.from_preset("paper", env="Humanoid")
    assert made.learning.alpha == 0.05
    assert made.context.context_length == 10
    sac = Config.from_preset("paper", env="Humanoid", agent="sac")
    assert sac.context.context_length == 1


def test_preset_authors_holds_their_programs_values() -> None:
    flat = Config.from_preset("authors", env="Walker2d").flat()
    theirs = {
        "window": "scattered", "return_conditioning": "hindsight", "rtg_discount": 0.99,
        "hindsight_scale": 500.0, "next_rtg_decrement": 0.002, "target_return": 4_000.0,
        "return_scale": 1_000.0, "acting_context": "episode", "acting_context_limit": 512,
        "actor_heads": 1, "actor_activation": "relu", "actor_dropout": 0.1,
        "acting_dropout": True, "head_init_scale": 1.0, "critic_init": "xavier", "alpha": 0.2,
        "tune_alpha": False, "buffer_capacity": 1_000_000, "context_length": 6,
    }  # fmt: skip
    assert {name: flat[name] for name in theirs} == theirs
    humanoid = Config.from_preset("authors", env="Humanoid").flat()
    assert (humanoid["alpha"], humanoid["context_length"]) == (0.05, 10)
    # 128 episodes of 1,000 steps, or of about 22.
    for env, steps in {"HalfCheetah": 128_000, "brax:ant": 128_000, "Hopper": 2_900}.items():
        assert Config.from_preset("authors", env=env).run.prefill_env_steps == steps
    # SAC knows no windows: it is the paper's.
    sac = Config.from_preset("authors", env="Hopper", agent="sac").flat()
    paper = Config.from_preset("paper", env="Hopper", agent="sac").flat()
    assert {name for name in sac if sac[name] != paper[name]} == {"preset"}


def test_preset_best_changes_only_what_was_tuned() -> None:
    changed = {
        "sacformer": {
            "td_lambda": 0.5, "batch_size": 42, "tokens": "joint", "return_conditioning": "none",
            "time_embedding": "rotary", "burn_in": 5, "acting_context": "episode",
            "acting_context_limit": 6, "state_path_width": 256, "transformer_loss": "prediction",
            "prediction_weight": 1.0, "prediction_steps": "effect", "critic_features": True,
        },
        "sac": {"td_lambda": 0.5, "learnt_steps": 6, "batch_size": 42},
        "td3": {}, "ddpg": {}, "ppo": {},
    }  # fmt: skip
    for agent, values in changed.items():
        best = Config.from_preset("best", agent=agent, env="Ant").flat()
        cpu = Config.from_preset("cpu", agent=agent, env="Ant").flat()
        expected = {"preset": "best", "total_env_steps": 100_000, **values}
        assert {name: best[name] for name in best if best[name] != cpu[name]} == expected


@pytest.mark.parametrize("preset", ["best", "memory", "authors"])
def test_a_window_in_acting_needs_no_limit(preset: str) -> None:
    """A preset's limit is one of the episode seen."""
    resolved = resolve(preset, {"acting_context": "window"})
    resolved.config.validated()
    assert resolved.config.context.acting_context_limit is None
    assert resolved.sources["acting_context_limit"].startswith("default")
    given = {"env": "Ant", "acting_context": "window", "agent": "sacformer"}
    sources = sources_of(Config.from_preset(preset, **given))  # as where nobody kept them
    assert {name for name, source in sources.items() if source == "given"} == {"preset", *given}
    assert sources["acting_context_limit"].startswith("default")
    own = {"acting_context": "window", "acting_context_limit": 7}
    with pytest.raises(ConfigError, match=r"acting_context_limit=7: acting_context=window shows"):
        resolve(preset, own).config.validated()


def test_preset_memory_shows_both_agents_the_same_past() -> None:
    sacformer, sac = (
        Config.from_preset("memory", agent=agent, env="Hopper", hide_velocities=True)
        for agent in ("sacformer", "sac")
    )
    context = sacformer.context
    seen = (context.context_length, context.acting_context_limit, context.burn_in + 1)
    assert seen == (sac.task.stack_obs,) * 3
    assert (context.tokens, context.return_conditioning) == ("joint", "none")
    for made in (sacformer, sac):  # as many steps to learn from
        assert made.replay.batch_size * made.context.steps_to_learn == 252
    for made, added in ((sacformer, set()), (sac, {"stack_obs"})):
        best = Config.from_preset("best", agent=made.agent, env="Hopper").flat()
        differs = {name for name, value in made.flat().items() if best[name] != value}
        assert differs == {"preset", "hide_velocities", *added}


@pytest.mark.parametrize("agent", ["td3", "ddpg"])
def test_preset_paper_runs_the_deterministic_agents_as_cleanrl(agent: str) -> None:
    flat = Config.from_preset("paper", agent=agent, env="Hopper").flat()
    theirs = {
        "num_envs": 1, "total_env_steps": 1_000_000, "actor_learning_rate": 3e-4,
        "critic_learning_rate": 3e-4, "buffer_capacity": 1_000_000, "discount": 0.99,
        "tau": 0.005, "batch_size": 256, "prefill_env_steps": 25_000, "action_noise": 0.1,
        "target_noise": 0.2, "target_noise_clip": 0.5, "policy_delay": 2, "actor_layers": 2,
        "actor_width": 256, "actor_activation": "relu", "critic_layers": 2, "critic_width": 256,
        "critic_activation": "relu", "updates_per_env_step": 1.0, "normalize_obs": False,
    }  # fmt: skip
    assert {name: flat[name] for name in theirs} == theirs


def test_what_the_user_gives_wins_over_the_preset() -> None:
    made = Config.from_preset("paper", env="Humanoid", alpha=0.3, context_length=4)
    assert made.learning.alpha == 0.3
    assert made.context.context_length == 4


# --- steps and updates -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("updates_per_env_step", "num_envs", "steps", "updates"),
    [
        (1, 1, 1, 1),
        (1, 4, 1, 4),
        (2, 3, 1, 6),
        (0.5, 1, 2, 1),
        (0.5, 4, 1, 2),
        (0.25, 2, 2, 1),
        (0.1, 1, 10, 1),
        (0.1, 4, 5, 2),
        (1 / 3, 1, 3, 1),
        (1 / 3, 2, 3, 2),
        (1.5, 1, 2, 3),
        (0.75, 2, 2, 3),
        (0.001, 1, 1000, 1),
    ],
)
def test_steps_and_updates(
    updates_per_env_step: float, num_envs: int, steps: int, updates: int
) -> None:
    made = Config().replace(updates_per_env_step=updates_per_env_step, num_envs=num_envs)
    assert made.steps_and_updates == (steps, updates)
    assert updates / (steps * num_envs) == pytest.approx(updates_per_env_step)


@pytest.mark.parametrize(
    ("fields", "iterations", "env_steps"),
    [
        ({"num_envs": 1, "chunk_env_steps": 100}, 100, 100),
        ({"num_envs": 4, "chunk_env_steps": 100}, 25, 100),
        ({"num_envs": 3, "chunk_env_steps": 100}, 33, 99),
        # Five steps of four environments an iteration: 20 environment steps.
        ({"num_envs": 4, "chunk_env_steps": 110, "updates_per_env_step": 0.1}, 5, 100),
        # A chunk is never less than one iteration.
        ({"num_envs": 4, "chunk_env_steps": 1, "updates_per_env_step": 0.1}, 1, 20),
    ],
)
def test_chunk_size(fields: dict[str, Any], iterations: int, env_steps: int) -> None:
    made = Config().replace(**fields)
    assert made.iterations_per_chunk == iterations
    assert made.env_steps_per_chunk == env_steps


@pytest.mark.parametrize(
    ("prefill", "num_envs", "steps"), [(10, 4, 3), (12, 4, 3), (1, 8, 1), (0, 8, 0), (7, 1, 7)]
)
def test_prefill_is_rounded_up_to_whole_vector_steps(
    prefill: int, num_envs: int, steps: int
) -> None:
    made = Config().replace(prefill_env_steps=prefill, num_envs=num_envs)
    assert made.prefill_vector_steps == steps


# --- bad input ---------------------------------------------------------------------------------

BAD: list[tuple[dict[str, Any], str]] = [
    # What is given, and what the message must hold besides the first field's name.
    ({"num_env": 3}, "did you mean 'num_envs'"),
    ({"entropy": 3}, "'entropy' does not exist"),
    ({"task": {"env": "Hopper"}}, "'task' does not exist"),
    ({"env": 3}, "env=3"),
    ({"env": None}, "env=None"),
    ({"env": "Hoper"}, "env='Hoper'"),
    ({"env": ""}, "env=''"),
    ({"env": "Hopper-v5"}, "env='Hopper-v5'"),
    ({"env": "brax:nothing"}, "env='brax:nothing'"),
    ({"engine": "warp"}, "engine='warp'"),
    ({"preset": "gpu"}, "preset='gpu'"),
    ({"agent": "td4"}, "agent='td4'"),
    ({"brax_backend": "bullet"}, "brax_backend='bullet'"),
    ({"return_conditioning": "oracle"}, "return_conditioning='oracle'"),
    ({"actor_activation": "swish"}, "actor_activation='swish'"),
    ({"critic_activation": None}, "critic_activation=None"),
    ({"num_envs": "four"}, "num_envs='four'"),
    ({"num_envs": [4]}, "num_envs=[4]"),
    ({"num_envs": 2.5}, "num_envs=2.5"),
    ({"num_envs": True}, "num_envs=True"),
    ({"num_envs": 0}, "num_envs=0"),
    ({"seed": None}, "seed=None"),
    ({"seed": -1}, "seed=-1"),
    ({"seed": 2**32}, f"seed={2**32}"),
    ({"run_dir": 5}, "run_dir=5"),
    ({"tune_alpha": 1}, "tune_alpha=1"),
    ({"normalize_obs": "yes"}, "normalize_obs='yes'"),
    ({"alpha": False}, "alpha=False"),
    ({"alpha": 0}, "alpha=0.0"),
    ({"tau": 0.0}, "tau=0.0"),
    ({"tau": 1.5}, "tau=1.5"),
    ({"discount": -0.1}, "discount=-0.1"),
    ({"discount": 1.01}, "discount=1.01"),
    ({"discount": math.nan}, "discount=nan"),
    ({"rtg_discount": 2.0}, "rtg_discount=2.0"),
    ({"target_return": math.inf}, "target_return=inf"),
    ({"return_scale": 0.0}, "return_scale=0.0"),
    ({"target_entropy": math.nan}, "target_entropy=nan"),
    ({"target_entropy": "auto"}, "target_entropy='auto'"),
    ({"actor_learning_rate": -1e-3}, "actor_learning_rate=-0.001"),
    ({"head_init_scale": 0}, "head_init_scale=0.0"),
    ({"actor_dropout": 1.0}, "actor_dropout=1.0"),
    ({"actor_dropout": -0.1}, "actor_dropout=-0.1"),
    ({"actor_heads": 3}, "actor_width=8"),
    ({"actor_layers": 0}, "actor_layers=0"),
    ({"context_length": 0}, "context_length=0"),
    ({"batch_size": 0}, "batch_size=0"),
    ({"eval_every": 0}, "eval_every=0"),
    ({"eval_episodes": -2}, "eval_episodes=-2"),
    ({"context_length": 6, "agent": "sac"}, "agent=sac"),
    ({"return_conditioning": "hindsight", "agent": "sac", "context_length": 1}, "agent=sac"),
    (
        {"tokens": "gsa", "agent": "sac", "context_length": 1, "return_conditioning": "none"},
        "agent=sac",
    ),
    (
        {
            "critic": "transformer",
            "agent": "sac",
            "context_length": 1,
            "return_conditioning": "none",
        },
        "agent=sac",
    ),
    ({"tokens": "gsa", "context_length": 1}, "context_length=1"),
    ({"tokens": "joint", "context_length": 1}, "context_length=1"),
    ({"tokens": "joint", "window": "scattered", "prefill_env_steps": 100}, "tokens=gs"),
    ({"critic": "transformer", "context_length": 1}, "context_length=1"),
    ({"critic": "lstm"}, "critic='lstm'"),
    ({"critic_heads": 3, "critic": "transformer"}, "critic_width="),
    ({"critic_heads": 0}, "critic_heads=0"),
    ({"critic_layer_norm": True, "critic": "transformer"}, "critic=mlp"),
    ({"target_return": "best"}, "'auto'"),
    ({"target_return": None}, "target_return=None"),
    ({"target_return": "auto", "return_conditioning": "none"}, "looks at no return"),
    ({"tokens": "gas"}, "tokens='gas'"),
    ({"compute_dtype": "float16"}, "compute_dtype='float16'"),
    ({"window": "sliding"}, "window='sliding'"),
    ({"window": "scattered", "tokens": "gsa", "prefill_env_steps": 100}, "tokens=gs"),
    ({"window": "scattered", "critic": "transformer", "prefill_env_steps": 100}, "critic=mlp"),
    ({"window": "scattered", "context_length": 51}, "max_episode_steps=50"),
    ({"prefill_env_steps": 98, "window": "scattered"}, "at least 100"),
    (
        {
            "window": "scattered",
            "agent": "sac",
            "context_length": 1,
            "return_conditioning": "none",
        },
        "agent=sac",
    ),
    ({"buffer_capacity": 199, "window": "scattered", "prefill_env_steps": 100}, "at least 200"),
    ({"critic_init": "xavier", "critic": "transformer"}, "critic=mlp"),
    ({"next_rtg_decrement": 0.1}, "return_conditioning=hindsight"),
    ({"next_rtg_decrement": 0.1, "return_conditioning": "hindsight"}, "window=scattered"),
    ({"hindsight_scale": 500.0}, "return_conditioning=hindsight"),
    ({"hindsight_scale": 0.0, "return_conditioning": "hindsight"}, "greater than 0"),
    ({"hindsight_scale": "none"}, "hindsight_scale='none'"),
    ({"acting_context": "all"}, "acting_context='all'"),
    ({"acting_context": "episode", "context_length": 1}, "context_length of 2"),
    *(
        ({**what, "learnt_steps": 1}, "with learnt_steps=1 and burn_in=0")
        for what in ({"acting_context": "episode"}, {"tokens": "joint"}, {"critic": "transformer"})
    ),
    ({"acting_context_limit": 0}, "acting_context_limit=0"),
    ({"acting_context_limit": 5, "acting_context": "episode"}, "context_length=6"),
    ({"policy": "categorical"}, "policy='categorical'"),
    ({"tune_alpha": True, "policy": "deterministic"}, "no entropy"),
    (
        {
            "tune_alpha": True,
            "agent": "td3",
            "context_length": 1,
            "return_conditioning": "none",
        },
        "agent=td3 has no entropy",
    ),
    ({"acting_context_limit": 24}, "acting_context=window shows context_length=6"),
    ({"action_noise": -0.1}, "action_noise=-0.1"),
    ({"action_noise_clip": 0.0}, "action_noise_clip=0.0"),
    ({"policy_delay": 0}, "policy_delay=0"),
    ({"policy_delay": 1.5}, "policy_delay=1.5"),
    ({"target_noise": -0.1}, "target_noise=-0.1"),
    ({"target_noise_clip": 0.0}, "target_noise_clip=0.0"),
    ({"context_length": 6, "agent": "td3"}, "agent=td3"),
    ({"return_conditioning": "hindsight", "agent": "ddpg", "context_length": 1}, "agent=ddpg"),
    ({"acting_dropout": True}, "actor_dropout above 0"),
    ({"critic_init": "zeros"}, "critic_init='zeros'"),
    ({"mjx_preset": "quick"}, "mjx_preset='quick'"),
    ({"mjx_impl": "cpp"}, "mjx_impl='cpp'"),
    ({"prefill_env_steps": 90, "return_conditioning": "hindsight"}, "at least 100"),
    ({"prefill_env_steps": 0}, "prefill_env_steps=0"),
    ({"prefill_env_steps": -5}, "prefill_env_steps=-5"),
    ({"total_env_steps": 200}, "prefill_env_steps=200"),
    ({"total_env_steps": 100}, "prefill_env_steps=200"),
    ({"total_env_steps": 2**31}, f"total_env_steps={2**31}"),
    # (50 steps + K = 6) in each of two environments.
    ({"buffer_capacity": 111}, "at least 112"),
    ({"buffer_capacity": 112, "burn_in": 1}, "at least 114"),
    ({"burn_in": -1}, "burn_in=-1"),
    ({"burn_in": 2, "window": "scattered", "prefill_env_steps": 100}, "window=contiguous"),
    ({"td_lambda": 1.5}, "td_lambda=1.5"),
    ({"td_lambda": -0.5}, "td_lambda=-0.5"),
    ({"td_lambda": 0.5, "window": "scattered", "prefill_env_steps": 100}, "use td_lambda=0"),
    *(
        (
            {**what, "agent": "td3", "context_length": 1, "return_conditioning": "none"},
            "agent=sacformer or sac",
        )
        for what in ({"td_lambda": 0.5}, {"learnt_steps": 2})
    ),
    ({"td_lambda": 0.5, "context_length": 1}, "learnt_steps of 2 or more"),
    ({"learnt_steps": 0}, "learnt_steps=0"),
    ({"learnt_steps": 2, "window": "scattered", "prefill_env_steps": 100}, "use learnt_steps=None"),
    ({"buffer_capacity": 112, "learnt_steps": 7}, "at least 114"),
    ({"critic_history": 0}, "critic_history=0"),
    ({"critic_history": 2, "critic": "transformer"}, "critic=mlp"),
    ({"critic_history": 8}, "a window has 7 states"),
    ({"state_path_width": -1}, "state_path_width=-1"),
    ({"time_embedding": "sinusoidal"}, "time_embedding='sinusoidal'"),
    ({"time_embedding": "rotary", "actor_width": 6, "actor_heads": 2}, "even width"),
    *(
        (
            {**what, "agent": "sac", "context_length": 1, "return_conditioning": "none"},
            "agent=sac",
        )
        for what in (
            {"burn_in": 1},
            {"critic_history": 2},
            {"state_path_width": 8},
            {"prediction_weight": 1.0},
            {"critic_features": True},
            {"transformer_loss": "prediction"},
        )
    ),
    ({"transformer_loss": "prediction"}, "prediction_weight=0.0"),
    ({"transformer_loss": "prediction", "prediction_weight": 1.0}, "state_path_width=0"),
    ({"prediction_weight": -1.0}, "prediction_weight=-1.0"),
    ({"prediction_steps": "effect"}, "nothing is predicted"),
    ({"prediction_steps": 0, "prediction_weight": 1.0}, "prediction_steps=0"),
    ({"prediction_steps": 7, "prediction_weight": 1.0}, "from 1 to 6"),
    (
        {
            "prediction_steps": 2,
            "prediction_weight": 1.0,
            "window": "scattered",
            "prefill_env_steps": 100,
        },
        "window=scattered",
    ),
    ({"critic_features": True, "critic": "transformer"}, "critic=mlp"),
    ({"critic_features": True, "critic_history": 2}, "critic_history=1"),
    ({"updates_per_env_step": 0}, "updates_per_env_step=0.0"),
    ({"updates_per_env_step": math.inf}, "updates_per_env_step=inf"),
    ({"updates_per_env_step": 1e-5}, "simpler fraction"),
]


@pytest.mark.parametrize(("fields", "expected"), BAD, ids=lambda value: str(value)[:40])
def test_bad_input_is_refused_with_field_and_value(fields: dict[str, Any], expected: str) -> None:
    name, value = next(iter(fields.items()))
    with pytest.raises(ValueError, match=name) as refused:
        # The name of an environment is looked up when it is made.
        make_program(Config.from_preset(**{"preset": "cpu", **TINY, **fields}))
    message = str(refused.value)
    if "env" not in fields or fields["env"] in (3, None):
        assert isinstance(refused.value, ConfigError)
    assert "\n" not in message
    assert expected in message
    if "does not exist" not in message:  # with an unknown name, the value is not the matter
        shown = (repr(value), str(value), repr(float(value)) if isinstance(value, int) else "")
        assert any(text and f"{name}={text}" in message for text in shown)


def test_limits_are_inclusive_where_they_say_so() -> None:
    Config.from_preset("cpu", **{**TINY, "buffer_capacity": 112})
    Config.from_preset("cpu", **{**TINY, "total_env_steps": 201})
    Config.from_preset("cpu", **{**TINY, "tau": 1.0, "discount": 0.0, "seed": 2**32 - 1})
    Config.from_preset(
        "cpu", **{**TINY, "return_conditioning": "hindsight", "prefill_env_steps": 100}
    )


@pytest.mark.parametrize(
    "bad",
    [{"num_envs": 0}, {"actor_heads": 3}, {"buffer_capacity": 5}, {"env": "Hoper"}],
    ids=str,
)
def test_bad_input_leaves_nothing_on_disk(bad: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "run"
    # `replace` alone does not validate.
    refused = Config().replace(**{**TINY, "run_dir": str(path), **bad})
    with pytest.raises(ValueError, match=next(iter(bad))):
        train(refused, quiet=True)
    assert list(tmp_path.iterdir()) == []


def test_a_utd_that_cannot_be_kept_is_refused() -> None:
    with pytest.raises(ConfigError, match="updates_per_env_step"):
        Config.from_preset("cpu", **{**TINY, "updates_per_env_step": 0.0006})
