"""Damage to the checkpoints of a run: flipped bits, and numbers that are not finite."""

from __future__ import annotations

from pathlib import Path
import random
import shutil
from typing import Any

import jax
import jax.numpy as jnp

from apnpql_jax import checkpoint, resuming, runs
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.checkpoint_writer import CheckpointWriter
from apnpql_jax.env import make_env
from apnpql_jax.iteration import empty_expert, initial_state


def poison(run: Path, *, rewards: bool) -> None:
  """Puts NaN into the state of a run and saves it as its only checkpoint.

  Args:
    run: the run folder.
    rewards: whether all rewards of both replays become NaN; otherwise the velocity of
      one world does.
  """
  config = runs.load_run_config(run)
  env, agent = make_env(config.env), make_agent(config.agent)
  example = jax.eval_shape(lambda: initial_state(config, env, agent, empty_expert))
  state = resuming.restore(config, run, example, lambda line: None)
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
    writer.save(int(state.env_steps), resuming.to_items(state, whole=True))


def flip_a_bit(run: Path, rng: random.Random) -> str:
  """Flips a bit in the largest file of the newest checkpoint; returns its name."""
  folder = run / "checkpoints" / str(checkpoint.latest_step(run))
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
