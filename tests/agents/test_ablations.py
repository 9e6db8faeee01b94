"""Every ablation on the command line: what it takes away, and that all else stays."""

from __future__ import annotations

import functools
import re
from typing import Any, NamedTuple

import ablations
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.agents.learner import Agent, LearnerState, make_agent
from apnpql_jax.cli.sweep import config_of
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.testing import random_batch
from apnpql_jax.training.iteration import make_sample
from apnpql_jax.types import Metrics

BATCH = 8
EVERYTHING = {
  *("loss/ap", "loss/q", "loss/alpha", "loss/m", "loss/nu"),
  *("encoder", "ap", "bp", "z", "alpha", "nu"),
}
"""Losses of AP-NPQL, and what an update moves."""

CHANGED = {
  "--agent.regularizer uniform": {"loss/m", "loss/nu", "bp", "nu"},
  "--agent.prior-mean learned": set(),
  "--agent.no-primitive-gripper": set(),
  "--env.static-targets": set(),
  "--env.true-primitives": set(),
  "--agent.learning-rate-m 0": {"bp"},
  "--agent.learning-rate-nu 0": {"nu"},
  "--replay.expert-share 0": set(),
  "--agent.lambda-ap 0": {"ap"},
  "--agent.policy-evaluation td0": set(),
  "--agent.n-step 1": set(),
  "--agent.diagonal-covariance": set(),
  "--algorithm ap_mpo --agent.policy-components 3": {"loss/policy", "policy"},
  "--agent.target-samples 10 --agent.policy-samples 10": set(),
  "--agent.temperature shared --agent.learning-rate-alpha 3e-3": set(),
  "--agent.temperature fixed --agent.initial-alpha 0.02": {"alpha"},
  "--agent.alpha-floor clip": set(),
  ablations.NO_Q: {"alpha"},
  "--algorithm ap_dagger": set(),
  "--agent.no-gripper-offset": set(),
}
"""Flags -> what they take from ``EVERYTHING`` or add to it; the tests below have the
rest."""


class Played(NamedTuple):
  """An agent of push_plate's preset with ``flags`` on top, and its first update."""

  config: TrainConfig
  agent: Agent
  before: LearnerState
  after: LearnerState
  metrics: Metrics

  def prior(self) -> tuple[GripperGMM, jax.Array]:
    """Returns the prior of random parameters, and the predicted primitives."""
    rng = np.random.default_rng(0)
    params = jax.tree.map(
      lambda x: x + 0.1 * jnp.asarray(rng.normal(size=x.shape), jnp.float32),
      self.before.params,
    )
    heads = self.agent.networks.at(params, random_batch(1, BATCH).observation_tm1)
    return heads.prior(), heads.primitives()


def configured(flags: str) -> TrainConfig:
  # An entropy below its floor, so that nu has something to do from the first update,
  # and draws for a mixture of three.
  more = "--agent.epsilon-nu 5 --agent.target-samples 6 --agent.policy-samples 6"
  return config_of(["push_plate", *testing.TINY_ARGS, *more.split(), *flags.split()])


@functools.cache
def play(flags: str) -> Played:
  config = configured(flags)
  agent, batch = make_agent(config.agent), random_batch(0, BATCH)
  if config.env.true_primitives:
    given = [
      x.replace(primitives=batch.primitives_tm1)
      for x in (batch.observation_tm1, batch.observation_t)
    ]
    batch = batch.replace(observation_tm1=given[0], observation_t=given[1])
  before = agent.init(jax.random.key(0), batch.observation_tm1)
  with jax.numpy_rank_promotion("raise"):
    update = jax.jit(agent.update)
    after, metrics = update(before, batch, jax.random.key(1))
  return Played(config, agent, before, after, metrics)


def left(played: Played) -> set[str]:
  """Returns the names of the losses and of the parameters that the update moved."""
  pairs = ({**state.params, "nu": state.nu} for state in (played.before, played.after))
  moved = jax.tree.map(lambda a, b: bool(np.any(a != b)), *pairs)
  groups = {group for group, tree in moved.items() if any(jax.tree.leaves(tree))}
  return groups | {name for name in played.metrics if name.startswith("loss/")}


def test_every_documented_ablation_is_played():
  text = (testing.ROOT / "docs/algorithm.md").read_text("utf-8")
  table = text.split("| ablation | flags | effect |")[1].split("\n\n")[0]
  assert set(re.findall(r"\| `(--[^`]+)`", table)) == CHANGED.keys()


@pytest.mark.parametrize("flags", ["", *CHANGED])
def test_an_ablation_changes_only_what_it_names(flags: str):
  played = play(flags)
  for leaf in jax.tree.leaves((played.after, played.metrics)):
    assert np.all(np.isfinite(leaf))
  assert left(played) == EVERYTHING ^ CHANGED.get(flags, set())
  assert ("bp" in played.before.params) == ("uniform" not in flags)
  assert ("alpha" in played.before.params) == ("fixed" not in flags)


def test_without_q_the_policy_is_the_prior():
  played = play(ablations.NO_Q)
  samples = played.config.agent.policy_samples
  assert played.metrics["npql/ess"] == pytest.approx(samples, rel=1e-5)


def test_learned_means_are_not_those_of_the_primitives():
  for flags, same in (("", True), ("--agent.prior-mean learned", False)):
    prior, primitives = play(flags).prior()
    gap = np.abs(prior.loc - np.clip(primitives[..., :6], -1.0, 1.0)).max()
    assert (gap < 1e-6) == same


def test_diagonal_covariance_moves_each_joint_by_itself():
  for flags, some in (("", True), ("--agent.diagonal-covariance", False)):
    scale = np.asarray(play(flags).prior()[0].scale_tril)
    assert np.any(scale[..., np.tri(6, k=-1, dtype=bool)]) == some
    assert np.all(scale[..., np.eye(6, dtype=bool)] > 0.0)


@pytest.mark.parametrize(
  ("flags", "group", "shapes"),
  [
    ("", "z", {(51,)}),
    ("--agent.policy-evaluation td0", "z", {(1,)}),
    (
      "--agent.temperature shared --agent.learning-rate-alpha 3e-3",
      "alpha",
      {(1,)},
    ),
  ],
)
def test_heads_have_the_outputs_that_the_flag_names(flags, group, shapes):
  head = play(flags).before.params[group]
  last: dict[str, Any] = head["out"] if "out" in head else head
  assert {x.shape for k, x in last.items() if k != "kernel"} == shapes


@pytest.mark.parametrize(("target", "policy"), [(10, 500), (500, 10)])
def test_candidates_have_the_requested_number(target: int, policy: int):
  flags = f"--agent.target-samples {target} --agent.policy-samples {policy}"
  _, agent, state, _, metrics = play(flags)
  # Before training the values are nearly flat.
  assert metrics["npql/ess"] == pytest.approx(policy, rel=0.05)
  batch, key = random_batch(0, BATCH), jax.random.key(0)
  update = str(jax.make_jaxpr(agent.update)(state, batch, key))
  acting = str(jax.make_jaxpr(agent.act)(state.params, batch.observation_tm1, key))
  of_target, of_policy = (f"f32[{n},{BATCH},7]" for n in (target, policy))
  assert of_target in update and of_policy in update
  assert of_policy in acting and of_target not in acting


@pytest.mark.parametrize(
  ("flags", "expert", "steps"),
  [
    ("", 4, 2),
    ("--replay.expert-share 0 --replay.expert-steps 0", 0, 2),
    ("--agent.n-step 1", 4, 1),
  ],
)
def test_batches_have_the_requested_share_and_steps(flags, expert, steps):
  """Every reward of the agent is 1, every reward of the expert is -1."""

  def ring(reward: float) -> replay.Replay:
    slots = random_batch(2, 16, windows=4).window
    assert slots is not None
    never, step = jnp.zeros((16, 4), bool), slots.timestep
    step = step.replace(
      reward=jnp.full((16, 4), reward), terminated=never, truncated=never
    )
    example = jax.tree.map(lambda x: x[0, 0], slots)
    return replay.add(replay.create(example, 16, 4), slots.replace(timestep=step))

  config, agent, *_ = play(flags)
  theirs = ring(-1.0) if config.replay.expert_steps else None
  batch = make_sample(config, agent)(ring(1.0), theirs, jax.random.key(0))
  gamma = config.agent.gamma
  returns = np.where(np.arange(BATCH) < BATCH - expert, 1.0, -1.0)
  returns *= sum(gamma**k for k in range(steps))
  np.testing.assert_allclose(batch.reward_t, returns, rtol=1e-5)
  np.testing.assert_allclose(batch.discount_t, gamma**steps, rtol=1e-5)
  assert np.all(batch.weight == 1.0)
