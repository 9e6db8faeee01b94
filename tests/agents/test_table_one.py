"""Every row of Table I: what each column does, and which loss trains what."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import functools
from typing import Any, NamedTuple

from densities import scipy_log_prob
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from apnpql_jax import testing
from apnpql_jax.agents import table_one
from apnpql_jax.agents.columns import regularizer
from apnpql_jax.agents.columns.candidates import clip_action
from apnpql_jax.agents.columns.policy import parametric
from apnpql_jax.agents.learner import Agent, bellman_target, make_agent, total_loss
from apnpql_jax.agents.networks import Heads
from apnpql_jax.agents.table_one import ALGORITHMS, algorithm_of, check_effects
from apnpql_jax.config import checks
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.dists.action import ActionDistribution, UniformBox
from apnpql_jax.errors import ConfigError
from apnpql_jax.testing import SMALL, random_batch
from apnpql_jax.training.train import train
from apnpql_jax.types import Array, Metrics, Transition

BATCH = 6
NU = 0.1
KEY = jax.random.key(2)
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
  "ap_dagger": VALUE | ALPHA | PRIOR,
}
"""Row -> loss -> parameters that it trains, by the paper's names of its arguments."""


class Columns(NamedTuple):
  """A row of Table I in docs/algorithm.md."""

  regularizer: str
  policy: str
  fitted_to: str | None
  kl: str
  outputs: int
  windows: bool = False


COLUMNS = {
  "ap_npql": Columns("b", "q", "q", "none", SMALL.num_atoms),
  "ap_mpo": Columns("b", "pi", "q", "forward", SMALL.num_atoms),
  "ap_sac": Columns("b", "pi", "pi", "reverse", SMALL.num_atoms),
  "abm_mpo": Columns("b", "pi", "good", "forward", 1),
  "svg_prior": Columns("b", "pi", "pi", "reverse", 1, windows=True),
  "mpo": Columns("past", "pi", None, "forward", 1, windows=True),
  "sac": Columns("uniform", "pi", None, "reverse", 2),
  "ap_cem": Columns("b", "cem", "q", "none", 2),
  "ap_dagger": Columns("b", "b", "expert", "none", SMALL.num_atoms),
}


class Example(NamedTuple):
  """One batch, and what the learner makes of it."""

  agent: Agent
  batch: Transition
  trained: dict[str, Any]
  target_params: dict[str, Any]
  learn: Callable[[Transition], tuple[dict[str, Any], tuple[Array, Metrics]]]
  """Slopes of each loss; total loss and metrics."""

  def heads(self, params: dict[str, Any]) -> Heads:
    return self.agent.networks.at(params, self.batch.observation_tm1)


@functools.cache
def example_of(name: str, components: int = 1) -> Example:
  """Returns an example with random parameters, so that no two candidates are alike."""
  config = dataclasses.replace(SMALL, algorithm=name, policy_components=components)
  agent, row = make_agent(config), algorithm_of(config)
  batch = random_batch(1, BATCH, windows=config.n_step)
  rng = np.random.default_rng(0)
  params = jax.tree.map(
    lambda x: x + 0.3 * jnp.asarray(rng.normal(size=x.shape), jnp.float32),
    jax.jit(agent.networks.init)(jax.random.key(0), batch.observation_tm1),
  )
  trained = {**params, "nu": jnp.float32(NU)}
  # A target network that has fallen behind, as it has in training.
  target_params = jax.tree.map(lambda x: 0.9 * x, params)

  learner = agent.networks, row, agent.policy_evaluation

  def losses(trained, batch):
    target = bellman_target(*learner, target_params, batch, jax.random.key(1))
    total, metrics = total_loss(*learner, trained, target_params, batch, target, KEY)
    parts = {k: v for k, v in metrics.items() if k.startswith("loss/")}
    return parts, (total, metrics)

  with jax.numpy_rank_promotion("raise"):
    learn = jax.jit(jax.jacrev(losses, has_aux=True))
    learn(trained, batch)
  learn = functools.partial(learn, trained)
  return Example(agent, batch, trained, target_params, learn)


def touched(slope: dict) -> set[str]:
  """Returns groups in which any entry of the gradient differs from zero."""
  return {k for k, g in slope.items() if any(np.any(x) for x in jax.tree.leaves(g))}


@pytest.mark.parametrize(
  ("name", "components"),
  [
    *((name, 1) for name in ALGORITHMS),
    *((name, 2) for name, row in ALGORITHMS.items() if row.policy is parametric),
  ],
)
def test_each_loss_trains_exactly_the_parameters_the_paper_names(
  name: str, components: int
):
  example = example_of(name, components)
  slopes, (total, metrics) = example.learn(example.batch)
  assert {k: touched(slope) for k, slope in slopes.items()} == TRAINS[name]
  # What is trained is what there is.
  assert set().union(*TRAINS[name].values()) | {"nu"} == set(slopes["loss/q"])
  expected = sum(metrics[k] for k in slopes) + 9.0 * metrics["loss/ap"]
  assert total == pytest.approx(float(expected), rel=1e-5)
  assert all(np.isfinite(v) for v in metrics.values())


def test_settings_name_every_evaluation():
  assert {"row", *table_one.POLICY_EVALUATIONS} == set(checks.POLICY_EVALUATIONS)


def changed(settings: dict[str, Any], *, true_primitives: bool = False) -> TrainConfig:
  return dataclasses.replace(
    testing.TINY,
    env=dataclasses.replace(testing.TINY.env, true_primitives=true_primitives),
    agent=dataclasses.replace(SMALL, **settings),
  )


@pytest.mark.parametrize(
  ("settings", "idle"),
  [
    ({"policy_components": 3}, "agent.policy_components"),
    ({"algorithm": "ap_cem", "policy_components": 3}, "agent.policy_components"),
    ({"algorithm": "ap_dagger", "policy_components": 3}, "agent.policy_components"),
    ({"algorithm": "mpo", "prior_mean": "learned"}, "agent.prior_mean"),
    ({"algorithm": "sac", "prior_mean": "learned"}, "agent.prior_mean"),
    ({"regularizer": "uniform", "prior_mean": "learned"}, "agent.prior_mean"),
    ({"algorithm": "mpo"}, "env.true_primitives"),
    ({"prior_mean": "learned"}, "env.true_primitives"),
  ],
)
def test_a_new_run_refuses_a_setting_without_effect(settings, idle: str, tmp_path):
  config = changed(settings, true_primitives=idle == "env.true_primitives")
  with pytest.raises(ConfigError, match=f"{idle} has no effect: .* has no p"):
    train(config, tmp_path / "run")
  assert not (tmp_path / "run").exists()
  make_agent(config.agent)  # Older runs with it can still be used.


@pytest.mark.parametrize("name", ["ap_mpo", "svg_prior", "ap_dagger"])
def test_a_new_run_may_change_what_its_row_has(name: str):
  own = {"policy_components": 3} if COLUMNS[name].policy == "pi" else {}
  check_effects(changed({"algorithm": name, "prior_mean": "learned", **own}))
  check_effects(changed({"algorithm": name, **own}, true_primitives=True))


def regularizer_of(name: str, heads: Heads, target_heads: Heads) -> ActionDistribution:
  kinds = {"b": heads.prior, "uniform": lambda: UniformBox((BATCH,), 6)}
  return {**kinds, "past": target_heads.policy}[COLUMNS[name].regularizer]()


def log_prob(distribution: ActionDistribution, actions: Array) -> np.ndarray:
  """Computes log densities f64[S, B], one state after the other."""
  if isinstance(distribution, UniformBox):
    return np.full(actions.shape[:2], -7.0 * np.log(2.0))
  each = [
    scipy_log_prob(jax.tree.map(lambda x, i=i: x[i], distribution), one)
    for i, one in enumerate(np.moveaxis(np.asarray(actions), 1, 0))
  ]
  return np.stack(each, axis=1)


def values(heads: Heads, actions: Array) -> np.ndarray:
  return np.asarray(heads.q(clip_action(actions)), np.float64)


def of_q(heads: Heads, prior: ActionDistribution, key: Array):
  """Draws of the regularizer, and their weights under q (Eq. 6)."""
  samples = prior.sample(seed=key, sample_shape=SMALL.policy_samples)
  return samples, special.softmax(values(heads, samples) / heads.alpha(), axis=0)


def of_pi(heads: Heads, key: Array):
  """Returns half as many draws of the arm, each open and closed, and their weights."""
  policy, half = heads.policy(), SMALL.policy_samples // 2
  drawn = policy.sample(seed=key, sample_shape=half)
  samples = jnp.concatenate([drawn.at[..., 6].set(x) for x in (0.0, 1.0)])
  close = special.expit(policy.gripper_logits[:, 0])
  return samples, np.repeat(np.stack([1.0 - close, close]), half, axis=0) / half


def of_good(heads: Heads, actions: Array, key: Array):
  """Returns the replayed actions; the weight is one where they are no worse than pi."""
  samples, weights = of_pi(heads, key)
  q, q_pi = values(heads, actions[None])[0], values(heads, samples)
  good = [float(q[i] - weights[:, i] @ q_pi[:, i] >= 0.0) for i in range(BATCH)]
  assert set(good) == {0.0, 1.0}  # Else this batch would tell nothing.
  return actions[None], np.array([good])


@pytest.mark.parametrize("name", ALGORITHMS)
def test_losses_are_those_of_the_candidates_that_the_row_names(name: str):
  example, columns = example_of(name), COLUMNS[name]
  heads, (_, metrics) = example.heads(example.trained), example.learn(example.batch)[1]
  prior = regularizer_of(name, heads, example.heads(example.target_params))
  entropy = prior.entropy_bound()
  assert metrics["prior/entropy"] == pytest.approx(float(entropy.mean()), rel=1e-4)
  expected = {}
  candidates = {"q": of_q(heads, prior, KEY)}
  if columns.policy == "pi":
    policy = heads.policy()
    candidates["pi"] = samples, weights = of_pi(heads, KEY)
    log_pi, q = log_prob(policy, samples), values(heads, samples)
    kl = np.sum(weights * (log_pi - log_prob(prior, samples)), axis=0)
    reverse = heads.alpha() * kl - np.sum(weights * q, axis=0)
    samples, weights = candidates["q"]
    forward = -np.sum(weights * log_prob(policy, samples), axis=0)
    expected["loss/policy"] = {"forward": forward, "reverse": reverse}[columns.kl]
  if columns.fitted_to == "good":
    # By draws of its own, not those of the policy update.
    key = jax.random.fold_in(KEY, 2)
    candidates["good"] = of_good(heads, example.batch.action_tm1, key)
  if columns.fitted_to == "expert":
    assert example.batch.expert_tm1 is not None
    candidates["expert"] = example.batch.expert_tm1[None], np.ones((1, BATCH))
  if columns.fitted_to:
    samples, weights = candidates[columns.fitted_to]
    fit = -np.sum(weights * log_prob(prior, samples), axis=0)
    expected["loss/m"] = fit - NU * entropy
  assert set(expected) == set(metrics) & {"loss/m", "loss/policy"}
  for loss, value in expected.items():
    assert metrics[loss] == pytest.approx(float(np.mean(value)), rel=1e-3), loss


@pytest.mark.parametrize("name", ALGORITHMS)
def test_actions_are_those_of_the_policy_that_the_row_names(name: str):
  example = example_of(name)
  heads = example.heads(example.trained)
  key, _ = jax.random.split(KEY)
  act = jax.jit(example.agent.act)
  _, info = act(example.trained, example.batch.observation_tm1, KEY)
  kind = COLUMNS[name].policy
  if kind in ("cem", "b"):
    expected = np.full(BATCH, 1.0 if kind == "cem" else SMALL.policy_samples)
  else:
    drawn = of_pi(heads, key) if kind == "pi" else of_q(heads, heads.prior(), key)
    expected = 1.0 / np.sum(drawn[1] ** 2, axis=0)
    assert np.ptp(expected) > 0.1
  np.testing.assert_allclose(info["ess"], expected, rtol=1e-3)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_values_are_learned_as_the_row_defines(name: str):
  """Outputs of the value head, and whether one reward or a window is read."""
  example, columns = example_of(name), COLUMNS[name]
  batch, window = example.batch, example.batch.window
  assert window is not None
  outputs = example.heads(example.trained).z(batch.action_tm1[None]).shape[-1]
  timestep = window.timestep.replace(reward=window.timestep.reward - 0.5)
  others = (
    batch.replace(reward_t=batch.reward_t - 0.5),
    batch.replace(window=window.replace(timestep=timestep)),
  )
  targets = [example.learn(x)[1][1]["q/target"] for x in (batch, *others)]
  read = [bool(x < targets[0]) for x in targets[1:]]
  assert (outputs, *read) == (columns.outputs, not columns.windows, columns.windows)


def test_past_policy_is_that_of_the_target_network():
  example = example_of("mpo")
  heads = example.heads(example.trained)
  target_heads = example.heads(example.target_params)
  past = regularizer.previous_policy(heads, target_heads)
  jax.tree.map(np.testing.assert_array_equal, past, target_heads.policy())
  assert np.all(np.abs(past.loc - heads.policy().loc).max((1, 2)) > 1e-3)
