"""Figures and tables of studies: what they show is what the tables hold."""

from __future__ import annotations

import csv
import itertools
import math
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import figures
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from report.curves import grid_figure, panels_figure
from report.intervals import intervals_figure
from report.lines import Program, StudyLines, read_study
from report.scores import RANDOM_RETURNS, REFERENCE_RETURNS, normalized
from report.styles import AGENTS, Style, styles_of
from report.tables import aggregates, markdown, scores_csv
from report.timed import scores_until, step_seconds, timed

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
COLUMNS = (
    "study", "run", "agent", "preset", "env", "engine", "seed", "env_steps", "return_mean",
    "return_std", "episodes", "wall_s", "commit", "cpu",
)  # fmt: skip
Runs = Mapping[str, Sequence[Sequence[float]]]


def write(
    path: Path,
    runs: Runs,
    agent: str | None = None,
    every: int = 1_000,
    seconds: Mapping[str, float] | None = None,
    cpus: Mapping[str, str] | None = None,
) -> Path:
    """A table of ``{TASK-VARIANT: [returns of seed 0, of seed 1, …]}``.

    ``seconds`` are a run's from one evaluation to the next, ``cpus`` what it was trained on.
    """
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for run, seeds in runs.items():
            task, variant = run.split("-", 1)
            variant, _, first_seed = variant.partition("-from-")
            for seed, returns in enumerate(seeds, int(first_seed or 0)):
                for place, value in enumerate(returns, 1):
                    at = (seconds or {}).get(run, 0.5) * (place - 1)
                    cpu = (cpus or {}).get(run, "A")
                    row = (path.stem, run, agent or variant, "cpu", task, "native", seed,
                           every * place, value, 1.0, 4, at, "abc", cpu)  # fmt: skip
                    writer.writerow(row)
    return path


def read(*args: object, **kwargs: object) -> StudyLines:
    study = read_study(write(*args, **kwargs))  # type: ignore[arg-type]
    assert study is not None
    return study


def panels(figure: Figure) -> dict[str, Axes]:
    return {axes.get_title(): axes for axes in figure.axes}


def line_of(axes: Axes, label: str) -> tuple[list[float], list[float]]:
    """What is plotted: x and y."""
    (line,) = (line for line in axes.lines if line.get_label() == label)
    return list(line.get_xdata()), list(line.get_ydata())


def band_of(axes: Axes, place: int) -> dict[float, tuple[float, float]]:
    """Lowest and highest y of a band, by x."""
    vertices = axes.collections[place].get_paths()[0].vertices
    by_x: dict[float, list[float]] = {}
    for x, y in vertices:
        by_x.setdefault(float(x), []).append(float(y))
    return {x: (min(ys), max(ys)) for x, ys in by_x.items()}


def caption_of(figure: Figure) -> str:
    (text,) = figure.texts
    return " ".join(text.get_text().split())


def returns_for(task: str, *scores: float) -> list[float]:
    low = RANDOM_RETURNS[task]
    return [low + score * (REFERENCE_RETURNS[task] - low) for score in scores]


TWO_AGENTS = {
    "Hopper-sacformer": [[10, 20, 30], [30, 60, 50]],
    "Hopper-sac": [[1, 2, 3], [3, 2, 1]],
    "HalfCheetah-sacformer": [[100, 300, 200], [0, 100, 400]],
    "HalfCheetah-sac": [[5, 5, 5], [7, 9, 11]],
}


def test_lines_are_means_and_bands_the_range_of_seeds(tmp_path: Path) -> None:
    study = read(tmp_path / "two.csv", TWO_AGENTS)
    figure = panels_figure(study)
    axes = panels(figure)
    assert list(axes) == ["HalfCheetah", "Hopper", "IQM over tasks"]
    assert line_of(axes["Hopper"], "SACFormer") == ([1, 2, 3], [20, 40, 40])
    assert line_of(axes["HalfCheetah"], "SAC") == ([1, 2, 3], [6, 7, 8])
    assert band_of(axes["Hopper"], 0) == {1: (10, 30), 2: (20, 60), 3: (30, 50)}
    assert band_of(axes["HalfCheetah"], 1) == {1: (5, 7), 2: (5, 9), 3: (5, 11)}
    assert axes["Hopper"].get_xlabel() == "env steps (thousands)"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["SACFormer", "SAC"]
    caption = caption_of(figure)
    assert caption.startswith(
        "Study two: 2 seeds, 3,000 env steps, 4 episodes an evaluation, engine native, preset cpu. "
        "Lines: mean over seeds, not smoothed. Bands: lowest to highest seed."
    )
    assert "Not finished" not in caption


def test_the_average_is_the_interquartile_mean_of_normalized_scores(tmp_path: Path) -> None:
    runs = {
        f"{task}-sac": [[value] for value in returns_for(task, *scores)]
        for task, scores in {"Hopper": (0.0, 0.4), "Ant": (0.6, 1.5)}.items()
    }
    axes = panels(panels_figure(read(tmp_path / "average.csv", runs)))["IQM over tasks"]
    assert line_of(axes, "SAC")[1] == pytest.approx([0.5], abs=1e-9)
    # Of 16 resamples the lowest and the highest, trimmed: (0, 0, .6, .6) and (.4, .4, 1.5, 1.5).
    assert band_of(axes, 0)[1] == pytest.approx((0.3, 0.95), abs=1e-9)


def test_many_seeds_have_a_bootstrap_band(tmp_path: Path) -> None:
    # The sum of five draws from 0, 0, 0, 0, 10 is over 30 in 0.7 % of all, over 20 in 6 %.
    study = read(tmp_path / "many.csv", {"Hopper-sac": [[0], [0], [0], [0], [10]]}, every=10**6)
    figure = panels_figure(study)
    (axes,) = figure.axes
    assert line_of(axes, "SAC") == ([1], [2])
    assert band_of(axes, 0) == {1: (0, 6)}
    assert axes.get_xlabel() == "env steps (millions)"
    assert "5 seeds, 1,000,000 env steps" in caption_of(figure)
    assert "Bands: 95 % bootstrap interval of the mean." in caption_of(figure)


def test_bands_of_few_and_of_many_seeds_are_told_apart(tmp_path: Path) -> None:
    runs = {"Hopper-sac": [[1]] * 5, "Hopper-paper": [[1]] * 3}
    figure = panels_figure(read(tmp_path / "mixed.csv", runs, agent="sac"))
    assert (
        "Bands: 95 % bootstrap interval of the mean, of fewer than 5 seeds lowest to highest."
        in caption_of(figure)
    )
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["SAC", "preset paper (reduced)"]


def test_runs_in_progress(tmp_path: Path) -> None:
    runs = {
        **TWO_AGENTS,
        "Hopper-td3": [[1, 2, 3], [3, 4]],  # a seed of its own is behind
        "Hopper-ppo": [[9, 8, 7]],
        "HalfCheetah-ppo": [[9, 8]],
    }
    study = read(tmp_path / "progress.csv", runs)
    figure = panels_figure(study)
    axes = panels(figure)
    assert line_of(axes["Hopper"], "TD3") == ([1, 2], [2, 3])
    assert line_of(axes["IQM over tasks"], "PPO")[0] == [1, 2]
    average = {line.get_label() for line in axes["IQM over tasks"].lines}
    assert average == {"SACFormer", "SAC", "PPO"}
    caption = caption_of(figure)
    assert "1 to 2 seeds, 3,000 env steps" in caption
    assert "Without TD3, not begun on every task." in caption
    assert caption.endswith(
        "Not finished: TD3 on HalfCheetah (not begun); TD3 on Hopper (2,000 env steps); "
        "PPO on HalfCheetah (2,000 env steps)."
    )
    made = {one.variant: one for one in aggregates(study, "sac")}
    assert made["td3"].iqm is made["td3"].improvement is made["ppo"].iqm is None
    assert made["ppo"].tasks == ["Hopper"]
    assert made["ppo"].improvement is not None
    assert made["ppo"].improvement.value == 1.0
    text = markdown(study, list(made.values()), "sac")
    assert "| PPO | – | 0.00 on Hopper only | 1.00 on Hopper only |" in text
    lines = scores_csv(study, list(made.values())).splitlines()
    assert "progress,Hopper,ppo,difference,,0.0026,," in lines
    assert "progress,Hopper,ppo,improvement,,1.0000,," in lines
    assert [line.split(",")[1] for line in lines if ",sac,iqm," in line] == [""]
    assert "| TD3 | – † | 2 ± 1 (2 / 4) † |" in text
    assert "| PPO | 8 (8) † | 8 (8) |" in text
    assert "\n† Not finished: TD3 on HalfCheetah (not begun); TD3 on Hopper" in text


def test_a_table_of_markdown(tmp_path: Path) -> None:
    study = read(tmp_path / "figure2-cpu.csv", {
        "Hopper-sacformer": [[999, *[20] * 5], [0, 10, 20, 30, 40, 0]],
        "Hopper-sac": [[0, *[10] * 5], [0, 30, 30, 30, 30, 30]],
        "Hopper-ppo": [[0, *[1] * 5]],
    })  # fmt: skip
    assert study.baseline() == "sac"
    lines = markdown(study, aggregates(study, "sac"), "sac").splitlines()
    assert lines[0] == "# Study figure2-cpu"
    assert "| SACFormer | 20 ± 0 (20 / 20) |" in lines
    assert "| SAC | 20 ± 14 (10 / 30) |" in lines
    assert "| PPO | 1 (1) |" in lines
    assert lines[-5] == "|  | interquartile mean | less SAC's | P(better than SAC) |"
    assert lines[-3:] == [
        "| SACFormer | 0.00 [0.00, 0.00] | 0.00 [0.00, 0.00] | 0.50 [0.00, 1.00] |",
        "| SAC | 0.00 [0.00, 0.01] | – | – |",
        "| PPO | -0.01 | -0.01 | 0.00 |",
    ]


def test_scores_at_equal_wall_clock(tmp_path: Path) -> None:
    runs = {
        # Twice as slow as SAC on Hopper, eight times on Walker2d: geometric mean 4.
        "Hopper-sacformer": [
            returns_for("Hopper", 0.0, 0.2, 0.3, 0.5, 0.9, 0.9, 0.9, 0.9),
            returns_for("Hopper", 0.0, 0.2, 0.3, 0.9, 0.9, 0.9, 0.9, 0.9),
        ],
        "Walker2d-sacformer": [returns_for("Walker2d", 0.1, *[0.9] * 7)] * 2,
        "Hopper-sac": [returns_for("Hopper", *[0.3] * 8)] * 2,
        "Walker2d-sac": [returns_for("Walker2d", *[0.21] * 8)] * 2,
        "Hopper-ppo": [returns_for("Hopper", *[0.4] * 8)],
    }
    seconds = dict.fromkeys(runs, 1.0) | {"Hopper-sacformer": 2.0, "Walker2d-sacformer": 8.0}
    table = write(tmp_path / "arena.csv", runs, seconds=seconds)
    study = read_study(table)
    assert study is not None
    (one,) = timed(study, "sac")  # PPO has another number of seeds
    assert (one.variant, one.tasks) == ("sacformer", ["Hopper", "Walker2d"])
    assert one.slowdown == pytest.approx(4.0)
    # In SAC's 7 seconds: evaluations at 0, 2, 4 and 6 s on Hopper, on Walker2d the first alone.
    hopper = study.lines["Hopper", "sacformer"]
    assert normalized("Hopper", scores_until(hopper, 4_500.0)) == pytest.approx([0.25, 0.35])
    assert normalized("Hopper", scores_until(hopper, 0.0)) == pytest.approx([0.0, 0.0])
    assert one.improvement.value == pytest.approx((0.5 + 0.0) / 2)
    # Trimmed are one at each end: of 0.1, 0.1, 0.25, 0.35, and of 0.21, 0.21, 0.3, 0.3.
    assert one.difference.value == pytest.approx((0.1 + 0.25) / 2 - (0.21 + 0.3) / 2)
    figures.draw(table)
    text = (tmp_path / "arena.md").read_text()
    assert "## At equal wall-clock" in text
    assert "| SACFormer | 4.00 | -0.08 [" in text
    figures.draw(write(tmp_path / "figure2-cpu.csv", runs, seconds=seconds))
    assert "wall-clock" not in (tmp_path / "figure2-cpu.md").read_text()


def test_a_longer_beginning_is_free(tmp_path: Path) -> None:
    runs = {
        "Hopper-sac": [returns_for("Hopper", *[0.5] * 8)] * 2,
        "Hopper-sacformer": [returns_for("Hopper", *[0.0] * 4, 1.0, 1.0, 1.0, 1.0)] * 2,
    }
    study = read(tmp_path / "a.csv", runs, seconds={"Hopper-sacformer": 3.5, "Hopper-sac": 0.5})
    own = study.lines["Hopper", "sacformer"]
    # As if it had begun to learn after the fourth evaluation: its first is at 4,000 steps.
    own.__dict__.pop("steps", None)
    for curve in own.curves.values():
        for step in (1_000, 2_000, 3_000):
            del curve[step]
    assert own.steps[0] == 4_000
    (one,) = timed(study, "sac")
    # A seventh of SAC's 7,000 steps after its first evaluation: 4,000 and 5,000 are counted.
    assert one.slowdown == pytest.approx(7.0)
    assert one.difference.value == pytest.approx((0.0 + 1.0) / 2 - 0.5)


def test_a_run_that_was_held_up_is_no_slower(tmp_path: Path) -> None:
    study = read(tmp_path / "arena.csv", {"Hopper-sac": [[0.0, 1, 2, 3, 4]] * 2})
    line, program = study.lines["Hopper", "sac"], Program("A", 2)
    assert step_seconds(line, program) == pytest.approx(0.5 / 1_000)
    for of_seed in line.seconds.values():
        of_seed.update({step: at + 60.0 for step, at in of_seed.items() if step > 3_000})
    assert step_seconds(line, program) == pytest.approx(0.5 / 1_000)
    line.seconds = {0: {1_000: 0.0}}
    assert math.isnan(step_seconds(line, program))


def test_a_run_that_was_held_up_most_of_the_time_is_no_slower_either(tmp_path: Path) -> None:
    study = read(tmp_path / "arena.csv", {"Hopper-sac": [list(range(25))] * 2})
    line, program = study.lines["Hopper", "sac"], Program("A", 2)
    for of_seed in line.seconds.values():
        of_seed.update({step: 3 * at for step, at in of_seed.items() if step > 4_000})
    assert step_seconds(line, program) == pytest.approx(0.5 / 1_000)


def test_lost_records_of_seconds_are_no_seconds(tmp_path: Path) -> None:
    study = read(tmp_path / "arena.csv", {"Hopper-sac": [list(range(9))] * 2})
    line, program = study.lines["Hopper", "sac"], Program("A", 2)
    line.seconds = {
        0: {1_000: math.nan, 2_000: math.nan, 3_000: 1.0, 4_000: 1.5, 5_000: 0.5, 6_000: 1.0}
    }
    assert step_seconds(line, program) == pytest.approx(0.5 / 1_000)
    line.seconds = {0: {1_000: 0.0, 2_000: 0.0, 3_000: math.nan}}
    assert math.isnan(step_seconds(line, program))


def test_a_lost_beginning_of_one_seed_is_not_taken_for_random_steps(tmp_path: Path) -> None:
    flat = [returns_for("Hopper", *[0.5] * 8)] * 2
    runs = {"Hopper-sacformer": flat, "Hopper-sac": flat}
    study = read(tmp_path / "a.csv", runs, seconds={"Hopper-sacformer": 2.0, "Hopper-sac": 1.0})
    own = study.lines["Hopper", "sacformer"]
    for step in (1_000, 2_000, 3_000):
        del own.curves[0][step]
    assert (own.first_step, own.steps[0]) == (1_000, 4_000)
    # Half of SAC's 7,000 steps after its first evaluation, so those at 4,000 are counted alone.
    (one,) = timed(study, "sac")
    assert one.slowdown == pytest.approx(2.0)
    own.curves[0][5_000] = own.curves[1][5_000] = returns_for("Hopper", 9.0)[0]
    del own.__dict__["steps"]
    assert timed(study, "sac")[0].difference.value == pytest.approx(0.0)


def test_seeds_that_are_being_added_do_not_cut_a_line_short(tmp_path: Path) -> None:
    finished = returns_for("Hopper", *[0.5] * 8)
    runs = {"Hopper-sac": [finished] * 2, "Hopper-sacformer": [finished] * 2}
    begun = runs | {"Hopper-sac-from-2": [returns_for("Hopper", 0.1, 0.2)] * 2}
    study = read(tmp_path / "a.csv", begun)
    assert study.lines["Hopper", "sac"].seeds == [0, 1]
    assert study.finished("Hopper", "sac")
    text = markdown(study, aggregates(study, "sac"), "sac")
    assert "Not finished: run Hopper-sac-from-2 (2,000 env steps)." in text
    grown = runs | {"Hopper-sac-from-2": [finished] * 2}
    study = read(tmp_path / "a.csv", grown)
    assert study.lines["Hopper", "sac"].seeds == [0, 1, 2, 3]
    assert not study.added


def test_seconds_are_compared_on_the_same_processor(tmp_path: Path) -> None:
    flat = [returns_for("Hopper", *[0.5] * 8)] * 2
    runs = {"Hopper-sacformer": flat, "Hopper-sac": flat}
    seconds = {"Hopper-sacformer": 2.0, "Hopper-sac": 1.0, "Hopper-sac-from-2": 0.5}
    cpus = {"Hopper-sacformer": "B", "Hopper-sac": "A", "Hopper-sac-from-2": "B"}
    assert timed(read(tmp_path / "a.csv", runs, seconds=seconds, cpus=cpus), "sac") == []
    for cpu in ("unknown", "A+B"):  # which seconds were whose?
        alike = dict.fromkeys(runs, cpu)
        assert timed(read(tmp_path / "a.csv", runs, seconds=seconds, cpus=alike), "sac") == []
    runs["Hopper-sac-from-2"] = flat
    study = read(tmp_path / "b.csv", runs, seconds=seconds, cpus=cpus)
    assert study.lines["Hopper", "sac"].programs == dict(
        zip(range(4), [*2 * [Program("A", 2)], *2 * [Program("B", 2)]], strict=True)
    )
    (one,) = timed(study, "sac")
    assert one.slowdown == pytest.approx(4.0)
    # Of both, the geometric mean; of those that have any.
    both = runs | {"Hopper-sacformer-from-2": flat}
    cpus["Hopper-sacformer-from-2"] = "A"
    study = read(tmp_path / "c.csv", both, seconds=seconds, cpus=cpus)
    (one,) = timed(study, "sac")
    assert one.slowdown == pytest.approx(math.sqrt(4.0 * 0.5))
    study.lines["Hopper", "sac"].seconds |= {0: {1_000: 0.0}, 1: {1_000: 0.0}}
    (one,) = timed(study, "sac")
    assert one.slowdown == pytest.approx(4.0)


def test_the_table_of_scores(tmp_path: Path) -> None:
    table = write(tmp_path / "baselines.csv", {
        "Hopper-td3": [[0, *[3135] * 5], [0, *[0] * 5]], "Hopper-sac": [[1.0], [2.0]],
    })  # fmt: skip
    figures.draw(table)
    with (tmp_path / "baselines-scores.csv").open(newline="") as file:
        rows = {
            (row["task"], row["variant"], row["statistic"], row["seed"]): row["value"]
            for row in csv.DictReader(file)
        }
    assert rows["Hopper", "td3", "score", "0"] == "3135.00"
    assert rows["Hopper", "td3", "score", "1"] == "0.00"
    assert rows["Hopper", "td3", "mean", ""] == "1567.50"
    assert rows["Hopper", "td3", "std", ""] == f"{3135 / 2**0.5:.2f}"
    assert rows["Hopper", "td3", "ratio_to_cleanrl", ""] == "0.5000"
    assert rows["Hopper", "td3", "env_steps", ""] == "6000"
    assert float(rows["", "td3", "iqm", ""]) == pytest.approx((1567.5 - 17.7) / (2326 - 17.7), 1e-3)
    assert ("", "sac", "iqm", "") not in rows  # in progress
    published = (tmp_path / "baselines.md").read_text()
    assert "| Hopper | TD3 | 1,568 | 0.50 | 3,135 | 3,472 | 3,606 | 6,000 |" in published


MANY = ["sacformer", *(f"change-{letter}" for letter in "abcdefg")]
MANY_RUNS = {
    f"{task}-{variant}": [
        returns_for(task, 0.0, 0.1 * place), returns_for(task, 0.0, 0.1 * place + 0.02)
    ]
    for place, variant in enumerate(MANY) for task in ("Hopper", "Walker2d")
}  # fmt: skip


def test_many_variants_have_a_row_each(tmp_path: Path) -> None:
    study = read(tmp_path / "ablations.csv", MANY_RUNS, agent="sacformer")
    assert study.baseline() == "sacformer"
    figure = grid_figure(study, "sacformer")
    rows = np.array(figure.axes).reshape(7, 3)
    assert [row[0].get_ylabel() for row in rows] == MANY[1:]
    assert [axes.get_title() for axes in rows[0]][::2] == ["Hopper, return", "IQM over tasks"]
    for place, row in enumerate(rows, 1):
        expected = returns_for("Walker2d", 0.1 * place + 0.01)
        assert line_of(row[1], MANY[place])[1][1] == pytest.approx(expected[0])
        assert line_of(row[2], MANY[place])[1][1] == pytest.approx(0.1 * place + 0.01)
        assert line_of(row[2], "SACFormer")[1][1] == pytest.approx(0.01)


def test_many_variants_on_many_tasks_leave_room_for_each_other(tmp_path: Path) -> None:
    long = ["sacformer", "sac", *(f"a-change-with-a-long-name-{letter}" for letter in "abcdefg")]
    study = read(tmp_path / "study.csv", {
        f"{task}-{variant}": [returns_for(task, 0.0, 0.5), returns_for(task, 0.1, 0.6)]
        for task in REFERENCE_RETURNS for variant in long
        if (task, variant) != ("Ant", "sacformer")
    })  # fmt: skip
    with figures.matplotlib.rc_context(figures.FONTS):
        figure = grid_figure(study, "sac")
        figures.FigureCanvasAgg(figure).draw()
    texts = [axes.title for axes in figure.axes] + [axes.xaxis.label for axes in figure.axes]
    boxes = [text.get_window_extent() for text in texts if text.get_text()]
    assert len(boxes) == len(REFERENCE_RETURNS) + 1 + 1  # titles, the average's, one of the axes
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.x1 for box in boxes)
    assert caption_of(figure).endswith("Empty panels: not begun.")


def test_intervals_are_sorted(tmp_path: Path) -> None:
    study = read(tmp_path / "ablations.csv", MANY_RUNS, agent="sacformer")
    figure = intervals_figure(study, aggregates(study, "sacformer"), "sacformer")
    left, right = figure.axes
    assert [tick.get_text() for tick in left.get_yticklabels()] == [*MANY[:0:-1], "SACFormer"]
    best = [line.get_xdata() for line in left.lines if line.get_ydata()[0] == 0]
    score = [0.35, 0.36]  # two evaluations are the whole score
    assert list(best[0]) == pytest.approx(score)
    assert list(best[1]) == pytest.approx([np.mean(score)])
    points = [line.get_xdata()[0] for line in right.lines if line.get_marker() == "o"]
    assert points == [1.0] * 7


def test_the_caption_tells_which_tasks_are_compared(tmp_path: Path) -> None:
    both = [returns_for("Hopper", 0.5), returns_for("Hopper", 0.6)]
    other = [returns_for("Walker2d", 0.5), returns_for("Walker2d", 0.6)]
    runs = {f"Hopper-{name}": both for name in MANY}
    runs |= {f"Walker2d-{name}": other for name in MANY if name != "sacformer"}
    study = read(tmp_path / "ablations.csv", runs, agent="sacformer")
    caption = caption_of(intervals_figure(study, aggregates(study, "sacformer"), "sacformer"))
    assert "no worse than SACFormer. " in caption  # it is not shown, so nothing is hollow
    assert caption.count(": on Hopper only.") == 1
    assert "Left out, not finished: SACFormer." in caption


def test_files_are_the_same_every_time_and_made_without_jax(tmp_path: Path) -> None:
    runs = {f"Hopper-K={length}": [[1, 2], [length, 3], [4, length]] for length in range(6)}
    first, again = tmp_path / "first", tmp_path / "again"
    for folder in (first, again):
        folder.mkdir()
        write(folder / "lengths.csv", runs, agent="sacformer")
    paths = figures.draw(first / "lengths.csv")
    program = (
        "import sys, figures; "
        "code = figures.main(['--results', sys.argv[1]]); "
        "sys.exit(code or 'jax' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program, again], cwd=EXPERIMENTS, check=True)
    names = {path.name for path in paths}
    assert names == {f"lengths{end}" for end in (
        ".png", ".svg", ".md", "-scores.csv", "-scores.png", "-scores.svg"
    )}  # fmt: skip
    assert {path.name for path in again.iterdir()} == {*names, "lengths.csv"}
    for path in paths:
        assert path.read_bytes() == (again / path.name).read_bytes(), path.name


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("variant", ["", "-of-which-much-is-to-be-said", "-very-long" * 7])
def test_captions_and_legends_lie_within_the_page(tmp_path: Path, seeds: int, variant: str) -> None:
    tasks = ("HalfCheetah", "Hopper", "Walker2d", "Ant")
    runs = {f"{task}-{agent}{variant}": [[1, 2]] * seeds for agent in AGENTS for task in tasks}
    del runs[f"Ant-ddpg{variant}"]
    study = read(tmp_path / "figure2-full.csv", runs)
    with figures.matplotlib.rc_context(figures.FONTS):
        figure = panels_figure(study)
        figures.FigureCanvasAgg(figure).draw()
        (caption,) = figure.texts
        boxes = [caption.get_window_extent(), figure.legends[0].get_window_extent()]
        boxes += [axes.get_tightbbox() for axes in figure.axes]
        for box in boxes:
            assert box.x0 >= 0
            assert box.x1 <= figure.bbox.width
            assert box.y0 >= 0
        assert boxes[0].y1 <= boxes[1].y0
        assert all(boxes[1].y1 <= box.y0 for box in boxes[2:])


def test_the_last_bits_of_the_layout_do_not_matter() -> None:
    """The layout's solver differs in them from time to time; names in an SVG are made of places."""
    places = []
    for jitter in (0.0, 3e-13):
        study = read_study(EXPERIMENTS / "results" / "figure2-cpu.csv")
        assert study is not None
        figure = panels_figure(study)
        layout = figure.get_layout_engine().execute

        def execute(drawn: Figure, layout=layout, jitter: float = jitter) -> None:
            layout(drawn)
            for axes in drawn.axes:
                x, y, width, height = axes.get_position().bounds
                axes.set_position([x + jitter, y, width + jitter, height])

        figure.get_layout_engine().execute = execute
        figures._settle(figure)
        figure.draw_without_rendering()
        places.append([tuple(axes.get_position().bounds) for axes in figure.axes])
    assert places[0] == places[1]


def lightness(style: Style) -> float:
    """L* of CIELAB, from 0 (black) to 100 (white)."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
              for c in to_rgb(style.color)]  # fmt: skip
    luminance = float(np.dot(linear, [0.2126, 0.7152, 0.0722]))
    return 116 * luminance ** (1 / 3) - 16 if luminance > 0.008856 else 903.3 * luminance


@pytest.mark.parametrize("variants", [
    list(AGENTS), ["K=1", "K=2", "K=5", "K=10", "K=15", "K=20"], ["sacformer", *"abcde"],
    ["sac", "a"], ["a"], ["sacformer", "sac", "a"], ["sacformer", "sac", *"abcd"],
])  # fmt: skip
def test_lines_can_be_told_apart_without_colour(variants: list[str]) -> None:
    styles = styles_of(variants)
    assert styles.keys() == set(variants)
    for one, other in itertools.combinations(styles.values(), 2):
        assert one.dashes != other.dashes
        assert one.marker != other.marker
        assert abs(lightness(one) - lightness(other)) > 6
    assert all(lightness(style) < 80 for style in styles.values())  # prints on white


def test_an_agent_looks_the_same_in_every_figure() -> None:
    assert styles_of(["sac", "a"])["sac"] == styles_of(["ppo", "sac"])["sac"] == AGENTS["sac"]
    with pytest.raises(ValueError, match="7 lines"):
        styles_of(list("abcdefg"))


def test_a_table_of_separate_seeds() -> None:
    study = read_study(EXPERIMENTS / "results" / "variants.csv")
    assert study is not None
    assert all(line.seeds == [0, 1] for line in study.lines.values())
    assert all(study.finished(*key) for key in study.lines)
    assert len(study.lines) == 15 * 2


def test_variants_of_numbers_are_in_their_order(tmp_path: Path) -> None:
    runs = {f"Humanoid-K={length}": [[1.0]] for length in (5, 10, 15, 1, 2, 20)}
    study = read(tmp_path / "figure3.csv", runs, agent="sacformer")
    assert study.variants == ["K=1", "K=2", "K=5", "K=10", "K=15", "K=20"]
    assert study.baseline() == "K=10"


def test_agents_are_in_the_same_order_everywhere(tmp_path: Path) -> None:
    runs = {f"Hopper-{agent}": [[1.0]] for agent in ("ppo", "td3", "ddpg", "sac")}
    assert read(tmp_path / "baselines.csv", runs).variants == ["sac", "td3", "ddpg", "ppo"]


def test_tasks_without_a_scale_have_no_average(tmp_path: Path) -> None:
    runs = {"brax:ant-sac": [[1], [2]], "tiny-sac": [[3], [4]], "tiny-td3": [[5], [6]]}
    study = read(tmp_path / "tiny.csv", runs)
    assert list(panels(panels_figure(study))) == ["brax:ant", "tiny"]
    made = aggregates(study, "sac")
    assert [one.iqm for one in made] == [None, None]
    assert "| TD3 | – | – | 1.00 [1.00, 1.00] on tiny only |" in markdown(study, made, "sac")
    # A difference is of tasks with a scale, a probability of all.
    both = read(tmp_path / "mixed.csv", runs | {"Hopper-sac": [[1], [2]], "Hopper-td3": [[3], [4]]})
    made = aggregates(both, "sac")
    rows = [line for line in markdown(both, made, "sac").splitlines() if "| TD3 |" in line]
    difference, improvement = rows[-1].split(" | ")[2:]
    assert difference.endswith("]")
    assert improvement == "1.00 [1.00, 1.00] on Hopper, tiny only |"


def test_studies_together_are_as_one_of_all_their_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "TOGETHER", {"both": ("one", "two")})
    of = {
        "one": {"Hopper-sac": (0.1, 0.2, 0.3, 0.4), "Hopper-x": (0.5, 0.6, 0.7, 0.8)},
        "two": {"Hopper-sac": (0.0, 0.1, 0.2, 0.3), "Hopper-x": (0.1, 0.2, 0.4, 0.9),
                "Hopper-y": (0.0, 0.0, 0.0, 0.0)},
    }  # fmt: skip
    for name, runs in of.items():
        lines = {run: [[r] for r in returns_for("Hopper", *of_run)] for run, of_run in runs.items()}
        write(tmp_path / f"{name}.csv", lines)
        if name == "one":
            figures.draw(tmp_path / "one.csv")
            assert not (tmp_path / "both.md").exists()
    assert tmp_path / "both.md" in figures.draw(tmp_path / "two.csv")
    text = (tmp_path / "both.md").read_text()
    # Of SAC's eight scores the middle four are .1 .2 .2 .3, of the other's .4 .5 .6 .7.
    assert "| SAC | 0.20 [" in text
    assert "| x | 0.55 [" in text
    assert "] | 0.35 [" in text
    # Better in 16 of 16 pairs, and in 11 and two halves of 16.
    assert f"] | {(1 + 12 / 16) / 2:.2f} [" in text
    assert "| y |" not in text
    assert "one: Hopper; two: Hopper" in text
    # Nothing where a study lacks what it is compared with.
    (tmp_path / "both.md").unlink()
    assert tmp_path / "both.md" not in figures.draw(tmp_path / "two.csv", "y")


def test_tables_without_rows_and_strange_arguments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = write(tmp_path / "empty.csv", {})
    assert figures.draw(empty) == []
    table = write(tmp_path / "some.csv", {"Hopper-sac": [[1]]})
    (tmp_path / "some-scores.csv").write_text("study,task,variant\n")
    with pytest.raises(ValueError, match=r"'td3': some\.csv has sac"):
        figures.draw(table, baseline="td3")
    for arguments in (["none"], ["some", "--baseline", "td3"], ["some-scores"]):
        with pytest.raises(SystemExit) as refused:
            figures.main([*arguments, "--results", str(tmp_path)])
        assert refused.value.code == 2
    assert "there are empty, some\n" in capsys.readouterr().err
