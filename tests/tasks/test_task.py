"""The registry of tasks."""

from __future__ import annotations

import pytest

from apnpql_jax.errors import ConfigError
from apnpql_jax.tasks import make_task
from apnpql_jax.tasks.push_plate import PushPlate
from apnpql_jax.tasks.task import register_task


def test_a_name_belongs_to_one_class():
  """Only a reload, the same class by module and qualified name, may replace it."""
  other = type("Other", (PushPlate,), {})
  with pytest.raises(
    ConfigError, match=r"'push_plate' .*Other is taken by .*PushPlate"
  ):
    register_task(other)
  assert type(make_task("push_plate")) is PushPlate
  reloaded = type("PushPlate", (PushPlate,), {"__module__": PushPlate.__module__})
  try:
    register_task(reloaded)
    assert type(make_task("push_plate")) is reloaded
  finally:
    register_task(PushPlate)
