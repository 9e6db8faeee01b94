"""The batch of worlds: reset, step, time limit, automatic reset, observations."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import AgentConfig, EnvConfig
from apnpql_jax.data import replay
from apnpql_jax.envs.env import Env, make_env, observation_shapes
from apnpql_jax.envs.state import Arrival, EnvState
from apnpql_jax.errors import ConfigError
from apnpql_jax.primitives import tracking
from apnpql_jax.sim import arm
from apnpql_jax.training import evaluate
from apnpql_jax.training.evaluate import play_held_out
from apnpql_jax.training.rollout import (
  FILMED,
  agent_policy,
  example_slot,
  expert_policy,
  make_player,
  rollout,
)
from apnpql_jax.types import Observation, TimeStep

CONFIG = EnvConfig(obs="state", backend="native", worlds=16, bank_rows=256)
SHORT = dataclasses.replace(CONFIG, time_limit_s=0.45)


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(CONFIG)


@pytest.fixture(scope="module")
def pixel_chunk(env) -> TimeStep:
  """Plays twelve periods of the expert in four worlds, with images of both cameras."""
  pixels = Env(dataclasses.replace(CONFIG, obs="pixels"), env.task, env._bank)
  states = [pixels.reset(jnp.arange(4))]
  for key in jax.random.split(jax.random.key(0), 11):
    states.append(pixels.step(states[-1], pixels.expert_action(states[-1]), key))
  return jax.tree.map(lambda *x: np.stack(x), *(state.timestep for state in states))


@pytest.mark.parametrize(
  ("setting", "words"),
  [
    ({"task": "juggle"}, "choose from .*push_plate"),
    ({"obs": "State"}, "env.obs 'State'; choose from pixels, state"),
    ({"time_limit_s": 0.1}, "env.time_limit_s=0.1 .* at least 0.15"),
    ({"control_period_s": 0.1501}, "env.control_period_s=0.1501 must be a multiple"),
  ],
)
def test_wrong_settings_are_rejected_before_the_bank_is_built(
  setting, words, monkeypatch, tmp_path
):
  monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
  with pytest.raises(ConfigError, match=words):
    make_env(dataclasses.replace(CONFIG, **setting))
  assert not any(tmp_path.iterdir())


def test_held_out_rows_are_never_trained_on(env):
  """Where an episode is over, the next one starts from any of the other rows."""
  assert env.bank_split == 192 and env.held_out == 64
  state, action = env.reset(jnp.arange(16)), jnp.zeros((16, 7))
  over = state.replace(timestep=state.timestep.replace(truncated=jnp.ones(16, bool)))
  keys = jax.random.split(jax.random.key(0), 150)
  starts = [np.asarray(env.advance(over, action, key).physics.qpos) for key in keys]
  same = (np.concatenate(starts)[:, None] == np.asarray(env._bank.qpos)).all(-1)
  assert (same.sum(-1) == 1).all()
  np.testing.assert_array_equal(np.unique(same.argmax(-1)), np.arange(192))


@pytest.mark.parametrize("noise", [0.1, 0.0])
def test_density_of_the_expert_is_that_of_its_noise(env, noise: float):
  """Without noise it is far higher than that of any other policy."""
  state = env.reset(jnp.arange(16))
  policy = jax.jit(expert_policy(env, noise=noise))
  action, log_prob = policy(state, jax.random.key(0))
  mean = jax.jit(env.expert_action)(state)[..., :6]
  expected = stats.norm.logpdf(action[..., :6], mean, max(noise, 1e-6)).sum(-1)
  np.testing.assert_allclose(log_prob, expected, rtol=1e-3)
  assert np.all(np.asarray(log_prob) > 60.0) == (noise == 0.0)


def test_the_action_of_the_expert_is_a_label_where_it_is_imitated(env):
  labeled = Env(env.config, env.task, env._bank, label_expert=True)
  state = labeled.reset(jnp.arange(4))
  np.testing.assert_array_equal(state.timestep.expert, env.expert_action(state))
  assert env.reset(jnp.arange(4)).timestep.expert is None


def test_static_targets_do_not_follow_a_plate_that_moves(env):
  """The labels lead to where the plate was; the expert still acts on where it is."""
  static = Env(
    dataclasses.replace(CONFIG, static_targets=True),
    env.task,
    env._bank,
    label_expert=True,
  )
  rows, joints = jnp.arange(8), env.task.scene.arm_qpos
  at, _ = env.task.scene.free_joint("plate")
  follows, stays = (worlds.reset(rows) for worlds in (env, static))

  def moved(worlds: Env, state: EnvState) -> EnvState:
    qpos = state.physics.qpos.at[:, at].add(0.05)
    physics = state.physics.replace(qpos=qpos)
    same = jnp.zeros(8, bool)
    return worlds.observe(Arrival.after(state, physics, state.targets, same))

  follows, stays = moved(env, follows), moved(static, stays)
  q = stays.physics.qpos[:, None, joints]
  expected = tracking.follow(env._bank.targets[rows], q)
  labels = stays.timestep.primitives
  np.testing.assert_allclose(labels[..., :6], expected, atol=1e-5)
  np.testing.assert_array_equal(labels[..., 6], follows.timestep.primitives[..., 6])
  moving = follows.timestep.primitives
  assert np.abs(labels - moving).max() > 0.02
  np.testing.assert_allclose(static.moving_primitives(stays), moving, atol=1e-3)
  expert = env.expert_action(follows)
  np.testing.assert_allclose(static.expert_action(stays), expert, atol=1e-3)
  assert stays.timestep.expert is not None
  np.testing.assert_allclose(stays.timestep.expert, expert, atol=1e-3)


def test_true_primitives_are_observed_if_wanted(env):
  config = dataclasses.replace(CONFIG, true_primitives=True)
  timestep = Env(config, env.task, env._bank).reset(jnp.arange(4)).timestep
  np.testing.assert_array_equal(timestep.observation.primitives, timestep.primitives)
  assert env.reset(jnp.arange(4)).observation.primitives is None
  shapes: Any = observation_shapes(config, env.task, lstm_instants=0)
  assert shapes.primitives.shape == (1, 3, 7)


def test_time_out_truncates_then_resets(env):
  """Three periods, then a terminal instant, then the first instant of a new episode."""
  short = Env(SHORT, env.task, env._bank)
  assert SHORT.episode_steps == 3
  play = jax.jit(
    lambda start, key: rollout(
      short, expert_policy(short, noise=0.0), start, key, length=9
    )
  )
  _, chunk = play(short.reset(jnp.arange(16)), jax.random.key(0))
  step = chunk.timestep
  expected = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], bool)
  np.testing.assert_array_equal(step.truncated, np.tile(expected[:, None], (1, 16)))
  assert not step.terminated.any() and not step.reward.any()
  robot = np.asarray(step.observation.robot)
  # A new episode starts with three equal robot states, from another row.
  np.testing.assert_array_equal(robot[4, :, :7], robot[4, :, 14:])
  assert (np.abs(robot[4] - robot[0]).max(-1) > 1e-3).mean() > 0.8
  # Within an episode the stack shifts by one state per period.
  np.testing.assert_array_equal(robot[1, :, 7:14], robot[0, :, 14:])


def test_the_replay_returns_the_observations_that_the_lstm_acted_on(env):
  """Windows of three instants, in episodes of four."""
  short = Env(SHORT, env.task, env._bank, lstm_instants=3)

  def velocity(observation: Observation) -> jax.Array:
    """Maps observations to f32[b], different for other values or another order."""
    leaves = [x.reshape(len(x), -1) for x in jax.tree.leaves(observation)]
    flat = jnp.concatenate(leaves, axis=1)
    weights = jax.random.normal(jax.random.key(0), flat.shape[1:])
    return jnp.tanh(flat @ weights / 10.0)

  def act(params, observation: Observation, key, *, acting):
    action = jnp.full((16, 7), 0.5).at[:, 0].set(velocity(observation))
    return action, {"log_prob": jnp.zeros(16)}

  agent = dataclasses.replace(make_agent(AgentConfig()), act=act)
  policy = agent_policy(agent, {}, acting="policy")

  @jax.jit
  def play(key):
    start = short.reset(jnp.arange(16))
    _, chunk = rollout(short, policy, start, key, length=10)
    ring = replay.add(replay.create(example_slot(start), 10, 16), chunk)
    return replay.sample(
      ring, key, batch_size=256, n_step=2, gamma=0.9, lstm_instants=3
    )

  batch = play(jax.random.key(0))
  observation = batch.observation_tm1
  np.testing.assert_allclose(velocity(observation), batch.action_tm1[:, 0], atol=1e-4)
  # Transitions start at the first, the second and a later instant of an episode.
  moves = np.diff(observation.robot[..., -7:], axis=1).any(axis=-1)
  kinds = np.unique(moves, axis=0)
  np.testing.assert_array_equal(kinds, [[0, 0], [0, 1], [1, 1]])


@pytest.fixture(scope="module")
def play(env):
  """Plays the expert; the parameter of its policy is its noise."""
  return make_player(env, lambda noise: expert_policy(env, noise=noise))


def test_worlds_are_drawn_by_other_keys_than_rows(env, monkeypatch):
  """``randint`` splits its key in two and draws the rows by both."""
  monkeypatch.setattr(Env, "advance_or_begin", lambda *args: args[-1])
  key = jax.random.key(0)
  found = env.advance(env.reset(jnp.arange(4)), jnp.zeros((4, 7)), key)
  for used in jax.random.split(key):
    assert np.all(found != jax.random.split(used, 4))


def test_evaluation_is_repeatable(env, play):
  first, again, other = (
    play_held_out(env, play, 0.3, episodes=16, seed=seed) for seed in (5, 5, 6)
  )
  same = jax.tree.map(np.array_equal, first, again)
  assert all(jax.tree.leaves(same))
  assert not np.array_equal(first.length, other.length)


def test_every_held_out_row_is_played_before_any_is_repeated(env, play, monkeypatch):
  monkeypatch.setattr(evaluate, "MAX_WORLDS", 16)
  played = play_held_out(env, play, 0.0, episodes=93, seed=5)  # The last turn is short.
  assert len(played.success) == len(played.length) == 93
  rows = (env.bank_split + np.arange(env.held_out)).reshape(-1, 16)
  in_order = [play(0.0, jnp.asarray(turn), jax.random.key(9)) for turn in rows]
  for field in ("success", "length"):
    each = np.concatenate([getattr(episodes, field) for episodes in in_order])
    found = getattr(played, field)[: env.held_out]
    np.testing.assert_array_equal(np.sort(found), np.sort(each))


def test_the_player_matches_a_rollout_from_a_reset(env, play):
  """The player calls ``Env.observe`` at the head of its loop."""
  rows = env.bank_split + jnp.arange(16)
  episodes = play(0.0, rows, jax.random.key(0))
  length = env.config.episode_steps + 1

  @jax.jit
  def stepped(start, key):
    policy = expert_policy(env, noise=0.0)
    return rollout(env, policy, start, key, length=length)[1].timestep

  timestep = stepped(env.reset(rows), jax.random.key(1))
  last = np.asarray(timestep.last).argmax(0)
  np.testing.assert_array_equal(episodes.length, last)
  np.testing.assert_array_equal(
    episodes.success, timestep.terminated[last, np.arange(16)]
  )
  joints = episodes.states.qpos[..., env.task.scene.arm_qpos]
  assert joints.shape[:2] == (length, FILMED)
  for i in range(FILMED):
    instants = slice(last[i] + 1)
    expected = timestep.observation.robot[instants, i, -7:-1]
    np.testing.assert_allclose(joints[instants, i], expected, atol=1e-3)


def test_a_world_that_breaks_has_failed_even_if_its_next_episode_succeeds(env):
  """Every other world breaks in its first period; afterwards the expert plays on."""
  expert = expert_policy(env, noise=0.0)

  def breaking(broken):
    def policy(state, key):
      action, log_prob = expert(state, key)
      poisoned = broken & (state.faults == 0)
      return jnp.where(poisoned[:, None], jnp.nan, action), log_prob

    return policy

  rows, broken = env.bank_split + jnp.arange(16), jnp.arange(16) % 2 == 0
  episodes = make_player(env, breaking)(broken, rows, jax.random.key(0))
  np.testing.assert_array_equal(episodes.success, ~broken)


def test_the_observed_tool_is_where_the_joints_put_it(env):
  state = env.reset(jnp.arange(16))
  observation = state.timestep.observation
  position, _, _ = arm.forward(
    arm.make_chain(env.task.scene), observation.robot[:, -7:-1]
  )
  np.testing.assert_allclose(observation.tool, position, atol=1e-5)


def test_pixels_show_the_task(env, pixel_chunk):
  """Plate and goal appear in their colors, at the right size, and motion is visible."""
  observation = pixel_chunk.observation
  assert observation.global_image.shape == (12, 4, 72, 96, 3)
  assert observation.wrist_image.shape == (12, 4, 36, 64, 3)
  assert observation.global_image.dtype == observation.wrist_image.dtype == np.uint8
  assert observation.objects is None
  image = np.asarray(observation.global_image[0], int)
  red, green, blue = np.moveaxis(image, -1, 0)
  goal = (red > 1.8 * blue).sum((1, 2))
  plate = (blue > 2.5 * red).sum((1, 2))
  assert (goal > 80).all() and (goal < 800).all()
  assert (plate > 40).all() and (plate < 400).all()
  moved = np.abs(image - np.asarray(observation.global_image[-1], int)).max(-1)
  assert ((moved > 20).sum((1, 2)) > 30).all()
