"""MJX keeps only the deepest contacts, which must not change how the tasks behave."""

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
"""Long enough for every expert to solve its task."""

FINGERS = range(6, 10)
"""Their places in qpos."""


@pytest.mark.slow
@pytest.mark.parametrize("name", task_names())
def test_the_limit_does_not_change_a_period(name):
  """At all phases of the expert's episodes: free, gripped, carried, put down."""
  env = make_env(EnvConfig(task=name, backend="native", obs="state", worlds=WORLDS))
  expert = expert_policy(env, noise=ReplayConfig().expert_noise)

  def period(state, key):
    action, _ = expert(state, key)
    return env.step(state, action, key), (state.physics, action)

  keys = jax.random.split(jax.random.key(0), PERIODS)
  start = env.reset(jnp.arange(WORLDS))
  _, played = jax.jit(lambda s: jax.lax.scan(period, s, keys))(start)
  worlds = np.arange(WORLDS)
  state, action = jax.tree.map(lambda x: x[worlds % PERIODS, worlds], played)
  ends = []
  for limit in (None, -1):
    scene = make_task(name).scene
    if limit is not None:
      scene.model.numeric("max_contact_points").data[:] = limit
    engine = engines.make_physics("mjx", scene, substeps=30)
    ends.append(jax.jit(engine.step)(state, action[:, :6], action[:, 6]).qpos)
  # Objects and tool to 0.1 mm. For a light finger that is 1.8e-3 rad, at its pad 57 mm
  # away; the order of the rows alone moves one by 3e-4.
  tolerance = np.where(np.isin(np.arange(scene.model.nq), FINGERS), 1e-3, 1e-4)
  assert np.all(np.abs(ends[0] - ends[1]) < tolerance)
