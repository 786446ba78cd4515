"""Exporting a policy's acting step, to run where this package is not installed.

A file of format ``jax`` is a zip archive of two members::

    manifest.json        what it is, and how to call it (sacformer_jax.acting_step.manifest)
    policy.jax_export    a program of ``jax.export``, its parameters inside

The program is ``action, state = call(obs, state, episode_start, reward)``, with the meaning that
:meth:`Policy.predict` gives these words. The state is a dictionary of arrays; before the first step
all of them are zero.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax

from sacformer_jax.acting_step import ActingStep, manifest
from sacformer_jax.config import ConfigError
from sacformer_jax.onnx_export import onnx_program
from sacformer_jax.policy import Policy

MANIFEST, PROGRAM = "manifest.json", "policy.jax_export"
PLATFORMS = ("cpu", "cuda", "tpu")
EXISTING_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
Format = Literal["jax", "onnx"]


def export_policy(
    policy: Policy,
    to: str | Path,
    *,
    format: Format = "jax",
    num_envs: int | None = None,
    deterministic: bool = True,
    platforms: Sequence[str] = PLATFORMS,
) -> Path:
    """Writes a policy's acting step into a file that runs without this package.

    Args:
      policy: from :func:`~sacformer_jax.policy.load_policy`.
      to: the file to write; there must be none yet.
      format: ``"jax"``, a program of ``jax.export`` (extra ``export``); or ``"onnx"`` (extra
        ``onnx``).
      num_envs: N; None: any, by the arrays it is called with.
      deterministic: the mean action; otherwise one drawn, as by ``predict``.
      platforms: of JAX, that the program is for; ONNX knows none.

    Returns:
      the file.

    Raises:
      ConfigError: the file exists or cannot be written, the extra is not installed, or an argument
        cannot work.
    """
    path = Path(to).expanduser().absolute()
    if format not in ("jax", "onnx"):
        raise ConfigError(f"format={format!r}: must be jax or onnx")
    if path.exists():
        raise ConfigError(f"to={str(to)!r}: is there already; choose another file")
    if not path.parent.is_dir():
        raise ConfigError(f"to={str(to)!r}: there is no folder {str(path.parent)!r}; make it first")
    if num_envs is not None and num_envs < 1:
        raise ConfigError(f"num_envs={num_envs}: must be at least 1, or None for any")
    step = ActingStep(policy, deterministic)
    if num_envs is None and step.random:
        raise ConfigError(
            "num_envs=None: a policy that draws random numbers is exported for a fixed number of "
            "environments; give num_envs"
        )
    about = manifest(step, num_envs, deterministic)
    if format == "onnx":
        content = onnx_program(step, num_envs, about)
    else:
        content = _jax_program(step, num_envs, about, platforms)
    _write_new(path, content)
    return path


def _jax_program(
    step: ActingStep, num_envs: int | None, about: dict[str, Any], platforms: Sequence[str]
) -> bytes:
    if not platforms or set(platforms) - set(EXISTING_PLATFORMS):
        raise ConfigError(
            f"platforms={tuple(platforms)}: must be some of {', '.join(EXISTING_PLATFORMS)}"
        )
    try:
        import flatbuffers  # noqa: F401  (what jax.export writes with)
    except ImportError as error:
        raise ConfigError(
            "format='jax': jax.export needs the package flatbuffers; "
            "pip install 'sacformer-jax[export]'"
        ) from error
    n = jax.export.symbolic_shape("N")[0] if num_envs is None else num_envs
    obs, episode_start, reward, *leaves = step.shapes(n)
    state = {leaf.name: shaped for leaf, shaped in zip(step.leaves, leaves, strict=True)}
    exported = jax.export.export(jax.jit(step.call), platforms=tuple(platforms))(
        obs, state, episode_start, reward
    )
    about["jax_export"] = {
        "calling_convention_version": exported.calling_convention_version,
        "platforms": list(exported.platforms),
    }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(MANIFEST, json.dumps(about, indent=2) + "\n")
        archive.writestr(PROGRAM, bytes(exported.serialize()))
    return file.getvalue()


def _write_new(path: Path, content: bytes) -> None:
    """Never over another file."""
    try:
        with path.open("xb") as file:
            try:
                file.write(content)
            except OSError:
                path.unlink()
                raise
    except OSError as error:
        raise ConfigError(
            f"to={str(path)!r}: cannot be written ({error.strerror}); choose another file"
        ) from error
