"""MJX keeps the deepest contacts only: nothing that the tasks do may show it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.config.schema import EnvConfig, ReplayConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.sim import engines
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.training.rollout import expert_policy

WORLDS = 64
PERIODS = 60
"""Within which every expert has done what it came for."""

FINGERS = range(6, 10)
"""Their places in qpos."""


@pytest.mark.slow
@pytest.mark.parametrize("name", task_names())
def test_a_period_goes_as_with_a_slot_for_every_point(name):
  """From instants all over the expert's episodes: free, gripped, carried, put down."""
  env = make_env(EnvConfig(task=name, backend="native", obs="state", worlds=WORLDS))
  expert = expert_policy(env, noise=ReplayConfig().expert_noise)

  def period(state, key):
    action, _ = expert(state, key)
    return env.step(state, action, key), (state.physics, action)

  keys = jax.random.split(jax.random.key(0), PERIODS)
  start = env.reset(jnp.arange(WORLDS))
  _, seen = jax.jit(lambda s: jax.lax.scan(period, s, keys))(start)
  worlds = np.arange(WORLDS)
  state, action = jax.tree.map(lambda x: x[worlds % PERIODS, worlds], seen)
  ends = []
  for limit in (None, -1):
    scene = make_task(name).scene
    if limit is not None:
      scene.model.numeric("max_contact_points").data[:] = limit
    engine = engines.make_physics("mjx", scene, substeps=30)
    ends.append(jax.jit(engine.step)(state, action[:, :6], action[:, 6]).qpos)
  # Objects and tool to 0.1 mm. At its pad, 57 mm away, so much for a light finger is
  # 1.8e-3 rad; the order of the rows alone moves one by 3e-4.
  tolerance = np.where(np.isin(np.arange(scene.model.nq), FINGERS), 1e-3, 1e-4)
  assert np.all(np.abs(ends[0] - ends[1]) < tolerance)
