"""The pages that speak of the code say what the code says."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from probe import point_config, point_env
from site_tools import generated, messages, one_step

import sacformer_jax
from sacformer_jax import make_program, policy_of
from sacformer_jax.digests import num_bytes
from sacformer_jax.evaluate import Evaluation
from sacformer_jax.loop import summarize

DOCS = Path(__file__).resolve().parents[1] / "docs"
PACKAGE = Path(sacformer_jax.__file__).parent


def _page(name: str) -> str:
    return (DOCS / f"{name}.md").read_text()


def _section(page: str, heading: str) -> str:
    """What stands below a heading, up to the next one as high."""
    found = re.search(rf"^(#+) {re.escape(heading)}\n(.*?)(?=^#{{1,2}} |\Z)", page, re.M | re.S)
    assert found, heading
    return found[2]


def _first_cells(text: str) -> list[str]:
    return re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)


# What one step does.


def test_the_tables_of_a_step_are_those_of_the_program() -> None:
    page = _page("one_step")
    assert re.findall(r"<!-- table: (\w+) -->", page) == list(one_step.STRUCTS)
    assert one_step.with_tables(page) == page, "cd docs && python -m site_tools.one_step"


def test_the_numbers_of_a_step_are_those_of_the_program() -> None:
    page = _page("one_step")
    for letter, size in one_step.letters().items():
        assert re.search(rf"^\| {letter} \| [^|]+ \| {size:,} \|$", page, re.MULTILINE), letter
    for what, number in one_step.numbers().items():
        assert f"| {what} | {number:,} |" in page, what


def test_docstrings_of_the_structs_have_the_shapes_of_the_program() -> None:
    letters, checked = one_step.letters(), 0
    for struct in one_step.structs().values():
        for field, said in one_step.meanings(type(struct)).items():
            shape = re.search(r"`\[([\w, +]+)\]`", said)
            value = getattr(struct, field)
            if shape is None or not hasattr(value, "shape"):
                continue
            sizes = [eval(size, {}, letters) for size in shape[1].split(",")]
            assert sizes == list(value.shape), (type(struct).__name__, field, said)
            checked += 1
    assert checked > 20


@pytest.mark.parametrize(("env", "size"), [("HalfCheetah", 107), ("Humanoid", 1475)])
def test_bytes_of_a_step_in_the_replay(env: str, size: int) -> None:
    config = sacformer_jax.Config.from_preset("cpu", env=env, engine="native")
    program = make_program(config)
    held = num_bytes(jax.eval_shape(program.buffer.init).steps) / config.replay.buffer_capacity
    spec = program.env.spec
    assert held == size == 4 * (spec.obs_size + spec.action_size + 3) + 3
    assert "`4 (O + A + 3) + 3` bytes" in _page("accelerators")


# Metrics.


def _metrics(**fields: Any) -> set[str]:
    """The names of what a chunk gives."""
    program = make_program(point_config(**fields), point_env(4))
    state = jax.eval_shape(program.init, jax.random.key(0))
    return set(jax.eval_shape(program.train_chunk, state)[1])


MLP = {"context_length": 1, "return_conditioning": "none"}
PPO = {"prefill_env_steps": 0, "tune_alpha": False, "rollout_steps": 32, "minibatches": 4}


def test_the_metrics_of_training_are_explained() -> None:
    written = _metrics(prediction_weight=1.0)
    for agent in ("td3", "ddpg"):
        written |= _metrics(agent=agent, tune_alpha=False, **MLP)
    written |= _metrics(agent="ppo", **PPO, **MLP)
    explained = _first_cells(_section(_page("metrics"), "Training: `kind` is `train`"))
    assert sorted(explained) == sorted(written)


def test_the_metrics_of_evaluation_are_explained() -> None:
    written = summarize(Evaluation(returns=np.zeros(2), lengths=np.ones(2), bad=np.ones(2, bool)))
    explained = _first_cells(_section(_page("metrics"), "Evaluation: `kind` is `eval`"))
    assert sorted(explained) == sorted(written)


def test_the_metrics_of_pretraining_are_explained() -> None:
    config = point_config(
        dataset="some", pretrain_updates=8, prefill_env_steps=0, prediction_weight=1.0
    )
    program = make_program(config, point_env(4))
    state = jax.eval_shape(program.init, jax.random.key(0))
    assert program.pretrain_chunk is not None
    written = jax.eval_shape(program.pretrain_chunk, state)[1]
    explained = _first_cells(_section(_page("metrics"), "Pretraining: `kind` is `pretrain`"))
    assert sorted(explained) == sorted(written)


def test_the_timings_are_explained() -> None:
    (call,) = (
        node
        for node in ast.walk(ast.parse((PACKAGE / "loop.py").read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "self._timings.write"
    )
    values = call.args[-1]
    assert isinstance(values, ast.Dict)
    written = ["env_steps", "updates", *(ast.literal_eval(key) for key in values.keys if key)]
    explained = _first_cells(_section(_page("metrics"), "Timings: `timings.jsonl`"))
    assert sorted(explained) == sorted(written)


# Troubleshooting.

TEMPLATES = list(messages.in_source(PACKAGE))
QUOTED = messages.quoted(_page("troubleshooting"))


@pytest.mark.parametrize("message", QUOTED)
def test_a_quoted_message_is_in_the_source(message: str) -> None:
    fixed = max((part.strip() for part in message.split(messages.GAP)), key=len)
    assert any(fixed in template for template in TEMPLATES), "no such words"
    # Not only its longest part: the whole, with something in each gap.
    assert any(
        messages.says(template, message) and len(template.replace(messages.GAP, "")) > 20
        for template in TEMPLATES
    )


def test_messages_are_quoted() -> None:
    assert len(QUOTED) > 30


@pytest.mark.parametrize(
    ("source", "quoted", "same"),
    [
        ("num_envs=…: must be at least …", "num_envs=…: must be at least …", True),
        ("…=…: must be at least 1", "epochs=0: must be at least 1", True),
        ("must be below 2**32", "must be below 2**31", False),
        ("run … is gone", "run … was gone", False),
    ],
)
def test_messages_are_compared(source: str, quoted: str, same: bool) -> None:
    assert messages.says(source, quoted) is same


def test_exit_codes_are_explained() -> None:
    from sacformer_jax import cli

    codes = {value for name, value in vars(cli).items() if name.startswith("EXIT_")}
    explained = _section(_page("troubleshooting"), "Exit codes")
    assert {int(code) for code in re.findall(r"^\| (\d+) \|", explained, re.M)} == {0, *codes}


# What is made of the code.


def test_every_field_is_in_the_configuration() -> None:
    page = generated.configuration()
    for name in sacformer_jax.Config().flat():
        rows = re.findall(rf"^\| `{name}`<br>.*$", page, re.MULTILINE)
        assert len(rows) == 1, name
        assert len(rows[0].split("|")[-2].strip()) > 5, name  # what it is


def test_a_field_tells_the_values_of_presets_and_their_source() -> None:
    page = generated.configuration()
    (row,) = re.findall(r"^\| `alpha`<br>.*$", page, re.MULTILINE)
    assert "`0.05` [paper Humanoid](#layer-paper-" in row
    (number,) = re.findall(r"`0.05` \[paper Humanoid\]\(#(layer-paper-\d+)\)", row)
    layer = page.split(f"({number})=")[1].split("(layer-")[0]
    assert "alpha 0.05 on Humanoid" in layer
    assert re.search(r"`float` or `auto`|float or `auto`", page)  # target_return


def test_every_command_has_its_help() -> None:
    page = generated.command_line()
    assert {"train", "resume", "evaluate", "report", "describe"} <= set(generated.commands())
    for name in generated.commands():
        assert f"usage: sacformer {name}" in page, name
    assert "--total-env-steps" in page
    assert "\x1b" not in page


def test_every_public_name_is_in_the_api_reference() -> None:
    named = re.findall(r"^\.\. auto\w+:: ([\w.]+)$", _page("api"), re.MULTILINE)
    public = {name for name in sacformer_jax.__all__ if not name.startswith("__")}
    assert public <= set(named), public - set(named)


def test_the_policy_of_a_step_is_what_the_page_says() -> None:
    state = one_step.state()
    assert set(vars(policy_of(state))) == {
        "actor_params", "normalizer", "target_return", "return_scale",
    }  # fmt: skip
