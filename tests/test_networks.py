"""Networks: convolutions, the split value head, the shape of the prior."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.agents import encoder
from apnpql_jax.agents.networks import GROUPS, make_networks
from apnpql_jax.agents.prior import one_way_clip, prior_from_outputs
from apnpql_jax.config import AgentConfig
from apnpql_jax.types import Observation

CONFIG = AgentConfig(
  hidden=(24, 16), feature_dim=20, num_atoms=11, patch_channels=5, conv_channels=6
)


def observation(batch: int, *, pixels: bool, objects: bool = False) -> Observation:
  rng = np.random.default_rng(0)

  def image(height: int, width: int) -> jax.Array:
    return jnp.asarray(rng.integers(0, 256, (batch, height, width, 3)), jnp.uint8)

  return Observation(
    robot=jnp.asarray(rng.normal(size=(batch, 21)), jnp.float32),
    global_image=image(72, 96) if pixels else None,
    wrist_image=image(36, 64) if pixels else None,
    objects=jnp.asarray(rng.normal(size=(batch, 9)), jnp.float32) if objects else None,
  )


@pytest.mark.parametrize("shape", [(72, 96), (36, 64), (120, 160)])
@pytest.mark.parametrize("overlap", [True, False])
def test_pixel_encoder_is_two_convolutions(shape: tuple[int, int], overlap: bool):
  height, width = shape
  rng = np.random.default_rng(1)
  image = jnp.asarray(rng.integers(0, 256, (2, height, width, 3)), jnp.uint8)
  module = encoder.PixelEncoder((5, 6), overlap)
  ours, variables = module.init_with_output(jax.random.key(0), image)
  params = variables["params"]

  def convolve(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    return jax.lax.conv_general_dilated(
      x, kernel, (stride, stride), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )

  pad = ((0, 0), (0, -height % 8), (0, -width % 8), (0, 0))
  x = jnp.pad(image, pad).astype(jnp.float32) / 255.0
  x = convolve(x, params["patches"]["kernel"].reshape(4, 4, 3, 5), 4)
  x = jax.nn.relu(x + params["patches"]["bias"].reshape(1, 1, 1, -1))
  rows = params["conv"]["kernel"].reshape(-1, 5, 6)
  if overlap:
    # Window positions in the order in which ``windows`` stacks them.
    places = [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (1, 2), (2, 0), (2, 1), (2, 2)]
    kernel = jnp.zeros((3, 3, 5, 6))
  else:
    places = [(0, 0), (0, 1), (1, 0), (1, 1)]
    kernel = jnp.zeros((2, 2, 5, 6))
  for place, row in zip(places, rows, strict=True):
    kernel = kernel.at[place].set(row)
  x = jax.nn.relu(convolve(x, kernel, 2) + params["conv"]["bias"].reshape(1, 1, 1, -1))
  np.testing.assert_allclose(ours, x.reshape(2, -1), rtol=1e-4, atol=1e-5)


def test_space_to_depth_of_numbered_pixels():
  image = jnp.arange(2 * 4 * 3).reshape(1, 4, 6, 1)
  cells = encoder.space_to_depth(image, 2)
  assert cells.shape == (1, 2, 3, 4)
  np.testing.assert_array_equal(cells[0, 1, 2], [16, 17, 22, 23])


def test_robot_inputs_hold_the_newest_state_and_the_changes():
  stack = jnp.stack([jnp.full(7, x) for x in (0.1, 0.3, 0.6)]).reshape(-1)
  inputs = encoder.robot_inputs(stack)
  np.testing.assert_allclose(inputs[:7], 0.6, rtol=1e-6)
  np.testing.assert_allclose(inputs[7:13], np.sin(0.6), rtol=1e-6)
  np.testing.assert_allclose(inputs[13:19], np.cos(0.6), rtol=1e-6)
  np.testing.assert_allclose(inputs[19:26], 7.0 * 0.2, rtol=1e-5)
  np.testing.assert_allclose(inputs[26:], 7.0 * 0.3, rtol=1e-5)


@pytest.mark.parametrize(
  "pixels, objects", [(True, False), (False, True), (True, True)]
)
def test_outputs_have_the_declared_shapes(pixels: bool, objects: bool):
  networks = make_networks(CONFIG)
  seen = observation(4, pixels=pixels, objects=objects)
  params = networks.init(jax.random.key(0), seen)
  assert tuple(params) == GROUPS
  phi = networks.features(params, seen)
  assert phi.shape == (4, 20)
  assert networks.primitives(params, phi).shape == (4, 3, 7)
  assert networks.alpha(params, phi).shape == (4,)
  assert networks.q_logits(params, phi, jnp.zeros((9, 4, 7))).shape == (9, 4, 11)
  prior = networks.prior(params, phi)
  assert prior.mean.shape == (4, 3, 6)
  assert prior.scale_tril.shape == (4, 3, 6, 6)
  assert prior.logits.shape == prior.gripper_logits.shape == (4, 3)


@pytest.mark.parametrize("changed", ["robot", "global_image", "wrist_image"])
def test_features_depend_on_every_modality(changed: str):
  networks = make_networks(CONFIG)
  seen = observation(2, pixels=True)
  params = networks.init(jax.random.key(0), seen)
  other = seen.replace(**{changed: getattr(seen, changed) // 2})
  assert np.any(networks.features(params, seen) != networks.features(params, other))


def test_value_head_is_a_plain_network_of_features_and_action():
  networks = make_networks(CONFIG)
  params = networks.init(jax.random.key(0), observation(3, pixels=False))
  rng = np.random.default_rng(2)
  phi = jnp.asarray(rng.normal(size=(3, 20)), jnp.float32)
  actions = jnp.asarray(rng.uniform(-1.0, 1.0, (5, 3, 7)), jnp.float32)
  actions = actions.at[..., -1].set(
    jnp.asarray(rng.integers(0, 2, (5, 3)), jnp.float32)
  )
  z = jax.tree.map(lambda x: np.asarray(x, np.float64), params["z"])
  centred = np.asarray(actions) * np.array([1.0] * 6 + [2.0]) - np.array(
    [0.0] * 6 + [1.0]
  )
  both = np.concatenate([np.broadcast_to(phi, (5, 3, 20)), centred], axis=-1)
  kernel = np.concatenate([z["phi"]["kernel"], z["action"]["kernel"]])
  x = np.maximum(both @ kernel + z["phi"]["bias"], 0.0)
  x = np.maximum(x @ z["Dense_0"]["kernel"] + z["Dense_0"]["bias"], 0.0)
  expected = x @ z["out"]["kernel"] + z["out"]["bias"]
  ours = networks.q_logits(params, phi, actions)
  np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-5)


def test_fresh_networks_predict_the_configured_start():
  config = dataclasses.replace(CONFIG, initial_alpha=0.3, initial_value=0.2)
  networks = make_networks(config)
  seen = observation(8, pixels=False)
  params = networks.init(jax.random.key(0), seen)
  phi = networks.features(params, seen)
  np.testing.assert_allclose(networks.alpha(params, phi), 0.3, atol=0.02)
  logits = networks.q_logits(params, phi, jnp.zeros((1, 8, 7)))
  values = jax.nn.softmax(logits) @ networks.atoms
  np.testing.assert_allclose(values, 0.2, atol=0.02)
  prior = networks.prior(params, phi)
  expected = np.broadcast_to(config.initial_std * np.eye(6), (8, 3, 6, 6))
  np.testing.assert_allclose(prior.scale_tril, expected, atol=0.02)


def test_prior_keeps_its_floors_and_limits():
  rng = np.random.default_rng(3)
  outputs = jnp.asarray(20.0 * rng.normal(size=(200, 3 * 23)), jnp.float32)
  prior = prior_from_outputs(
    outputs,
    jnp.zeros((200, 3, 6)),
    jnp.zeros((200, 3)),
    min_std=0.05,
    initial_std=0.2,
    max_std=0.5,
    min_prob=0.05,
  )
  scale = np.asarray(prior.scale_tril, np.float64)
  std = np.sqrt(np.diagonal(scale @ scale.swapaxes(-1, -2), axis1=-2, axis2=-1))
  assert std.min() == pytest.approx(0.05, abs=1e-4)
  assert std.max() == pytest.approx(0.5, abs=1e-4)
  assert not np.any(np.triu(scale, k=1))
  below = scale[:, :, *np.tril_indices(6, k=-1)]
  assert np.all(below != 0.0)
  # No joint is determined by the others: what remains free of it is bounded below.
  free = np.diagonal(scale, axis1=-2, axis2=-1) / std
  assert free.min() > 1.0 / np.sqrt(6.0) - 1e-4
  weights = np.exp(prior.logits)
  np.testing.assert_allclose(weights.sum(-1), 1.0, atol=1e-5)
  # One at the floor, one or both others at the limit.
  one, both = 0.05, 0.05 / 0.9 / (2 + 0.05 / 0.9)
  assert weights.min() == pytest.approx(both, abs=1e-3)
  ranked = np.sort(weights, axis=-1)
  two_at_floor = ranked[np.isclose(ranked[:, 0], ranked[:, 1]) & (ranked[:, 2] > 0.8)]
  assert two_at_floor.min() == pytest.approx(one, abs=1e-3)
  close = jax.nn.sigmoid(prior.gripper_logits)
  assert close.min() == pytest.approx(0.05, abs=1e-3)
  assert close.max() == pytest.approx(0.95, abs=1e-3)


def test_a_limit_lets_the_gradient_back_in():
  x = jnp.array([-3.0, -1.0, 0.5, 1.0, 3.0])
  np.testing.assert_array_equal(
    one_way_clip(x, -1.0, 1.0), jnp.array([-1.0, -1.0, 0.5, 1.0, 1.0])
  )
  pull = jax.vjp(lambda x: one_way_clip(x, -1.0, 1.0), x)[1]
  # Descent goes against the gradient: a positive one leads down.
  np.testing.assert_array_equal(pull(jnp.ones(5))[0], [0, 0, 1, 1, 1])
  np.testing.assert_array_equal(pull(-jnp.ones(5))[0], [-1, -1, -1, 0, 0])


def test_prior_is_centred_on_the_primitives_within_the_action_box():
  networks = make_networks(CONFIG)
  seen = observation(4, pixels=False)
  params = networks.init(jax.random.key(0), seen)
  params["ap"]["out"]["bias"] = jnp.linspace(-4.0, 4.0, 21)
  phi = networks.features(params, seen)
  primitives = np.asarray(networks.primitives(params, phi))
  expected = np.clip(primitives[..., :6], -1.0, 1.0)
  prior = networks.prior(params, phi)
  np.testing.assert_array_equal(prior.mean, expected)
  assert np.abs(expected).max() == 1.0
  surest = np.log((1 - CONFIG.min_prob) / CONFIG.min_prob)
  expected = np.clip(primitives[..., 6], -surest, surest)
  np.testing.assert_allclose(prior.gripper_logits, expected, atol=0.02)
  assert expected.max() == pytest.approx(surest)
