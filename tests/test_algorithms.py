"""Every row of Table I: which loss trains what, and that it survives anything."""

from __future__ import annotations

import dataclasses
import functools

from batches import random_batch
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from apnpql_jax import validation
from apnpql_jax.agents import algorithms
from apnpql_jax.agents.algorithms import ALGORITHMS, algorithm_of
from apnpql_jax.agents.learner import bellman_target, make_agent, total_loss
from apnpql_jax.config import AgentConfig

CONFIG = AgentConfig(
  hidden=(16, 16),
  feature_dim=16,
  num_atoms=11,
  target_samples=8,
  policy_samples=8,
  patch_channels=4,
  conv_channels=4,
  n_step=2,
)
BATCH = 6
VALUE = {"loss/q": {"encoder", "z"}, "loss/ap": {"encoder", "ap"}}
ALPHA = {"loss/alpha": {"alpha"}}
PRIOR = {"loss/m": {"bp"}, "loss/nu": {"nu"}}
POLICY = {"loss/policy": {"policy"}}
TRAINS = {
  "ap_npql": VALUE | ALPHA | PRIOR,
  "ap_mpo": VALUE | ALPHA | PRIOR | POLICY,
  "ap_sac": VALUE | ALPHA | PRIOR | POLICY,
  "abm_mpo": VALUE | ALPHA | PRIOR | POLICY,
  "svg_prior": VALUE | ALPHA | PRIOR | POLICY,
  "mpo": VALUE | ALPHA | POLICY,
  "sac": VALUE | ALPHA | POLICY,
  "ap_cem": VALUE | ALPHA | PRIOR,
}
"""Row -> loss -> parameters that it trains, by the paper's names of its arguments."""


def losses_and_slopes(config: AgentConfig):
  """Total loss, its parts, the gradient of each part, and the metrics of one batch."""
  agent, algorithm = make_agent(config), algorithm_of(config)
  batch = random_batch(1, BATCH, windows=config.n_step)
  params = agent.networks.init(jax.random.key(0), batch.observation_tm1)
  trained = {**params, "nu": jnp.float32(0.1)}
  # A target network that has fallen behind, as it has in training.
  slow = jax.tree.map(lambda x: 0.9 * x, params)

  def losses(trained):
    target = bellman_target(agent.networks, algorithm, slow, batch, jax.random.key(1))
    total, metrics = total_loss(
      agent.networks, algorithm, trained, slow, batch, target, jax.random.key(2)
    )
    parts = {k: v for k, v in metrics.items() if k.startswith("loss/")}
    return parts, (total, metrics)

  with jax.numpy_rank_promotion("raise"):
    slope = jax.jit(
      jax.jacrev(losses, has_aux=True), compiler_options=tiny.FAST_COMPILE
    )
    slopes, (total, metrics) = slope(trained)
  return total, metrics, slopes


def touched(slope: dict) -> set[str]:
  """Groups in which any entry of the gradient differs from zero."""
  return {k for k, g in slope.items() if any(np.any(x) for x in jax.tree.leaves(g))}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_each_loss_trains_exactly_the_parameters_the_paper_names(name: str):
  total, metrics, slopes = losses_and_slopes(
    dataclasses.replace(CONFIG, algorithm=name)
  )
  assert {k: touched(slope) for k, slope in slopes.items()} == TRAINS[name]
  # What is trained is what there is.
  assert set().union(*TRAINS[name].values()) | {"nu"} == set(slopes["loss/q"])
  expected = sum(metrics[k] for k in slopes) + 9.0 * metrics["loss/ap"]
  assert total == pytest.approx(float(expected), rel=1e-5)
  assert all(np.isfinite(v) for v in metrics.values())


def test_settings_name_every_evaluation():
  assert {"row", *algorithms.EVALUATIONS} == set(validation.EVALUATIONS)


@pytest.mark.parametrize(
  ("changes", "missing"),
  [
    ({"temperature": "fixed"}, {"loss/alpha": set()}),
    ({"regulariser": "uniform"}, {"loss/m": None, "loss/nu": None}),
  ],
)
def test_ablations_train_less_and_nothing_else(changes, missing):
  _, _, slopes = losses_and_slopes(dataclasses.replace(CONFIG, **changes))
  expected = {k: v for k, v in (TRAINS["ap_npql"] | missing).items() if v is not None}
  assert {k: touched(slope) for k, slope in slopes.items()} == expected


@pytest.mark.parametrize("name", ALGORITHMS)
def test_no_batch_makes_a_number_that_is_none(name: str):
  """A hundred updates on rewards of 1e6 and images and states far from any seen."""
  config = dataclasses.replace(CONFIG, algorithm=name)
  agent = make_agent(config)
  batch = random_batch(2, BATCH, pixels=True, windows=config.n_step)
  state = agent.init(jax.random.key(0), batch.observation_tm1)

  def adversarial(batch, key):
    """All leaves scaled by a random power of ten, images black or white."""
    scale = 10.0 ** jax.random.uniform(key, minval=-3.0, maxval=6.0)
    white = jnp.where(jax.random.bernoulli(key), 255, 0).astype(jnp.uint8)

    def change(path, leaf):
      if leaf.dtype == jnp.uint8:
        return jnp.full_like(leaf, white)
      kept = ("action", "discount", "weight", "terminated", "truncated")
      kept_ = any(k in jax.tree_util.keystr(path) for k in kept)
      return leaf if kept_ else scale * leaf

    return jax.tree_util.tree_map_with_path(change, batch)

  def body(state, key):
    return agent.update(state, adversarial(batch, key), key)

  @functools.partial(jax.jit, compiler_options=tiny.FAST_COMPILE)
  def run(state):
    state, metrics = jax.lax.scan(body, state, jax.random.split(jax.random.key(1), 100))
    action, info = agent.act(
      state.params, batch.observation_tm1, jax.random.key(2), False
    )
    return state, metrics, action, info

  state, metrics, action, info = run(state)
  for leaf in jax.tree.leaves((state.params, state.nu, metrics, info)):
    assert np.all(np.isfinite(leaf))
  assert action.shape == (BATCH, 7) and np.all(np.abs(action) <= 1.0)
  assert set(np.unique(action[:, 6])) <= {0.0, 1.0}
  common = {"q/min", "q/max", "npql/kl_over_eps", "npql/ess", "npql/alpha_mean"}
  common |= {"prior/entropy", "policy/entropy", "prior/nu", "q/data", "q/target"}
  common |= {f"grad_norm/{group}" for group in state.params}
  assert common <= set(metrics)
