"""Part `peer`: training with other libraries on the same task, network, batch and updates per step.

Every peer is a process of its own (see peer_programs/protocol.py), most in a virtual environment
of their own, which is made once under :data:`VENVS`. All are started and warmed up first; then they
train in rounds, a stretch each in turn, while the others wait. A peer that cannot be set up or
fails is left out, and its error is its result.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bench.clock import Clock
from bench.peer_programs.host import Answer, PeerError, Program, ensure_venv, tell
from bench.peer_programs.protocol import Setting
from sacformer_jax.cores import usable_cores

ROOT = Path(__file__).resolve().parents[2]
VENVS = ROOT / ".venv-peers"
ENVIRONMENT = {"PYTHONPATH": str(ROOT / "experiments"), "JAX_PLATFORMS": "cpu"}
ENV = "HalfCheetah"
LIMIT_SECONDS = 240.0


def _as_here(*packages: str) -> tuple[str, ...]:
    return tuple(f"{package}=={version(package.split('[')[0])}" for package in packages)


def requirements() -> dict[str, tuple[str, ...]]:
    """What pip installs into each virtual environment.

    Physics is the one here, and so is JAX where the peer runs on it. brax 0.14.2's SAC calls
    ``jax.device_put_replicated``, which JAX 0.10.0 removed: it gets the last release before and
    the last Flax that runs there. Torch is used on the CPU only; a build without CUDA will do.
    """
    task = _as_here("gymnasium[mujoco]", "mujoco")
    ours = ("--editable", str(ROOT), *_as_here("mujoco-mjx", "brax"))
    plain = _as_here("optax", "numpy")
    current_jax = (*_as_here("jax", "jaxlib", "flax"), *plain)
    return {
        "stable_baselines": (
            "sbx-rl==0.28.0",
            "stable-baselines3==2.9.2",
            "torch==2.13.0",
            *current_jax,
            *task,
        ),
        "brax": ("jax==0.9.2", "jaxlib==0.9.2", "flax==0.12.6", *plain, *task, *ours),
        "rejax": ("rejax==0.1.3", *current_jax, *task, *ours),
    }


@dataclasses.dataclass(frozen=True)
class Peer:
    """A library and how it is run.

    Attributes:
      module: its program, in bench.peer_programs.
      venv: key of :func:`requirements`, or None for the Python that runs this.
      arguments: of the program, after the setting.
    """

    module: str
    venv: str | None
    arguments: tuple[str, ...] = ()

    def start(self, setting: Setting) -> Program:
        """Starts its program, its environment set up if need be.

        Raises:
          PeerError: the environment cannot be made.
        """
        python = sys.executable
        if self.venv is not None:
            python = str(ensure_venv(VENVS / self.venv, requirements()[self.venv]))
        module = f"bench.peer_programs.{self.module}"
        command = [python, "-m", module, setting.to_json(), *self.arguments]
        return Program(command, ENVIRONMENT, LIMIT_SECONDS)


PEERS: dict[str, Peer] = {
    "sbx": Peer("stable_baselines", "stable_baselines", ("sbx",)),
    "sb3": Peer("stable_baselines", "stable_baselines", ("sb3",)),
    "brax": Peer("brax_training", "brax"),
    "rejax": Peer("rejax_algorithms", "rejax"),
    "ours": Peer("ours", None),
}


@dataclasses.dataclass(frozen=True)
class Case:
    """An agent, at our preset `paper` or with more environments, and who else has it.

    Attributes:
      agent: the algorithm.
      peers: keys of :data:`PEERS`, besides ours.
      rounds: stretches of each.
      stretch_steps: environment steps of one; of PPO whole rollouts.
      fields: of the setting, other than its defaults.
    """

    agent: str
    peers: tuple[str, ...]
    rounds: int
    stretch_steps: int = 500
    fields: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def setting(self) -> Setting:
        """What its programs are told."""
        return Setting(self.agent, ENV, self.stretch_steps, usable_cores(), **self.fields)


PPO = {"hidden_layers": (64, 64), "activation": "tanh", "learning_starts": 0}

CASES: dict[str, Case] = {
    "sac": Case("sac", ("sbx", "sb3", "brax", "rejax"), rounds=9),
    "td3": Case("td3", ("sbx", "sb3", "rejax"), rounds=7),
    "ddpg": Case("ddpg", ("sbx", "sb3"), rounds=7),
    "ppo": Case("ppo", ("sbx", "sb3", "brax", "rejax"), 7, 2 * 2_048, PPO),
    "ppo64": Case(
        "ppo",
        ("sbx", "sb3", "brax", "rejax"),
        7,
        2 * 64 * 128,
        {**PPO, "num_envs": 64, "rollout_steps": 128},
    ),
}
"""By the name in the keys. JAX peers are made for many environments, hence ``ppo64``: 64 of them
make 128 steps each, and the 32 minibatches are of 256 samples instead of 64."""

Start = Callable[[], Program]


def measure(clock: Clock) -> dict[str, float | str]:
    """All cases by flat keys ``peer.CASE.NAME.WHAT``.

    ``steps_per_s`` is the median over the stretches, in environment steps per second of training;
    ``steps_per_s_min`` and ``_max`` are the slowest and the fastest stretch;
    ``updates_per_env_step`` and ``parameters`` (of actor and critics) show that they do the same
    work; ``version`` is the library's and ``jax_version``, ``torch_version`` are those below it.
    """
    del clock  # steps per second of programs that take turns: their ratios are what holds
    results: dict[str, float | str] = {}
    for name, case in CASES.items():
        setting = case.setting()
        starts = {peer: partial(PEERS[peer].start, setting) for peer in (*case.peers, "ours")}
        results |= compare(starts, f"peer.{name}", case.rounds)
    return results


def compare(
    starts: Mapping[str, Start], prefix: str, rounds: int, ours: str = "ours"
) -> dict[str, float | str]:
    """Starts all programs, lets them train in rounds, stops them; see :func:`measure`.

    Args:
      starts: starts a program, by name.
      prefix: of the keys.
      rounds: stretches of each.
      ours: the name of the one that is compared with the fastest other.
    """
    programs: dict[str, Program] = {}
    facts: dict[str, Answer] = {}
    stretches: dict[str, list[Answer]] = {}
    results: dict[str, float | str] = {}

    def failed(name: str, error: Exception) -> None:
        tell(f"{prefix}.{name}: {error}")
        results[f"{prefix}.{name}.error"] = str(error)
        facts.pop(name, None)
        if name in programs:
            programs.pop(name).stop()

    try:
        for name, start in starts.items():
            tell(f"{prefix}.{name}: starting …")
            try:
                programs[name] = start()
                facts[name] = programs[name].answer()
                stretches[name] = []
            except (PeerError, OSError) as error:
                failed(name, error)
        for number in range(rounds):
            for name in list(programs):
                try:
                    stretches[name].append(programs[name].stretch())
                except PeerError as error:
                    failed(name, error)
            rates = {name: round(_rates(stretches[name])[-1]) for name in programs}
            tell(f"{prefix}: round {number + 1} of {rounds}, steps per second: {rates}")
    finally:
        for program in programs.values():
            program.stop()
    for name in facts:
        summary = {**_summary(facts[name]), **_speed(stretches[name])}
        results |= {f"{prefix}.{name}.{what}": value for what, value in summary.items()}
    return results | _comparison({name: stretches[name] for name in facts}, prefix, ours)


def _rates(stretches: list[Answer]) -> list[float]:
    return [answer["env_steps"] / answer["seconds"] for answer in stretches]


def _summary(facts: Answer) -> dict[str, float | str]:
    """What a program says of itself, by the names in the keys."""
    (_, own), *below = facts["versions"].items()
    versions = {f"{name.replace('-', '_')}_version": number for name, number in below}
    return {"version": own, **versions, "parameters": facts["parameters"]}


def _speed(stretches: list[Answer]) -> dict[str, float]:
    rates = _rates(stretches)
    updates = sum(answer["updates"] for answer in stretches)
    return {
        "steps_per_s": statistics.median(rates),
        "steps_per_s_min": min(rates),
        "steps_per_s_max": max(rates),
        "updates_per_env_step": updates / sum(answer["env_steps"] for answer in stretches),
    }


def _comparison(
    stretches: dict[str, list[Answer]], prefix: str, ours: str
) -> dict[str, float | str]:
    """Ours over the fastest peer, if there is one to compare with."""
    rates = {name: _rates(answers) for name, answers in stretches.items()}
    own = rates.pop(ours, None)
    if own is None or not rates:
        return {}
    medians = {name: statistics.median(of_one) for name, of_one in rates.items()}
    fastest = max(medians, key=lambda name: medians[name])
    # Round by round: what slows the machine down for a while slows both.
    by_round = [mine / theirs for mine, theirs in zip(own, rates[fastest], strict=True)]
    return {
        f"{prefix}.fastest_peer": fastest,
        f"{prefix}.{ours}_over_fastest": statistics.median(by_round),
    }
