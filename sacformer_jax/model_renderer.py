"""Drawing MuJoCo models without a window."""

from __future__ import annotations

import copy
import dataclasses
import os
import sys
from typing import Any

import numpy as np

from sacformer_jax.config import ConfigError

_SHADOW_MAP = 1024
"""Pixels; MuJoCo's own 4096 take most of the time without a GPU."""
_DEBIAN = "on Debian and Ubuntu: apt install libegl1 libopengl0 libgl1-mesa-dri"


@dataclasses.dataclass(frozen=True)
class View:
    """How to look at an environment.

    Attributes:
      width: pixels, even.
      height: pixels, even.
      camera: a camera's name or number; None: ``"track"`` where there is one (Gymnasium's choice),
        else a free one that follows the root.
    """

    width: int = 480
    height: int = 360
    camera: str | int | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not 16 <= value <= 4096 or value % 2:
                raise ConfigError(f"{name}={value}: must be even, from 16 to 4096 pixels")


class ModelRenderer:
    """Draws positions of a MuJoCo model, without a window.

    Args:
      model: the model; a copy of it is changed.
      view: size and camera.

    Raises:
      ConfigError: there is no such camera, or OpenGL cannot be used.
    """

    def __init__(self, model: Any, view: View):
        mujoco = mujoco_that_draws()
        self._mujoco, self._model = mujoco, copy.copy(model)
        visual = self._model.vis
        visual.global_.offwidth = max(visual.global_.offwidth, view.width)
        visual.global_.offheight = max(visual.global_.offheight, view.height)
        visual.quality.shadowsize = min(visual.quality.shadowsize, _SHADOW_MAP)
        _endless_floor(self._model)
        self.data = mujoco.MjData(self._model)
        self._camera = _camera(self._model, view.camera)
        try:
            self._renderer = mujoco.Renderer(self._model, view.height, view.width)
        except Exception as error:  # every backend fails in ways of its own
            raise _no_gl(error) from error

    def set_state(self, state: np.ndarray) -> None:
        """Puts a state of the native engine, float64, into ``data``."""
        from sacformer_jax.envs.native_host import STATE_SPEC

        self._mujoco.mj_setState(self._model, self.data, state, STATE_SPEC)

    def draw(self) -> np.ndarray:
        """``[height, width, 3]`` uint8 of the positions in ``data``."""
        self._mujoco.mj_forward(self._model, self.data)
        # Endless planes are laid around where the camera was at the update before: so twice.
        self._renderer.update_scene(self.data, camera=self._camera)
        self._renderer.update_scene(self.data, camera=self._camera)
        return np.array(self._renderer.render())

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._renderer.close()


def _endless_floor(model: Any) -> None:
    """Draws planes without an end, which they have not in the physics either."""
    import mujoco

    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        material, half_size = model.geom_matid[geom], model.geom_size[geom, :2].copy()
        if not np.all(half_size > 0):
            continue
        model.geom_size[geom, :2] = 0.0
        if material >= 0 and not model.mat_texuniform[material]:
            # The texture as dense as before: then over the whole plane, now over two metres.
            model.mat_texuniform[material] = 1
            model.mat_texrepeat[material] /= half_size


def _camera(model: Any, wanted: str | int | None) -> Any:
    """What ``Renderer.update_scene`` takes.

    Raises:
      ConfigError: there is no such camera.
    """
    import mujoco

    names = [model.camera(number).name for number in range(model.ncam)]
    if wanted is None and "track" in names:
        return "track"
    if wanted is None:
        camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, camera)
        camera.type, camera.trackbodyid = (
            mujoco.mjtCamera.mjCAMERA_TRACKING,
            min(1, model.nbody - 1),
        )
        return camera
    if str(wanted).isdecimal() and int(wanted) < model.ncam:
        return int(wanted)
    if wanted in names:
        return wanted
    known = ", ".join(name or str(number) for number, name in enumerate(names)) or "none"
    raise ConfigError(f"camera={wanted!r}: the model has {known}; without it one follows the root")


# --- OpenGL --------------------------------------------------------------------------------------


def mujoco_that_draws() -> Any:
    """MuJoCo with a way to draw: EGL, where nobody chose another and there is no display.

    MuJoCo chooses when it is imported, which happened long before; and there a missing library
    would stop everything that only computes. So the choice is changed here.

    Raises:
      ConfigError: EGL cannot be loaded.
    """
    import mujoco

    displays = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if os.environ.get("MUJOCO_GL") or displays or sys.platform != "linux":
        return mujoco
    try:
        from mujoco.egl import GLContext
    except Exception as error:  # PyOpenGL without its library: AttributeError, and others
        raise _no_gl(error) from error
    os.environ["MUJOCO_GL"] = "egl"  # for programs started from here
    sys.modules[mujoco.Renderer.__module__].gl_context.GLContext = GLContext
    return mujoco


def _no_gl(error: Exception) -> ConfigError:
    reason = next(iter(str(error).splitlines()), "") or type(error).__name__
    backend = os.environ.get("MUJOCO_GL", "")
    return ConfigError(
        f"MUJOCO_GL={backend!r}: OpenGL cannot be used here ({reason.strip()}). Without a display "
        f"MUJOCO_GL=egl is right ({_DEBIAN}), or MUJOCO_GL=osmesa (libosmesa6)"
    )
