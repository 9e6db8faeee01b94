"""Memory of a training whose replay is saved while it continues, in a new process."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile

from apnpql_jax import devices, testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.envs.env import make_env
from apnpql_jax.runs import leaves, segments
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter
from apnpql_jax.training import resume
from apnpql_jax.training.expert import collect_expert
from apnpql_jax.training.iteration import make_iteration
from apnpql_jax.training.start import needed_memory
from apnpql_jax.training.state import TrainState, example_state, initial_state
from benchmarks.reliability.memory import memory

CAPACITY = 1_600_000
PART_BYTES = 32 << 20


def test_a_save_takes_the_memory_of_a_part_and_gives_it_back():
  path = os.pathsep.join(map(str, (testing.ROOT, *sys.path, Path(__file__).parent)))
  done = subprocess.run(
    [sys.executable, "-c", "import test_memory as t; t.save_and_restore()"],
    env=os.environ | {"XLA_FLAGS": testing.XLA_FLAGS, "PYTHONPATH": path},
    stdout=subprocess.PIPE,
    timeout=600,
    check=True,
  )
  found = json.loads(done.stdout)
  print({name: x >> 20 for name, x in found.items()})
  replay = found["replay"]
  assert replay > 10 * PART_BYTES
  assert found["saving"] - found["before"] < 5 * PART_BYTES
  assert found["saved"] - found["before"] < 2 * PART_BYTES
  # A second replay would double these; buffers of TensorStore remain.
  assert found["restoring"] - found["dropped"] < 1.75 * replay
  assert found["restored"] - found["dropped"] < 1.5 * replay
  assert found["restoring"] < found["needed"]


def save_and_restore() -> None:
  """Prints the resident bytes at each stage as JSON."""
  segments.PART_BYTES = PART_BYTES
  config = dataclasses.replace(
    testing.TINY, replay=dataclasses.replace(testing.TINY.replay, capacity=CAPACITY)
  )
  env, agent = make_env(config.env), make_agent(config.agent)
  example = example_state(config, env, agent)
  state = initial_state(config, env, agent, collect_expert)
  iteration = make_iteration(config, env, agent)
  # As if the replay were full, so that all of it has to be written.
  state = state.replace(env_steps=state.env_steps + CAPACITY)
  for _ in range(2):
    state, _ = iteration(state)
  found = {"replay": leaves.nbytes(example.replay), "needed": needed_memory(example)}
  with tempfile.TemporaryDirectory() as name:
    run = Path(name)
    with CheckpointWriter(run, config, keep=1) as writer:
      found["before"] = settled()
      items = resume.to_items(state, whole=True)
      writer.save(CAPACITY, items, rings=rings(state))
      del items
      while not writer.proceed(rings(state)):
        state, _ = iteration(state)
    found["saving"], _ = memory(os.getpid())
    found["saved"] = settled()
    del state, writer
    found["dropped"] = settled()
    restored = resume.restore_run(config, run, example, print).state
    found["restoring"], _ = memory(os.getpid())
    found["restored"] = settled()
    assert int(restored.env_steps) == CAPACITY + 2 * testing.STEPS
  print(json.dumps(found))


def rings(state: TrainState) -> dict[str, segments.Ring]:
  return resume.to_rings(state, chunk=testing.TINY.rollout_length)


def settled() -> int:
  """Returns the resident bytes, and lets the peak start from there."""
  devices.release_memory()
  Path("/proc/self/clear_refs").write_text("5")
  return memory(os.getpid())[1]
