"""Damage to the checkpoints of a run, for the soak: bits, and what is not finite."""

from __future__ import annotations

from pathlib import Path
import random
import shutil
from typing import Any

from apnpql_jax.runs import run_folder

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)

import jax
import jax.numpy as jnp

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.envs.env import make_env
from apnpql_jax.runs import checkpoint_reader
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter
from apnpql_jax.training import resume
from apnpql_jax.training.expert import empty_expert
from apnpql_jax.training.state import initial_state


def poison(run: Path, *, rewards: bool) -> None:
  """Puts what is not finite into the state of a run, as its only checkpoint.

  Args:
    run: the run folder.
    rewards: into all of both replays; else into the velocity of one world.
  """
  config = run_folder.load_run_config(run)
  env, agent = make_env(config.env), make_agent(config.agent)
  example = jax.eval_shape(lambda: initial_state(config, env, agent, empty_expert))
  state = resume.restore(config, run, example, lambda line: None)
  if rewards:
    state = state.replace(
      replay=_no_rewards(state.replay), expert_replay=_no_rewards(state.expert_replay)
    )
  else:
    physics = state.env.physics
    physics = physics.replace(qvel=physics.qvel.at[1, 0].set(jnp.nan))
    state = state.replace(env=state.env.replace(physics=physics))
  shutil.rmtree(run / "checkpoints")
  with CheckpointWriter(run, config, keep=1) as writer:
    writer.save(int(state.env_steps), resume.to_items(state, whole=True))


def flip_a_bit(run: Path, rng: random.Random) -> str:
  """In the largest file of the newest checkpoint; returns its name."""
  folder = run / "checkpoints" / str(checkpoint_reader.latest_step(run))
  files = [path for path in folder.rglob("*") if path.is_file()]
  file = max(files, key=lambda path: path.stat().st_size)
  data = bytearray(file.read_bytes())
  data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
  file.write_bytes(data)
  return str(file.relative_to(run))


def _no_rewards(ring: Any) -> Any:
  timestep = ring.slots.timestep
  timestep = timestep.replace(reward=timestep.reward * jnp.nan)
  return ring.replace(slots=ring.slots.replace(timestep=timestep))
