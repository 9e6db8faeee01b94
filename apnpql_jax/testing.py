"""Tiny but complete runs and random batches, for tests and benchmarks.

Such runs compile without optimization, because optimizing takes longer than it saves.
"""

from __future__ import annotations

import hashlib
from importlib import metadata
import json
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from apnpql_jax.config.schema import AgentConfig, EnvConfig, ReplayConfig, TrainConfig
from apnpql_jax.runs import checkpoint_record, metrics, segments
from apnpql_jax.types import Observation, Slot, TimeStep, Transition

ROOT = Path(__file__).resolve().parents[1]

XLA_FLAGS = (
  "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
  "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
"""Value of the environment variable that makes compilation fast."""

TINY = TrainConfig(
  env=EnvConfig(worlds=4, bank_rows=256, obs="state", backend="native"),
  agent=AgentConfig(
    n_step=2,
    hidden=(16, 16),
    feature_dim=16,
    target_samples=4,
    policy_samples=4,
  ),
  replay=ReplayConfig(capacity=64, expert_steps=32, expert_share=0.5, batch_size=8),
  total_steps=64,
  rollout_length=2,
  updates_per_iteration=2,
  eval_every=1_000_000,
  eval_episodes=4,
  checkpoint_every=16,
  video=False,
)
STEPS = TINY.env.worlds * TINY.rollout_length
"""Environment steps per iteration."""

TINY_ARGS = (
  "--env.worlds 4 --env.bank-rows 256 --obs state --backend native --agent.n-step 2 "
  "--agent.hidden 16 16 --agent.feature-dim 16 --agent.target-samples 4 "
  "--agent.policy-samples 4 --agent.m-step-delay 0 --replay.capacity 64 "
  "--replay.expert-steps 32 --replay.expert-share 0.5 --replay.batch-size 8 "
  "--rollout-length 2 --updates-per-iteration 2 --eval-every 1000000 "
  "--eval-episodes 4 --checkpoint-every 16 --no-video"
).split()
"""Options that give the run of a preset the sizes of ``TINY``."""


def start(
  run_dir: Path,
  *args: str,
  log: Path,
  log_compiles: bool = False,
  xla_flags: str = XLA_FLAGS,
) -> subprocess.Popen[bytes]:
  """Trains in a new process, or resumes if ``run_dir`` is a run; output to ``log``."""
  command = [sys.executable, "-m", "apnpql_jax", "train"]
  if (run_dir / "config.json").exists():
    command += ["--resume", str(run_dir)]
  else:
    command += ["push_plate", "--run", str(run_dir), *TINY_ARGS]
  env = os.environ | {"XLA_FLAGS": xla_flags, "PYTHONPATH": str(ROOT)}
  env |= {"JAX_LOG_COMPILES": "1"} if log_compiles else {}
  with log.open("ab") as file:
    return subprocess.Popen(
      [*command, *args], cwd=log.parent, env=env, stdout=file, stderr=file
    )


def rows(run_dir: Path) -> list[dict[str, Any]]:
  """Returns the complete rows of a run's metrics; none if it has not begun."""
  files = metrics.metric_files(run_dir)
  return [dict(row) for path in files for row in metrics.read_rows(path)]


def saved_arrays(run_dir: Path, step: int) -> dict[str, np.ndarray]:
  """Returns every array of a checkpoint, read by Orbax alone.

  Arrays in segments are in parts.
  """
  folder = (run_dir / "checkpoints" / str(step)).absolute()
  folders = {item: folder / item for item in ("learner", "rest", "replay")}
  for part in checkpoint_record.read(run_dir, step).segments:
    folders[f"{part.ring} {part.start}"] = segments.folder(run_dir) / str(part.number)
  found = {}
  for name, folder in folders.items():
    with ocp.StandardCheckpointer() as reader:
      tree = reader.restore(folder)
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
      found[f"{name} {path}"] = np.asarray(leaf)
  return found


def saved_bytes(run_dir: Path, step: int) -> dict[str, bytes]:
  """Returns the bytes of ``saved_arrays``."""
  return {name: x.tobytes() for name, x in saved_arrays(run_dir, step).items()}


SMALL = AgentConfig(
  hidden=(16, 16),
  feature_dim=16,
  num_atoms=11,
  target_samples=8,
  policy_samples=8,
  patch_channels=4,
  conv_channels=4,
  n_step=2,
)
"""Settings that compile in a few seconds for every row of Table I."""


def export_untrained(
  folder: Path, agent: AgentConfig = SMALL, *, time_limit_s: float = 3.0
) -> dict[str, Any]:
  """Writes a policy for push_plate with random weights as ``apnpql export`` does.

  Returns its contract, without most of its origin.
  """
  from apnpql_jax.agents.learner import make_agent
  from apnpql_jax.deploy import contract, program
  from apnpql_jax.deploy.export import CONTRACT, PROGRAM, VERSION
  from apnpql_jax.envs.env import observation_shapes
  from apnpql_jax.tasks import make_task

  config = EnvConfig(time_limit_s=time_limit_s)
  learner, task = make_agent(agent), make_task(config.task)
  seen = observation_shapes(config, task, lstm_instants=agent.lstm_instants)
  zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), seen)
  params = learner.init(jax.random.key(1), zeros).params
  shapes = seen.present()
  made = program.export(program.make_act(learner, params, acting="policy"), shapes)
  about = {
    "contract": VERSION,
    "program": {
      "file": PROGRAM,
      "sha256": hashlib.sha256(made.data).hexdigest(),
      "xla_flags": os.environ.get("XLA_FLAGS", ""),
    },
    "acting": {"rule": "policy", "needs_key": made.needs_key},
    **contract.describe(config, task.scene, shapes, lstm_instants=agent.lstm_instants),
    "origin": {
      "scene_sha256": task.scene.fingerprint,
      "exported_with": {"packages": {"jaxlib": metadata.version("jaxlib")}},
    },
  }
  folder.mkdir(parents=True, exist_ok=True)
  (folder / PROGRAM).write_bytes(made.data)
  (folder / CONTRACT).write_text(json.dumps(about), encoding="utf-8")
  return about


def random_batch(
  seed: int,
  batch: int = 16,
  *,
  pixels: bool = False,
  windows: int = 0,
  lstm_instants: int = 0,
) -> Transition:
  """Returns a batch of random transitions, with images if ``pixels``.

  ``windows`` is the N of ``Transition.window``, 0 for none; ``lstm_instants`` the
  number of instants per observation, 0 for single observations.
  """
  rng = np.random.default_rng(seed)

  def normal(*shape: int) -> jax.Array:
    return jnp.asarray(rng.normal(size=shape), jnp.float32)

  def flags(*shape: int) -> jax.Array:
    return jnp.asarray(rng.random(shape) < 0.3)

  def image(*shape: int) -> jax.Array | None:
    return jnp.asarray(rng.integers(0, 256, shape), jnp.uint8) if pixels else None

  def observation(*shape: int) -> Observation:
    shape += (lstm_instants,) * bool(lstm_instants)
    return Observation(
      robot=normal(*shape, 21),
      tool=0.3 * normal(*shape, 3),
      global_image=image(*shape, 72, 96, 3),
      wrist_image=image(*shape, 36, 64, 3),
      objects=0.3 * normal(*shape, 9),
    )

  def action(*shape: int) -> jax.Array:
    gripper = jnp.asarray(rng.integers(0, 2, (*shape, 1)), jnp.float32)
    return jnp.concatenate([jnp.tanh(normal(*shape, 6)), gripper], axis=-1)

  def slots(*shape: int) -> Slot:
    timestep = TimeStep(
      observation=observation(*shape),
      reward=normal(*shape),
      terminated=flags(*shape),
      truncated=flags(*shape),
      primitives=action(*shape, 3),
    )
    return Slot(timestep, action(*shape), log_prob=normal(*shape))

  success = flags(batch).astype(jnp.float32)
  return Transition(
    observation_tm1=observation(batch),
    action_tm1=action(batch),
    reward_t=success,
    discount_t=0.97 * (1.0 - success),
    observation_t=observation(batch),
    primitives_tm1=action(batch, 3),
    weight=jnp.ones(batch),
    window=slots(batch, windows) if windows else None,
    expert_tm1=action(batch),
  )
