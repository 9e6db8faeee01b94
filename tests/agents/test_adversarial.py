"""Updates on absurd batches: all numbers stay finite."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.agents.columns.regularizer import no_update
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.agents.table_one import ALGORITHMS
from apnpql_jax.testing import SMALL, random_batch
from apnpql_jax.types import Array, Transition

BATCH, ROWS = 6, 32
QUICK = ("ap_npql", "abm_mpo", "svg_prior", "ap_cem", "ap_dagger")
KEPT = ("action", "discount", "weight", "terminated", "truncated")
"""Parts of a transition that keep their values."""


def absurd_images(key: Array, noise: Array) -> Array:
  """Makes each image black, white, a checkerboard of single pixels, or noise."""
  row, column = jnp.indices(noise.shape[-3:-1])
  board = jnp.where((row + column) % 2, 255, 0)[..., None]
  kind = jax.random.randint(key, (*noise.shape[:-3], 1, 1, 1), 0, 4)
  plain = jnp.where(kind == 0, 0, 255)
  pattern = jnp.where(kind == 2, board, plain)
  return jnp.where(kind == 3, noise, pattern).astype(jnp.uint8)


def absurd_batch(rows: Transition, key: Array) -> Transition:
  """Draws rows, a scale up to 1e6, a sign and images for each leaf independently."""

  def change(path: Any, leaf: Array, key: Array) -> Array:
    pick, size, sign, images = jax.random.split(key, 4)
    leaf = leaf[jax.random.randint(pick, (BATCH,), 0, ROWS)]
    if leaf.dtype == jnp.uint8:
      return absurd_images(images, leaf)
    if any(name in jax.tree_util.keystr(path) for name in KEPT):
      return leaf
    scale = 10.0 ** jax.random.uniform(size, minval=-3.0, maxval=6.0)
    return jax.random.rademacher(sign, (), jnp.float32) * scale * leaf

  leaves, treedef = jax.tree_util.tree_flatten_with_path(rows)
  keys = jax.random.split(key, len(leaves))
  pairs = zip(leaves, keys, strict=True)
  return treedef.unflatten([change(path, leaf, k) for (path, leaf), k in pairs])


def _cases() -> list[Any]:
  """Returns rows, whether they see images, and numbers of updates.

  All rows have the same encoder, so one of them sees images. The quick ones together
  have every policy, update and evaluation.
  """
  cases = [(name, name == "ap_npql", 100) for name in QUICK]
  slow = [(name, True, 1000) for name in ALGORITHMS]
  return cases + [pytest.param(*case, marks=pytest.mark.slow) for case in slow]


def test_quick_rows_have_what_all_rows_have():
  for column in ("policy", "regularizer_update", "policy_update", "policy_evaluation"):
    of_quick, of_all = (
      {getattr(ALGORITHMS[name], column) for name in names}
      for names in (QUICK, ALGORITHMS)
    )
    assert of_quick == of_all - {no_update}


@pytest.mark.parametrize(("name", "pixels", "updates"), _cases())
def test_no_batch_produces_a_non_finite_number(name: str, pixels: bool, updates: int):
  """Combines rewards and states up to 1e6 with images unlike any rendered one."""
  config = dataclasses.replace(SMALL, algorithm=name)
  agent = make_agent(config)
  rows = random_batch(2, ROWS, pixels=pixels, windows=config.n_step)
  state = agent.init(jax.random.key(0), rows.observation_tm1)

  def body(state, key):
    batch = absurd_batch(rows, key)
    state, metrics = agent.update(state, batch, key)
    rich = jnp.abs(batch.reward_t) > 1e5
    if pixels:
      rich &= jnp.all(batch.observation_tm1.global_image == 255, axis=(-3, -2, -1))
    return state, (metrics, jnp.any(rich))

  @jax.jit
  def run(state):
    keys = jax.random.split(jax.random.key(1), updates)
    state, history = jax.lax.scan(body, state, keys)
    last = absurd_batch(rows, jax.random.key(3)).observation_tm1
    return state, *history, *agent.act(state.params, last, jax.random.key(2))

  state, metrics, met, action, info = run(state)
  assert np.any(met)  # A large reward, in a state with a white image if there are any.
  for leaf in jax.tree.leaves((state.params, state.nu, metrics, info)):
    assert np.all(np.isfinite(leaf))
  assert action.shape == (BATCH, 7) and np.all(np.abs(action) <= 1.0)
  assert set(np.unique(action[:, 6])) <= {0.0, 1.0}
  common = {"q/min", "q/max", "npql/kl_over_eps", "npql/ess", "npql/alpha_mean"}
  common |= {"npql/kl_over_eps_p95", "npql/alpha_p95"}
  common |= {"prior/entropy", "policy/entropy", "prior/nu", "q/data", "q/target"}
  common |= {f"grad_norm/{group}" for group in state.params}
  assert common <= set(metrics)
