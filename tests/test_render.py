"""Videos: what is on them, how long they are, and that their returns are evaluation's."""

from __future__ import annotations

import base64
import json
import re
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v2
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image
from probe import PointEnv
from untrained import STEPS, untrained_config, untrained_run

from sacformer_jax import ConfigError, evaluate, load_policy, make_env, render, train
from sacformer_jax import model_renderer as gl
from sacformer_jax.cli import main
from sacformer_jax.frames import BraxFrames, EngineFrames, PlaygroundFrames, frame_source
from sacformer_jax.gym_frames import GymFrames
from sacformer_jax.model_renderer import View
from sacformer_jax.policy_renderer import PolicyRenderer, Timing, caption, episode_frames
from sacformer_jax.recording import Recording
from sacformer_jax.video import Frame, GifWriter, Mp4Writer, captioned

SIZE = View(64, 48)
HOPPER_DT = 0.008
FPS = 1 / (3 * HOPPER_DT)  # every third step: at most 50
HOLD = 21  # half a second of that


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained_run(tmp_path_factory.mktemp("render") / "run")


@pytest.fixture(scope="module")
def drawn(run: Path):
    return render(run, episodes=2, seed=3, view=SIZE, timing=Timing(gif_seconds=0.2))


def _frames(path: Path) -> list[np.ndarray]:
    with imageio.v2.get_reader(path) as reader:
        return [np.asarray(frame) for frame in reader]


# --- whole videos ----------------------------------------------------------------------------


def test_returns_are_those_of_an_evaluation(run: Path, drawn) -> None:
    record = evaluate(run, episodes=2, seed=3)
    assert float(drawn.returns.mean()) == record["return_mean"]
    assert float(drawn.lengths.mean()) == record["length_mean"]
    other = evaluate(run, episodes=2, seed=4)
    assert other["return_mean"] != record["return_mean"]


def test_files_lie_in_the_runs_folder(run: Path, drawn) -> None:
    assert drawn.paths == (run / "videos" / "best.mp4", run / "videos" / "best.gif")
    assert sorted((run / "videos").iterdir()) == sorted(drawn.paths)


def test_the_mp4_has_a_frame_every_third_step_and_holds_the_last(drawn) -> None:
    frames = _frames(drawn.paths[0])
    expected = [-(-length // 3) + HOLD for length in drawn.lengths.tolist()]
    assert len(frames) == sum(expected)
    assert frames[0].shape == (48, 64, 3)
    with imageio.v2.get_reader(drawn.paths[0]) as reader:
        assert reader.get_meta_data()["fps"] == pytest.approx(FPS, abs=0.01)
    right = [frame[:, 40:].astype(int) for frame in frames]  # beside the caption
    assert right[0].std() > 10  # something is to be seen
    moved = np.abs(right[0] - right[expected[0] - 1]).mean()
    still = np.abs(right[expected[0] - 1] - right[expected[0] - 2]).mean()
    assert moved > 1 > still


def test_the_gif_is_short_and_slow(drawn) -> None:
    with Image.open(drawn.paths[1]) as gif:
        assert gif.size == (64, 48)
        durations = []
        for place in range(gif.n_frames):
            gif.seek(place)
            durations.append(gif.info["duration"])
    assert len(durations) > 1
    # It ends at the first frame of the MP4's that is not before 0.2 s.
    assert sum(durations) == round(100 * np.ceil(0.2 * FPS) / FPS) * 10


class Counting:
    """Draws what it is given, as a colour."""

    dt = 0.05

    def draw(self, snapshot: np.ndarray) -> np.ndarray:
        return np.full((48, 64, 3), snapshot, np.uint8)


def test_frames_have_the_state_acted_on_and_the_return_before_it(run: Path) -> None:
    recording = Recording(
        seen=np.array([[1, 11], [2, 12], [3, 99]]),
        return_so_far=np.float32([[0, 0], [1.5, 4], [2.5, 7], [4.5, 7]]),
        lengths=np.array([3, 2]),
    )
    frames = list(episode_frames(recording, load_policy(run), Counting(), Timing()))
    assert [frame.image[0, 0, 0] for frame in frames] == [1, 2, 3, 3, 11, 12, 12]
    assert [frame.num_shown for frame in frames] == [1, 1, 1, 10, 1, 1, 10]
    assert frames[0].caption == (
        "episode 1 of 2, step 0", "return 0.0", "return-to-go 40.0 of 40",
    )  # fmt: skip
    assert frames[3].caption == (
        "episode 1 of 2, step 3", "return 4.5", "return-to-go 35.5 of 40",
    )  # fmt: skip
    assert frames[5].caption[1:] == ("return 4.0", "return-to-go 36.0 of 40")
    assert frames[6].caption[0] == "episode 2 of 2, step 2"


def test_captions_without_a_target_return(run: Path) -> None:
    policy = load_policy(run)
    for fields in ({"agent": "sac"}, {"return_conditioning": "none"}):
        policy.config = untrained_config(**fields)
        assert caption(policy, 2, 1.0) == ("step 2", "return 1.0")


# --- frames and captions -----------------------------------------------------------------------


@pytest.mark.parametrize("background", [0, 255])
def test_captions_can_be_read_on_dark_and_on_light(background: int) -> None:
    image = np.full((48, 64, 3), background, np.uint8)
    seen = captioned(image, ("step 7", "return 12.5")).astype(int)
    contrast = np.abs(seen - background).max(axis=2)
    assert np.all(image == background)
    assert (contrast > 200).sum() > 40  # letters, or their edges
    assert (seen.min(axis=2) > 240).any()  # white within
    assert (seen.max(axis=2) < 15).any()  # black around
    other = captioned(image, ("step 8", "return 12.5"))
    assert np.any(other != seen)


def test_long_captions_are_made_smaller() -> None:
    blank = np.zeros((48, 400, 3), np.uint8)
    lines = ("return-to-go 12345.6 of 123456, and more that is far too long to be drawn large",)
    width = np.flatnonzero(captioned(blank, lines).any(axis=(0, 2))).max()
    assert width < 400
    short = np.flatnonzero(captioned(blank, ("far too long 1,",)).any(axis=(1, 2)))
    long = np.flatnonzero(captioned(blank, lines).any(axis=(1, 2)))
    assert np.ptp(long) < np.ptp(short)


@pytest.mark.parametrize(
    ("length", "dt", "fps", "expected"),
    [
        (4, 0.05, None, [0, 1, 2, 3]),  # 20 a second
        (10, 0.008, None, [0, 3, 6, 9]),  # 125 a second
        (5, 0.015, None, [0, 2, 4]),  # 67 a second
        (6, 0.05, 10.0, [0, 2, 4]),
        (3, 0.05, 40.0, [0, 0, 1, 1, 2, 2]),
        (7, 0.05, 8.0, [0, 2, 5]),
        (1, 0.008, None, [0]),
    ],
)
def test_steps_that_are_drawn(length: int, dt: float, fps: float | None, expected: list) -> None:
    assert Timing(fps).steps(length, dt) == expected


def test_a_model_of_one_joint_is_drawn_from_mjx() -> None:
    frames: Any = SimpleNamespace(_native=False)
    state = SimpleNamespace(qpos=jnp.array([0.5]), origin=jnp.array([2.0, 0.0]))
    np.testing.assert_array_equal(EngineFrames.snapshot(frames, state), [2.5])


def test_writers_leave_nothing_behind_when_they_fail(tmp_path: Path) -> None:
    frame = Frame(np.zeros((48, 64, 3), np.uint8), ("step 0",))

    def fails(writer: Mp4Writer | GifWriter) -> None:
        with writer:
            writer.write(frame)
            raise RuntimeError("broken")

    for writer in (Mp4Writer(tmp_path / "a.mp4", 20.0), GifWriter(tmp_path / "a.gif", 20.0, 1.0)):
        with pytest.raises(RuntimeError, match="broken"):
            fails(writer)
    assert list(tmp_path.iterdir()) == []


def test_both_engines_are_drawn_alike() -> None:
    images = []
    for engine in ("native", "mjx"):
        env = make_env("Ant", engine)
        qpos = np.array(env.engine.model.qpos0)
        qpos[:3], qpos[7:] = (20.0, -3.0, 0.6), 0.3
        if engine == "native":
            data = mujoco.MjData(env.engine.model)
            data.qpos[:] = qpos
            spec = mujoco.mjtState.mjSTATE_FULLPHYSICS | mujoco.mjtState.mjSTATE_WARMSTART
            physics = np.zeros(mujoco.mj_stateSize(env.engine.model, spec))
            mujoco.mj_getState(env.engine.model, data, physics, spec)
            state = env.engine.pack_state(physics, np.zeros(2))
        else:
            zeros = jnp.zeros(env.engine.nv)
            state = env.engine.state(jnp.float32(qpos), zeros, zeros, jnp.zeros(2))
        source = frame_source(env, SIZE)
        assert isinstance(source, EngineFrames)
        images.append(source.draw(jax.tree.map(np.asarray, source.snapshot(state))).astype(int))
        source.close()
    assert images[0].std() > 20
    assert np.abs(images[0] - images[1]).mean() < 0.5


def test_the_floor_has_no_end() -> None:
    source = frame_source(make_env("HalfCheetah", "native"), SIZE)
    assert isinstance(source, EngineFrames)
    seen = []
    for x in (0.0, 500.0):
        source._renderer.data.qpos[0] = x
        seen.append(source._renderer.draw()[36:].astype(int))
    source.close()
    assert min(image.std() for image in seen) > 40  # squares, not the sky


def test_playground_is_drawn() -> None:
    pytest.importorskip("mujoco_playground")
    env = make_env("playground:CartpoleBalance")
    source = frame_source(env, SIZE)
    assert isinstance(source, PlaygroundFrames)
    assert source.dt == pytest.approx(0.01)
    images = []
    for position in (0.0, 1.0):
        data = {"mocap_pos": np.zeros((0, 3)), "mocap_quat": np.zeros((0, 4))}
        images.append(source.draw({**data, "qpos": np.array([position, 0.5])}).astype(int))
    source.close()
    assert np.abs(images[0] - images[1]).mean() > 1


def test_gymnasium_draws_its_own_and_is_brought_to_the_state() -> None:
    env = make_env("gym:InvertedPendulum-v5")
    source = frame_source(env, SIZE)
    assert isinstance(source, GymFrames)
    assert source.dt == pytest.approx(0.04)
    actions = np.zeros((env.spec.max_episode_steps, 1), np.float32)
    actions[:6, 0] = [1, 1, -1, 1, 1, 1]

    def at(length: int, seed: int = 3) -> np.ndarray:
        state = {"seed": np.uint32(seed), "length": np.int32(length), "actions": actions}
        return source.draw(state).astype(int)

    first, later = at(0), at(6)  # from the reset, then six steps on
    assert first.shape == (64, 64, 3)
    assert np.abs(first - later).mean() > 0.5
    assert np.any(at(2) != later)  # back: from a reset again
    np.testing.assert_array_equal(at(6), later)
    np.testing.assert_array_equal(at(0), first)
    source.close()
    with pytest.raises(ConfigError, match="camera='track'"):
        frame_source(env, View(64, 48, "track"))


def test_what_nobody_can_draw_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"env='point': cannot be drawn.*frame_source"):
        frame_source(PointEnv(), SIZE)


def test_an_environment_may_draw_itself() -> None:
    class Own:
        def frame_source(self, view: View) -> str:
            return f"a source of {view.width} pixels"

    assert frame_source(Own(), SIZE) == "a source of 64 pixels"  # type: ignore[arg-type]


def test_brax_makes_a_page_and_is_drawn() -> None:
    env = make_env("brax:inverted_pendulum")
    source = frame_source(env, SIZE)
    assert isinstance(source, BraxFrames)
    states = [jax.jit(env.reset)(jax.random.key(seed))[0] for seed in (1, 2)]
    snapshots = [jax.tree.map(np.asarray, source.snapshot(state)) for state in states]
    assert source.draw(snapshots[0]).std() > 10
    page = source.html(snapshots, "return 1.5")
    source.close()
    assert ">return 1.5</div>" in page
    found = re.search(r'var system = "([^"]+)"', page)
    assert found is not None
    system = json.loads(zlib.decompress(base64.b64decode(found[1])))
    assert system["opt"]["timestep"] == pytest.approx(source.dt)
    positions = [state["pos"] for state in system["states"]["x"]]
    assert np.allclose(positions, [snapshot["x"].pos for snapshot in snapshots])


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "mentioned"),
    [
        (["--size", "64"], "size='64': must be WIDTHxHEIGHT"),
        (["--size", "63x48"], "width=63: must be even"),
        (["--camera", "nose"], "camera='nose': the model has track"),
        (["--episodes", "0"], "episodes=0"),
        (["--fps", "0"], "fps=0.0"),
        (["--gif-seconds", "-1"], "gif_seconds=-1.0"),
        (["--seed", "-1"], "seed=-1"),
        (["--to", "a.avi"], "must end in .mp4"),
        (["--to", "."], "to='.': is a folder"),
        (["--to", "a.html"], "brax's viewer makes HTML"),
        (["--member", "7"], "member='7'"),
        (["--policy", "latest"], "no latest policy yet"),
    ],
)
def test_what_cannot_be_drawn_is_refused(
    run: Path, flags: list[str], mentioned: str, capsys, monkeypatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["render", str(run), *flags]) == 2
    assert mentioned in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_missing_packages_are_named(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ConfigError, match=r"imageio_ffmpeg.*sacformer-jax\[video\]"):
        render(run, view=SIZE)


def test_without_opengl_the_debian_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*args: object) -> None:
        raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")

    monkeypatch.setattr(mujoco, "Renderer", fails)
    with pytest.raises(ConfigError, match=r"eglQueryString.*libegl1"):
        gl.ModelRenderer(make_env("Hopper", "native").engine.model, SIZE)


@pytest.mark.parametrize(
    ("environment", "chosen"),
    [({}, "egl"), ({"DISPLAY": ":0"}, None), ({"MUJOCO_GL": "osmesa"}, "osmesa")],
)
def test_egl_is_chosen_where_there_is_no_display(
    environment: dict[str, str], chosen: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = sys.modules[mujoco.Renderer.__module__].gl_context
    monkeypatch.setattr(context, "GLContext", None)
    monkeypatch.setattr(gl.os, "environ", dict(environment))
    monkeypatch.setattr(gl.sys, "platform", "linux")
    gl.mujoco_that_draws()
    assert gl.os.environ.get("MUJOCO_GL") == chosen
    assert (context.GLContext is not None) == (environment == {})


# --- the command, and training ------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_draws_each_member(tmp_path: Path, capsys) -> None:
    run = untrained_run(tmp_path / "run", seeds=2, agent="sac")
    to = tmp_path / "seen" / "hopper.mp4"
    assert main(["render", str(run), "--to", str(to), "--size", "64x48"]) == 0
    names = [path.name for path in sorted(to.parent.iterdir())]
    assert names == ["hopper-seed-0.mp4", "hopper-seed-1.mp4"]
    said = capsys.readouterr().out
    for member in ("seed-0", "seed-1"):
        record = evaluate(run, episodes=1, member=member)
        assert f"{member}: episode 1: return {record['return_mean']:.1f}" in said


TRAINING = {
    "agent": "sac", "prefill_env_steps": 100, "total_env_steps": 300,
    "chunk_env_steps": 50, "eval_every": 50, "eval_episodes": 1, "checkpoint_every": 1000,
}  # fmt: skip


@pytest.mark.slow
def test_videos_in_training_change_nothing_though_one_fails(
    tmp_path: Path, monkeypatch, capsys
) -> None:
    drawing = PolicyRenderer.render

    def fails_once(self, policy, seed, paths, timing):
        if paths[0].stem == "step_200":
            raise OSError("the disk is full")
        return drawing(self, policy, seed, paths, timing)

    monkeypatch.setattr(PolicyRenderer, "render", fails_once)
    metrics = {}
    for every in (0, 100):
        path = tmp_path / str(every)
        config = untrained_config(**TRAINING, video_every=every, run_dir=str(path))
        assert train(config).env_steps == 300
        metrics[every] = (path / "metrics.jsonl").read_bytes()
        assert (path / "diagnostics.png").stat().st_size > 10_000
    assert metrics[0] == metrics[100]
    # The run starts at 100, after prefill.
    videos = sorted(path.name for path in (tmp_path / "100" / "videos").iterdir())
    assert videos == ["step_100.mp4", "step_300.mp4"]
    frames = _frames(tmp_path / "100" / "videos" / "step_300.mp4")
    assert frames[0].shape == (240, 320, 3)
    assert HOLD < len(frames) <= HOLD + STEPS // 3
    assert not (tmp_path / "0" / "videos").exists()
    said = capsys.readouterr().out
    assert said.count("step_200.mp4 (the disk is full); training goes on") == 1
    assert said.count("training goes on") == 1


def test_where_videos_cannot_be_made_training_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio", None)
    config = untrained_config(**TRAINING, video_every=100, run_dir=str(tmp_path / "run"))
    with pytest.raises(ConfigError, match="imageio"):
        train(config)
    assert not (tmp_path / "run").exists()
