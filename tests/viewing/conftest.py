"""A tiny run with checkpoints, watched by the tests of this room."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from apnpql_jax import testing
from apnpql_jax.training.train import train
from apnpql_jax.viewing.actors import Trained
from apnpql_jax.viewing.player import Player


@pytest.fixture(scope="session")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
  """Trains a tiny agent from states, with episodes of four control periods."""
  env = dataclasses.replace(testing.TINY.env, time_limit_s=0.6)
  run = tmp_path_factory.mktemp("runs") / "tiny"
  train(dataclasses.replace(testing.TINY, env=env), run)
  return run


@pytest.fixture(scope="session")
def player(run_dir: Path) -> Player:
  """Returns a player of the run; each test begins an episode of its own."""
  return Player(Trained(run_dir, acting="policy"), wide=(82, 120))
