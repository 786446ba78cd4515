"""Part `compile`: what a start costs, with JAX's persistent compilation cache empty and filled.

Each start is a process of its own, since a compiled program stays in memory for as long as its
process lives. It traces, lowers and compiles what `sacformer train` does before and between its
chunks, and runs `init` and `prefill` on the way, so that a whole start can be told too.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax

from bench.child import answer_of
from bench.clock import Clock
from sacformer_jax import Config, make_program
from sacformer_jax.envs import VectorEnv
from sacformer_jax.evaluate import make_evaluator
from sacformer_jax.train import policy_of

CASES = {"main_job": ("compile", "cpu"), "paper": ("compile.paper", "paper")}
"""What `make train` runs, and the paper's settings: prefix of the functions' keys, and preset."""
STARTS = ("cold", "cached")
FUNCTIONS = ("init", "prefill", "train_chunk", "evaluate")
LIMIT_SECONDS = 300.0


def measure(clock: Clock) -> dict[str, float]:
    """All cases, the first start with an empty cache (``cold``) and the second (``cached``).

    ``compile.CASE.cold_s`` is what tracing, lowering and compiling all functions takes, in seconds;
    ``compile.CASE.start_cold_s`` the time from starting Python until the first chunk could run;
    ``compile.FUNCTION.cold_s`` and ``compile.paper.FUNCTION.cold_s`` are the single functions, and
    ``.from_cache`` is 1 where the second start found the function in the cache, else 0.
    """
    del clock  # seconds of other processes
    results: dict[str, float] = {}
    for case, (prefix, preset) in CASES.items():
        with tempfile.TemporaryDirectory() as cache:
            for start in STARTS:
                print(f"starting {case}, {start} …", file=sys.stderr, flush=True)
                begun = time.perf_counter()
                answer = start_once(preset, Path(cache))
                results[f"compile.{case}.start_{start}_s"] = time.perf_counter() - begun
                seconds: dict[str, float] = answer["seconds"]
                results[f"compile.{case}.{start}_s"] = sum(seconds.values())
                for function in FUNCTIONS:
                    results[f"{prefix}.{function}.{start}_s"] = seconds[function]
        for function in FUNCTIONS:
            results[f"{prefix}.{function}.from_cache"] = float(answer["from_cache"][function])
    return results


def start_once(preset: str, cache: Path) -> dict[str, dict[str, float]]:
    """One start in a fresh process, with JAX's persistent cache in the folder ``cache``.

    Returns:
      ``seconds`` and ``from_cache`` by function.

    Raises:
      RuntimeError: the process failed.
      subprocess.TimeoutExpired: it took longer than ``LIMIT_SECONDS``.
    """
    answer: dict[str, dict[str, float]] = answer_of(
        "bench.compiling",
        preset,
        limit_seconds=LIMIT_SECONDS,
        environment={
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            # Everything is to be cached, however small and quickly compiled.
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        },
    )
    return answer


class Compilations:
    """Compiles functions, and keeps what each took and whether it came from the cache."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.from_cache: dict[str, float] = {}
        self._hits = 0
        jax.monitoring.register_event_listener(self._on_event)

    def _on_event(self, event: str, **_: Any) -> None:
        self._hits += event == "/jax/compilation_cache/cache_hits"

    def compile(self, name: str, function: Any, *arguments: Any) -> Any:
        """The compiled function: an ahead-of-time one, which never compiles again."""
        start = time.perf_counter()
        lowered = function.lower(*arguments)
        hits = self._hits  # from here on, a hit is that of this very compilation
        compiled = lowered.compile()
        self.seconds[name] = time.perf_counter() - start
        self.from_cache[name] = self._hits - hits
        return compiled


def compile_all(config: Config) -> Compilations:
    """Compiles what a run of this configuration needs, as :mod:`sacformer_jax.runner` does."""
    compilations = Compilations()
    program = make_program(config)
    key = jax.random.key(config.seed)
    state = compilations.compile("init", program.init, key)(key)
    prefill = compilations.compile("prefill", program.prefill, state)
    state, _ = jax.block_until_ready(prefill(state))
    compilations.compile("train_chunk", program.train_chunk, state)
    env = VectorEnv(program.env.env, config.run.eval_episodes, config.task.max_episode_steps)
    evaluator = make_evaluator(env, program.agent, config.context.context_length)
    compilations.compile("evaluate", evaluator, policy_of(state), key)
    return compilations


def main() -> None:
    """The child process: compiles for the preset named in its argument, prints an answer."""
    config = Config.from_preset(sys.argv[1], env="HalfCheetah", engine="native")
    compilations = compile_all(config)
    answer = {"seconds": compilations.seconds, "from_cache": compilations.from_cache}
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
