"""Optuna's pruning through callbacks: the example, on a tiny scale."""

from __future__ import annotations

from pathlib import Path

import pytest

from sacformer_jax import Config
from sacformer_jax.run_folder import RunFolder

optuna = pytest.importorskip("optuna")
TINY = {
    "agent": "sac", "env": "Hopper", "max_episode_steps": 50, "num_envs": 2,
    "prefill_env_steps": 200, "chunk_env_steps": 100, "eval_every": 100, "eval_episodes": 2,
    "total_env_steps": 500, "batch_size": 4, "actor_width": 8, "actor_layers": 1, "critic_width": 8,
    "buffer_capacity": 2_000,
}  # fmt: skip


class WorseThanTheFirst(optuna.pruners.BasePruner):
    """Prunes every trial but the first, at its second report."""

    def prune(self, study: optuna.Study, trial: optuna.trial.FrozenTrial) -> bool:
        return trial.number > 0 and len(trial.intermediate_values) == 2


def test_a_pruned_trial_stops_saved_and_is_marked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import optuna_pruning

    from_preset = Config.from_preset

    def tiny(preset: str, **fields: object) -> Config:
        return from_preset(preset, **{**fields, **TINY})

    monkeypatch.setattr(Config, "from_preset", tiny)
    monkeypatch.setattr(optuna.pruners, "MedianPruner", lambda **_: WorseThanTheFirst())
    arguments = ["--trials", "2", "--runs", str(tmp_path / "runs")]
    arguments += ["--storage", f"sqlite:///{tmp_path}/optuna.db"]
    study = optuna_pruning.main(arguments)
    whole, pruned = study.trials
    states = optuna.trial.TrialState
    assert (whole.state, pruned.state) == (states.COMPLETE, states.PRUNED)
    assert list(whole.intermediate_values) == [200, 300, 400, 500]
    assert whole.value == pytest.approx(sum(list(whole.intermediate_values.values())[-3:]) / 3)
    assert list(pruned.intermediate_values) == [200, 300]
    assert RunFolder(tmp_path / "runs" / "trial-1").latest_step() == 300
    assert study.best_trial.number == 0
