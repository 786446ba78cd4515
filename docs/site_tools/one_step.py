"""The shapes and counters on the page about one step, worked out from the program itself.

cd docs && python -m site_tools.one_step    # renews the tables of docs/one_step.md
"""

from __future__ import annotations

import functools
import inspect
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from sacformer_jax import Config, Program, make_program
from sacformer_jax.iteration import policy_of
from sacformer_jax.rollout import RolloutState, _step
from sacformer_jax.types import Acted, Context, TrainState, Transition

STRUCTS = ("context", "acted", "step", "transition", "buffer", "window", "learner", "counters")
"""What the page has a table of, in the order in which a step meets them."""


@functools.cache
def program() -> Program:
    """What ``sacformer train --env HalfCheetah`` runs: preset ``cpu``."""
    return make_program(Config.from_preset("cpu", env="HalfCheetah", engine="native"))


@functools.cache
def state() -> TrainState:
    """The shapes of its train state."""
    shapes: TrainState = jax.eval_shape(program().init, jax.random.key(0))
    return shapes


def letters() -> dict[str, int]:
    """What each letter of the shapes stands for."""
    config, spec = program().config, program().env.spec
    return {
        "N": config.task.num_envs,
        "T": program().buffer.length,
        "B": config.replay.batch_size,
        "K": config.context.context_length,
        "O": spec.obs_size,
        "A": spec.action_size,
    }


def numbers() -> dict[str, int]:
    """How often things happen."""
    config = program().config
    steps, updates = config.steps_and_updates
    return {
        "vector steps in an iteration": steps,
        "updates in an iteration": updates,
        "iterations in a chunk": config.iterations_per_chunk,
        "env steps in a chunk": config.env_steps_per_chunk,
        "updates in a chunk": config.iterations_per_chunk * updates,
        "vector steps of prefill": config.prefill_vector_steps,
    }


def structs() -> dict[str, Any]:
    """Shapes of the structs that a step meets, by the names of :data:`STRUCTS`."""
    now, made = state(), program()
    key = jax.eval_shape(lambda: jax.random.key(0))

    def one_step(state: TrainState, key: jax.Array) -> Any:
        policy = policy_of(state)
        rollout = RolloutState(state.env, state.context, state.buffer)

        def choose(context: Context, key: jax.Array) -> Acted:
            return made.agent.act(policy, context, key, explore=True)

        done = _step(made.env, choose, rollout, key)
        return {"acted": done.acted, "step": done.step, "transition": done.transition}

    def draw(state: TrainState, key: jax.Array) -> Any:
        assert state.buffer is not None
        size = made.config.replay.batch_size
        return made.buffer.sample(state.buffer, key, size, jnp.float32(1.0))

    met = {
        "context": now.context,
        **jax.eval_shape(one_step, now, key),
        "buffer": now.buffer,
        "window": jax.eval_shape(draw, now, key),
        "learner": now.learner,
        "counters": now.counters,
    }
    return {name: met[name] for name in STRUCTS}


WHOLE = ("actor_params", "critic_params", "target_critic_params", "actor_opt", "critic_opt")
"""Fields of which only the size is told."""


def rows(name: str) -> list[tuple[str, str, str]]:
    """``(field, shape, dtype)`` of each array of a struct."""
    found: list[tuple[str, str, str]] = []
    for field, value in vars(structs()[name]).items():
        if field in WHOLE:
            leaves = jax.tree.leaves(value)
            size = sum(leaf.size for leaf in leaves)
            found.append((field, f"{len(leaves)} arrays, {size:,} numbers", "float32"))
            continue
        if name == "acted" and isinstance(value, Context):
            found.append((field, "as above", ""))
            continue
        for path, leaf in jax.tree_util.tree_flatten_with_path(value)[0]:
            inner = "".join(
                f".{getattr(entry, 'name', getattr(entry, 'key', ''))}" for entry in path
            )
            shape = f"[{', '.join(f'{size:,}' for size in leaf.shape)}]" if leaf.shape else "scalar"
            found.append((f"{field}{inner}", shape, str(leaf.dtype)))
    return found


def meanings(struct: type) -> dict[str, str]:
    """What the docstring of a struct says of each of its fields, as Markdown."""
    text = (inspect.getdoc(struct) or "").split("Attributes:")[-1]
    entries = re.findall(r"^  (\w+): (.+?)(?=^  \w+: |^\S|\Z)", text, re.MULTILINE | re.DOTALL)
    cleaned = {}
    for field, meaning in entries:
        meaning = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", " ".join(meaning.split()))
        cleaned[field] = meaning.replace("``", "`")
    return cleaned


def table(name: str) -> str:
    """The rows as Markdown, with what the struct's docstring says of them."""
    said = meanings(type(structs()[name]))
    if name == "buffer":
        said |= {f"steps.{field}": text for field, text in meanings(Transition).items()}
    lines = ["| field | here | dtype | |", "| --- | --- | --- | --- |"]
    for field, shape, dtype in rows(name):
        meaning = said.get(field, said.get(field.split(".")[0], ""))
        lines.append(f"| `{field}` | {shape} | {dtype} | {meaning} |")
    return "\n".join(lines)


def with_tables(page: str) -> str:
    """The page with each table after its marker ``<!-- table: NAME -->`` as it is now."""
    pattern = re.compile(r"(<!-- table: (\w+) -->\n\n)(?:\|[^\n]*\n)*\n*")
    return pattern.sub(lambda found: f"{found[1]}{table(found[2])}\n\n", page)


def main() -> None:
    """Renews the tables of the page."""
    page = Path(__file__).resolve().parents[1] / "one_step.md"
    page.write_text(with_tables(page.read_text()))


if __name__ == "__main__":
    main()
