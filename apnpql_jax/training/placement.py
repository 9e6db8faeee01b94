"""Placement of the training state: which part lies on which device."""

from __future__ import annotations

from typing import Any

import jax
from jax.sharding import (
  Mesh,
  NamedSharding,
  PartitionSpec,
  Sharding,
  SingleDeviceSharding,
)

from apnpql_jax.devices import AXIS
from apnpql_jax.envs.state import EnvState
from apnpql_jax.types import Slot, Transition

_SPLIT = {
  EnvState: PartitionSpec(AXIS),
  Slot: PartitionSpec(None, AXIS),  # As the replay holds them, [time, worlds, ...].
  Transition: PartitionSpec(AXIS),
}
"""What is split between devices, and along which axis; of all else each has a copy."""


def place(tree: Any, mesh: Mesh | None) -> Any:
  """Inside jit: the same tree, each part of which lies where ``_SPLIT`` says."""
  if mesh is None:
    return tree
  return jax.lax.with_sharding_constraint(tree, shardings(tree, mesh))


def shardings(tree: Any, mesh: Mesh | None) -> Any:
  """Where ``place`` puts each leaf; on the default device if there is no mesh."""

  def of(part: Any) -> Any:
    where: Sharding = SingleDeviceSharding(jax.local_devices()[0])
    if mesh is not None:
      where = NamedSharding(mesh, _SPLIT.get(type(part), PartitionSpec()))
    return jax.tree.map(lambda _: where, part)

  return jax.tree.map(of, tree, is_leaf=lambda part: type(part) in _SPLIT)
