"""Batches of noise with the shapes of a training."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.training.iteration import make_sample
from apnpql_jax.training.state import example_state
from apnpql_jax.types import Array, Transition


def transitions(config: TrainConfig) -> Transition:
  """Draws the batch of one update: images, flags and numbers within [0, 1)."""
  env = make_env(config.env, lstm_instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  state = example_state(config, env, agent)
  sample = make_sample(config, agent)
  batch = jax.eval_shape(sample, state.replay, state.expert_replay, state.key)
  rng = np.random.default_rng(0)

  def draw(x: Any) -> Array:
    if jnp.issubdtype(x.dtype, jnp.floating):
      return jnp.asarray(rng.random(x.shape), x.dtype)
    most = 256 if x.dtype == jnp.uint8 else 2
    return jnp.asarray(rng.integers(0, most, x.shape), x.dtype)

  return jax.tree.map(draw, batch)
