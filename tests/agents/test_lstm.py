"""Learner with an LSTM: it remembers what earlier instants showed."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.data import replay
from apnpql_jax.data.replay import Replay
from apnpql_jax.testing import random_batch
from apnpql_jax.types import Observation, Slot, TimeStep

CONFIG = AgentConfig(
  n_step=1,
  learning_rate_e=1e-3,
  hidden=(32,),
  feature_dim=32,
  patch_channels=2,
  conv_channels=2,
  target_samples=4,
  policy_samples=4,
)


def call(function: Callable, *args: Any) -> Any:
  """Returns the result of ``function``, compiled without optimization for one call."""
  lowered: Any = jax.jit(function).lower(*args)
  return lowered.compile()(*args)


def episodes(steps: int = 64, worlds: int = 16) -> Replay:
  """Returns episodes of four instants, whose first shows the labels of all four."""
  rng = np.random.default_rng(0)
  cue = rng.choice([-1.0, 1.0], (steps // 4, worlds)).astype(np.float32).repeat(4, 0)
  instant = np.broadcast_to(np.arange(steps)[:, None] % 4, cue.shape)
  timestep = TimeStep(
    observation=Observation(
      robot=jnp.zeros((*cue.shape, 21)),
      objects=jnp.asarray(np.where(instant == 0, cue, 0.0)[..., None]),
    ),
    reward=jnp.zeros(cue.shape),
    terminated=jnp.zeros(cue.shape, bool),
    truncated=jnp.asarray(instant == 3),
    primitives=jnp.broadcast_to(0.5 * cue[..., None, None], (*cue.shape, 3, 7)),
  )
  slots = Slot(timestep, jnp.zeros((*cue.shape, 7)), jnp.zeros(cue.shape))
  example = jax.tree.map(lambda x: x[0, 0], slots)
  return replay.add(replay.create(example, steps, worlds), slots)


def error_after_learning(instants: int) -> float:
  """Returns the error of the primitives (rad/s) over the last 20 of 400 updates."""
  agent = make_agent(dataclasses.replace(CONFIG, lstm_instants=instants))
  ring = episodes()
  draw = functools.partial(
    replay.sample, ring, batch_size=32, n_step=1, gamma=0.9, lstm_instants=instants
  )

  def update(state, key):
    return agent.update(state, draw(key), key)

  def learn(key):
    state = agent.init(key, draw(key).observation_tm1)
    return jax.lax.scan(update, state, jax.random.split(key, 400))[1]

  metrics = call(learn, jax.random.key(0))
  assert all(np.isfinite(x).all() for x in metrics.values())
  return float(metrics["ap/error"][-20:].mean())


def test_only_an_lstm_remembers_what_the_first_instant_showed():
  assert error_after_learning(3) < 0.05
  # Two of the three instants at which a transition starts show nothing, so that any
  # guess there is off by 0.5 on average.
  assert error_after_learning(0) > 0.28


def test_an_update_from_images_of_several_instants_trains_the_lstm():
  """Retrace evaluates the networks at each instant of a window."""
  config = dataclasses.replace(
    CONFIG, lstm_instants=2, policy_evaluation="retrace", image_shift=2
  )
  agent = make_agent(config)
  batch = random_batch(0, 4, pixels=True, windows=3, lstm_instants=2)
  with jax.numpy_rank_promotion("raise"):
    state = call(agent.init, jax.random.key(0), batch.observation_tm1)
    after, metrics = call(agent.update, state, batch, jax.random.key(1))
  assert all(np.isfinite(x) for x in metrics.values())
  moved = jax.tree.map(
    lambda a, b: np.any(a != b), after.params["encoder"], state.params["encoder"]
  )
  assert all(jax.tree.leaves((moved["lstm"], moved["wrist_image"])))
