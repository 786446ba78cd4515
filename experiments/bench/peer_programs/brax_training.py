"""brax.training on our task as a ``brax.envs.Env``.

Its ``train`` is one call that alternates epochs of training with evaluations, so a stretch is an
epoch, by brax's own timing of it (it waits for the results and leaves the evaluation out), and the
program waits for the next one where brax reports its progress. The evaluation is one episode.
"""

from __future__ import annotations

import functools
import inspect
import sys
from typing import Any

import jax
from brax.training.agents.sac import networks as sac_networks
from brax.training.agents.sac import train as sac

from bench.peer_programs.protocol import Session
from sacformer_jax.envs import make_env
from sacformer_jax.envs.brax_view import as_brax

MOST_STRETCHES = 1_000
WARM_EPOCHS = 2  # the first one compiles


def train_sac(session: Session) -> None:
    """Trains until no more stretches are wanted, then leaves by ``SystemExit``."""
    setting = session.setting
    epochs = 0
    done: dict[str, int] = {}  # counts at the last report

    def progress(env_steps: int, metrics: dict[str, Any]) -> None:
        nonlocal epochs
        # Brax counts updates but does not report them: they are looked up in its `train`.
        frame = inspect.currentframe()
        assert frame is not None
        assert frame.f_back is not None
        state = frame.f_back.f_locals["training_state"]
        updates = state.gradient_steps.to_numpy().item()  # a leading axis of one device
        if epochs == WARM_EPOCHS:
            networks = (state.policy_params, state.q_params)
            parameters = sum(leaf.size for leaf in jax.tree.leaves(networks))
            session.ready("brax", "jax", parameters=parameters)
        elif epochs > WARM_EPOCHS:
            steps = env_steps - done["env_steps"]
            seconds = steps / metrics["training/sps"]
            session.report(steps, updates - done["updates"], seconds)
        if epochs >= WARM_EPOCHS and not session.wanted():
            sys.exit()
        done.update(env_steps=env_steps, updates=updates)
        epochs += 1

    sac.train(
        as_brax(make_env(setting.env, "native")),
        num_timesteps=setting.learning_starts + MOST_STRETCHES * setting.stretch_steps,
        num_evals=MOST_STRETCHES + 1,
        episode_length=setting.max_episode_steps,
        num_envs=setting.num_envs,
        num_eval_envs=1,
        learning_rate=setting.learning_rate,
        discounting=setting.discount,
        tau=setting.tau,
        seed=setting.seed,
        batch_size=setting.batch_size,
        min_replay_size=setting.learning_starts,
        max_replay_size=setting.buffer_capacity,
        grad_updates_per_step=setting.updates_per_env_step * setting.num_envs,
        network_factory=functools.partial(
            sac_networks.make_sac_networks, hidden_layer_sizes=setting.hidden_layers
        ),
        progress_fn=progress,
    )


AGENTS = {"sac": train_sac}


def main() -> None:
    """Trains the agent asked for."""
    session = Session()
    AGENTS[session.setting.agent](session)


if __name__ == "__main__":
    main()
