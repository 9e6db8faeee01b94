"""The policy kept in the repository fits the present scene and solves it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
from jax import export
import jax.numpy as jnp
import numpy as np

from apnpql_jax.config.files import load_preset
from apnpql_jax.envs.env import make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.robot import policy_folder
from apnpql_jax.transfer.host_rollout import play
from apnpql_jax.types import Array, Observation

FOLDER = Path(__file__).parents[2] / "experiments/results/sim_to_real/policy"
WORLDS = 8


def test_the_kept_policy_was_trained_with_the_preset_for_the_present_arm():
  contract = policy_folder.load(FOLDER).contract
  preset = load_preset("sim_to_real")
  assert contract["task"] == preset.env.task
  assert contract["randomization"] == dataclasses.asdict(preset.env.randomization)
  assert contract["origin"]["checkpoint_step"] == preset.total_steps
  assert contract["acting"]["rule"] == preset.eval_acting


def test_the_kept_policy_puts_plates_into_boxes():
  """In the world of the scene file; its README has what it solves in others."""
  program = export.deserialize(bytearray((FOLDER / "policy.bin").read_bytes()))
  call = jax.jit(program.call)

  def act(state: EnvState, seen: Observation, key: Array) -> Array:
    del state, key
    given, unused = seen.present(), np.zeros(2, np.uint32)
    worlds = ({k: x[i : i + 1] for k, x in given.items()} for i in range(WORLDS))
    return jnp.concatenate([call(world, unused) for world in worlds])

  config = load_preset("sim_to_real").env
  env = make_env(dataclasses.replace(config, randomize=False, bank_rows=256))
  rows = env.bank_split + jnp.arange(WORLDS)
  assert play(env, act, rows, jax.random.key(0)).success.sum() >= WORLDS - 1
