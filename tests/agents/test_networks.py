"""Networks: convolutions, the split value head, the shape of the prior."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any

from flax import linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy import ndimage, optimize, special

from apnpql_jax.agents import encoder, losses
from apnpql_jax.agents.columns.policy_evaluation import Categorical
from apnpql_jax.agents.layers import PositionwiseDense
from apnpql_jax.agents.mixture_head import mixture_from_outputs, one_way_clip
from apnpql_jax.agents.networks import GROUPS, Heads, Networks, make_networks
from apnpql_jax.agents.table_one import algorithm_of
from apnpql_jax.config.checks import IMAGE_FEATURES
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.types import Observation

CONFIG = AgentConfig(
  hidden=(24, 16), feature_dim=20, num_atoms=11, patch_channels=5, conv_channels=6
)


def all_networks(config: AgentConfig = CONFIG) -> Networks:
  """Returns networks with every group, and categorical values."""
  evaluation = Categorical(config)
  head = evaluation.head(config.hidden)
  return make_networks(config, GROUPS, head, evaluation.value)


def observation(batch: int, *, pixels: bool, objects: bool = False) -> Observation:
  rng = np.random.default_rng(0)

  def image(height: int, width: int) -> jax.Array:
    return jnp.asarray(rng.integers(0, 256, (batch, height, width, 3)), jnp.uint8)

  return Observation(
    robot=jnp.asarray(rng.normal(size=(batch, 21)), jnp.float32),
    tool=jnp.asarray(rng.normal(size=(batch, 3)), jnp.float32),
    global_image=image(72, 96) if pixels else None,
    wrist_image=image(36, 64) if pixels else None,
    objects=jnp.asarray(rng.normal(size=(batch, 9)), jnp.float32) if objects else None,
  )


@pytest.mark.parametrize("shape", [(72, 96), (36, 64), (120, 160), (60, 107)])
@pytest.mark.parametrize(
  ("overlap", "standardize"), [(True, False), (False, False), (False, True)]
)
def test_pixel_encoder_is_two_convolutions(
  shape: tuple[int, int], overlap: bool, standardize: bool
):
  height, width = shape
  rng = np.random.default_rng(1)
  image = jnp.asarray(rng.integers(0, 256, (2, height, width, 3)), jnp.uint8)
  module = encoder.PixelEncoder((5, 6), overlap, standardize=standardize)
  (flat, points), variables = module.init_with_output(jax.random.key(0), image)
  params = variables["params"]

  def convolve(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    return jax.lax.conv_general_dilated(
      x, kernel, (stride, stride), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )

  pad = ((0, 0), (0, -height % 8), (0, -width % 8), (0, 0))
  x = jnp.pad(image, pad).astype(jnp.float32) / 255.0
  if standardize:
    x = np.pad(image, pad, mode="edge").astype(np.float64)
    x = (x - x.mean((1, 2), keepdims=True)) / x.std((1, 2), keepdims=True)
    x = jnp.asarray(x, jnp.float32)
  x = convolve(x, params["patches"]["kernel"].reshape(4, 4, 3, 5), 4)
  first = x + params["patches"]["bias"]
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
  second = convolve(jax.nn.relu(first), kernel, 2) + params["conv"]["bias"]
  expected = jax.nn.relu(second).reshape(2, -1)
  np.testing.assert_allclose(flat, expected, rtol=1e-4, atol=1e-5)
  expected = np.concatenate([expected_positions(x) for x in (first, second)], axis=-1)
  np.testing.assert_allclose(points, expected, atol=1e-4)


def test_a_standardized_image_has_no_exposure_and_no_white_balance():
  rng = np.random.default_rng(2)
  image = rng.integers(0, 80, (2, 36, 64, 3), np.uint8)
  other = image * np.array([3, 2, 1], np.uint8) + np.array([0, 60, 170], np.uint8)
  for standardize in (True, False):
    module = encoder.PixelEncoder((5, 6), overlap=True, standardize=standardize)
    params = module.init(jax.random.key(0), image)
    same = np.allclose(
      module.apply(params, image)[0], module.apply(params, other)[0], atol=1e-4
    )
    assert same == standardize


def test_a_positionwise_layer_is_the_dense_layer_of_flax():
  x = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 5, 7)), jnp.float32)
  ours, theirs = PositionwiseDense(6, input_scale=0.5), nn.Dense(6)
  params = theirs.init(jax.random.key(0), x)
  np.testing.assert_array_equal(
    ours.init(jax.random.key(0), x)["params"]["kernel"], params["params"]["kernel"]
  )

  def loss(module: nn.Module, scale: float, params: Any, x: jax.Array) -> jax.Array:
    out: Any = module.apply(params, scale * x)
    return jnp.sum(jnp.sin(out))

  expected = jax.value_and_grad(loss, (2, 3))(theirs, 0.5, params, x)
  found = jax.value_and_grad(loss, (2, 3))(ours, 1.0, params, x)
  for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_residual_blocks_start_as_the_identity_and_add_convolutions():
  rng = np.random.default_rng(0)
  image = jnp.asarray(rng.integers(0, 256, (2, 36, 64, 3)), jnp.uint8)
  plain = encoder.PixelEncoder((5, 6), overlap=True)
  deep = encoder.PixelEncoder((5, 6), overlap=True, residual_blocks=2)
  params = deep.init(jax.random.key(0), image)["params"]
  one = {name: params[name] for name in ("patches", "conv")}
  jax.tree.map(
    np.testing.assert_array_equal,
    deep.apply({"params": params}, image),
    plain.apply({"params": one}, image),
  )

  block = encoder.ResidualBlock(6)
  x = rng.normal(size=(2, 5, 7, 6)).astype(np.float32)
  params = block.init(jax.random.key(0), x)["params"]
  params = jax.tree.map(lambda p: rng.normal(size=p.shape).astype(np.float32), params)
  expected = x.astype(np.float64)
  y = expected
  for layer in ("first", "second"):
    y = same_convolution(np.maximum(y, 0.0), **params[layer])
  actual = block.apply({"params": params}, x)
  np.testing.assert_allclose(np.asarray(actual), expected + y, rtol=1e-4, atol=1e-3)


def same_convolution(x: np.ndarray, kernel: np.ndarray, bias: np.ndarray) -> np.ndarray:
  """Convolves 3x3 with stride 1 and zero padding, by scipy, f64[b, H, W, C or D]."""
  y = np.zeros((*x.shape[:3], kernel.shape[-1])) + bias
  for one, (c, d) in itertools.product(range(len(x)), np.ndindex(kernel.shape[2:])):
    y[one, ..., d] += ndimage.correlate(
      x[one, ..., c], kernel[..., c, d], mode="constant"
    )
  return y


def expected_positions(scores: jax.Array) -> np.ndarray:
  """Maps f32[b, H, W, C] to f64[b, 2 C], by a histogram of each axis."""
  _, height, width, _ = scores.shape
  shares = special.softmax(4.0 * np.asarray(scores, np.float64), axis=(1, 2))
  row = np.einsum("bhwc,h->bc", shares, np.linspace(-1, 1, 2 * height + 1)[1::2])
  column = np.einsum("bhwc,w->bc", shares, np.linspace(-1, 1, 2 * width + 1)[1::2])
  return np.stack([row, column], axis=-1).reshape(len(shares), -1)


def test_an_lstm_reads_what_would_be_phi_of_each_instant():
  plain = all_networks()
  networks = all_networks(dataclasses.replace(CONFIG, lstm_instants=3))
  seen = observation(2 * 3, pixels=True).replace(global_image=None)
  recent = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), seen)
  params = jax.jit(networks.init)(jax.random.key(0), recent)
  lstm = params["encoder"]["lstm"]
  without = {k: v for k, v in params["encoder"].items() if k != "lstm"}
  # Nothing else is new, and nothing else begins elsewhere.
  jax.tree.map(
    np.testing.assert_array_equal,
    params | {"encoder": without},
    jax.jit(plain.init)(jax.random.key(0), seen),
  )
  rng = np.random.default_rng(4)
  lstm = jax.tree.map(lambda x: rng.normal(size=x.shape).astype(np.float32), lstm)
  phi = plain.at(params | {"encoder": without}, seen).phi
  c = h = np.zeros((2, 20))
  for x in np.asarray(phi, np.float64).reshape(2, 3, 20).swapaxes(0, 1):
    i, f, g, o = (
      x @ lstm[f"i{gate}"]["kernel"]
      + h @ lstm[f"h{gate}"]["kernel"]
      + lstm[f"h{gate}"]["bias"]
      for gate in "ifgo"
    )
    c = special.expit(f) * c + special.expit(i) * np.tanh(g)
    h = special.expit(o) * np.tanh(c)
  actual = networks.at(params | {"encoder": without | {"lstm": lstm}}, recent).phi
  np.testing.assert_allclose(actual, h, atol=1e-4)
  with pytest.raises(ValueError, match="do not have 3 instants"):
    networks.at(params, seen)


@pytest.mark.parametrize("parts", [1, 4])
def test_a_keypoint_is_where_its_channel_peaks(parts: int):
  scores = jnp.zeros((3, 4, parts, 2)).at[2, 1, parts - 1, 0].set(100.0)
  points = encoder.keypoints(scores.at[0, 3, 0, 1].set(100.0)).reshape(2, 2)
  # Centers of the cells, or of their last and first quarters.
  off = 0.25 if parts == 4 else 0.0
  expected = [[(2.5 + off) / 1.5 - 1, (1.5 + off) / 2 - 1]]
  expected += [[(0.5 - off) / 1.5 - 1, (3.5 - off) / 2 - 1]]
  np.testing.assert_allclose(points, expected, atol=1e-5)


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


def test_points_are_seen_from_the_tool_in_detail_where_they_are_near():
  rng = np.random.default_rng(0)
  tool, away = rng.normal(size=(2, 5, 3)), rng.normal(0.0, 0.2, (2, 5, 4, 3))
  points = (tool[:, :, None] + away).reshape(2, 5, 12)
  expected = np.tanh(away[..., None] / [0.05, 0.2]).reshape(2, 5, 24)
  seen = encoder.seen_from(jnp.asarray(tool), jnp.asarray(points))
  np.testing.assert_allclose(seen, expected, atol=1e-5)


def test_features_resolve_a_centimeter_near_the_tool():
  networks = all_networks()
  seen = observation(1, pixels=False, objects=True)
  params = jax.jit(networks.init)(jax.random.key(0), seen)

  def phi(offset: float) -> jax.Array:
    """Returns three points on one side of the tool."""
    assert seen.tool is not None
    points = jnp.tile(seen.tool + offset, (1, 3))
    return networks.at(params, seen.replace(objects=points)).phi

  near, far = (jnp.linalg.norm(phi(x + 0.01) - phi(x)) for x in (0.0, 0.4))
  assert near > 2.0 * far > 0.0


@pytest.mark.parametrize(
  "pixels, objects", [(True, False), (False, True), (True, True)]
)
def test_outputs_have_the_declared_shapes(pixels: bool, objects: bool):
  networks = all_networks()

  def look(seen: Observation) -> Any:
    params = networks.init(jax.random.key(0), seen)
    assert tuple(params) == GROUPS
    heads, actions = networks.at(params, seen), jnp.zeros((9, 4, 7))
    found = heads.phi, heads.primitives(), heads.alpha(), heads.z(actions)
    return (*found, heads.q(actions)), {3: heads.prior(), 1: heads.policy()}

  seen = observation(4, pixels=pixels, objects=objects)
  outputs, mixtures = jax.eval_shape(look, seen)
  shapes = [(4, 20), (4, 3, 7), (4,), (9, 4, 11), (9, 4)]
  assert [output.shape for output in outputs] == shapes
  for num, mixture in mixtures.items():
    assert mixture.loc.shape == (4, num, 6)
    assert mixture.scale_tril.shape == (4, num, 6, 6)
    assert mixture.logits.shape == mixture.gripper_logits.shape == (4, num)


@pytest.mark.parametrize(
  "changed", ["robot", "tool", "global_image", "wrist_image", "objects"]
)
@pytest.mark.parametrize("kind", IMAGE_FEATURES)
def test_features_depend_on_every_modality(changed: str, kind: str):
  config = dataclasses.replace(CONFIG, global_features=kind, wrist_features=kind)
  networks = all_networks(config)
  seen = observation(2, pixels=True, objects=True)
  params = jax.jit(networks.init)(jax.random.key(0), seen)
  other = seen.replace(**{changed: getattr(seen, changed) // 2})
  assert np.any(networks.at(params, seen).phi != networks.at(params, other).phi)


def test_value_head_is_a_plain_network_of_features_and_action():
  networks = all_networks()
  params = jax.jit(networks.init)(jax.random.key(0), observation(3, pixels=False))
  rng = np.random.default_rng(2)
  phi = jnp.asarray(rng.normal(size=(3, 20)), jnp.float32)
  actions = jnp.asarray(rng.uniform(-1.0, 1.0, (5, 3, 7)), jnp.float32)
  actions = actions.at[..., -1].set(
    jnp.asarray(rng.integers(0, 2, (5, 3)), jnp.float32)
  )
  z = jax.tree.map(lambda x: np.asarray(x, np.float64), params["z"])
  centered = np.asarray(actions) * np.array([1.0] * 6 + [2.0]) - np.array(
    [0.0] * 6 + [1.0]
  )
  both = np.concatenate([np.broadcast_to(phi, (5, 3, 20)), centered], axis=-1)
  kernel = np.concatenate([z["phi"]["kernel"], z["action"]["kernel"]])
  x = np.maximum(both @ kernel + z["phi"]["bias"], 0.0)
  x = np.maximum(x @ z["Dense_0"]["kernel"] + z["Dense_0"]["bias"], 0.0)
  expected = x @ z["out"]["kernel"] + z["out"]["bias"]
  ours = Heads(networks, params, phi, None).z(actions)
  np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("algorithm", ["ap_npql", "sac"])
def test_bfloat16_candidates_have_nearly_the_values_of_float32(algorithm: str):
  config = dataclasses.replace(CONFIG, algorithm=algorithm, hidden=(64, 64))
  evaluation = algorithm_of(config).policy_evaluation(config)
  head = evaluation.head(config.hidden)
  networks = make_networks(config, ("encoder", "z"), head, evaluation.value)
  seen = observation(4, pixels=False)
  params = networks.init(jax.random.key(0), seen)
  # Spread the values as training does; fresh heads value all actions alike.
  rng = np.random.default_rng(0)
  params["z"] = jax.tree.map(
    lambda x: x + jnp.asarray(0.2 * rng.normal(size=x.shape), x.dtype), params["z"]
  )
  heads = networks.at(params, seen)
  actions = jnp.asarray(rng.uniform(-1.0, 1.0, (30, 4, 7)), jnp.float32)
  exact = heads.q(actions)
  rounded = networks.value(heads.z(actions, precision="bfloat16"))
  error, spread = jnp.abs(rounded - exact), jnp.ptp(exact)
  assert 0.0 < error.max() < 0.01 * spread
  # Policies with a reverse KL follow the slope of Q.
  exact, rounded = (
    jax.grad(lambda a, p=p: networks.value(heads.z(a, precision=p)).sum())(actions)
    for p in ("float32", "bfloat16")
  )
  error = jnp.linalg.norm(rounded - exact, axis=-1)
  assert jnp.median(error / jnp.linalg.norm(exact, axis=-1)) < 0.02


def test_fresh_networks_predict_the_configured_start():
  config = dataclasses.replace(CONFIG, initial_alpha=0.3, initial_value=0.2)
  heads = fresh_heads(config)
  np.testing.assert_allclose(heads.alpha(), 0.3, atol=0.02)
  np.testing.assert_allclose(heads.q(jnp.zeros((1, 8, 7))), 0.2, atol=0.02)
  expected = np.broadcast_to(config.initial_std * np.eye(6), (8, 3, 6, 6))
  np.testing.assert_allclose(heads.prior().scale_tril, expected, atol=0.02)
  expected = np.broadcast_to(config.policy_initial_std * np.eye(6), (8, 1, 6, 6))
  np.testing.assert_allclose(heads.policy().scale_tril, expected, atol=0.02)
  np.testing.assert_allclose(heads.policy().loc, 0.0, atol=0.05)


def fresh_heads(config: AgentConfig) -> Heads:
  """Returns untrained networks at eight states."""
  networks, seen = all_networks(config), observation(8, pixels=False)
  return networks.at(jax.jit(networks.init)(jax.random.key(0), seen), seen)


@pytest.mark.parametrize(("mode", "values"), [("state", 8), ("shared", 1)])
def test_one_temperature_is_for_each_state_or_for_all(mode: str, values: int):
  heads = fresh_heads(dataclasses.replace(CONFIG, temperature=mode))
  moved = jax.tree.map(lambda x: x + 0.5, heads.params["alpha"])
  alpha = dataclasses.replace(heads, params={**heads.params, "alpha": moved}).alpha()
  assert len(np.unique(alpha)) == values
  assert np.all(alpha > heads.alpha() + 0.01)


def test_a_fixed_temperature_reads_no_parameter():
  config = dataclasses.replace(CONFIG, temperature="fixed", initial_alpha=0.25)
  heads = dataclasses.replace(fresh_heads(config), params={})
  np.testing.assert_allclose(heads.alpha(), 0.25 + config.min_alpha, rtol=1e-6)


@pytest.mark.parametrize("epsilon", [0.5, 30.0])
@pytest.mark.parametrize("start", [-22.0, 3.0])
def test_a_clipped_alpha_finds_the_minimum_of_its_dual(epsilon: float, start: float):
  """From either side of the minimum, and where the floor is the minimum."""
  q = jnp.asarray(np.random.default_rng(0).uniform(size=(64, 8)), jnp.float32)
  config = dataclasses.replace(CONFIG, temperature="shared", alpha_floor="clip")
  heads = fresh_heads(config)

  def dual(alpha: jax.Array) -> jax.Array:
    return jnp.mean(losses.alpha_loss(q, alpha, epsilon=epsilon))

  def loss(raw: jax.Array) -> jax.Array:
    params = {**heads.params, "alpha": {"value": raw}}
    return dual(dataclasses.replace(heads, params=params).alpha())

  adam = optax.adam(0.02)

  def step(carry: Any, _: Any) -> Any:
    raw, state = carry
    updates, state = adam.update(jax.grad(loss)(raw), state)
    return (raw + updates, state), None

  raw = jnp.full(1, start)
  steps = functools.partial(jax.lax.scan, step, length=10_000)
  (raw, _), _ = jax.jit(steps)((raw, adam.init(raw)))
  params = {**heads.params, "alpha": {"value": raw}}
  found = dataclasses.replace(heads, params=params).alpha()[0]
  exact = optimize.minimize_scalar(
    lambda x: float(dual(jnp.full(8, x))),
    bounds=(config.min_alpha, 10.0),
    method="bounded",
    options={"xatol": 1e-6},
  )
  np.testing.assert_allclose(found, exact.x, rtol=0.02)


def test_alpha_leaves_its_floor_only_if_it_is_clipped():
  for floor, moves in (("softplus", False), ("clip", True)):
    heads = fresh_heads(dataclasses.replace(CONFIG, alpha_floor=floor))
    low = {**heads.params["alpha"]}
    low["out"] = {**low["out"], "bias": jnp.full(1, -22.0)}

    def alpha(head: Any, heads: Heads = heads) -> jax.Array:
      params = {**heads.params, "alpha": head}
      return jnp.sum(dataclasses.replace(heads, params=params).alpha())

    up = jax.grad(lambda head: -alpha(head))(low)["out"]["bias"]
    down = jax.grad(alpha)(low)["out"]["bias"]
    np.testing.assert_allclose(alpha(low), 8 * CONFIG.min_alpha, rtol=1e-5)
    assert (np.abs(up[0]) > 1e-4) == moves
    assert np.abs(down[0]) < 1e-8


def test_a_learned_mean_is_trained_and_kept_in_the_box():
  heads = fresh_heads(dataclasses.replace(CONFIG, prior_mean="learned"))

  def mean(bias: jax.Array) -> jax.Array:
    head = heads.params["bp"]
    head = {**head, "out": {**head["out"], "bias": bias}}
    return dataclasses.replace(heads, params={**heads.params, "bp": head}).prior().loc

  bias = jnp.zeros(3 * 29)
  assert np.count_nonzero(jax.grad(lambda b: jnp.sum(mean(b)))(bias)) == 18
  assert np.all(mean(bias - 9.0) == -1.0)


def test_diagonal_covariances_are_zero_off_the_diagonal():
  heads = fresh_heads(dataclasses.replace(CONFIG, diagonal_covariance=True))
  for mixture in (heads.prior(), heads.policy()):
    scale = np.asarray(mixture.scale_tril)
    assert np.all(scale == scale * np.eye(6))
    assert np.all(np.diagonal(scale, axis1=-2, axis2=-1) > 0.0)


def test_prior_keeps_its_floors_and_limits():
  rng = np.random.default_rng(3)
  outputs = jnp.asarray(20.0 * rng.normal(size=(200, 3 * 23)), jnp.float32)
  prior = mixture_from_outputs(
    outputs,
    jnp.zeros((200, 3, 7)),
    num=3,
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


def test_without_an_offset_the_gripper_is_that_of_the_primitives():
  rng = np.random.default_rng(4)
  outputs, primitives = rng.normal(size=(20, 3 * 23)), rng.normal(size=(20, 3, 7))
  limits: Any = {"min_std": 0.05, "initial_std": 0.2, "max_std": 0.5, "min_prob": 0.2}
  given = [jnp.asarray(3.0 * x, jnp.float32) for x in (outputs, primitives)]
  with_offset, without = (
    mixture_from_outputs(*given, num=3, gripper_offset=offset, **limits)
    for offset in (True, False)
  )
  expected = np.clip(3.0 * primitives[..., 6], -np.log(4.0), np.log(4.0))
  np.testing.assert_allclose(without.gripper_logits, expected, rtol=1e-5)
  assert np.abs(with_offset.gripper_logits - expected).max() > 1.0
  np.testing.assert_array_equal(with_offset.logits, without.logits)
  np.testing.assert_array_equal(with_offset.scale_tril, without.scale_tril)


@pytest.mark.parametrize(
  ("settings", "learned"),
  [
    ({}, False),
    ({"gripper_offset": True}, True),
    ({"prior_mean": "learned"}, True),
  ],
)
def test_the_setting_decides_whether_the_prior_learns_its_gripper(settings, learned):
  networks = all_networks(dataclasses.replace(CONFIG, **settings))
  seen = observation(4, pixels=False)
  params = jax.jit(networks.init)(jax.random.key(0), seen)

  def first(bp):
    prior = networks.at({**params, "bp": bp}, seen).prior()
    return prior.gripper_logits[0, 0]

  slope = jax.grad(first)(params["bp"])["out"]["bias"]
  assert bool(np.any(slope)) == learned


def test_without_grippers_of_primitives_only_the_m_step_closes_the_hand():
  networks = all_networks(
    dataclasses.replace(CONFIG, primitive_gripper=False, gripper_offset=True)
  )
  seen = observation(4, pixels=False)
  params = jax.jit(networks.init)(jax.random.key(0), seen)
  params["ap"]["out"]["bias"] = jnp.linspace(-4.0, 4.0, 21)
  close = np.asarray(networks.at(params, seen).prior().gripper_logits)
  assert np.abs(close).max() < 0.1  # A fresh head of the M-step.
  outputs = params["bp"]["out"]["bias"].reshape(3, -1).at[:, -1].add(2.0)
  params["bp"]["out"]["bias"] = outputs.ravel()
  closing = networks.at(params, seen).prior().gripper_logits
  np.testing.assert_allclose(closing, close + 2.0, atol=1e-5)


@pytest.mark.parametrize("instants", [0, 3])
def test_true_primitives_replace_the_predicted_ones_in_the_prior(instants: int):
  networks = all_networks(dataclasses.replace(CONFIG, lstm_instants=instants))
  rng, batch = np.random.default_rng(5), (4, instants) if instants else (4,)
  true = jnp.asarray(rng.uniform(-1.0, 1.0, (*batch, 3, 7)), jnp.float32)
  true = true.at[..., 6].set(rng.integers(0, 2, (*batch, 3)))
  seen = Observation(
    robot=jnp.zeros((*batch, 21)), tool=jnp.zeros((*batch, 3)), primitives=true
  )
  heads = networks.at(jax.jit(networks.init)(jax.random.key(0), seen), seen)
  newest = true[:, -1] if instants else true
  prior, least = heads.prior(), CONFIG.min_prob
  np.testing.assert_array_equal(prior.loc, newest[..., :6])
  closes = jax.nn.sigmoid(prior.gripper_logits)
  np.testing.assert_allclose(
    closes, np.clip(newest[..., 6], least, 1 - least), atol=1e-3
  )
  assert np.abs(heads.primitives()).max() < 0.1  # Those of a fresh head.


def test_a_limit_lets_the_gradient_back_in():
  x = jnp.array([-3.0, -1.0, 0.5, 1.0, 3.0])
  np.testing.assert_array_equal(
    one_way_clip(x, -1.0, 1.0), jnp.array([-1.0, -1.0, 0.5, 1.0, 1.0])
  )
  pull = jax.vjp(lambda x: one_way_clip(x, -1.0, 1.0), x)[1]
  # Descent goes against the gradient: a positive one leads down.
  np.testing.assert_array_equal(pull(jnp.ones(5))[0], [0, 0, 1, 1, 1])
  np.testing.assert_array_equal(pull(-jnp.ones(5))[0], [-1, -1, -1, 0, 0])


def test_prior_is_centered_on_the_primitives_within_the_action_box():
  networks = all_networks()
  seen = observation(4, pixels=False)
  params = jax.jit(networks.init)(jax.random.key(0), seen)
  params["ap"]["out"]["bias"] = jnp.linspace(-4.0, 4.0, 21)
  heads = networks.at(params, seen)
  primitives, prior = np.asarray(heads.primitives()), heads.prior()
  expected = np.clip(primitives[..., :6], -1.0, 1.0)
  np.testing.assert_array_equal(prior.loc, expected)
  assert np.abs(expected).max() == 1.0
  surest = np.log((1 - CONFIG.min_prob) / CONFIG.min_prob)
  expected = np.clip(primitives[..., 6], -surest, surest)
  np.testing.assert_allclose(prior.gripper_logits, expected, atol=0.02)
  assert expected.max() == pytest.approx(surest)
