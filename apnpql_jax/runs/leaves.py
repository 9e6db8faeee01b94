"""Leaves of state pytrees for storage: names, kinds, checksums, plain PRNG keys."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
import math
from typing import Any
import zlib

import jax
from jax.experimental import multihost_utils
import jax.numpy as jnp
import numpy as np

from apnpql_jax import devices

_SLAB_BYTES = 64 << 20
"""Size of the slabs that are gathered from all processes; one has to fit a device."""


def named(tree: Any) -> dict[str, Any]:
  """Returns path -> leaf."""
  leaves = jax.tree_util.tree_leaves_with_path(tree)
  return {_name(path): leaf for path, leaf in leaves}


def fill(example: Any, arrays: Mapping[str, Any]) -> Any:
  """Undoes ``named``: returns a tree like ``example`` with ``arrays`` as its leaves.

  Raises:
    KeyError: An array is missing.
  """
  return jax.tree_util.tree_map_with_path(lambda p, _: arrays[_name(p)], example)


def without(tree: Any, paths: Container[str]) -> Any:
  """Returns the tree with None in place of the leaves at ``paths``."""
  return jax.tree_util.tree_map_with_path(
    lambda path, leaf: None if _name(path) in paths else leaf, tree
  )


def nbytes(tree: Any) -> int:
  """Returns the bytes that the leaves or ShapeDtypeStructs take on each device."""

  def size(leaf: Any) -> int:
    where = getattr(leaf, "sharding", None)
    shape = leaf.shape if where is None else where.shard_shape(leaf.shape)
    return math.prod(shape) * leaf.dtype.itemsize

  return sum(map(size, jax.tree.leaves(tree)))


def kind(leaf: Any) -> str:
  """Returns dtype and shape of a leaf, such as ``uint8[4, 72, 96, 3]``."""
  return f"{leaf.dtype}{list(leaf.shape)}"


def key_impl(leaf: Any) -> str | None:
  """Returns the name of the generator of a typed PRNG key; None for other leaves."""
  return str(jax.random.key_impl(leaf)) if _is_key(leaf) else None


def checksums(tree: Any) -> dict[str, int]:
  """Returns path -> CRC-32 of the bytes of each leaf; typed keys count by their data.

  All processes that hold parts of the leaves must call this together.
  """
  devices.barrier()
  return {path: _crc32(_key_data(leaf)) for path, leaf in named(tree).items()}


def _crc32(array: Any) -> int:
  crc32 = 0
  for part in _on_host(array):
    flat = np.ascontiguousarray(part).reshape(-1)
    crc32 = zlib.crc32(flat.view(np.uint8).data, crc32)
  return crc32


def _on_host(array: Any) -> Iterator[Any]:
  """Yields the array, or slabs gathered from all processes if parts are elsewhere."""
  if getattr(array, "is_fully_addressable", True) or array.is_fully_replicated:
    yield array
  elif array.size:
    rows = max(1, _SLAB_BYTES * len(array) // array.nbytes)
    for start in range(0, len(array), rows):
      yield multihost_utils.process_allgather(array[start : start + rows], tiled=True)


def to_plain(tree: Any) -> Any:
  """Returns the tree with typed keys replaced by their data (u32).

  Arrays without elements, which Orbax rejects, become None.
  """
  return jax.tree.map(lambda leaf: _key_data(leaf) if leaf.size else None, tree)


def to_typed(tree: Any, impls: Mapping[str, str], example: Any) -> Any:
  """Undoes ``to_plain``, given the generators (path -> name) and the original shapes.

  Raises:
    ValueError: The generators do not fit the keys.
    TypeError: A generator is unknown.
  """

  def restored(path: Any, like: Any, leaf: jax.Array | None) -> jax.Array:
    if leaf is None:
      return jnp.zeros(like.shape, like.dtype, device=getattr(like, "sharding", None))
    if (impl := impls.get(_name(path))) is not None:
      leaf = jax.random.wrap_key_data(leaf, impl=impl)
    if leaf.dtype != like.dtype:
      raise ValueError(f"{_name(path)} is {leaf.dtype}, not {like.dtype}")
    return leaf

  return jax.tree_util.tree_map_with_path(restored, example, tree)


def abstract(tree: Any) -> Any:
  """Returns ShapeDtypeStructs of ``to_plain(tree)``, each on its leaf's devices.

  Leaves without a sharding go to the default device.
  """
  default = jax.sharding.SingleDeviceSharding(jax.devices()[0])

  def struct(leaf: Any) -> jax.ShapeDtypeStruct | None:
    if not leaf.size:
      return None
    plain = jax.eval_shape(_key_data, leaf)
    where = getattr(leaf, "sharding", None) or default
    return jax.ShapeDtypeStruct(plain.shape, plain.dtype, sharding=where)

  return jax.tree.map(struct, tree)


def _key_data(leaf: Any) -> Any:
  return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _is_key(leaf: Any) -> bool:
  return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _name(path: Any) -> str:
  return jax.tree_util.keystr(path, simple=True, separator="/")
