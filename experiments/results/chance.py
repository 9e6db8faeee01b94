"""Success of chance: true primitives, chosen at random and held for ten periods.

  python experiments/results/chance.py

Writes chance.json: per task, the figures of 512 episodes from the fresh reset states of
``pixel_comparison``.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from comparison import TASKS
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np

from apnpql_jax import configure, load_preset, make_env
from apnpql_jax.envs.env import HELD_OUT_SHARE
from apnpql_jax.envs.state import EnvState
from apnpql_jax.training.evaluate import figures_of, held_out_batches
from apnpql_jax.training.rollout import WorldPolicy, make_player
from apnpql_jax.types import NUM_PRIMITIVES, Array

EPISODES, BANK_SEED = 512, 1
HELD = 10
"""Control periods for which a choice is kept."""


def random_choice(choices: PRNGKeyArray) -> WorldPolicy:
  """Returns a policy whose choices depend on the key, world and time alone."""

  def policy(state: EnvState, key: PRNGKeyArray) -> tuple[Array, Array]:
    del key  # It changes in every period.
    worlds = jnp.arange(len(state.elapsed))

    def choice(world: Array, elapsed: Array) -> Array:
      own = jax.random.fold_in(jax.random.fold_in(choices, world), elapsed // HELD)
      return jax.random.randint(own, (), 0, NUM_PRIMITIVES)

    chosen = jax.vmap(choice)(worlds, state.elapsed)
    return state.timestep.primitives[worlds, chosen], jnp.zeros(len(worlds))

  return policy


def play(task: str) -> dict[str, Any]:
  """Returns the figures of a task."""
  config = dataclasses.replace(
    load_preset(task).env, obs="state", bank_rows=int(EPISODES / HELD_OUT_SHARE)
  )
  env = make_env(config, bank_seed=BANK_SEED)
  player = make_player(env, random_choice)
  batches = held_out_batches(env, episodes=EPISODES, seed=0)
  played = [player(jax.random.fold_in(key, 1), rows, key) for rows, key in batches]
  joined = played[0].replace(
    success=np.concatenate([x.success for x in played])[:EPISODES],
    length=np.concatenate([x.length for x in played])[:EPISODES],
  )
  return figures_of(joined)


if __name__ == "__main__":
  configure()
  found = {task: play(task) for task in TASKS}
  path = Path(__file__).resolve().with_suffix(".json")
  path.write_text(json.dumps(found, indent=1) + "\n")
  print(json.dumps(found, indent=1))
