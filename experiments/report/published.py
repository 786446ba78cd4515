"""Returns at 1 M env steps that others published, of earlier versions of the tasks."""

from __future__ import annotations

_TASKS = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid")


def _by_task(*returns: float | None) -> dict[str, float]:
    pairs = zip(_TASKS, returns, strict=True)
    return {task: float(value) for task, value in pairs if value is not None}


CLEANRL, TIANSHOU, ZOO = "CleanRL (v4)", "Tianshou (v3)", "SB3 zoo (v3)"
PUBLISHED = {
    CLEANRL: {
        "sac": _by_task(9635, 2310, 3591, None, 4996),
        "td3": _by_task(9583, 3135, 4058, None, 5035),
        "ddpg": _by_task(10374, 1577, 1240, None, 1700),
        "ppo": _by_task(1443, 2383, 2288, None, 716),
    },
    TIANSHOU: {
        "sac": _by_task(12139, 3542, 5007, 5850, 5489),
        "td3": _by_task(10201, 3472, 3982, 5116, 5190),
        "ddpg": _by_task(11719, 2197, 1401, 990, 177),
        "ppo": _by_task(5784, 2609, 3589, 3258, 787),
    },
    ZOO: {
        "sac": _by_task(9535, 2326, 3863, 4616, 6232),
        "td3": _by_task(9656, 3606, 4718, 5813, 5567),
        "ppo": _by_task(5819, 2410, 3479, 1327, None),
    },
}
"""By source, agent and task."""
ABOUT = (
    "CleanRL: 3 seeds, returns of training episodes; Tianshou: 10 seeds, the best within 1 M; "
    "Stable-Baselines3 zoo: one run, of 2 M steps on Humanoid."
)


def ratio_to_cleanrl(task: str, agent: str, score: float) -> float | None:
    """The score over CleanRL's return; None where CleanRL has none."""
    published = PUBLISHED[CLEANRL].get(agent, {}).get(task)
    return None if published is None else score / published
