"""brax.training on our task as a ``brax.envs.Env``; it has SAC and PPO, and neither TD3 nor DDPG.

Its ``train`` is one call that goes through epochs, so a stretch is an epoch, by brax's own timing
of it (it waits for the results, and leaves out the evaluations between SAC's), and the program
waits for the next one where brax reports its progress. SAC's evaluation is one episode; PPO does
without.

What is not the same as here: a sample of PPO's minibatches is a piece of :data:`UNROLL_STEPS` steps
in a row, within which advantages are estimated, anew at every update by the newest values. The
number of environment steps in a minibatch, of updates and of passes over every step is the same.
Rewards are not normalized.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable
from typing import Any

import jax
import optax
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo
from brax.training.agents.sac import networks as sac_networks
from brax.training.agents.sac import train as sac

from bench.peer_programs.protocol import Session, Setting
from sacformer_jax.envs import make_env
from sacformer_jax.envs.brax_view import as_brax

MOST_STRETCHES = 1_000
WARM_EPOCHS = 2  # the first one compiles
UNROLL_STEPS = 16
"""About as far as λ = 0.95 and γ = 0.99 look: 1 / (1 - λγ) is 17."""


class Progress:
    """What brax reports to: tells of each epoch, and ends the process when no more are wanted.

    Args:
      session: the conversation.
      updates: gradient updates, of brax's training state.
      networks: parameters of actor and critics, of the same.
    """

    def __init__(
        self, session: Session, updates: Callable[[Any], int], networks: Callable[[Any], Any]
    ):
        self._session, self._updates, self._networks = session, updates, networks
        self._epochs = 0
        self._done = {"env_steps": 0, "updates": 0}  # at the last report

    def __call__(self, env_steps: int, metrics: dict[str, Any]) -> None:
        """An epoch is over; leaves by ``SystemExit``."""
        # Brax counts updates but does not report them: they are looked up in its `train`.
        frame = inspect.currentframe()
        assert frame is not None
        assert frame.f_back is not None
        state = frame.f_back.f_locals["training_state"]
        updates = self._updates(state)
        if self._epochs == WARM_EPOCHS:
            leaves = jax.tree.leaves(self._networks(state))
            self._session.ready("brax", "jax", parameters=sum(leaf.size for leaf in leaves))
        elif self._epochs > WARM_EPOCHS:
            steps = env_steps - self._done["env_steps"]
            seconds = steps / metrics["training/sps"]
            self._session.report(steps, updates - self._done["updates"], seconds)
        if self._epochs >= WARM_EPOCHS and not self._session.wanted():
            sys.exit()
        self._done.update(env_steps=env_steps, updates=updates)
        self._epochs += 1


def train_sac(session: Session) -> None:
    """Trains until no more stretches are wanted, then leaves by ``SystemExit``."""
    setting = session.setting
    sac.train(
        **_common(setting),
        num_timesteps=setting.learning_starts + MOST_STRETCHES * setting.stretch_steps,
        tau=setting.tau,
        batch_size=setting.batch_size,
        min_replay_size=setting.learning_starts,
        max_replay_size=setting.buffer_capacity,
        grad_updates_per_step=setting.updates_per_env_step * setting.num_envs,
        network_factory=functools.partial(
            sac_networks.make_sac_networks, hidden_layer_sizes=setting.hidden_layers
        ),
        progress_fn=Progress(
            session,
            # A leading axis of one device.
            updates=lambda state: state.gradient_steps.to_numpy().item(),
            networks=lambda state: (state.policy_params, state.q_params),
        ),
    )


def train_ppo(session: Session) -> None:
    """The same with PPO."""
    setting = session.setting
    ppo.train(
        **_common(setting),
        num_timesteps=MOST_STRETCHES * setting.stretch_steps,
        run_evals=False,
        unroll_length=UNROLL_STEPS,
        batch_size=setting.minibatch_size // UNROLL_STEPS,
        num_minibatches=setting.minibatches,
        num_updates_per_batch=setting.epochs,
        normalize_observations=True,
        entropy_cost=0.0,
        gae_lambda=setting.gae_lambda,
        clipping_epsilon=setting.clip_range,
        clipping_epsilon_value=setting.clip_range,
        vf_loss_coefficient=setting.value_coefficient,
        max_grad_norm=setting.max_grad_norm,
        network_factory=functools.partial(
            ppo_networks.make_ppo_networks,
            policy_hidden_layer_sizes=setting.hidden_layers,
            value_hidden_layer_sizes=setting.hidden_layers,
            activation=getattr(jax.nn, setting.activation),
            distribution_type="normal",
            noise_std_type="log",
        ),
        progress_fn=Progress(
            session,
            updates=lambda state: optax.tree_utils.tree_get(state.optimizer_state, "count").item(),
            networks=lambda state: (state.params.policy, state.params.value),
        ),
    )


def _common(setting: Setting) -> dict[str, Any]:
    """What both take."""
    return {
        "environment": as_brax(make_env(setting.env, "native")),
        "num_evals": MOST_STRETCHES + 1,
        "episode_length": setting.max_episode_steps,
        "num_envs": setting.num_envs,
        "num_eval_envs": 1,
        "learning_rate": setting.learning_rate,
        "discounting": setting.discount,
        "seed": setting.seed,
    }


AGENTS = {"sac": train_sac, "ppo": train_ppo}


def main() -> None:
    """Trains the agent asked for."""
    session = Session()
    AGENTS[session.setting.agent](session)


if __name__ == "__main__":
    main()
