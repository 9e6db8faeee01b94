"""Runs that are resumed with other settings."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.cli.main import main
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.runs import leaves, run_folder
from apnpql_jax.training import resume
from apnpql_jax.training.evaluate import evaluate
from apnpql_jax.training.train import train

WORLDS = 2


def ring_of(instants: int, *, length: int, chunk: int) -> replay.Replay:
  """Returns a ring in which each slot's robot state is its number, from 1 on."""
  batch = testing.random_batch(0, windows=1)
  assert batch.window is not None
  slot = jax.tree.map(lambda x: x[0, 0], batch.window)
  ring = replay.create(slot, length, WORLDS)
  for start in range(1, instants + 1, chunk):
    ring = add(ring, start, chunk)
  return ring


def add(ring: replay.Replay, start: int, chunk: int) -> replay.Replay:
  empty = jax.tree.map(lambda x: jnp.zeros((chunk, *x.shape[1:]), x.dtype), ring.slots)
  number = jnp.arange(start, start + chunk, dtype=jnp.float32)
  robot = empty.timestep.observation.robot + number[:, None, None]
  observation = empty.timestep.observation.replace(robot=robot)
  timestep = empty.timestep.replace(observation=observation)
  return replay.add(ring, empty.replace(timestep=timestep))


def drawn(ring: replay.Replay) -> set[tuple[int, int]]:
  """Returns the numbers of the first and last slot of many transitions."""
  batch = replay.sample(ring, jax.random.key(0), batch_size=4000, n_step=2, gamma=0.9)
  pairs = np.stack(
    [batch.observation_tm1.robot[:, 0], batch.observation_t.robot[:, 0]], axis=1
  )
  return {(int(a), int(b)) for a, b in pairs[np.asarray(batch.weight) > 0]}


@pytest.mark.parametrize("instants", [2, 6, 22, 24, 26, 46])
@pytest.mark.parametrize("chunk", [1, 2, 3, 8])
def test_a_ring_takes_chunks_of_another_length(instants, chunk):
  """The ring is full, or not; no transition joins slots that are not neighbors."""
  ring = ring_of(instants, length=24, chunk=2)
  ring = resume._aligned(ring, chunk=chunk)
  assert int(ring.cursor) % chunk == 0
  for start in range(instants + 1, instants + 1 + 4 * chunk, chunk):
    pairs = drawn(ring)
    assert all(a > 0 and a < b <= a + 2 for a, b in pairs)
    # All are drawn but those at the seam and those that are passed over.
    oldest = max(1, start - 24)
    missing = set(range(oldest, start - 2)) - {a for a, _ in pairs}
    assert len(missing) <= 2 + chunk
    ring = add(ring, start, chunk)


def test_learning_rates_keep_their_counter():
  """One that did not decay starts at the updates done, and the moments are kept."""
  observation = testing.random_batch(0).observation_tm1
  constant = testing.SMALL
  decaying = dataclasses.replace(constant, decay_updates=100)
  states = [
    make_agent(config).init(jax.random.key(0), observation)
    for config in (constant, decaying)
  ]
  states = [x.replace(step=jnp.asarray(7, jnp.int32)) for x in states]
  # As after seven updates, each of which counts everywhere.
  states = [
    leaves.fill(
      x, {k: v + 7 if k.endswith("count") else v for k, v in leaves.named(x).items()}
    )
    for x in states
  ]
  for before, after in (states, states[::-1]):
    carried = resume._with_counters(before, after)
    jax.tree.map(np.testing.assert_array_equal, carried, after)
  assert len(leaves.named(states[0])) < len(leaves.named(states[1]))


def changed(config: TrainConfig, **parts: dict[str, Any]) -> TrainConfig:
  """Returns the configuration with settings of its parts, or of itself, changed."""
  own = parts.pop("own", {})
  new = {
    part: dataclasses.replace(getattr(config, part), **settings)
    for part, settings in parts.items()
  }
  return dataclasses.replace(config, **new, **own)


def test_a_run_goes_on_with_other_settings(tmp_path, capsys):
  run = tmp_path / "run"
  first = dataclasses.replace(testing.TINY, total_steps=24, checkpoint_every=8)
  train(first, run)
  other = changed(
    first,
    agent={
      "learning_rate_e": 1e-4,
      "learning_rate_m": 1e-5,
      "decay_updates": 50,
      "target_rate": 0.1,
      "target_samples": 6,
      "policy_samples": 5,
      "candidate_precision": "bfloat16",
      "epsilon": 0.8,
    },
    replay={"batch_size": 16, "expert_share": 0.25},
    own={"rollout_length": 4, "updates_per_iteration": 3, "total_steps": 56}
    | {"keep_checkpoints": 9},
  )
  capsys.readouterr()
  # The last checkpoint is at 24 = 6 instants of 4 worlds, no multiple of 4.
  summary = train(other, run, resume=True)
  assert summary["env_steps"] == 56 and summary["updates"] == 6 + 6
  line = "settings changed at step 24: agent.learning_rate_e 0.0003 -> 0.0001, "
  assert line in capsys.readouterr().err
  versions = json.loads((run / "versions.json").read_text())
  (change,) = versions["changes"]
  assert change["step"] == 24
  assert change["settings"]["agent.decay_updates"] == [0, 50]
  assert json.loads((run / "config.json").read_text())["rollout_length"] == 4
  # A checkpoint from before is evaluated too, though its optimizers differ.
  assert evaluate(run, episodes=2, step=24)["checkpoint_step"] == 24
  assert run_folder.load_run_config(run) == other
  capsys.readouterr()
  assert train(other, run, resume=True)["updates"] == 12
  assert "nothing to train: step 56 of 56 is done" in capsys.readouterr().err


def test_what_must_not_change_is_refused_with_the_cure(tmp_path, capsys):
  run = str(run_folder.create(tmp_path / "run", testing.TINY).path)
  resume_run = ["train", "--resume", run]
  assert main([*resume_run, "--env.worlds", "8"]) == 2
  assert "env.worlds 4 -> 8; resume it without" in capsys.readouterr().err
  assert main([*resume_run, "--rollout-length", "3"]) == 2
  assert "replay.capacity=64 must be a multiple of" in capsys.readouterr().err
  assert Path(run, "config.json").exists()
