"""How noisy the gradients of an update are, whole and by part of the network.

They are the agent's own: :data:`~sacformer_jax.agents.off_policy.ADAM` that has seen nothing yet
has after an update a constant times its gradient as first moment. With step sizes of 0 the actor's
loss, which an update looks at after the critics' step, is that of the restored critics. Noise is
all that an update draws: batch, actions, dropout.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diagnosis.numbers import signal
from diagnosis.subject import Subject
from sacformer_jax.agents.core import Metrics
from sacformer_jax.agents.faults import NO_FAULT
from sacformer_jax.agents.off_policy import ADAM
from sacformer_jax.types import LearnerState, Params, TrainState

_OPENED = ("trunk", "mlp")
"""Modules that are no group by themselves, but what they consist of."""


@dataclasses.dataclass(frozen=True)
class Gradients:
    """Of one update.

    Attributes:
      actor: like the actor's parameters.
      critics: like those of the critics.
      metrics: of the update.
    """

    actor: Params
    critics: Params
    metrics: Metrics


jax.tree_util.register_dataclass(Gradients, ["actor", "critics", "metrics"], [])

Update = Callable[[TrainState, jax.Array], tuple[LearnerState, Metrics]]


def make_gradients(update: Update) -> Callable[[TrainState, jax.Array], Gradients]:
    """``(state, key) -> Gradients`` of an ``update(state, key)`` of the state's learner; jitted."""
    # What Adam makes of a gradient of 1.
    nothing = jnp.zeros(())
    fresh = ADAM.init(nothing)
    _, stepped = ADAM.step_where(jnp.array(True), nothing, jnp.ones(()), fresh, nothing)
    unit = stepped.mu

    @jax.jit
    def gradients(state: TrainState, key: jax.Array) -> Gradients:
        learner, zero = state.learner, jnp.zeros(())
        learner = dataclasses.replace(
            learner,
            actor_opt=ADAM.init(learner.actor_params),
            critic_opt=ADAM.init(learner.critic_params),
        )
        hyper = dataclasses.replace(
            state.hyper, actor_learning_rate=zero, critic_learning_rate=zero
        )
        after, metrics = update(dataclasses.replace(state, learner=learner, hyper=hyper), key)
        actor, critics = (
            jax.tree.map(lambda mu: mu / unit, opt.mu)
            for opt in (after.actor_opt, after.critic_opt)
        )
        return Gradients(actor, critics, metrics)

    return gradients


def update_of(subject: Subject) -> Update:
    """The subject's update, on a batch that it draws by the key."""
    program = subject.tools.program

    def update(state: TrainState, key: jax.Array) -> tuple[LearnerState, Metrics]:
        assert state.buffer is not None
        return program.update(state.buffer, state.hyper, state.learner, key)

    return update


def group_of(path: tuple[Any, ...]) -> str:
    """The part of a network to which a parameter belongs, by its place in the tree."""
    names = [entry.key for entry in path if entry.key != "params"]
    return names[1] if names[0] in _OPENED else names[0]


def _place(group: str) -> tuple[int, str]:
    """Where a group comes on the way through a network."""
    prefixes = ("embed", "ln_embed", "block", "dense", "ln", "", "heads", "q")
    found = max((p for p in prefixes if group.startswith(p)), key=len)
    return prefixes.index(found), group


def by_group(trees: list[Params]) -> dict[str, np.ndarray]:
    """``[M, P]`` of each group of M trees, and of the ``whole``."""
    groups: dict[str, list[np.ndarray]] = {}
    rows = [jax.tree_util.tree_flatten_with_path(tree)[0] for tree in trees]
    for leaves in zip(*rows, strict=True):
        flat = np.stack([np.asarray(leaf).reshape(-1) for _, leaf in leaves])  # [M, P]
        groups.setdefault(group_of(leaves[0][0]), []).append(flat)
    parts = {name: np.concatenate(groups[name], axis=1) for name in sorted(groups, key=_place)}
    return {"whole": np.concatenate(list(parts.values()), axis=1), **parts}


def gradient_numbers(
    subject: Subject,
    gradients: Callable[[TrainState, jax.Array], Gradients],
    num_batches: int,
    seed: int,
) -> dict[str, float]:
    """Norm of the mean gradient and signal-to-noise ratio, over ``num_batches`` at the same state;
    and of the policy in those batches the entropy.

    Raises:
      FloatingPointError: an update was not finite.
    """
    keys = jax.random.split(jax.random.key(seed), num_batches)
    each = [jax.device_get(gradients(subject.state, key)) for key in keys]
    if any(one.metrics["fault"] != NO_FAULT for one in each):
        raise FloatingPointError(f"{subject.member}: an update of the restored state is not finite")
    numbers = {"entropy/training": float(np.mean([one.metrics["entropy"] for one in each]))}
    for network in ("actor", "critics"):
        for group, flat in by_group([getattr(one, network) for one in each]).items():
            found = signal(flat)
            numbers[f"gradient/{network}/{group}/norm"] = found.norm
            numbers[f"gradient/{network}/{group}/snr"] = found.snr
    return numbers
