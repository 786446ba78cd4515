"""A policy's acting step as an ONNX model, by jax2onnx (the extra ``onnx``)."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Iterator
from typing import Any

import jax
import jax.extend
from jax.interpreters import partial_eval

from sacformer_jax.acting_step import ActingStep
from sacformer_jax.config import ConfigError

METADATA = "manifest.json"
"""Key of the manifest in the model's metadata."""
_OPSET = 23


def onnx_program(step: ActingStep, num_envs: int | None, about: dict[str, Any]) -> bytes:
    """The model, serialized.

    Inputs are ``obs``, ``episode_start``, ``reward`` and ``state.NAME`` for each array of the
    state; outputs are ``action`` and ``next_state.NAME``. The manifest is in its metadata.

    Args:
      step: what to convert.
      num_envs: N; None: any.
      about: the manifest.

    Raises:
      ConfigError: the extra is not installed, or the policy has what does not convert.
    """
    config = step.policy.config
    if step.random:
        raise ConfigError(
            "format='onnx': random numbers do not convert; export the mean action of a policy "
            "without acting_dropout, or use format='jax'"
        )
    if num_envs is None and config.context.acting_context == "episode":
        raise ConfigError(
            "format='onnx' with num_envs=None: the cache of acting_context=episode converts for a "
            "fixed number of environments only; give num_envs"
        )
    if config.precision.compute_dtype != "float32":
        raise ConfigError(
            f"format='onnx' of compute_dtype={config.precision.compute_dtype}: onnxruntime cannot "
            "multiply such matrices on CPUs; use format='jax', or train in float32"
        )
    try:
        import onnx_ir
        from jax2onnx import to_onnx
    except ImportError as error:
        raise ConfigError(
            "format='onnx': the package jax2onnx is missing; pip install 'sacformer-jax[onnx]'"
        ) from error
    n = jax.export.symbolic_shape("N")[0] if num_envs is None else num_envs
    shapes = step.shapes(n)
    closed = jax.make_jaxpr(step.flat)(*shapes)
    # Without this the unused random keys, which do not convert, would be in it.
    used = [True] * len(closed.out_avals)
    jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, used, instantiate=True)
    function = jax.extend.core.jaxpr_as_fun(jax.extend.core.ClosedJaxpr(jaxpr, closed.consts))
    names = [leaf.name for leaf in step.leaves]

    def outputs(*arrays: jax.Array) -> list[jax.Array]:
        # The action is in the state, too; an array of ONNX has one name.
        return [
            x + 0 if name == "action" else x
            for name, x in zip(["", *names], function(*arrays), strict=True)
        ]

    with _without_warnings("onnx_ir"):  # one for each value whose type it leaves open
        model: Any = to_onnx(
            outputs,
            inputs=shapes,
            model_name="policy",
            opset=_OPSET,
            return_mode="ir",
            input_names=["obs", "episode_start", "reward", *(f"state.{name}" for name in names)],
            output_names=["action", *(f"next_state.{name}" for name in names)],
        )
        onnx_ir.passes.common.RemoveUnusedNodesPass()(model)
        model.metadata_props[METADATA] = json.dumps(about)
        return onnx_ir.to_proto(model).SerializeToString()


@contextlib.contextmanager
def _without_warnings(name: str) -> Iterator[None]:
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
