"""Diagnosis: what it records of an agent, and what it makes of it."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.cli import main
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.training.diagnose import Instants, make_recorder, summarize
from apnpql_jax.training.train import train

WORLDS = 4


@pytest.fixture(scope="module")
def recorded():
  """Returns an untrained agent, its parameters, its worlds and their instants."""
  config = testing.TINY
  env = make_env(dataclasses.replace(config.env, time_limit_s=0.75))
  agent, rows = make_agent(config.agent), jnp.arange(WORLDS)
  state = env.reset(rows)
  params = agent.init(jax.random.key(0), state.observation).params
  record = make_recorder(env, agent, config.agent)
  return agent, params, state, record(params, rows, jax.random.key(1))


def test_an_instant_is_active_until_its_episode_ends(recorded):
  """Five periods fit into the time limit, and the first episode alone counts."""
  *_, instants = recorded
  assert instants.active.shape == (6, WORLDS)
  np.testing.assert_array_equal(instants.active.sum(0), 5)
  assert not instants.active[-1].any() and not instants.solved.any()


def test_errors_are_those_of_the_predicted_primitives(recorded):
  agent, params, state, instants = recorded
  predicted = agent.networks.at(params, state.observation).primitives()
  label = np.asarray(state.timestep.primitives)
  error = np.abs(np.asarray(predicted) - label)[..., :6].mean(-1)
  np.testing.assert_allclose(instants.error[0], error, rtol=1e-4)
  wrong = (np.asarray(predicted)[..., 6] > 0) != (label[..., 6] == 1)
  np.testing.assert_array_equal(instants.gripper[0], wrong)


def test_commands_against_the_expert_are_those_of_the_actions(recorded):
  agent, params, state, instants = recorded
  key = jax.random.split(jax.random.key(1), len(instants.active))[0]
  for _ in range(2):  # The first of two is for the policy, of these for the action.
    key = jax.random.split(key)[0]
  action, _ = agent.act(params, state.observation, key)
  expert = make_env(testing.TINY.env).expert_action(state)
  against = np.asarray(action[:, 6] != expert[:, 6])
  assert against.any()
  np.testing.assert_array_equal(instants.against[0], against)


def test_means_do_not_depend_on_the_key(recorded):
  """Draws do, so that the acting rule shows."""
  agent, params, *_ = recorded
  config = testing.TINY
  env = make_env(dataclasses.replace(config.env, time_limit_s=0.75))
  chosen = {}
  for acting in ("mean", "policy"):
    record = make_recorder(env, agent, config.agent, acting=acting)
    runs = [record(params, jnp.arange(WORLDS), jax.random.key(seed)) for seed in (1, 2)]
    chosen[acting] = np.asarray(runs[0].q) == np.asarray(runs[1].q)
  assert chosen["mean"].all()
  assert not chosen["policy"].all()


def test_an_episode_begins_with_the_way_to_the_object(recorded):
  *_, instants = recorded
  np.testing.assert_array_equal(instants.stage[0], 0)


def test_a_world_that_breaks_does_not_count_its_next_episode(recorded):
  """Weights that are not finite break every world in its first period."""
  agent, params, *_ = recorded
  record = make_recorder(make_env(testing.TINY.env), agent, testing.TINY.agent)
  broken = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), params)
  instants = record(broken, jnp.arange(WORLDS), jax.random.key(0))
  np.testing.assert_array_equal(instants.active.sum(0), 1)


def hand_made() -> Instants:
  """Returns three worlds: solved after two actions; lost after the goal; no grip."""
  active = np.array([[1, 1, 1], [1, 1, 1], [0, 1, 1], [0, 0, 0]], bool)
  solved = np.zeros((4, 3), bool)
  solved[2, 0] = True
  stage = np.array([[0, 0, 0], [1, 1, 0], [2, 0, 0], [2, 2, 2]])
  error = np.broadcast_to(np.array([0.1, 0.2, 0.3]), (4, 3, 3)) * (1 + stage[..., None])
  gripper = np.zeros((4, 3, 3), bool)
  gripper[1, 0, 1] = True  # One of the two instants of the stage "goal".
  against = (stage == 0) & active & (np.arange(3) == 2)  # Half of those of "object".
  q = np.array([[0.9, 0.2, 0.0], [1.0, 0.3, 0.1], [9.0, 0.4, 0.15], [9.0, 9.0, 9.0]])
  arrays: Any = {
    "active": active,
    "solved": solved,
    "stage": stage,
    "error": error,
    "gripper": gripper,
    "against": against,
    "kl": np.where(active, 2.0, np.nan),
    "alpha": np.where(active, 0.5, np.nan),
    "q": q,
  }
  return Instants(**arrays)


def test_the_summary_of_hand_made_episodes():
  found = summarize(hand_made(), AgentConfig(gamma=0.5, epsilon=4.0))
  assert found["failures"] == {"object after goal": 1, "object": 1}
  assert set(found["stages"]) == {"object", "goal"}
  assert found["stages"]["object"]["share"] == pytest.approx(6 / 8)
  assert found["stages"]["goal"]["goal_error"] == pytest.approx(0.4)
  assert found["stages"]["goal"]["wrong_gripper"] == 0.5
  assert found["stages"]["object"]["wrong_gripper"] == 0.0
  assert found["stages"]["object"]["against_expert"] == 0.5
  assert found["stages"]["goal"]["against_expert"] == 0.0
  assert set(found["kl_over_epsilon"].values()) == {0.5}
  assert set(found["alpha"].values()) == {0.5}
  # The reward comes with the second action: 1 there, gamma before.
  assert found["calibration"]["q"][-1] == 1.0
  assert found["calibration"]["return"] == [0.0, 0.0, 0.0, 0.5, 1.0]


@pytest.mark.slow
def test_the_command_reports_a_run(tmp_path, capsys):
  run = str(tmp_path / "run")
  train(testing.TINY, run)
  assert main.main(["diagnose", run, "--episodes", "6"]) == 0
  shown = capsys.readouterr().out
  for words in ("solved", "stages object", "calibration return", "kl_over_epsilon"):
    assert words in shown
  # Another rule plays other episodes, and so do other reset states.
  found = []
  for options in ([], ["--acting", "prior"], ["--bank-seed", "1"]):
    assert main.main(["diagnose", run, "--episodes", "6", "--json", *options]) == 0
    found.append(json.loads(capsys.readouterr().out))
  assert [x["acting"] for x in found] == ["policy", "prior", "policy"]
  assert (
    found[0]["alpha"] != found[1]["alpha"] and found[0]["alpha"] != found[2]["alpha"]
  )
  assert main.main(["diagnose", run, "--acting", "best"]) == 2
