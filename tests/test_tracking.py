"""Weights & Biases, offline: what lies ready for `wandb sync`; a resumed run goes on in its own."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sacformer_jax import Callback, Config, ConfigError, Event, resume, train
from sacformer_jax.logging import read_records
from sacformer_jax.results import RunResult
from sacformer_jax.tracking import Tracking, WandbTracker, resumed_tracking

pytest.importorskip("wandb")
TINY = {
    "agent": "sac", "env": "Hopper", "num_envs": 2, "max_episode_steps": 50,
    "prefill_env_steps": 200, "chunk_env_steps": 100, "total_env_steps": 400, "eval_every": 200,
    "eval_episodes": 2, "checkpoint_every": 400, "actor_width": 8, "actor_layers": 1,
    "critic_width": 8, "batch_size": 4, "buffer_capacity": 2000, "seeds": 2,
}  # fmt: skip


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A run of two members, tracked offline, and resumed."""
    path = tmp_path_factory.mktemp("runs") / "tracked"
    config = Config.from_preset("cpu", **TINY, run_dir=str(path))
    tracking = Tracking("testing", wandb_mode="offline")
    train(config, quiet=True, callbacks=tracking.callbacks())
    return resume(path, 600, quiet=True, callbacks=resumed_tracking(path))


def _written(path: Path, identity: str) -> list[bytes]:
    """What lies there for `wandb sync` under an id, a file for each stretch."""
    files = sorted(path.glob(f"wandb/offline-run-*-{identity}/run-{identity}.wandb"))
    return [file.read_bytes() for file in files]


def test_every_member_has_a_run_with_its_metrics(tracked: RunResult) -> None:
    known = json.loads((tracked.path / "wandb.json").read_text())
    assert (known["project"], known["mode"]) == ("testing", "offline")
    assert set(known["ids"]) == {"seed-0", "seed-1"}
    for name, other in (("seed-0", "seed-1"), ("seed-1", "seed-0")):
        stretches = _written(tracked.path, known["ids"][name])
        assert len(stretches) == 2  # before it was resumed, and since, under the same id
        own, others = (
            [
                (record["env_steps"], json.dumps(record["return_mean"]).encode())
                for record in read_records(tracked.path / each / "metrics.jsonl", "eval")
            ]
            for each in (name, other)
        )
        assert [env_steps for env_steps, _ in own] == [200, 400, 600]
        for env_steps, value in own:
            assert [value in content for content in stretches] == [env_steps < 600, env_steps > 400]
        assert not any(value in content for _, value in others for content in stretches)
        for words in (b"train/critic_loss", b"timing/steps_per_second", b"actor_learning_rate"):
            assert all(words in content for content in stretches)
        assert b"tracked-" + name.encode() in stretches[0]


def test_tracking_is_remembered_by_the_folder_alone(tracked: RunResult, tmp_path: Path) -> None:
    (tracker,) = resumed_tracking(tracked.path)
    assert isinstance(tracker, WandbTracker)
    assert (tracker.project, tracker.entity, tracker.mode) == ("testing", None, "offline")
    assert resumed_tracking(tmp_path) == []
    assert Tracking().callbacks() == []


def _offline() -> WandbTracker:
    return WandbTracker("testing", mode="offline")


@pytest.mark.parametrize("left", ["", "{}", '{"project": "p"'])
def test_what_is_remembered_of_it_and_damaged_is_named(tmp_path: Path, left: str) -> None:
    (tmp_path / "wandb.json").write_text(left)
    with pytest.raises(ConfigError, match=r"wandb\.json is damaged .*remove it to go on"):
        resumed_tracking(tmp_path)


def test_what_is_remembered_of_it_and_cannot_be_read_is_not_called_damaged(tmp_path: Path) -> None:
    (tmp_path / "wandb.json").mkdir()  # who may read everything is refused this, too
    with pytest.raises(ConfigError, match=r"wandb\.json cannot be read .*remove it to go on"):
        resumed_tracking(tmp_path)


def test_their_failures_do_not_stop_training(tmp_path: Path) -> None:
    class Breaking(Callback):
        """Breaks the tracker's connection after the first evaluation."""

        def __init__(self, tracker: WandbTracker):
            self.tracker, self.seen = tracker, 0

        def on_eval(self, event: Event) -> None:
            self.seen += 1
            if self.seen == 1:
                for started in self.tracker._runs.values():
                    started.finish()

    tracker = _offline()
    config = Config.from_preset("cpu", **TINY, run_dir=str(tmp_path / "run"))
    with pytest.warns(UserWarning, match="Weights & Biases: .*training goes on"):
        result = train(config, quiet=True, callbacks=[Breaking(tracker), tracker])
    assert result.env_steps == 400
    assert not result.stopped


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Tracking(wandb_entity="team").callbacks(), "give wandb_project, too"),
        (lambda: Tracking(wandb_mode="offline").callbacks(), "give wandb_project, too"),
    ],
)
def test_senseless_choices_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()


def test_the_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ConfigError, match=r"pip install 'sacformer-jax\[wandb\]'"):
        WandbTracker("testing")
