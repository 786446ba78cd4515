"""What the programs of the peers have in common: what is asked of them, and how they answer.

One JSON object a line; other lines, which libraries print, are skipped. A program gets the
:class:`Setting` as its first argument, sets itself up, trains until nothing is left to compile, and
says on standard output what it is::

    {"versions": {"jax": "0.10.2"}, "parameters": 217870}

For every ``{"do": "stretch"}`` on standard input it then trains on for a stretch and answers::

    {"env_steps": 500, "updates": 500, "seconds": 1.6}

Between stretches it waits and uses no core. It ends when its standard input is closed.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from importlib.metadata import version
from typing import Any

STRETCH = {"do": "stretch"}


@dataclasses.dataclass(frozen=True)
class Setting:
    """What every peer trains; the networks are MLPs, and all of it is float32.

    Attributes:
      agent: the algorithm: sac, td3, ddpg or ppo.
      env: the MuJoCo task, as named here and, with ``-v5``, by Gymnasium.
      stretch_steps: environment steps of a stretch.
      cores: threads a library may use, if it asks.
      hidden_layers: of the actor and of each critic.
      activation: after each of them, ``relu`` or ``tanh``.
      updates_per_env_step: of agents with a replay, as is all up to ``tau``.
      learning_starts: environment steps before the first update.
      buffer_capacity: environment steps the replay holds.
      action_noise: of TD3 and DDPG in acting, over half the action range.
      policy_delay: TD3's updates of the critics to one of the actor and of the targets.
      rollout_steps: PPO's of each environment between two rounds; what follows is PPO's, too.
      epochs: passes over a rollout.
      minibatches: parts of a pass, an update each.
    """

    agent: str
    env: str
    stretch_steps: int
    cores: int
    num_envs: int = 1
    hidden_layers: tuple[int, ...] = (256, 256)
    activation: str = "relu"
    max_episode_steps: int = 1_000
    learning_rate: float = 3e-4
    discount: float = 0.99
    seed: int = 0
    updates_per_env_step: int = 1
    batch_size: int = 256
    learning_starts: int = 1_000
    buffer_capacity: int = 1_000_000
    tau: float = 0.005
    action_noise: float = 0.1
    policy_delay: int = 2
    target_noise: float = 0.2
    target_noise_clip: float = 0.5
    rollout_steps: int = 2_048
    epochs: int = 10
    minibatches: int = 32
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    value_coefficient: float = 0.5
    max_grad_norm: float = 0.5

    @property
    def minibatch_size(self) -> int:
        """Samples of an update of PPO."""
        return self.num_envs * self.rollout_steps // self.minibatches

    def to_json(self) -> str:
        """As a program gets it."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Setting:
        """Inverse of :meth:`to_json`."""
        values = json.loads(text)
        return cls(**values | {"hidden_layers": tuple(values["hidden_layers"])})


class Conversation:
    """A program's end of it."""

    def ready(self, *libraries: str, parameters: int) -> None:
        """Everything is compiled and warm.

        Args:
          *libraries: names of the installed packages whose versions matter, the peer's own first.
          parameters: numbers in the actor and in the critics, targets not counted.
        """
        versions = {name: version(name) for name in libraries}
        self._say({"versions": versions, "parameters": parameters})

    def wanted(self) -> bool:
        """Waits until another stretch is wanted; False if none will be any more."""
        line = sys.stdin.readline()
        return bool(line) and json.loads(line) == STRETCH

    def report(self, env_steps: int, updates: int, seconds: float) -> None:
        """What a stretch did and the time it took."""
        self._say({"env_steps": env_steps, "updates": updates, "seconds": seconds})

    def _say(self, answer: dict[str, Any]) -> None:
        print(json.dumps(answer), flush=True)


class Session(Conversation):
    """Of the program of a peer, which is told a setting."""

    def __init__(self) -> None:
        self.setting = Setting.from_json(sys.argv[1])
