"""What the tests of the runtime share: a policy, and patience with the doubles."""

from __future__ import annotations

from pathlib import Path

import pytest

from apnpql_jax.robot.drivers import buses


@pytest.fixture(autouse=True)
def patience(monkeypatch) -> None:
  """Lets the driver of the gripper wait longer.

  On a busy machine doubles answer late, which is not what most tests are about.
  """
  monkeypatch.setattr(buses, "ATTEMPTS", 20)


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Path:
  """Returns the folder of an untrained policy."""
  from apnpql_jax.testing import export_untrained  # Imports JAX.

  folder = tmp_path_factory.mktemp("policies") / "policy"
  export_untrained(folder)
  return folder
