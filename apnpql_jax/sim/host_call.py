"""NumPy functions called from compiled code that XLA can cache.

``jax.pure_callback`` writes the address of a Python object into the program, so that
each process compiles it anew, for minutes. A call through XLA's foreign function
interface is known by name instead, and the program that makes it is read back from
JAX's persistent cache. The structures are those of XLA's ``ffi/api/c_api.h``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import ctypes
import math
import traceback
from typing import Any

import jax
import numpy as np

HostFunction = Callable[..., Sequence[np.ndarray]]
"""(f32 arrays, read only) -> f32 arrays; touches NumPy only, as JAX could deadlock."""

_MAJOR, _MINOR = 0, 1
"""Version of the interface that what is used here has been in since."""

_F32, _EXECUTE, _METADATA, _INTERNAL = 11, 3, 1, 13

_registered: dict[str, tuple[HostFunction, Any]] = {}
"""Name -> function and what XLA has the address of; both must outlive every program."""


def register(name: str, function: HostFunction) -> None:
  """Makes ``call`` find ``function``; a name keeps its first function.

  Args:
    name: must tell functions apart in every process: programs that were compiled by
      another one know the function by it, and by nothing else.
    function: returns arrays of the shapes that ``call`` was given.
  """
  if name in _registered:
    return

  def handler(pointer: Any) -> int | None:
    frame = pointer.contents
    extension = frame.extension
    if extension and extension.contents.kind == _METADATA:
      version = extension.contents.metadata.contents.version
      version.major, version.minor = _MAJOR, _MINOR
      return None
    if frame.stage != _EXECUTE:
      return None
    try:
      results = function(*map(_array, frame.arguments.buffers()))
      for to, value in zip(frame.results.buffers(), results, strict=True):
        _array(to)[...] = value
      return None
    except BaseException:  # Nothing may be raised into XLA.
      message = traceback.format_exc().encode()
      error = _ErrorArgs(ctypes.sizeof(_ErrorArgs), None, message, _INTERNAL)
      return frame.api.contents.create_error(ctypes.byref(error))

  _registered[name] = function, _Handler(handler)
  address = ctypes.cast(_registered[name][1], ctypes.c_void_p)
  jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")


def call(name: str, shapes: Sequence[Any], *arrays: Any) -> Sequence[Any]:
  """Inside jit: what the function of this name makes of f32 ``arrays``.

  Args:
    name: as given to ``register``.
    shapes: ShapeDtypeStructs of what it returns.
    arrays: its arguments.
  """
  if jax.default_backend() == "cpu":
    return jax.ffi.ffi_call(name, shapes)(*arrays)
  # The arrays of a program on another device have to come over first.
  function, _ = _registered[name]
  host = lambda *arrays: tuple(function(*map(np.asarray, arrays)))  # noqa: E731
  return jax.pure_callback(host, tuple(shapes), *arrays)


def _array(buffer: Any) -> np.ndarray:
  """The memory of a buffer as an array."""
  if buffer.dtype != _F32:
    raise TypeError(f"a buffer of XLA type {buffer.dtype} is none of f32")
  shape = tuple(buffer.dims[: buffer.rank])
  size = math.prod(shape)
  if not size:  # Its address may be null.
    return np.empty(shape, np.float32)
  return np.asarray((ctypes.c_float * size).from_address(buffer.data)).reshape(shape)


class _Version(ctypes.Structure):
  _fields_ = (
    ("size", ctypes.c_size_t),
    ("extension", ctypes.c_void_p),
    ("major", ctypes.c_int),
    ("minor", ctypes.c_int),
  )


class _Metadata(ctypes.Structure):
  _fields_ = (("size", ctypes.c_size_t), ("version", _Version))


class _Extension(ctypes.Structure):
  _fields_ = (
    ("size", ctypes.c_size_t),
    ("kind", ctypes.c_int),
    ("next", ctypes.c_void_p),
    ("metadata", ctypes.POINTER(_Metadata)),
  )


class _Buffer(ctypes.Structure):
  _fields_ = (
    ("size", ctypes.c_size_t),
    ("extension", ctypes.c_void_p),
    ("dtype", ctypes.c_int),
    ("data", ctypes.c_void_p),
    ("rank", ctypes.c_int64),
    ("dims", ctypes.POINTER(ctypes.c_int64)),
  )


class _Buffers(ctypes.Structure):
  """Arguments or results."""

  _fields_ = (
    ("size", ctypes.c_size_t),
    ("extension", ctypes.c_void_p),
    ("count", ctypes.c_int64),
    ("kinds", ctypes.c_void_p),
    ("pointers", ctypes.POINTER(ctypes.POINTER(_Buffer))),
  )

  def buffers(self) -> list[_Buffer]:
    return [self.pointers[i].contents for i in range(self.count)]


class _ErrorArgs(ctypes.Structure):
  _fields_ = (
    ("size", ctypes.c_size_t),
    ("extension", ctypes.c_void_p),
    ("message", ctypes.c_char_p),
    ("code", ctypes.c_int),
  )


class _Api(ctypes.Structure):
  """Its beginning."""

  _fields_ = (
    ("size", ctypes.c_size_t),
    ("extension", ctypes.c_void_p),
    ("version", _Version),
    ("internal", ctypes.c_void_p),
    (
      "create_error",
      ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArgs)),
    ),
  )


class _CallFrame(ctypes.Structure):
  """Its beginning."""

  _fields_ = (
    ("size", ctypes.c_size_t),
    ("extension", ctypes.POINTER(_Extension)),
    ("api", ctypes.POINTER(_Api)),
    ("context", ctypes.c_void_p),
    ("stage", ctypes.c_int),
    ("arguments", _Buffers),
    ("results", _Buffers),
  )


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_CallFrame))
