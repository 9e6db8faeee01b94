"""NumPy functions called from compiled code that XLA can cache.

``jax.pure_callback`` writes the address of a Python object into the program, so every
process would compile it again, for minutes. A call through XLA's foreign function
interface refers to a name instead, so JAX's persistent cache can hold the program.
The structures are those of XLA's ``ffi/api/c_api.h``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import ctypes
from ctypes import CFUNCTYPE, POINTER, c_char_p, c_int, c_int64, c_size_t, c_void_p
import math
import traceback
from typing import Any

import jax
import numpy as np

# (read-only f32 arrays) -> f32 arrays; uses NumPy only, because JAX could deadlock.
HostFunction = Callable[..., Sequence[np.ndarray]]
_MAJOR, _MINOR = 0, 1  # first version of the interface that has everything used here
_F32, _EXECUTE, _METADATA, _INTERNAL = 11, 3, 1, 13
# Function and callback given to XLA by name; both must outlive every program.
_registered: dict[str, tuple[HostFunction, Any]] = {}


def register(name: str, function: HostFunction) -> None:
  """Makes a function available to ``call``; a name keeps its first function.

  A program from the cache finds its function by the name alone, in every process.
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
      results = function(*_arrays(frame.arguments))
      for array, value in zip(_arrays(frame.results), results, strict=True):
        array[...] = value
      return None
    except BaseException:  # No exception may reach XLA.
      message = traceback.format_exc().encode()
      error = _ErrorArgs(ctypes.sizeof(_ErrorArgs), None, message, _INTERNAL)
      return frame.api.contents.create_error(ctypes.byref(error))

  _registered[name] = function, _Handler(handler)
  address = ctypes.cast(_registered[name][1], c_void_p)
  jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")


def call(name: str, shapes: Sequence[Any], *arrays: Any) -> Sequence[Any]:
  """Calls a function inside jit; ``shapes`` are ShapeDtypeStructs of its results."""
  if jax.default_backend() == "cpu":
    return jax.ffi.ffi_call(name, shapes)(*arrays)
  # On other devices the arrays have to be copied to the host first.
  function, _ = _registered[name]
  host = lambda *arrays: tuple(function(*map(np.asarray, arrays)))  # noqa: E731
  return jax.pure_callback(host, tuple(shapes), *arrays)


def _arrays(buffers: Any) -> list[np.ndarray]:
  """Returns views of the buffers' memory."""
  return [_array(buffers.pointers[i].contents) for i in range(buffers.count)]


def _array(buffer: Any) -> np.ndarray:
  if buffer.dtype != _F32:
    raise TypeError(f"expected an f32 buffer, got one of XLA type {buffer.dtype}")
  shape = tuple(buffer.dims[: buffer.rank])
  size = math.prod(shape)
  if not size:  # The address may be null.
    return np.empty(shape, np.float32)
  return np.asarray((ctypes.c_float * size).from_address(buffer.data)).reshape(shape)


def _structure(name: str, **fields: Any) -> Any:
  return type(name, (ctypes.Structure,), {"_fields_": list(fields.items())})


_HEAD = {"size": c_size_t, "extension": c_void_p}
_Version = _structure("Version", **_HEAD, major=c_int, minor=c_int)
_Metadata = _structure("Metadata", size=c_size_t, version=_Version)
_Extension = _structure(
  "Extension", size=c_size_t, kind=c_int, next=c_void_p, metadata=POINTER(_Metadata)
)
_Buffer = _structure(
  "Buffer", **_HEAD, dtype=c_int, data=c_void_p, rank=c_int64, dims=POINTER(c_int64)
)
_Buffers = _structure(  # arguments or results of a call
  "Buffers", **_HEAD, count=c_int64, kinds=c_void_p, pointers=POINTER(POINTER(_Buffer))
)
_ErrorArgs = _structure("ErrorArgs", **_HEAD, message=c_char_p, code=c_int)
_CreateError = CFUNCTYPE(c_void_p, POINTER(_ErrorArgs))
_Api = _structure(  # the first fields
  "Api", **_HEAD, version=_Version, internal=c_void_p, create_error=_CreateError
)
_CallFrame = _structure(  # the first fields
  "CallFrame",
  size=c_size_t,
  extension=POINTER(_Extension),
  api=POINTER(_Api),
  context=c_void_p,
  stage=c_int,
  arguments=_Buffers,
  results=_Buffers,
)
_Handler = CFUNCTYPE(c_void_p, POINTER(_CallFrame))
