"""Several devices, and several processes, learn what one device learns.

Only the order of their sums may differ, so the distance between the parameters must be
small compared to how far they moved.
"""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from typing import Any

from hand_made import SLOW_MJX
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import devices, testing
from apnpql_jax.agents.learner import LearnerState, make_agent
from apnpql_jax.cli import main
from apnpql_jax.config.checks import validate
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.errors import UserError
from apnpql_jax.runs import checkpoint_reader, leaves, run_folder
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter
from apnpql_jax.training import resume
from apnpql_jax.training.expert import collect_expert
from apnpql_jax.training.iteration import make_iteration
from apnpql_jax.training.placement import shardings
from apnpql_jax.training.rollout import agent_policy, rollout
from apnpql_jax.training.state import TrainState, example_state, initial_state
from benchmarks.speed import messages

DEVICES = 4
ITERATIONS = 3
LENGTH = 26
"""Instants of the replay; no other size in the program has this value."""

ROUNDING = 1e-4
"""Allowed distance as a fraction of how far the parameters moved; measured: 1e-6."""

PATIENCE_S = 600


@pytest.mark.parametrize("backend", SLOW_MJX)
def test_four_devices_learn_what_one_learns(backend):
  flags = f"{testing.XLA_FLAGS} --xla_force_host_platform_device_count={DEVICES}"
  path = os.pathsep.join(map(str, (testing.ROOT, *sys.path, Path(__file__).parent)))
  done = subprocess.run(
    [sys.executable, "-c", f"import test_sharding as t; t.compare({backend!r})"],
    env=os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": path},
    stdout=subprocess.PIPE,
    timeout=PATIENCE_S,
    check=True,
  )
  result = json.loads(done.stdout)
  print(result)
  assert result["loss"][0] == pytest.approx(result["loss"][1], rel=1e-4)
  assert result["distance"] < ROUNDING * result["moved"]
  # Each device has a part of the worlds and of both replays, and all of the rest.
  assert result["split"] == ["env", "expert_replay/slots", "replay/slots"]
  # Messages hold a batch or gradients, never a replay. Rollouts send none.
  assert result["messages"] and not any(f"[{LENGTH}," in m for m in result["messages"])
  assert result["messages_of_rollout"] == []
  assert result["resumed_on_four"] and result["resumed_on_one"]


def compare(backend: str) -> None:
  """Prints the results of a run on one device and on several as JSON."""
  env = dataclasses.replace(testing.TINY.env, backend=backend, worlds=2 * DEVICES)
  replay = dataclasses.replace(testing.TINY.replay, capacity=LENGTH * env.worlds)
  config = dataclasses.replace(testing.TINY, env=env, replay=replay)
  result: dict[str, Any] = {"loss": []}
  several = make_env(config.env, devices.make_mesh(DEVICES))
  alone, agent, ends = several.on_one_device(), make_agent(config.agent), []
  begin = initial_state(config, alone, agent, collect_expert)
  for env in (alone, several):
    copy = jax.tree.map(jnp.copy, begin)  # The iteration donates its argument.
    state = jax.device_put(copy, shardings(copy, env.mesh))
    jitted: Any = make_iteration(config, env, agent)
    iteration = jitted.lower(state).compile()
    for _ in range(ITERATIONS):
      state, metrics = iteration(state)
    result["loss"].append(float(metrics["loss/q"]))
    ends.append(_flat(state.learner))
  result["distance"] = float(np.linalg.norm(ends[1] - ends[0]))
  result["moved"] = float(np.linalg.norm(ends[0] - _flat(begin.learner)))
  result["split"] = _split(state)
  result["messages"] = messages.messages(iteration)

  def play(state: TrainState) -> Any:
    policy = agent_policy(agent, state.learner.params, acting="policy")
    return rollout(several, policy, state.env, state.key, length=2)

  result["messages_of_rollout"] = messages.messages(
    jax.jit(play).lower(state).compile()
  )
  with tempfile.TemporaryDirectory() as name:
    run = Path(name)
    with CheckpointWriter(run, config, keep=1) as writer:
      rings = resume.to_rings(state, chunk=config.rollout_length)
      writer.save(1, resume.to_items(state, whole=True), rings=rings)
    for key, place in (("four", several), ("one", alone)):
      example = example_state(config, place, agent)
      found = resume.restore_run(config, run, example, print).state
      same = leaves.checksums(found) == leaves.checksums(state)
      result[f"resumed_on_{key}"] = same and jax.tree.map(
        lambda x: x.sharding, found
      ) == jax.tree.map(lambda x: x.sharding, example)
  print(json.dumps(result))


def _flat(learner: LearnerState) -> np.ndarray:
  return np.concatenate([np.ravel(x) for x in jax.tree.leaves(learner.params)])


def _split(state: TrainState) -> list[str]:
  """Returns the parts that are split evenly; all leaves of a part must be."""
  parts: dict[str, set[bool]] = {}
  for name, leaf in leaves.named(state).items():
    sizes = [shard.data.size for shard in leaf.addressable_shards]
    assert len(sizes) == DEVICES and len(set(sizes)) == 1
    part = "/".join(name.split("/")[: 2 if "replay" in name else 1])
    parts.setdefault(part, set()).add(sizes[0] * DEVICES == leaf.size != 0)
  return sorted(part for part, split in parts.items() if split == {True})


@pytest.mark.slow
@pytest.mark.parametrize("resumed", [False, True])
def test_two_processes_learn_what_one_learns_and_stop_together(tmp_path, resumed):
  run, single = tmp_path / "run", tmp_path / "single"
  logs = [tmp_path / "first", tmp_path / "second", tmp_path / "single.log"]

  def start(*args: str) -> list[subprocess.Popen[bytes]]:
    with socket.socket() as free:
      free.bind(("127.0.0.1", 0))
      address = f"127.0.0.1:{free.getsockname()[1]}"
    shared = ("--coordinator", address, "--processes", "2", "--process")
    common = ("--keep-checkpoints", "1000", *args)
    return [testing.start(run, *common, *shared, str(i), log=logs[i]) for i in range(2)]

  alone = testing.start(single, "--total-steps", "64", log=logs[2])
  if resumed:
    for process, log in zip(start("--total-steps", "32"), logs, strict=False):
      assert process.wait(PATIENCE_S) == 0, log.read_text()[-4000:]
  pair = start("--total-steps", "1000000")
  deadline = time.monotonic() + PATIENCE_S
  while 64 not in checkpoint_reader.all_steps(run):
    assert time.monotonic() < deadline and pair[0].poll() is None, logs[0].read_text()
    time.sleep(0.1)
  pair[1].send_signal(signal.SIGTERM)
  for process, log in zip(pair, logs, strict=False):
    assert process.wait(PATIENCE_S) == 128 + signal.SIGTERM, log.read_text()[-4000:]
  rows = [row["step"] for row in testing.rows(run) if "loss/q" in row]
  assert rows == list(range(8, rows[-1] + 8, 8))
  assert checkpoint_reader.latest_step(run) == rows[-1]
  # Only the first process shows progress.
  shown = [" of 1,000,000" in log.read_text() for log in logs[:2]]
  assert shown == [True, False]

  assert alone.wait(PATIENCE_S) == 0, logs[2].read_text()[-4000:]
  assert_same(run, single)


def assert_same(run: Path, single: Path) -> None:
  """Asserts that both runs have the same parameters after 64 steps, within rounding."""
  config = run_folder.load_run_config(run)
  env, agent = make_env(config.env), make_agent(config.agent)
  example = {"learner": example_state(config, env, agent).learner}

  def saved(folder: Path, step: int) -> np.ndarray:
    return _flat(checkpoint_reader.restore(folder, step, example).items["learner"])

  end = saved(single, 64)
  moved, distance = (np.linalg.norm(end - saved(run, step)) for step in (16, 64))
  print(f"distance {distance:.3g}, moved {moved:.3g}")
  assert 0 < distance < ROUNDING * moved


@pytest.mark.parametrize(
  ("devices", "message"),
  [(3, "env.worlds=32 must be a multiple of the 3 devices"), (64, "env.worlds=32")],
)
def test_uneven_splits_are_rejected(devices, message):
  with pytest.raises(UserError, match=re.escape(message)):
    validate(TrainConfig(), devices=devices)


@pytest.mark.parametrize(
  ("options", "message"),
  [
    (["--devices", "99"], "--devices 99 must be from 0 (all) to 1"),
    (["--coordinator", "a:1"], "processes of one run must be given the same --run"),
    (["--processes", "2"], "--processes and --process need a --coordinator"),
  ],
)
def test_bad_options_are_rejected_in_one_line(options, message, capsys):
  assert main.main(["train", "push_plate", *options]) == 2
  assert message in capsys.readouterr().err
