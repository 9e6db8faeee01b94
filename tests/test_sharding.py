"""Several devices, and several processes, learn what one device learns.

They add up in another order than one device does. Nothing else may differ: how far
the parameters are apart is held to be small against the way that they have come.
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
import tiny

from apnpql_jax import checkpoint, cli, leaves, resuming, runs, sharding
from apnpql_jax.agents.learner import LearnerState, make_agent
from apnpql_jax.checkpoint_writer import CheckpointWriter
from apnpql_jax.config import ConfigError, TrainConfig, validate
from apnpql_jax.env import make_env
from apnpql_jax.iteration import (
  TrainState,
  collect_expert,
  example_state,
  initial_state,
  make_iteration,
  shardings,
)
from apnpql_jax.rollout import agent_policy, rollout
from benchmarks.speed import messages

DEVICES = 4
ITERATIONS = 3
LENGTH = 26
"""Time steps of the replay: of the sizes in the program, only it has this one."""

ROUNDING = 1e-4
"""Of the way that the parameters have come; measured: 1e-6."""

PATIENCE_S = 600


@pytest.mark.parametrize("backend", SLOW_MJX)
def test_four_devices_learn_what_one_learns(backend):
  flags = f"{tiny.XLA_FLAGS} --xla_force_host_platform_device_count={DEVICES}"
  path = os.pathsep.join(map(str, (tiny.ROOT, *sys.path, Path(__file__).parent)))
  done = subprocess.run(
    [sys.executable, "-c", f"import test_sharding as t; t.tell({backend!r})"],
    env=os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": path},
    stdout=subprocess.PIPE,
    timeout=PATIENCE_S,
    check=True,
  )
  told = json.loads(done.stdout)
  print(told)
  assert told["loss"][0] == pytest.approx(told["loss"][1], rel=1e-4)
  assert told["distance"] < ROUNDING * told["way"]
  # Each device has a part of the worlds and of both replays, and all of the rest.
  assert told["split"] == ["env", "expert_replay/slots", "replay/slots"]
  # What travels is a batch or gradients, never a replay; and while worlds are played,
  # nothing.
  assert told["messages"] and not any(f"[{LENGTH}," in m for m in told["messages"])
  assert told["messages_of_rollout"] == []
  assert told["resumed_on_four"] and told["resumed_on_one"]


def tell(backend: str) -> None:
  """Prints what becomes of a run on one device and on several, as JSON."""
  env = dataclasses.replace(tiny.CONFIG.env, backend=backend, worlds=2 * DEVICES)
  replay = dataclasses.replace(tiny.CONFIG.replay, capacity=LENGTH * env.worlds)
  config = dataclasses.replace(tiny.CONFIG, env=env, replay=replay)
  told: dict[str, Any] = {"loss": []}
  several = make_env(config.env, sharding.make_mesh(DEVICES))
  alone, agent, ends = several.on_one_device(), make_agent(config.agent), []
  begin = initial_state(config, alone, agent, collect_expert)
  for env in (alone, several):
    copy = jax.tree.map(jnp.copy, begin)  # The iteration takes the state for itself.
    state = jax.device_put(copy, shardings(copy, env.mesh))
    jitted: Any = make_iteration(config, env, agent)
    iteration = jitted.lower(state).compile()
    for _ in range(ITERATIONS):
      state, metrics = iteration(state)
    told["loss"].append(float(metrics["loss/q"]))
    ends.append(_flat(state.learner))
  told["distance"] = float(np.linalg.norm(ends[1] - ends[0]))
  told["way"] = float(np.linalg.norm(ends[0] - _flat(begin.learner)))
  told["split"] = _split(state)
  told["messages"] = messages.messages(iteration)

  def play(state: TrainState) -> Any:
    policy = agent_policy(agent, state.learner.params, greedy=False)
    return rollout(several, policy, state.env, state.key, length=2)

  told["messages_of_rollout"] = messages.messages(jax.jit(play).lower(state).compile())
  with tempfile.TemporaryDirectory() as name:
    run = Path(name)
    with CheckpointWriter(run, config, keep=1) as writer:
      writer.save(1, resuming.to_items(state, whole=True))
    for key, place in (("four", several), ("one", alone)):
      example = example_state(config, place, agent)
      found = resuming.restore(config, run, example, print)
      same = leaves.checksums(found) == leaves.checksums(state)
      told[f"resumed_on_{key}"] = same and jax.tree.map(
        lambda x: x.sharding, found
      ) == jax.tree.map(lambda x: x.sharding, example)
  print(json.dumps(told))


def _flat(learner: LearnerState) -> np.ndarray:
  return np.concatenate([np.ravel(x) for x in jax.tree.leaves(learner.params)])


def _split(state: TrainState) -> list[str]:
  """Which parts are split evenly; all leaves of a part must be."""
  parts: dict[str, set[bool]] = {}
  for name, leaf in leaves.named(state).items():
    sizes = [shard.data.size for shard in leaf.addressable_shards]
    assert len(sizes) == DEVICES and len(set(sizes)) == 1
    part = "/".join(name.split("/")[: 2 if "replay" in name else 1])
    parts.setdefault(part, set()).add(sizes[0] * DEVICES == leaf.size != 0)
  return sorted(part for part, split in parts.items() if split == {True})


def test_two_processes_learn_what_one_learns_and_stop_together(tmp_path):
  run, single = tmp_path / "run", tmp_path / "single"
  said = [tmp_path / "first", tmp_path / "second", tmp_path / "single.log"]

  def start(*args: str) -> list[subprocess.Popen[bytes]]:
    with socket.socket() as free:
      free.bind(("127.0.0.1", 0))
      address = f"127.0.0.1:{free.getsockname()[1]}"
    shared = ("--coordinator", address, "--processes", "2", "--process")
    common = ("--keep-checkpoints", "1000", *args)
    return [tiny.start(run, *common, *shared, str(i), said=said[i]) for i in range(2)]

  pair = start("--total-steps", "32")
  alone = tiny.start(single, "--total-steps", "64", said=said[2])
  for process, log in zip([*pair, alone], said, strict=True):
    assert process.wait(PATIENCE_S) == 0, log.read_text()[-4000:]
  # The first process tells of it, the second one has nothing to say.
  assert "32 of 32" in said[0].read_text()
  assert "step" not in said[1].read_text()

  pair = start("--total-steps", "1000000")
  deadline = time.monotonic() + PATIENCE_S
  while 64 not in checkpoint.all_steps(run):
    assert time.monotonic() < deadline and pair[0].poll() is None, said[0].read_text()
    time.sleep(0.1)
  pair[1].send_signal(signal.SIGTERM)
  for process, log in zip(pair, said, strict=False):
    assert process.wait(PATIENCE_S) == 128 + signal.SIGTERM, log.read_text()[-4000:]
  rows = [row["step"] for row in tiny.rows(run) if "loss/q" in row]
  assert rows == list(range(8, rows[-1] + 8, 8))
  assert checkpoint.latest_step(run) == rows[-1]

  assert_same(run, single)


def assert_same(run: Path, single: Path) -> None:
  """Both runs have the same parameters after 64 steps, within rounding."""
  config = runs.load_run_config(run)
  env, agent = make_env(config.env), make_agent(config.agent)
  example = {"learner": example_state(config, env, agent).learner}

  def saved(folder: Path, step: int) -> np.ndarray:
    return _flat(checkpoint.restore(folder, step, example).items["learner"])

  end = saved(single, 64)
  way, distance = (np.linalg.norm(end - saved(run, step)) for step in (16, 64))
  print(f"distance {distance:.3g}, way {way:.3g}")
  assert 0 < distance < ROUNDING * way


@pytest.mark.parametrize(
  ("devices", "message"),
  [(3, "env.worlds=32 must be a multiple of the 3 devices"), (64, "env.worlds=32")],
)
def test_what_cannot_be_split_is_refused(devices, message):
  with pytest.raises(ConfigError, match=re.escape(message)):
    validate(TrainConfig(), devices=devices)


@pytest.mark.parametrize(
  ("options", "message"),
  [
    (["--devices", "99"], "--devices 99 must be within 0 (all) and 1"),
    (["--coordinator", "a:1"], "processes of one run must be given the same --run"),
    (["--processes", "2"], "--processes and --process need a --coordinator"),
  ],
)
def test_bad_options_are_refused_in_one_line(options, message, capsys):
  assert cli.main(["train", "push_plate", *options]) == 2
  assert message in capsys.readouterr().err
