"""Digests of the learner, a batch and the iteration, to compare two commits.

  python -m benchmarks.reliability.digest

Prints one SHA-256 per line, shortened. Equal lines mean equal bits on one machine.
"""

import dataclasses
import hashlib
from typing import Any

import jax
import numpy as np

from apnpql_jax import runtime, testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.agents.table_one import ALGORITHMS
from apnpql_jax.envs.env import make_env
from apnpql_jax.training.expert import collect_expert
from apnpql_jax.training.iteration import make_iteration, make_sample
from apnpql_jax.training.state import initial_state
from benchmarks.common import settings


def main() -> None:
  runtime.configure()
  for algorithm in ALGORITHMS:
    pixels = algorithm in ("ap_npql", "sac")
    print(f"{algorithm:<10} {learner(algorithm, pixels=pixels)}", flush=True)
  for obs in ("state", "pixels"):
    for name, tree in run(obs).items():
      print(f"{obs} {name:<14} {digest(tree)}", flush=True)


def digest(tree: Any) -> str:
  """Returns 16 digits of the SHA-256 of all leaves, in order."""
  sha = hashlib.sha256()
  for leaf in jax.tree.leaves(tree):
    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
      leaf = jax.random.key_data(leaf)
    sha.update(np.asarray(leaf).tobytes())
  return sha.hexdigest()[:16]


def learner(algorithm: str, *, pixels: bool) -> str:
  """Returns the digest of a row of Table I after two updates."""
  config = dataclasses.replace(testing.SMALL, algorithm=algorithm)
  agent = make_agent(config)
  batch = testing.random_batch(0, pixels=pixels, windows=config.n_step)
  state = agent.init(jax.random.key(0), batch.observation_tm1)
  update = jax.jit(agent.update)
  for seed in range(2):
    state, metrics = update(state, batch, jax.random.key(seed))
  return digest((state, metrics))


def run(obs: str) -> dict[str, Any]:
  """Returns the first state of a run, a batch, and the state after two iterations."""
  config = settings.changed(testing.TINY, "env", obs=obs)
  env, agent = make_env(config.env), make_agent(config.agent)
  state = initial_state(config, env, agent, collect_expert)
  iteration, sample = make_iteration(config, env, agent), make_sample(config, agent)
  found: dict[str, Any] = {"initial state": jax.tree.map(jax.numpy.copy, state)}
  for _ in range(2):
    state, metrics = iteration(state)
  batch = sample(state.replay, state.expert_replay, jax.random.key(7))
  return found | {"batch": batch, "iteration": (state, metrics)}


if __name__ == "__main__":
  main()
