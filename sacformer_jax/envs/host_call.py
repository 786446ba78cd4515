"""Calling a Python function from inside a jitted program.

``jax.pure_callback`` does that everywhere, but on the CPU a call costs several times what it need
(operands become JAX arrays first), and a program that contains one holds a pointer into this
process, so JAX never keeps it in its compilation cache. There, the function is registered with
XLA's foreign function interface instead, under a name that can be the same in every process. The
interface is in C (``xla/ffi/api/c_api.h`` in ``jax.ffi.include_dir()``); its structures, which only
ever grow at their ends, are spelled out with ctypes as far as they are looked at.
"""

from __future__ import annotations

import ctypes
import functools
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

HostFunction = Callable[..., Sequence[np.ndarray]]
"""``(*operands) -> results``, NumPy arrays; operands are views that must not be kept or written."""

_METADATA, _INTERNAL_ERROR = 1, 13
# The oldest that XLA still takes; what is used here has been in it from the beginning.
_API_VERSION = (0, 1)
_DTYPES: dict[int, Any] = {
    1: np.bool_,
    2: np.int8,
    3: np.int16,
    4: np.int32,
    5: np.int64,
    6: np.uint8,
    7: np.uint16,
    8: np.uint32,
    9: np.uint64,
    10: np.float16,
    11: np.float32,
    12: np.float64,
}


class _Extension(ctypes.Structure):
    pass


_Extension._fields_ = [
    ("struct_size", ctypes.c_size_t),
    ("type", ctypes.c_int),
    ("next", ctypes.POINTER(_Extension)),
]


def _structure(name: str, *fields: tuple[str, Any]) -> Any:
    """A structure of the interface: all begin alike."""
    head = [("struct_size", ctypes.c_size_t), ("extension", ctypes.POINTER(_Extension))]
    return type(name, (ctypes.Structure,), {"_fields_": [*head, *fields]})


_ApiVersion = _structure("_ApiVersion", ("major", ctypes.c_int), ("minor", ctypes.c_int))
_ErrorArgs = _structure("_ErrorArgs", ("message", ctypes.c_char_p), ("code", ctypes.c_int))
_CREATE_ERROR = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArgs))
_Api = _structure(
    "_Api",
    ("version", _ApiVersion),
    ("internal", ctypes.c_void_p),
    ("create_error", _CREATE_ERROR),
)
_Buffer = _structure(
    "_Buffer",
    ("dtype", ctypes.c_int),
    ("data", ctypes.c_void_p),
    ("rank", ctypes.c_int64),
    ("dims", ctypes.POINTER(ctypes.c_int64)),
)
_Buffers = _structure(
    "_Buffers",
    ("size", ctypes.c_int64),
    ("types", ctypes.c_void_p),
    ("buffers", ctypes.POINTER(ctypes.POINTER(_Buffer))),
)
_CallFrame = _structure(
    "_CallFrame",
    ("api", ctypes.POINTER(_Api)),
    ("context", ctypes.c_void_p),
    ("stage", ctypes.c_int),
    ("operands", _Buffers),
    ("results", _Buffers),
)


class _Metadata(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("version", _ApiVersion)]


class _MetadataExtension(ctypes.Structure):
    _fields_ = [
        ("base", _Extension),
        ("metadata", ctypes.POINTER(_Metadata)),
    ]


_HANDLER = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_CallFrame))
_new_capsule = ctypes.pythonapi.PyCapsule_New
_new_capsule.restype = ctypes.py_object
_new_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]


@functools.lru_cache(maxsize=1024)
def _bytes_type(size: int) -> Any:
    return ctypes.c_char * size


def _view(buffer: Any) -> np.ndarray:
    """XLA's memory as an array."""
    dtype = np.dtype(_DTYPES[buffer.dtype])
    shape = tuple(buffer.dims[: buffer.rank])
    size = dtype.itemsize
    for length in shape:
        size *= length
    if size == 0:
        return np.empty(shape, dtype)
    return np.frombuffer(_bytes_type(size).from_address(buffer.data), dtype).reshape(shape)


def _views(buffers: Any) -> list[np.ndarray]:
    return [_view(buffers.buffers[i].contents) for i in range(buffers.size)]


def _execute(function: HostFunction, frame: Any) -> None:
    results = function(*_views(frame.operands))
    for to, values in zip(_views(frame.results), results, strict=True):
        to[...] = values


def _handle(function: HostFunction, frame_pointer: Any) -> int | None:
    """What XLA calls; never raises, since nobody could catch it."""
    frame = frame_pointer.contents
    if frame.extension and frame.extension.contents.type == _METADATA:
        extension = ctypes.cast(frame.extension, ctypes.POINTER(_MetadataExtension)).contents
        version = extension.metadata.contents.version
        version.major, version.minor = _API_VERSION
        return None
    try:
        _execute(function, frame)
    except BaseException:
        message = f"the host function failed:\n{traceback.format_exc()}".encode()
        arguments = _ErrorArgs(ctypes.sizeof(_ErrorArgs), None, message, _INTERNAL_ERROR)
        return frame.api.contents.create_error(ctypes.byref(arguments))
    return None


_REGISTERED: dict[str, Any] = {}
"""Handlers by name: XLA may call them for as long as the process lives."""


class HostCall:
    """A pure function on NumPy arrays as a function on JAX arrays; ``jax.vmap`` adds leading axes.

    Args:
      name: unique in this process, for good; a compilation cache finds the program again in
        another process where the name stands for the same function.
      function: takes and returns arrays with any leading axes, the same for all of them.

    Raises:
      ValueError: the name is taken.
    """

    def __init__(self, name: str, function: HostFunction):
        if name in _REGISTERED:
            raise ValueError(f"host function {name!r} is registered already")
        self.name, self.function = name, function
        handler = _HANDLER(functools.partial(_handle, function))
        capsule = _new_capsule(ctypes.cast(handler, ctypes.c_void_p), None, None)
        jax.ffi.register_ffi_target(name, capsule, platform="cpu")
        _REGISTERED[name] = handler

    def __call__(
        self, results: Sequence[jax.ShapeDtypeStruct], *operands: jax.Array
    ) -> Sequence[jax.Array]:
        """Calls it, with the shapes and types of its results given without leading axes.

        Raises:
          jax.errors.JaxRuntimeError: when the program runs, with the traceback of the function (of
            a KeyboardInterrupt, too, which cannot pass through XLA).
        """
        by_name = jax.ffi.ffi_call(self.name, tuple(results), vmap_method="broadcast_all")

        def elsewhere(*operands: jax.Array) -> Sequence[jax.Array]:
            return jax.pure_callback(
                self.function, tuple(results), *operands, vmap_method="broadcast_all"
            )

        return jax.lax.platform_dependent(*operands, cpu=by_name, default=elsewhere)
