"""The player: its episodes, what its frames hold, and its actors."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.errors import ConfigError, FileError
from apnpql_jax.sim import arm
from apnpql_jax.viewing.actors import scripted
from apnpql_jax.viewing.player import Player


def test_an_episode_has_all_its_instants(player):
  frames, periods = list(player.episode()), player.actor.env.config.episode_steps
  assert len(frames) == periods + 1 == 5
  times = [frame.time_s for frame in frames]
  np.testing.assert_allclose(times, 0.15 * np.arange(periods + 1), rtol=1e-6)
  assert [frame.last for frame in frames] == [False] * periods + [True]
  assert {frame.episode for frame in frames} == {frames[0].episode}
  again = player.step()
  assert again.time_s == 0.0 and again.episode == frames[0].episode + 1


def test_frames_show_the_images_of_both_cameras_and_the_scene(player):
  env, frame = player.actor.env, player.begin()
  sizes = {name: image.shape[:2] for name, image in frame.images.items()}
  config = env.config
  assert sizes == {"global": config.global_size, "wrist": config.wrist_size} | {
    "wide": (82, 120)
  }
  assert all(
    image.dtype == np.uint8 and image.std() > 0 for image in frame.images.values()
  )


def test_the_action_moves_the_world_and_is_explained(player):
  """The next frame is where ``Env.step`` leads from the explained action."""
  frame = player.begin()
  before, explanation = player._state, frame.explanation
  np.testing.assert_array_equal(frame.action, explanation.action)
  assert any((explanation.candidates == frame.action).all(-1))
  assert len(explanation.weights) == testing.TINY.agent.policy_samples
  np.testing.assert_array_equal(frame.shares, explanation.prior.shares)
  action = jnp.asarray(frame.action)[None]
  after = player.actor.env.step(before, action, jax.random.key(9))
  expected = player.actor.env.poses(after.physics).geom_xpos[0]
  np.testing.assert_allclose(player.step().poses.geom_xpos, expected, atol=1e-5)


def test_tool_paths_lead_to_where_the_primitive_ends(player):
  frame, scene = player.begin(), player.actor.env.task.scene
  tool = frame.poses.site_xpos[scene.tool_site]
  chain = arm.make_chain(scene)
  q = player._state.physics.qpos[0, scene.arm_qpos]
  for path, velocity in zip(
    frame.tool_paths, frame.explanation.primitives[:, :6], strict=True
  ):
    np.testing.assert_allclose(path.positions[0], tool, atol=1e-4)
    # Close by, the tool moves as the Jacobian maps the velocity.
    _, _, jacobian = arm.forward(chain, q)
    ahead = np.asarray(jacobian[:3] @ velocity.clip(-1, 1))
    first = path.positions[1] - path.positions[0]
    cosine = first @ ahead / np.linalg.norm(first) / np.linalg.norm(ahead)
    assert cosine > 0.98
    np.testing.assert_allclose(path.mat @ path.mat.T, np.eye(3), atol=1e-4)
    assert 0.0 <= path.close <= 1.0


def test_equal_seeds_give_equal_episodes(player):
  one, other = (Player(player.actor, seed=3) for _ in range(2))
  first = one.begin()
  np.testing.assert_array_equal(first.poses.geom_xpos, other.begin().poses.geom_xpos)
  np.testing.assert_array_equal(one.step().action, other.step().action)
  assert (one.begin().poses.geom_xpos != first.poses.geom_xpos).any()


def test_checkpoints_can_be_switched(player):
  actor = player.actor
  newest, *older = actor.steps()
  assert actor.step == newest and older
  newer = jax.tree.leaves(actor.params)
  actor.load(older[-1])
  changed = [
    (a != b).any() for a, b in zip(newer, jax.tree.leaves(actor.params), strict=True)
  ]
  assert player.begin().checkpoint == older[-1] and any(changed)
  with pytest.raises(FileError, match="no checkpoint 7"):
    actor.load(7)
  assert actor.step == older[-1]
  actor.load(None)
  assert actor.step == newest


def test_the_expert_solves_its_task_and_shows_the_primitive_it_follows():
  env = dataclasses.replace(testing.TINY.env, task="push_plate")
  frames = list(Player(scripted("expert", env)).episode())
  assert frames[-1].solved and frames[-1].explanation is None
  stages = [frame.stage for frame in frames[:-1]]
  assert stages[0] == 0 and stages[-1] == 1
  for frame in frames:
    np.testing.assert_array_equal(frame.shares, np.eye(3)[frame.stage])


def test_an_unknown_actor_is_rejected():
  with pytest.raises(ConfigError, match="expert, random"):
    scripted("nobody", testing.TINY.env)
