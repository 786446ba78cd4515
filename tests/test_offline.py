"""Starting from recorded episodes: their place in the replay, imitation, and whole runs."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe import EPISODE, PointEnv, point_config

from sacformer_jax import (
    Config,
    ConfigError,
    api,
    collect,
    load_policy,
    make_population,
    resume,
    seed_members,
    train,
)
from sacformer_jax.buffer import TrajectoryBuffer
from sacformer_jax.collecting import make_collector
from sacformer_jax.datasets import read_episodes, write_episodes
from sacformer_jax.digests import digest
from sacformer_jax.distributions import NoisyPoint, TanhGaussian
from sacformer_jax.envs import VectorEnv, make_env, wrapped
from sacformer_jax.logging import read_records
from sacformer_jax.offline import Episode, check_episodes, lay_out, with_dataset
from sacformer_jax.run_folder import RunFolder
from sacformer_jax.train import policy_of
from sacformer_jax.types import Acted, Context

DISCOUNT = 0.9


def _episodes(lengths: list[int], seed: int = 0) -> list[Episode]:
    """Observations hold the episode's number and the time step; odd ones terminate."""
    random = np.random.default_rng(seed)
    return [
        Episode(
            obs=np.stack([np.full(length + 1, number), np.arange(length + 1)], 1).astype("f4"),
            action=random.uniform(-1, 1, (length, 1)).astype("f4"),
            reward=random.normal(size=length).astype("f4"),
            terminated=number % 2 == 1,
        )
        for number, length in enumerate(lengths)
    ]


def _buffer(num_envs: int, **fields: Any) -> TrajectoryBuffer:
    settings = {"length": 100, "context_length": 3, "max_episode_steps": 12, **fields}
    return TrajectoryBuffer(num_envs=num_envs, obs_size=2, action_size=1, **settings)


LENGTHS = [[12, 12, 12], [1, 12, 3, 7, 7, 2, 12, 9], list(range(1, 13))]
EACH_LAYOUT = pytest.mark.parametrize(
    ("lengths", "num_envs", "fields"),
    [
        (lengths, num_envs, fields)
        for lengths in LENGTHS
        for num_envs in (1, 2, 5)
        for fields in ({}, {"hindsight": True}, {"scattered": True})
        if len(lengths) >= num_envs or not fields.get("hindsight")
    ],
)


@EACH_LAYOUT
def test_every_step_lies_once_where_windows_look_for_it(
    lengths: list[int], num_envs: int, fields: dict[str, Any]
) -> None:
    episodes, buffer = _episodes(lengths), _buffer(num_envs, **fields)
    layout = lay_out(episodes, buffer)
    steps, total = layout.steps, sum(lengths)
    length = steps.reward.shape[0]
    assert steps.obs.shape == (length, num_envs, 2)
    assert layout.dropped == total - length * num_envs
    if not buffer.hindsight:
        assert layout.dropped < num_envs
    seen = set()
    for column in range(num_envs):
        for place in range(length):
            number, t = (int(x) for x in steps.obs[place, column])
            episode = episodes[number]
            seen.add((number, t))
            assert steps.time_step[place, column] == t
            assert steps.action[place, column] == episode.action[t]
            assert steps.reward[place, column] == episode.reward[t]
            np.testing.assert_allclose(
                steps.return_so_far[place, column], episode.reward[:t].sum(), atol=1e-5
            )
            ended = steps.terminated[place, column] | steps.truncated[place, column]
            goes_on = place + 1 < length and steps.time_step[place + 1, column] == t + 1
            if goes_on:
                # What comes next is the same episode's.
                assert steps.obs[place + 1, column].tolist() == [number, t + 1]
                assert not ended
            elif place + 1 < length:
                assert steps.time_step[place + 1, column] == 0 or not buffer.hindsight
            last = t == len(episode) - 1
            whole = steps.time_step[place - t, column] == 0 if place >= t else False
            if buffer.scattered and not whole:
                assert not ended
            elif not goes_on:
                assert ended
                assert steps.terminated[place, column] == (last and episode.terminated)
                assert last or not buffer.hindsight
    assert len(seen) == length * num_envs


@pytest.mark.parametrize("num_envs", [1, 3])
def test_hindsight_returns_are_those_of_the_whole_episode(num_envs: int) -> None:
    episodes = _episodes([5, 12, 12, 7, 3, 9, 12, 4])
    buffer = _buffer(num_envs, hindsight=True)
    layout = lay_out(episodes, buffer)
    state = buffer.init()
    for place in range(layout.steps.reward.shape[0]):
        state = buffer.add(state, jax.tree.map(lambda x, p=place: jnp.asarray(x[p]), layout.steps))
    windows = buffer.sample(state, jax.random.key(1), 200, jnp.float32(DISCOUNT))
    for row in range(200):
        for slot in np.flatnonzero(np.asarray(windows.mask[row])):
            number, t = (int(x) for x in windows.obs[row, slot])
            rest = episodes[number].reward[t:]
            expected = float(np.sum(rest * DISCOUNT ** np.arange(len(rest))))
            assert float(windows.return_to_go[row, slot]) == pytest.approx(expected, abs=1e-5)
            np.testing.assert_array_equal(windows.action[row, slot], episodes[number].action[t])


def test_too_few_steps_are_refused() -> None:
    buffer = _buffer(3)
    told = f"7 steps in 1 episodes are too few for num_envs=3 columns of {buffer.context_length} "
    with pytest.raises(ConfigError, match=told):
        lay_out(_episodes([7]), buffer)


# --- imitation -----------------------------------------------------------------------------------


def test_the_loss_of_a_gaussian_is_minus_its_log_density() -> None:
    distribution = TanhGaussian((-2.0, 0.0), (1.0, 3.0))
    keys = jax.random.split(jax.random.key(0), 3)
    # Far from the bounds, where actions are drawn in.
    noise, mean, log_std = (0.3 * jax.random.normal(key, (50, 2)) for key in keys)
    action, log_prob = distribution.sample_and_log_prob(noise, mean, log_std)
    loss = distribution.imitation_loss(action, mean, log_std)
    np.testing.assert_allclose(loss, -log_prob, rtol=1e-3, atol=1e-3)


def test_the_loss_is_finite_on_the_bounds_and_draws_towards_them() -> None:
    distribution = TanhGaussian((-1.0,), (1.0,))
    loss, slope = jax.value_and_grad(
        lambda mean: distribution.imitation_loss(jnp.ones(1), mean, jnp.zeros(1))
    )(jnp.zeros(1))
    assert np.isfinite(loss)
    # d/dmean of (u - mean)^2 / 2 at 0, where u is what the bound counts as.
    np.testing.assert_allclose(slope, -np.arctanh(1 - 1e-3), rtol=1e-4)


def test_the_loss_of_a_point_is_the_squared_distance_in_half_ranges() -> None:
    distribution = NoisyPoint((-2.0, 0.0), (2.0, 1.0), 0.1, 0.2)
    mean = jnp.array([[0.0, jnp.arctanh(0.5)]])
    loss = distribution.imitation_loss(jnp.array([[1.0, 1.0]]), mean, jnp.zeros((1, 2)))
    # (1/2 - 0)^2 + (1 - 0.5)^2
    np.testing.assert_allclose(loss, [0.5], rtol=1e-6)


def _expert(context: Context, key: jax.Array) -> Acted:
    """Near the best there is for the point: brake before the origin."""
    x, v = context.obs[:, -1, 0], context.obs[:, -1, 1]
    return Acted(jnp.clip(-1.5 * x - 1.5 * v, -1, 1)[:, None], context)


def _expert_episodes(num: int) -> list[Episode]:
    env = VectorEnv(PointEnv(), num)
    return make_collector(env, _expert, 1, {})(jax.random.key(5))


@pytest.fixture(scope="module")
def cloned() -> dict[str, float]:
    """Mean returns on the point task: of the expert, before and after imitating it."""
    config = point_config(
        num_envs=2, dataset="of the test", prefill_env_steps=0, pretrain_updates=500,
        normalize_obs=True, context_length=2, eval_episodes=32, actor_learning_rate=3e-3,
    )  # fmt: skip
    episodes = _expert_episodes(40)
    population = make_population(config, seed_members([0]), env=PointEnv())
    state, dropped = with_dataset(population, population.init(), episodes)
    assert dropped == 0

    def score(state: Any) -> float:
        return float(np.mean(population.evaluate(policy_of(state), np.int32(0)).returns))

    before, critics = score(state), jax.device_get(state.learner.critic_params)
    log_alpha, first = jax.device_get(state.learner.log_alpha), None
    for _ in range(2):
        state, metrics = population.pretrain_chunk(state)
        first = metrics if first is None else first
    assert int(state.counters.updates[0]) == 500
    assert int(state.counters.env_steps) == 0
    np.testing.assert_array_equal(state.learner.log_alpha, log_alpha)
    changed = jax.tree.map(lambda a, b: np.any(a != b), critics, state.learner.critic_params)
    assert all(jax.tree.leaves(changed))
    return {
        "expert": float(np.mean([episode.episode_return for episode in episodes])),
        "before": before,
        "after": score(state),
        "first error": float(first["action_error"][0]),
        "last error": float(metrics["action_error"][0]),
    }


def test_the_actor_comes_to_do_as_it_was_shown(cloned: dict[str, float]) -> None:
    way = cloned["expert"] - cloned["before"]
    assert way > 10
    assert cloned["after"] - cloned["before"] > 0.8 * way
    assert cloned["last error"] < 0.8 * cloned["first error"]


@pytest.mark.slow
def test_the_replay_goes_on_after_the_dataset() -> None:
    """Steps of the environments come after it, and both are drawn."""
    config = point_config(
        agent="sacformer", num_envs=2, dataset="of the test", prefill_env_steps=0, seeds=2,
        normalize_obs=True, chunk_env_steps=40, target_return="auto", updates_per_env_step=0.5,
    )  # fmt: skip
    episodes = _expert_episodes(6)
    best = max(episode.episode_return for episode in episodes)
    episodes = [dataclasses.replace(episode, reward=episode.reward + 1) for episode in episodes]
    population = make_population(config, seed_members([0, 1]), env=PointEnv())
    state, _ = with_dataset(population, population.init(), episodes)
    np.testing.assert_allclose(state.hyper.target_return, best + EPISODE, rtol=1e-5)
    held = 6 * EPISODE // 2
    assert (int(state.buffer.size), int(state.buffer.head)) == (held, held)
    rings = np.asarray(state.buffer.steps.obs)[:, :, :held]  # [S, N, held, O]
    np.testing.assert_array_equal(rings[0], rings[1])
    shown = np.concatenate([episode.obs[:-1] for episode in episodes])
    statistics = state.learner.normalizer
    np.testing.assert_allclose(statistics.mean, np.tile(shown.mean(0), (2, 1)), rtol=1e-4)
    np.testing.assert_allclose(
        statistics.m2 / statistics.count[:, None], np.tile(shown.var(0), (2, 1)), rtol=1e-4
    )
    state, metrics = population.train_chunk(state)
    assert np.isfinite(metrics["critic_loss"]).all()
    assert (int(state.buffer.size), int(state.counters.env_steps)) == (held + 20, 40)
    time_steps = np.asarray(state.buffer.steps.time_step)[:, :, held : held + 20]
    assert (time_steps == np.arange(20)).all()


# --- whole runs ----------------------------------------------------------------------------------

TINY = {
    "agent": "sac", "env": "Hopper", "num_envs": 2, "max_episode_steps": 50,
    "chunk_env_steps": 100, "total_env_steps": 300, "eval_every": 100, "eval_episodes": 2,
    "checkpoint_every": 1000, "actor_width": 8, "actor_layers": 1, "critic_width": 8,
    "batch_size": 4, "buffer_capacity": 2000,
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _datasets(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A place for Minari's datasets."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("datasets")))
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without a dataset, whose policy makes one."""
    pytest.importorskip("minari")
    path = tmp_path_factory.mktemp("runs") / "first"
    settings = {**TINY, "total_env_steps": 200, "prefill_env_steps": 100}
    return train(Config.from_preset("cpu", **settings, run_dir=str(path)), quiet=True).path


@pytest.fixture(scope="module")
def dataset(run: Path) -> Path:
    """Episodes of random actions in Hopper."""
    return collect(run, "test/random-v0", episodes=20, actions="random", seed=3)


def test_a_dataset_is_read_as_it_was_collected(run: Path, dataset: Path) -> None:
    import minari

    env = VectorEnv(make_env("Hopper"), 16, 50)

    def random_action(context: Context, key: jax.Array) -> Acted:
        return Acted(env.random_action(key), context)

    key = jax.random.fold_in(jax.random.key(3), 0)
    expected = make_collector(env, random_action, 1, {})(key)
    assert len(expected) == 16
    for name in ("test/random-v0", str(dataset), str(dataset / "data" / "main_data.hdf5")):
        episodes = read_episodes(name)
        assert len(episodes) == 20
        for found, collected in zip(episodes, expected, strict=False):
            for field in ("obs", "action", "reward"):
                np.testing.assert_array_equal(getattr(found, field), getattr(collected, field))
            assert found.terminated == collected.terminated
    theirs = minari.load_dataset("test/random-v0")
    assert theirs.spec.env_spec.id == "Hopper-v5"
    assert theirs.total_steps == sum(map(len, episodes))
    assert theirs.recover_environment().observation_space.shape == (11,)


def test_mean_actions_are_those_an_evaluation_takes(run: Path) -> None:
    path = collect(run, "test/mean-v0", episodes=3, actions="mean", policy="latest")
    policy = load_policy(run, "latest")
    for episode in read_episodes(str(path)):
        context_length, cache = policy.config.context.context_length, policy.agent.init_cache(1)
        assert context_length == 1
        from sacformer_jax import context as contexts

        for obs, action in zip(episode.obs, episode.action, strict=False):
            context = contexts.start(jnp.asarray(obs)[None], 1, 3, cache)
            acted = policy.agent.act(policy.state, context, jax.random.key(0), explore=False)
            np.testing.assert_allclose(acted.action[0], action, atol=1e-5)


@pytest.mark.slow
def test_a_run_from_a_dataset_resumes_as_if_never_stopped(dataset: Path, tmp_path: Path) -> None:
    config = Config.from_preset(
        "cpu", **TINY, dataset=str(dataset), pretrain_updates=20, run_dir=str(tmp_path / "run")
    )
    assert config.run.prefill_env_steps == 0
    result = train(config, quiet=True)
    pretraining = read_records(result.path / "metrics.jsonl", "pretrain")
    assert [(record["env_steps"], record["updates"]) for record in pretraining] == [(0, 20)]
    assert set(pretraining[0]) >= {"critic_loss", "actor_loss", "action_error"}
    assert [record["env_steps"] for record in result.evaluations] == [0, 100, 200, 300]
    # Pretraining was saved before the first step.
    assert RunFolder(result.path).steps() == [0, 300]
    path = tmp_path / "killed"
    shutil.copytree(result.path, path)
    shutil.rmtree(path / "checkpoints" / "300")
    resume(path, quiet=True)
    ends = [load_policy(each, "latest").state for each in (path, result.path)]
    assert digest(ends[0]) == digest(ends[1])
    metrics = [(each / "metrics.jsonl").read_bytes() for each in (path, result.path)]
    assert metrics[0] == metrics[1]


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"pretrain_updates": 5}, "pretrain_updates=5: there is nothing to learn from"),
        ({"pretrain_updates": -1}, "pretrain_updates=-1: must not be negative"),
        ({"dataset": "x", "agent": "ppo"}, "agent=ppo learns from its own steps alone"),
        ({"dataset": "x", "agent": "td3", "pretrain_updates": 5}, "agent=td3 can only begin"),
        (
            {"dataset": "x", "pretrain_updates": 5, "prefill_env_steps": 400},
            "prefill_env_steps=400: pretrain_updates would imitate these random actions",
        ),
        ({"dataset": "x", "checkpoint_replay": False}, "checkpoint_replay=False does not save"),
    ],
)
def test_senseless_settings_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Config.from_preset("cpu", **fields)


def _broken(what: str) -> list[Episode]:
    episodes = _episodes([4, 5])
    second = episodes[1]
    changes: dict[str, dict[str, Any]] = {
        "empty": {"obs": second.obs[:1], "action": second.action[:0], "reward": second.reward[:0]},
        "short": {"obs": second.obs[:-1]},
        "nan": {"reward": np.full_like(second.reward, np.nan)},
        "far": {"action": second.action + 3},
    }
    return [episodes[0], dataclasses.replace(second, **changes[what])]


@pytest.mark.parametrize(
    ("episodes", "fields", "message"),
    [
        ([], {}, "holds no episodes"),
        (_broken("empty"), {}, "episode 1 has no steps"),
        (_broken("short"), {}, r"observations \(5, 2\).*needs \(6, 2\)"),
        (_broken("nan"), {}, "episode 1 has rewards that are not finite"),
        (_broken("far"), {}, r"episode 1 has actions from .* has bounds \(-1\.0,\)"),
        (_episodes([4, 30]), {}, "30 steps: more than max_episode_steps=20"),
        (_episodes([20] * 401), {}, "8020 steps, buffer_capacity=8000: give at least 8020"),
    ],
)
def test_episodes_of_another_task_are_refused(
    episodes: list[Episode], fields: dict[str, Any], message: str
) -> None:
    config = point_config(dataset="x", **fields)
    with pytest.raises(ConfigError, match=message):
        check_episodes(episodes, PointEnv().spec, config)


def test_an_environment_that_comes_wrapped_takes_no_steps_of_the_task_as_it_is() -> None:
    delayed = wrapped(PointEnv(), action_delay=1).spec
    with pytest.raises(ConfigError, match=r"has wrappers \(.*\); use an environment without any"):
        check_episodes(_episodes([4]), delayed, point_config(dataset="x"))


def test_a_dataset_that_is_not_there_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    config = Config.from_preset("cpu", **TINY, dataset="none/such-v0", run_dir=str(tmp_path / "r"))
    with pytest.raises(ConfigError, match="is no local Minari dataset"):
        train(config, quiet=True)
    assert not (tmp_path / "r").exists()


def test_a_dataset_of_another_task_is_refused(dataset: Path) -> None:
    hopper = make_env("Hopper")
    read_episodes(str(dataset), hopper.spec)
    with pytest.raises(ConfigError, match=r"is of Hopper-v5, not of env='Walker2d'.* env=Hopper"):
        read_episodes(str(dataset), make_env("Walker2d").spec)
    delayed = wrapped(hopper, action_delay=2).spec
    episodes = read_episodes(str(dataset))[:1]
    write_episodes(episodes, "test/delayed-v0", delayed, "nobody", "as if delayed")
    with pytest.raises(ConfigError, match=r"was collected with ActionDelay, .*env='Hopper'"):
        read_episodes("test/delayed-v0", hopper.spec)


@pytest.mark.parametrize("whole", [0, 3])
def test_collecting_goes_on_until_there_are_enough_or_says_that_there_are_not(
    run: Path, whole: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    turns = []

    def broken(*_: Any) -> Any:  # of each turn so many are whole
        return lambda key: turns.append(key) or [turns[-1]] * whole

    monkeypatch.setattr(api, "make_collector", broken)
    monkeypatch.setattr(api, "write_episodes", lambda episodes, *_: len(episodes))
    if whole:
        assert collect(run, "test/few-v0", episodes=20) == 20
        assert len(turns) == 7
    else:
        with pytest.raises(ConfigError, match="episodes=20: of 208 only 0 were whole"):
            collect(run, "test/few-v0", episodes=20)


@pytest.mark.parametrize(
    ("to", "fields", "message"),
    [
        ("no version", {}, "must be like 'name-v0'"),
        ("test/random-v0", {}, "there is such a dataset already"),
        ("test/new-v0", {"episodes": 0}, "episodes=0: must be at least 1"),
        ("test/new-v0", {"actions": "best"}, "actions='best': must be mean, sample or random"),
    ],
)
def test_collecting_refuses(
    run: Path, dataset: Path, to: str, fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        collect(run, to, **fields)
