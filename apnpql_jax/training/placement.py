"""Placement of the training state on devices."""

from __future__ import annotations

from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

from apnpql_jax.devices import AXIS
from apnpql_jax.envs.state import EnvState
from apnpql_jax.types import Slot, Transition

_SPLIT = {
  EnvState: PartitionSpec(AXIS),
  Slot: PartitionSpec(None, AXIS),  # As in the replay, [time, worlds, ...].
  Transition: PartitionSpec(AXIS),
}
"""Axes along which parts are split between devices; all else is replicated."""


def place(tree: Any, mesh: Mesh | None) -> Any:
  """Constrains a tree inside jit to the placement of ``shardings``."""
  if mesh is None:
    return tree
  return jax.lax.with_sharding_constraint(tree, shardings(tree, mesh))


def shardings(tree: Any, mesh: Mesh | None) -> Any:
  """Returns the sharding of each leaf; the default device without a mesh."""
  if mesh is None:
    single = SingleDeviceSharding(jax.local_devices()[0])
    return jax.tree.map(lambda _: single, tree)

  def split(part: Any) -> Any:
    sharding = NamedSharding(mesh, _SPLIT.get(type(part), PartitionSpec()))
    return jax.tree.map(lambda _: sharding, part)

  return jax.tree.map(split, tree, is_leaf=lambda part: type(part) in _SPLIT)
