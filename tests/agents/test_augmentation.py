"""Random shifts and color jitter, compared with loops in NumPy."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.agents.augmentation import augment, jitter_colors, shift_images
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.testing import random_batch

IMAGES = np.random.default_rng(0).integers(0, 256, (3, 5, 12, 16, 3)).astype(np.uint8)
CONFIG = AgentConfig(
  hidden=(8,),
  feature_dim=8,
  patch_channels=2,
  conv_channels=2,
  target_samples=4,
  policy_samples=4,
  epsilon=0.5,
)


def _crops(image: np.ndarray, most: int) -> list[bytes]:
  """Returns all shifts of one image, cropped from a padded one."""
  padded = np.pad(image, ((most, most), (most, most), (0, 0)), "edge")
  height, width = image.shape[:2]
  return [
    padded[row : row + height, column : column + width].tobytes()
    for row in range(2 * most + 1)
    for column in range(2 * most + 1)
  ]


def test_a_shift_is_a_crop_of_a_padded_image():
  found = np.asarray(
    jax.jit(shift_images, static_argnums=2)(jax.random.key(0), IMAGES, 2)
  )
  assert found.shape == IMAGES.shape and found.dtype == np.uint8
  shifts = [
    _crops(image, 2).index(crop.tobytes())
    for image, crop in zip(
      IMAGES.reshape(-1, 12, 16, 3), found.reshape(-1, 12, 16, 3), strict=True
    )
  ]
  assert len(set(shifts)) > 8


def test_all_shifts_are_equally_likely():
  image = np.repeat(IMAGES[0, :1], 2000, axis=0)
  found = np.asarray(
    jax.jit(shift_images, static_argnums=2)(jax.random.key(1), image, 1)
  )
  crops = _crops(IMAGES[0, 0], 1)
  counts = np.bincount([crops.index(crop.tobytes()) for crop in found], minlength=9)
  # The mean is 222, the standard deviation 14.
  assert counts.min() > 160 and counts.max() < 290


def test_jitter_multiplies_each_channel():
  found = np.asarray(jitter_colors(jax.random.key(0), jnp.asarray(IMAGES), 0.25))
  assert found.dtype == np.uint8
  factors = []
  for before, after in zip(
    IMAGES.reshape(-1, 192, 3), found.reshape(-1, 192, 3), strict=True
  ):
    for channel in range(3):
      old, new = before[:, channel].astype(float), after[:, channel].astype(float)
      plain = (new < 255) & (old > 0)
      factor = (old @ (new * plain)) / (old @ (old * plain))
      np.testing.assert_allclose(
        new, np.minimum(np.round(old * factor), 255), atol=1.01
      )
      factors.append(factor)
  assert 0.74 < min(factors) < 0.82 and 1.18 < max(factors) < 1.26
  assert len(np.unique(np.round(factors, 4))) > 40


def test_only_images_change_and_each_independently():
  batch = random_batch(0, 4, pixels=True, windows=3)
  other = augment(jax.random.key(0), batch, shift=3, jitter=0.1)
  assert batch.window is not None and other.window is not None
  for before, after in (
    (batch.observation_tm1, other.observation_tm1),
    (batch.observation_t, other.observation_t),
    (batch.window.timestep.observation, other.window.timestep.observation),
  ):
    for name in ("global_image", "wrist_image"):
      changed = np.not_equal(getattr(before, name), getattr(after, name))
      assert changed.any((-3, -2, -1)).all()
    np.testing.assert_array_equal(before.robot, after.robot)
  plain = lambda b: b.replace(observation_tm1=0, observation_t=0, window=0)  # noqa: E731
  jax.tree.map(np.testing.assert_array_equal, plain(batch), plain(other))
  state = random_batch(0, 4)
  jax.tree.map(
    np.testing.assert_array_equal,
    state,
    augment(jax.random.key(0), state, shift=3, jitter=0.1),
  )


def test_images_of_one_window_change_identically():
  """Three equal instants stay equal but change."""
  batch = random_batch(0, 4, pixels=True, windows=2, lstm_instants=3)
  batch = jax.tree.map(
    lambda x: x[..., :1, :, :, :].repeat(3, -4) if x.dtype == np.uint8 else x, batch
  )
  other = augment(jax.random.key(0), batch, shift=3, jitter=0.1, together=True)
  assert batch.window is not None and other.window is not None
  for before, after in (
    (batch.observation_tm1, other.observation_tm1),
    (batch.observation_t, other.observation_t),
    (batch.window.timestep.observation, other.window.timestep.observation),
  ):
    for name in ("global_image", "wrist_image"):
      old, new = np.asarray(getattr(before, name)), np.asarray(getattr(after, name))
      assert new.shape == old.shape and new.dtype == np.uint8
      assert np.not_equal(old, new).any((-4, -3, -2, -1)).all()
      np.testing.assert_array_equal(new, new[..., :1, :, :, :].repeat(3, -4))


def test_the_learner_augments_images_with_a_key_of_their_own():
  """As if the images had been augmented before, by a key that draws nothing else."""
  batch, key = random_batch(0, 4, pixels=True), jax.random.key(3)
  plain = make_agent(CONFIG)
  jittered = make_agent(dataclasses.replace(CONFIG, color_jitter=0.2))
  state = plain.init(jax.random.key(0), batch.observation_tm1)
  own = jax.random.split(key, 3)[2]
  _, expected = jax.jit(plain.update)(
    state, augment(own, batch, shift=0, jitter=0.2), key
  )
  _, found = jax.jit(jittered.update)(state, batch, key)
  for name, value in expected.items():
    np.testing.assert_allclose(found[name], value, rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("settings", [{"image_shift": 2}, {"color_jitter": 0.2}])
def test_the_learner_augments_images_only_if_configured(settings):
  """Without augmentation its operations are absent from the compiled update."""
  batch = random_batch(0, 4, pixels=True)
  zero = dict.fromkeys(settings, 0)

  def program(config: AgentConfig) -> str:
    agent = make_agent(config)
    state = agent.init(jax.random.key(0), batch.observation_tm1)
    return str(jax.make_jaxpr(agent.update)(state, batch, jax.random.key(0)))

  plain = program(CONFIG)
  assert program(dataclasses.replace(CONFIG, **zero)) == plain
  assert program(dataclasses.replace(CONFIG, **settings)) != plain
