"""The pictures of finished (or running) runs: what ``sacformer plot`` draws."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax.attention import acting_attention
from sacformer_jax.config import ConfigError
from sacformer_jax.diagnostics import achieved_returns, attention_map, diagnostics_sheet
from sacformer_jax.evaluate import Episodes, make_evaluator
from sacformer_jax.logging import Record, read_records
from sacformer_jax.networks import STEP_TOKENS
from sacformer_jax.plots import comparison, learning_curve
from sacformer_jax.policy import Policy, load_policy
from sacformer_jax.policy_renderer import is_return_conditioned
from sacformer_jax.recording import Recorder
from sacformer_jax.run_folder import RunConfigFile, RunFolder, labels
from sacformer_jax.stored import CheckpointError
from sacformer_jax.train import make_training_env

TARGETS = (0.25, 0.5, 0.75, 1.0, 1.25)
"""Target returns that are tried, over that of training."""
MAX_PAIRS = 50
"""Pairs that an attention map shows by themselves."""
_TOKENS = {"return": "return-to-go"}
"""Names of tokens in pictures, where they differ from the networks'."""


@dataclasses.dataclass(frozen=True)
class RunRecords:
    """What a run's folder says.

    Attributes:
      folder: the folder.
      run: ``config.json``.
      records: by the member's name, its ``metrics.jsonl``.
    """

    folder: RunFolder
    run: RunConfigFile
    records: dict[str, list[Record]]

    @property
    def title(self) -> str:
        """The agent and its task."""
        return f"{self.run.config.agent} on {self.run.config.task.env}"


def read_run(path: str | Path) -> RunRecords:
    """Reads a run's configuration and metrics.

    Raises:
      CheckpointError: there is no run, or it has no metrics yet.
    """
    folder = RunFolder(path).opened()
    run = folder.read_config()
    records: dict[str, list[Record]] = {}
    for member in run.members:
        metrics = folder.metrics_path(member.name)
        if not metrics.is_file():
            raise CheckpointError(
                f"run {str(folder.path)!r} has no metrics yet: let it train up to its first chunk"
            )
        records[member.name] = read_records(metrics)
    return RunRecords(folder, run, records)


def draw_records(run: RunRecords, to: Path) -> list[Path]:
    """Draws learning curve and diagnostics of each member, and of all together where several.

    Args:
      run: what is drawn.
      to: folder of the pictures; those of a member of several go to a folder of its name in it.

    Returns:
      The files.
    """
    several = len(run.records) > 1
    drawn = []
    for member in run.run.members:
        folder = to / member.name if several else to
        folder.mkdir(parents=True, exist_ok=True)
        title, own = f"{run.title}, seed {member.seed}", run.records[member.name]
        learning_curve(own, folder / "learning_curve.png", title)
        diagnostics_sheet({"": [own]}, folder / "diagnostics.png", title)
        drawn += [folder / "learning_curve.png", folder / "diagnostics.png"]
    if several:
        label = str(run.run.config.agent)
        if rows := _rows(run, label):
            comparison(rows, to / "learning_curve.png", run.title)
            drawn.append(to / "learning_curve.png")
        diagnostics_sheet({label: list(run.records.values())}, to / "diagnostics.png", run.title)
        drawn.append(to / "diagnostics.png")
    return drawn


def _rows(run: RunRecords, label: str) -> list[Record]:
    """A run's evaluations as :func:`~sacformer_jax.plots.comparison` wants them."""
    return [
        {"env": run.run.config.task.env, "variant": label, "seed": name, **record}
        for name, own in run.records.items()
        for record in own
        if record["kind"] == "eval"
    ]


def draw_runs(
    paths: Sequence[str | Path],
    to: str | Path | None = None,
    policy: str = "best",
    episodes: int = 4,
    seed: int = 0,
) -> Iterator[Path]:
    """Draws the pictures of a run, or a comparison of several.

    Args:
      paths: folders of runs.
      to: folder of the pictures; default: the run's own, or of several the current one.
      policy: ``"best"`` or ``"latest"``, for the pictures of what a policy does.
      episodes: for each target return; 0: none of those pictures.
      seed: of the resets.

    Yields:
      The files, each when it is written.

    Raises:
      CheckpointError: a folder holds no run, or nothing to draw yet.
      ConfigError: one was given twice.
    """
    runs = [read_run(path) for path in paths]
    if len(runs) > 1:
        yield from _compare(runs, Path("." if to is None else to))
        return
    (run,) = runs
    to = run.folder.path if to is None else Path(to)
    yield from draw_records(run, to)
    if episodes == 0 or run.run.config.agent != "sacformer":
        return
    for member in run.run.members:
        loaded = load_policy(run.folder.path, policy, member.name)
        folder = to / member.name if len(run.records) > 1 else to
        yield from draw_policy(loaded, folder, episodes, seed, f"{run.title}, seed {member.seed}")


def _compare(runs: list[RunRecords], to: Path) -> Iterator[Path]:
    to.mkdir(parents=True, exist_ok=True)
    names = _labels(runs)
    rows = [row for run, name in zip(runs, names, strict=True) for row in _rows(run, name)]
    title = " and ".join(dict.fromkeys(run.run.config.task.env for run in runs))
    if rows:
        comparison(rows, to / "comparison.png", "evaluations")
        yield to / "comparison.png"
    groups = {name: list(run.records.values()) for run, name in zip(runs, names, strict=True)}
    diagnostics_sheet(groups, to / "diagnostics.png", title)
    yield to / "diagnostics.png"


def _labels(runs: list[RunRecords]) -> list[str]:
    """A name for each run: its agent's, or where that does not tell them apart its folder's."""
    by_agent = [run.run.config.agent for run in runs]
    if len(set(by_agent)) == len(runs):
        return [str(agent) for agent in by_agent]
    return labels([run.folder.path for run in runs])


# --- what a policy does --------------------------------------------------------------------------


def draw_policy(policy: Policy, to: Path, episodes: int, seed: int, title: str) -> Iterator[Path]:
    """Draws what a SACFormer policy does: ``target_return.png`` (where the actor is conditioned on
    returns) and ``attention.png``.
    """
    target = float(policy.state.target_return)
    if is_return_conditioned(policy.config) and target != 0.0:
        targets = [fraction * target for fraction in TARGETS]
        returns = returns_for_targets(policy, targets, episodes, seed)
        achieved_returns(targets, returns, target, to / "target_return.png", title)
        yield to / "target_return.png"
    shown = mean_attention(policy, seed)
    names = STEP_TOKENS[policy.config.context.tokens].names
    tokens = [_TOKENS.get(name, name) for name in names]
    attention_map(shown.attention, tokens, shown.older, to / "attention.png", title)
    yield to / "attention.png"


def returns_for_targets(
    policy: Policy, targets: Sequence[float], episodes: int, seed: int = 0
) -> np.ndarray:
    """Evaluates a policy under other target returns: the Decision Transformer's figure.

    Args:
      policy: of SACFormer.
      targets: M target returns.
      episodes: E, at least 1; they start alike under each target.
      seed: of the resets.

    Returns:
      ``[M, E]`` undiscounted returns.
    """
    if episodes < 1:
        raise ConfigError(f"episodes={episodes}: must be at least 1")
    env = make_training_env(policy.config, num_envs=episodes)
    evaluate = make_evaluator(env, policy.agent, policy.config.context.context_length)
    key = jax.random.key(seed)
    results = [
        evaluate(dataclasses.replace(policy.state, target_return=jnp.float32(target)), key).returns
        for target in targets
    ]
    return np.stack([np.asarray(result) for result in results])


@dataclasses.dataclass(frozen=True)
class MeanAttention:
    """Attention of the state acted on, over an episode.

    Attributes:
      attention: ``[L, H, P, n]``: layers, heads, pairs from the newest back, tokens of a pair; the
        mean over the steps, so that the rows over the last two axes sum to 1.
      older: the last pair stands for all older ones.
    """

    attention: np.ndarray
    older: bool


def mean_attention(policy: Policy, seed: int = 0) -> MeanAttention:
    """Runs an evaluation's episode and takes the mean of what the actor attends to in it."""
    config = policy.config
    env = make_training_env(config, num_envs=1)

    def look(episodes: Episodes) -> Any:
        return dataclasses.replace(episodes.context, cache={})

    recorder = Recorder(env, policy.agent, config.context.context_length, look)
    contexts = jax.tree.map(lambda leaf: leaf[:, 0], recorder.record(policy.state, seed).seen)
    attend = jax.jit(functools.partial(acting_attention, config, policy.spec))
    attention = np.asarray(attend(policy.state, contexts)[0]).mean(axis=2)  # [L, H, P, n]
    older = attention.shape[2] > MAX_PAIRS
    if older:
        rest = attention[:, :, MAX_PAIRS - 1 :].sum(axis=2, keepdims=True)
        attention = np.concatenate([attention[:, :, : MAX_PAIRS - 1], rest], axis=2)
    return MeanAttention(attention, older)
