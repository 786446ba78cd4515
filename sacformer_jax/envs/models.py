"""The MuJoCo model of a task: found, compiled, and refused where the engines could not run it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import get_args

import mujoco
import numpy as np

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.physics import is_mjcf, model_path
from sacformer_jax.envs.tasks import Derived, Measure, Task


@contextlib.contextmanager
def loading_quietly() -> Iterator[None]:
    """Around the loading of Gymnasium's models: drops the warnings about their old attributes.

    MuJoCo's own handler would print them and write MUJOCO_LOG.TXT into the working directory.
    """
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


def load_model(task: Task) -> mujoco.MjModel:
    """Compiles the task's model.

    Raises:
      ConfigError: a value of the task cannot be, there is no such file, it does not compile, or it
        has what no engine here can run.
    """
    _check_task(task)
    try:
        with loading_quietly():
            if is_mjcf(task):
                model = mujoco.MjModel.from_xml_string(task.xml_file)
            else:
                model = mujoco.MjModel.from_xml_path(str(model_path(task)))
    except ValueError as error:
        if isinstance(error, ConfigError):
            raise
        what = "its MJCF" if is_mjcf(task) else f"xml_file={str(task.xml_file)!r}"
        problem = " ".join(str(error).split())
        raise ConfigError(f"task {task.name!r}: {what} does not compile: {problem}") from error
    _check_model(task, model)
    return model


def _check_task(task: Task) -> None:
    def require(field: str, holds: bool, right: str) -> None:
        if not holds:
            value = getattr(task, field)
            raise ConfigError(f"task {task.name!r}: {field}={value!r}: must be {right}")

    for field in ("frame_skip", "max_episode_steps"):
        value = getattr(task, field)
        require(field, isinstance(value, int) and value >= 1, "a whole number of at least 1")
    for field in ("qpos_noise", "qvel_noise"):
        value = getattr(task, field)
        require(field, math.isfinite(value) and value >= 0, "a finite number, 0 or more")
    measures, derived = get_args(Measure), get_args(Derived)
    require("measure", task.measure in measures, f"one of {', '.join(measures)}")
    require("derived", set(task.derived) <= set(derived), f"names among {', '.join(derived)}")
    require("derived", len(set(task.derived)) == len(task.derived), "names that differ")
    functions = ("reward_terms", "observe", "terminated")
    for field in (*functions, *(("reset",) if task.reset is not None else ())):
        require(field, callable(getattr(task, field)), "a function")
    if task.recentre_root:
        require(
            "derived",
            "sensordata" not in task.derived,
            "without sensordata where recentre_root=True: sensors may measure where the root is",
        )


def _check_model(task: Task, model: mujoco.MjModel) -> None:
    def require(holds: bool, message: str) -> None:
        if not holds:
            raise ConfigError(f"task {task.name!r}: its model {message}")

    require(model.nq > 0, "has no joint, so nothing moves: give a body a <joint>")
    require(model.nu > 0, "has no actuators, so there are no actions: add an <actuator> section")
    low, high = model.actuator_ctrlrange.T
    limited = model.actuator_ctrllimited.astype(bool)
    # Actions are drawn from the bounds and scaled to them.
    unbounded = [_actuator(model, int(i)) for i in np.flatnonzero(~(limited & (low < high)))]
    require(
        not unbounded,
        f"has actuators without a range of control: {', '.join(unbounded)}; give each a ctrlrange "
        'in the MJCF, such as ctrlrange="-1 1"',
    )
    require(model.npluginstate == 0, "has plugins with a state of their own, which is not kept")
    data = mujoco.MjData(model)
    for name in task.derived:
        require(getattr(data, name).size > 0, f"has nothing that derived={name!r} could report")
    if task.recentre_root:
        joint, axis = model.jnt_type[0], model.jnt_axis[0]
        slides = joint == mujoco.mjtJoint.mjJNT_SLIDE and np.array_equal(axis, [1.0, 0.0, 0.0])
        require(
            joint == mujoco.mjtJoint.mjJNT_FREE or slides,
            "has a first joint that is neither free nor a slide along x; use recentre_root=False",
        )


def _actuator(model: mujoco.MjModel, index: int) -> str:
    """Its name, or its number where it has none."""
    return model.actuator(index).name or f"number {index}"
