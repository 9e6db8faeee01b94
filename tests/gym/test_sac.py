"""Stable-Baselines3's SAC learns a task of this project from states."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from apnpql_jax.agents.encoder import seen_from
from apnpql_jax.gym import sac
from apnpql_jax.gym.stable_baselines import StableBaselinesVecEnv

TASK, WORLDS = "push_plate", 2
RETURNS = {"n_steps": sac.N_STEP, "gamma": sac.GAMMA}


@pytest.fixture(scope="module")
def worlds() -> sac.StateVector:
  settings = {"obs": "state", "bank_rows": 16, "backend": "native"}
  return sac.StateVector(StableBaselinesVecEnv(TASK, WORLDS, **settings))


def test_points_are_seen_from_the_tool():
  rng = np.random.default_rng(0)
  robot, tool, objects = (rng.normal(0.0, 0.1, (4, n)) for n in (21, 3, 6))
  seen = sac.state_vector({"robot": robot, "tool": tool, "objects": objects})
  expected = np.asarray(seen_from(*map(jnp.asarray, (tool, objects)))).reshape(4, -1, 2)
  np.testing.assert_allclose(
    seen[:, -12:], np.moveaxis(expected, -1, 1).reshape(4, -1), atol=1e-6
  )
  robot = np.tile(np.arange(7.0), 3)[None]  # At rest.
  seen = sac.state_vector({"robot": robot, "tool": tool[:1], "objects": objects[:1]})
  np.testing.assert_array_equal(seen[0, 21:35], 0.0)


def test_half_of_each_batch_are_demonstrations(worlds):
  spaces = worlds.observation_space, worlds.action_space
  kind: dict = {"device": "cpu", "n_envs": WORLDS, **RETURNS}
  replay = sac.HalfDemonstrations(64, *spaces, **kind)
  replay.demonstrations = sac.NStepReplayBuffer(200, *spaces, **kind)
  sac.fill(replay.demonstrations, worlds, noise=0.0, seed=0)
  observation, still = worlds.reset(), np.zeros((WORLDS, 7), np.float32)
  for _ in range(8):
    after, reward, done, infos = worlds.step(still)
    replay.add(observation, after, still, reward, done, infos)
    observation = after
  batch = replay.sample(64)
  moves = np.abs(batch.actions.numpy()).sum(-1) > 0
  assert moves.sum() == 32 and not moves[:32].any()
  # 100 steps of two worlds solve the task a few times, within five steps of some.
  batch = replay.sample(1024)
  assert (batch.rewards.numpy()[512:] > 0.9).mean() > 0.02
  assert not batch.rewards.numpy()[:512].any()
  assert set(batch.dones.numpy()[512:, 0]) == {0.0, 1.0}


@pytest.mark.slow
def test_sac_learns_push_plate():
  learner = sac.make_sac(TASK, seed=0)
  held_out = sac.held_out_worlds(TASK, 64)
  assert sac.success_rate(learner, held_out) < 0.1
  learner.learn(30_720)
  assert sac.success_rate(learner, held_out) >= 0.8
