"""Doubles answer late on a busy machine, which is not what most tests are about."""

from __future__ import annotations

import pytest

from apnpql_jax.robot.drivers import buses


@pytest.fixture(autouse=True)
def patience(request, monkeypatch) -> None:
  """Lets the driver of the gripper wait longer, unless a test is about its silence."""
  if "silent" not in request.node.name:
    monkeypatch.setattr(buses, "ATTEMPTS", 20)
